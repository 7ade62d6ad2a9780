//! Patches are triangulated anew, each inside its rim, which stays.

use glam::Vec3A;
use rayon::prelude::*;

use super::cover::Cover;
use super::refine::refine;
use super::regions::{Frame, Regions};
use super::scene::Scene;
use super::sheet::Sheet;
use super::topology::{Topology, side, sorted_sides};

/// A patch with fewer triangles is left to the collapses.
const FEW_TRIANGLES: usize = 64;
/// Share of the tolerances that vertices may be off by. What is left is for places between them, where two surfaces can be
/// farther apart, and for the collapses.
const SHARE: f32 = 0.5;
/// How often a patch is tried again, without the places that were too far away.
const TRIES: usize = 6;

/// The mesh with its patches triangulated anew where they can be.
pub(super) struct Patched {
    pub(super) cover: Cover,
    pub(super) patches: usize,
    /// Patches of which nothing was triangulated anew.
    pub(super) kept: usize,
}

/// Part of a patch, with the triangles of the original that it is instead of.
struct Renewed {
    old: Vec<u32>,
    cover: Cover,
}

pub(super) fn triangulate(scene: &Scene, topology: &Topology) -> Patched {
    let regions = Regions::grow(scene.mesh, topology);
    let patches = regions.members.len();
    let renew = |(members, frame): (Vec<u32>, Frame)| renew(scene, topology, members, frame);
    let all: Vec<(Vec<u32>, Frame)> = regions.members.into_iter().zip(regions.frames).collect();
    let mut renewed: Vec<Renewed> = all.into_par_iter().filter_map(renew).collect();
    let triangles = scene.mesh.triangles.len();
    loop {
        let mut stays = vec![true; triangles];
        renewed.iter().flat_map(|r| &r.old).for_each(|&t| stays[t as usize] = false);
        let old: Vec<u32> = (0..triangles as u32).filter(|&t| stays[t as usize]).collect();
        let mut cover = Cover::of(scene, topology, &old);
        let mut owners = vec![None; old.len()];
        for (n, part) in renewed.iter().enumerate() {
            cover.triangles.extend(&part.cover.triangles);
            owners.resize(cover.triangles.len(), Some(n));
        }
        let tangled = tangled(&cover.triangles, &owners);
        if tangled.is_empty() {
            let kept = patches - renewed.len();
            cover.over.extend(renewed.into_iter().flat_map(|part| part.cover.over));
            return Patched { cover, patches, kept };
        }
        tangled.into_iter().rev().for_each(|n| drop(renewed.remove(n)));
    }
}

/// Triangulates a patch anew, but for the places where the result would be too far away; these keep their triangles.
fn renew(scene: &Scene, topology: &Topology, mut members: Vec<u32>, frame: Frame) -> Option<Renewed> {
    for _ in 0..TRIES {
        if members.len() < FEW_TRIANGLES {
            return None;
        }
        let cover = retriangulate(scene, topology, &members, frame)?;
        let far = far_vertices(scene, &cover);
        if far.is_empty() {
            return Some(Renewed { old: members, cover });
        }
        let near = |v: &u32| far.binary_search(v).is_err();
        members.retain(|&t| scene.mesh.triangles[t as usize].iter().all(near));
    }
    None
}

fn retriangulate(scene: &Scene, topology: &Topology, members: &[u32], frame: Frame) -> Option<Cover> {
    let (mut rim, mut inside, mut samples) = (Vec::new(), Vec::new(), Vec::new());
    for &t in members {
        let triangle = &scene.mesh.triangles[t as usize];
        let across = topology.across[t as usize];
        let open = (0..3).filter(|&k| members.binary_search(&across[k]).is_err());
        rim.extend(open.map(|k| side(triangle, k)));
        inside.extend(triangle);
        samples.extend(Cover::samples(scene, topology, t));
    }
    let mut on_rim = rim.as_flattened().to_vec();
    on_rim.sort_unstable();
    inside.sort_unstable();
    inside.dedup();
    inside.retain(|v| on_rim.binary_search(v).is_err());
    samples.extend(&inside);
    let cover = refine(scene, Sheet::new(scene, frame, &rim)?, &samples, SHARE)?;
    // Inside the same rim, each vertex fewer is two triangles fewer.
    let left_out = cover.over.iter().flatten().filter(|&&s| scene.vertex(s).is_some()).count();
    (cover.triangles.len() + 2 * left_out == members.len()).then_some(cover)
}

/// Vertices of the original near places where the two surfaces or their attributes differ by too much.
fn far_vertices(scene: &Scene, cover: &Cover) -> Vec<u32> {
    let mut far = Vec::new();
    for (t, over) in cover.triangles.iter().zip(&cover.over) {
        let corners: [Vec3A; 3] = t.map(|v| scene.position(v));
        for &sample in over.iter().filter(|&&s| !scene.fits(s, *t, corners)) {
            far.extend(scene.around(sample));
        }
        let sides = (0..3).map(|k| [corners[k], corners[(k + 1) % 3]]);
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        let crossed = scene.far_crossing(sides, &scene.triangles(over.iter()), normal, &[corners]);
        for old in scene.surface.beyond(corners, scene.spacing, scene.tolerance).into_iter().chain(crossed) {
            far.extend(&scene.mesh.triangles[old as usize]);
        }
    }
    far.sort_unstable();
    far.dedup();
    far
}

/// Renewed parts with an edge that others have as well, on both sides of something thin; in rising order.
fn tangled(triangles: &[[u32; 3]], owners: &[Option<usize>]) -> Vec<usize> {
    let mut tangled = Vec::new();
    let start = |s: u32| triangles[s as usize / 3][s as usize % 3];
    let far = |s: u32| triangles[s as usize / 3][(s as usize % 3 + 2) % 3];
    for edge in sorted_sides(triangles).chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
        let sound = match edge {
            [_] => true,
            [x, y] => start(x.2) != start(y.2) && far(x.2) != far(y.2),
            _ => false,
        };
        if !sound {
            tangled.extend(edge.iter().filter_map(|s| owners[s.2 as usize / 3]));
        }
    }
    tangled.sort_unstable();
    tangled.dedup();
    tangled
}
