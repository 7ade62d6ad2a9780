//! The distance between the mesh as it was and as it is, from both sides.

use glam::{Vec3, Vec3A};
use rayon::prelude::*;

use crate::bvh::TriangleBvh;
use crate::extract::TriMesh;

/// Barycentric weights at which a triangle of the original is looked at: corners, middles of the sides, centre. The
/// difference of two triangulated surfaces is largest at corners and where edges cross.
const PLACES: [[f32; 3]; 7] = [
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.5, 0.5, 0.0],
    [0.0, 0.5, 0.5],
    [0.5, 0.0, 0.5],
    [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
];
/// A triangle is not looked at in more than this many steps along a side.
const MOST_STEPS: usize = 64;

/// A surface that distances are measured to.
pub(super) struct Surface(TriangleBvh);

impl Surface {
    pub(super) fn new(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Self {
        let corners = |t: usize| triangles[t].map(|v| Vec3::from_array(positions[v as usize]));
        Self(TriangleBvh::new(triangles.len(), corners))
    }

    /// Distance to the surface and the triangle that is nearest.
    fn nearest(&self, p: Vec3A) -> (f32, u32) {
        self.0.nearest(p.into()).map_or((f32::INFINITY, u32::MAX), |n| (n.distance, n.triangle))
    }
}

/// The largest distance of each of some triangles of the original to the new surface.
pub(super) fn old_to_new(mesh: &TriMesh, which: &[u32], new: &Surface) -> Vec<f32> {
    let one = |&t: &u32| {
        let corners = mesh.corners(t as usize);
        let places = PLACES.iter().map(|w| corners[0] * w[0] + corners[1] * w[1] + corners[2] * w[2]);
        places.map(|p| new.nearest(p).0).fold(0.0, f32::max)
    };
    which.par_iter().map(one).collect()
}

/// The largest distance of each of some new triangles to the original, looked at in steps of `spacing` at most, and the
/// triangles of the original that are nearest to the places that are farther than `tolerance`.
pub(super) fn new_to_old(
    positions: &[[f32; 3]],
    triangles: &[[u32; 3]],
    old: &Surface,
    spacing: f32,
    tolerance: f32,
) -> Vec<(f32, Vec<u32>)> {
    let one = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| Vec3A::from_array(positions[v as usize]));
        let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
        let steps = ((longest / spacing).ceil() as usize).clamp(2, MOST_STEPS);
        let (mut largest, mut beyond) = (0.0f32, Vec::new());
        for i in 0..=steps {
            for j in 0..=steps - i {
                let (u, v) = (i as f32 / steps as f32, j as f32 / steps as f32);
                let (distance, nearest) = old.nearest(a + (b - a) * u + (c - a) * v);
                largest = largest.max(distance);
                if distance > tolerance && beyond.last() != Some(&nearest) {
                    beyond.push(nearest);
                }
            }
        }
        (largest, beyond)
    };
    triangles.par_iter().map(one).collect()
}
