//! The distance between the mesh as it was and as it is, from both sides.

use glam::{Vec3, Vec3A};
use rayon::prelude::*;

use crate::bvh::TriangleBvh;

/// A triangle is not looked at in more than this many steps along a side.
const MOST_STEPS: usize = 64;

/// A surface that distances are measured to.
pub(super) struct Surface(TriangleBvh);

impl Surface {
    pub(super) fn new(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Self {
        let corners = |t: usize| triangles[t].map(|v| Vec3::from_array(positions[v as usize]));
        Self(TriangleBvh::new(triangles.len(), corners))
    }

    pub(super) fn is_within(&self, p: Vec3A, distance: f32) -> bool {
        self.0.within(p.into(), distance)
    }

    /// Whether all places of a triangle's raster are at most `distance` from the surface.
    pub(super) fn holds(&self, corners: [Vec3A; 3], spacing: f32, distance: f32) -> bool {
        raster(corners, spacing).all(|p| self.is_within(p, distance))
    }

    /// The triangles of the surface that are nearest to places of a triangle farther than `distance` from it.
    pub(super) fn beyond(&self, corners: [Vec3A; 3], spacing: f32, distance: f32) -> Vec<u32> {
        let far = raster(corners, spacing).filter(|&p| !self.is_within(p, distance));
        far.filter_map(|p| Some(self.0.nearest(p.into())?.triangle)).collect()
    }

    fn distance(&self, p: Vec3A) -> f32 {
        self.0.nearest(p.into()).map_or(f32::INFINITY, |n| n.distance)
    }
}

/// Places of a triangle, in at least two steps a side, each of `spacing` at most; without its corners.
pub(super) fn raster([a, b, c]: [Vec3A; 3], spacing: f32) -> impl Iterator<Item = Vec3A> {
    let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
    let steps = ((longest / spacing).ceil() as usize).clamp(2, MOST_STEPS);
    let inner = move |&(i, j): &(usize, usize)| i != steps && j != steps && i + j != 0;
    let all = (0..=steps).flat_map(move |i| (0..=steps - i).map(move |j| (i, j)));
    let share = move |n: usize| n as f32 / steps as f32;
    all.filter(inner).map(move |(i, j)| a + (b - a) * share(i) + (c - a) * share(j))
}

/// The largest distance of places to a surface.
pub(super) fn farthest(places: impl ParallelIterator<Item = Vec3A>, surface: &Surface) -> f32 {
    places.map(|p| surface.distance(p)).reduce(|| 0.0, f32::max)
}
