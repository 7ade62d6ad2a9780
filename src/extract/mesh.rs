//! The bare triangle mesh that the stages of this area hand on.

use glam::Vec3A;

/// Shared-vertex triangles. Positions are relative to the grid's origin, in world units.
///
/// Triangles are counter-clockwise seen from outside (where the density is lower); indices are in range.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// `[vertices]`, relative to the grid's origin, world units.
    pub positions: Vec<[f32; 3]>,
    /// `[triangles]`, indices into `positions`.
    pub triangles: Vec<[u32; 3]>,
}

impl TriMesh {
    /// The three corners of triangle `t`.
    pub fn corners(&self, t: usize) -> [Vec3A; 3] {
        self.triangles[t].map(|v| Vec3A::from_array(self.positions[v as usize]))
    }

    /// Normal of triangle `t`, twice its area long, towards the outside.
    pub fn area_normal(&self, t: usize) -> Vec3A {
        let [a, b, c] = self.corners(t);
        (b - a).cross(c - a)
    }

    /// Area of triangle `t`, world units squared.
    pub fn area(&self, t: usize) -> f64 {
        0.5 * f64::from(self.area_normal(t).length())
    }

    /// Enclosed volume by the divergence theorem; only meaningful for a closed mesh.
    pub fn signed_volume(&self) -> f64 {
        let volume = |t: usize| {
            let [a, b, c] = self.corners(t).map(|p| p.as_dvec3());
            a.dot(b.cross(c)) / 6.0
        };
        (0..self.triangles.len()).map(volume).sum()
    }
}

impl TriMesh {
    /// Drops the vertices that no triangle uses, keeping the order of the others. Returns the old index of
    /// each vertex that is left, so that the caller's own columns can follow.
    pub fn drop_unused_vertices(&mut self) -> Vec<u32> {
        let mut new_index = vec![u32::MAX; self.positions.len()];
        for t in &self.triangles {
            for &v in t {
                new_index[v as usize] = 0;
            }
        }
        let kept: Vec<u32> =
            (0..self.positions.len() as u32).filter(|&v| new_index[v as usize] == 0).collect();
        for (new, &old) in kept.iter().enumerate() {
            new_index[old as usize] = new as u32;
        }
        self.positions = kept.iter().map(|&v| self.positions[v as usize]).collect();
        for t in &mut self.triangles {
            *t = t.map(|v| new_index[v as usize]);
        }
        kept
    }
}
