//! What the original looks like to those who must stay close to it.

use glam::Vec3A;

use super::columns::Rows;
use super::measure::Surface;
use super::topology::side;
use crate::extract::TriMesh;

/// Samples of a triangle beside its corners: the middles of its sides and its centre.
const PER_TRIANGLE: u32 = 4;

/// What every step of the work looks at.
pub(super) struct Scene<'a> {
    pub(super) mesh: &'a TriMesh,
    pub(super) rows: &'a Rows,
    /// The original surface.
    pub(super) surface: Surface,
    /// Largest distance, world units.
    pub(super) tolerance: f32,
    /// New triangles are looked at in steps of this length at most, world units.
    pub(super) spacing: f32,
}

impl Scene<'_> {
    /// The samples of an original triangle, but its corners; `sides` says which of its sides it answers for.
    pub(super) fn samples(&self, t: u32, sides: [bool; 3]) -> impl Iterator<Item = u32> {
        let first = self.mesh.positions.len() as u32 + PER_TRIANGLE * t;
        (0..3).filter(move |&k| sides[k as usize]).chain([3]).map(move |k| first + k)
    }

    /// Vertex of the original that a sample is, if it is one.
    pub(super) fn vertex(&self, sample: u32) -> Option<u32> {
        ((sample as usize) < self.mesh.positions.len()).then_some(sample)
    }

    /// Triangle of the original that a sample is from, unless it is a vertex.
    pub(super) fn triangle(&self, sample: u32) -> Option<u32> {
        sample.checked_sub(self.mesh.positions.len() as u32).map(|n| n / PER_TRIANGLE)
    }

    /// Vertices of the original that a sample is, or is between.
    pub(super) fn around(&self, sample: u32) -> Vec<u32> {
        self.triangle(sample).map_or(vec![sample], |t| self.mesh.triangles[t as usize].to_vec())
    }

    pub(super) fn position(&self, v: u32) -> Vec3A {
        Vec3A::from_array(self.mesh.positions[v as usize])
    }

    /// Where a sample is.
    pub(super) fn place(&self, sample: u32) -> Vec3A {
        let Some(n) = sample.checked_sub(self.mesh.positions.len() as u32) else {
            return self.position(sample);
        };
        let t = &self.mesh.triangles[(n / PER_TRIANGLE) as usize];
        match n % PER_TRIANGLE {
            3 => t.iter().map(|&v| self.position(v)).sum::<Vec3A>() / 3.0,
            k => {
                let [a, b] = side(t, k as usize);
                (self.position(a) + self.position(b)) * 0.5
            }
        }
    }

    /// Sides of the original's triangles `old` cross new edges where both are seen along `normal`; there two surfaces that
    /// agree at their vertices differ most. The first of the triangles for which they are too far from each other, and from
    /// the original and from `faces`.
    pub(super) fn far_crossing(
        &self,
        edges: impl Iterator<Item = [Vec3A; 2]>,
        old: &[u32],
        normal: Vec3A,
        faces: &[[Vec3A; 3]],
    ) -> Option<u32> {
        let limit = self.tolerance * self.tolerance;
        for [start, end] in edges {
            let d = end - start;
            let far = |&t: &u32| {
                let corners = self.mesh.corners(t as usize);
                (0..3).any(|k| {
                    let (p, e) = (corners[k], corners[(k + 1) % 3] - corners[k]);
                    let det = d.cross(e).dot(normal);
                    let inside = |x: f32| x * det > 0.0 && x.abs() < det.abs();
                    let (s, u) = ((p - start).cross(e).dot(normal), (p - start).cross(d).dot(normal));
                    if !inside(s) || !inside(u) {
                        return false;
                    }
                    let (new, old) = (start + d * (s / det), p + e * (u / det));
                    new.distance_squared(old) > limit
                        && !(self.surface.is_within(new, self.tolerance)
                            && faces.iter().any(|f| foot(old, *f).1 <= limit))
                })
            };
            if let Some(&t) = old.iter().find(|t| far(t)) {
                return Some(t);
            }
        }
        None
    }

    /// Triangles of the original that samples are from, in rising order.
    pub(super) fn triangles<'b>(&self, samples: impl Iterator<Item = &'b u32>) -> Vec<u32> {
        let mut triangles: Vec<u32> = samples.filter_map(|&s| self.triangle(s)).collect();
        triangles.sort_unstable();
        triangles.dedup();
        triangles
    }

    /// Whether a sample is close enough to a triangle, in place and attributes.
    pub(super) fn fits(&self, sample: u32, triangle: [u32; 3], corners: [Vec3A; 3]) -> bool {
        let (weights, distance) = foot(self.place(sample), corners);
        distance <= self.tolerance * self.tolerance && self.fits_attributes(sample, triangle, weights)
    }

    /// Whether a sample's attributes are close enough to what a triangle interpolates.
    pub(super) fn fits_attributes(&self, sample: u32, triangle: [u32; 3], weights: [f32; 3]) -> bool {
        self.vertex(sample).is_none_or(|v| self.rows.deviation(v, triangle, weights) <= 1.0)
    }
}

/// A point of a triangle close to `p`: the weights of its corners, and the squared distance. It is the nearest one where
/// that is not on the rim.
pub(super) fn foot(p: Vec3A, [a, b, c]: [Vec3A; 3]) -> ([f32; 3], f32) {
    let (e, f, d) = (b - a, c - a, p - a);
    let (ee, ef, ff) = (e.dot(e), e.dot(f), f.dot(f));
    let (de, df) = (d.dot(e), d.dot(f));
    let (v, w) = (ff * de - ef * df, ee * df - ef * de);
    let raw = [ee * ff - ef * ef - v - w, v, w].map(|x| x.max(0.0));
    let sum = raw[0] + raw[1] + raw[2];
    // A sliver of no area: any of its points will do.
    let weights = if sum > f32::MIN_POSITIVE { raw.map(|x| x / sum) } else { [1.0 / 3.0; 3] };
    let off = d - e * weights[1] - f * weights[2];
    (weights, off.length_squared())
}
