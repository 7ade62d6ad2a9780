//! The new surface while it is made: triangles, and what of the original lies over each.

use std::collections::BTreeMap;

use glam::Vec3A;
use rayon::prelude::*;

use super::scene::Scene;
use super::topology::Topology;

/// Triangles (vertices of the original) and the samples of the original over each of them.
#[derive(Clone, Debug, Default)]
pub(super) struct Cover {
    pub(super) triangles: Vec<[u32; 3]>,
    pub(super) over: Vec<Vec<u32>>,
}

impl Cover {
    /// Some triangles of the original.
    pub(super) fn of(scene: &Scene, topology: &Topology, which: &[u32]) -> Self {
        let over = |&t: &u32| Self::samples(scene, topology, t).collect();
        let triangles = which.iter().map(|&t| scene.mesh.triangles[t as usize]).collect();
        Self { triangles, over: which.par_iter().map(over).collect() }
    }

    /// The samples of an original triangle, but its corners. Of two triangles at a side the first has its middle;
    /// those without area stay as they are and need none.
    pub(super) fn samples(scene: &Scene, topology: &Topology, t: u32) -> impl Iterator<Item = u32> {
        let solid = !topology.frozen[t as usize];
        let samples = scene.samples(t, topology.across[t as usize].map(|beyond| beyond > t));
        samples.filter(move |_| solid)
    }

    /// Takes the triangles of a list out, in its order.
    fn take(&mut self, list: &[u32]) -> Self {
        let triangles = list.iter().map(|&t| self.triangles[t as usize]).collect();
        let over = list.iter().map(|&t| std::mem::take(&mut self.over[t as usize])).collect();
        Self { triangles, over }
    }

    pub(super) fn append(&mut self, mut other: Self) {
        self.triangles.append(&mut other.triangles);
        self.over.append(&mut other.over);
    }

    /// Divides the cover into cubes of a side, counted from `origin`; triangles belong where their centres are.
    pub(super) fn cubes(mut self, scene: &Scene, side: f32, origin: Vec3A) -> Vec<Self> {
        let mut lists: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
        for (t, corners) in self.triangles.iter().enumerate() {
            let centre = corners.iter().map(|&v| scene.position(v)).sum::<Vec3A>() / 3.0;
            let cube = ((centre - origin) / side).floor().to_array().map(|x| x as i64);
            lists.entry(cube).or_default().push(t as u32);
        }
        lists.into_values().map(|list| self.take(&list)).collect()
    }
}
