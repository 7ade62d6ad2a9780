//! The order of the work: patches, then collapses in cubes, then a last look at both surfaces.

use glam::Vec3A;
use rayon::prelude::*;

use super::collapse::collapse;
use super::columns::Rows;
use super::cover::Cover;
use super::measure::{Surface, farthest, raster};
use super::patches::{Patched, triangulate};
use super::scene::{Scene, foot};
use super::topology::Topology;
use super::{Simplified, SimplifyReport};
use crate::extract::TriMesh;

/// Triangles of the original in a cube, about: small enough to keep all threads busy, large enough to have few at its rim.
const CUBE_TRIANGLES: f64 = 8000.0;
/// Where the cubes of each pass begin, in cubes: what is at the rim of one is inside another later.
const SHIFTS: [f32; 3] = [0.0, 1.0 / 3.0, 2.0 / 3.0];

/// Share of the tolerance that is used: what is computed in two ways may differ in the last bits.
const SHARE: f32 = 0.9999;

/// Simplifies a mesh that has triangles. `progress` hears the share that is done.
pub(super) fn run(mesh: &TriMesh, rows: &Rows, tolerance: f32, progress: &mut dyn FnMut(f32)) -> Simplified {
    let least = mesh.positions.iter().fold(Vec3A::INFINITY, |m, p| m.min(Vec3A::from_array(*p)));
    // Near the origin, where places between vertices keep their precision.
    let near = |p: &[f32; 3]| (Vec3A::from_array(*p) - least).to_array();
    let local =
        TriMesh { positions: mesh.positions.iter().map(near).collect(), triangles: mesh.triangles.clone() };
    let mut simplified = run_near_origin(&local, rows, tolerance, progress);
    let kept = simplified.kept_vertices.iter();
    simplified.mesh.positions = kept.map(|&v| mesh.positions[v as usize]).collect();
    simplified
}

fn run_near_origin(mesh: &TriMesh, rows: &Rows, tolerance: f32, progress: &mut dyn FnMut(f32)) -> Simplified {
    let topology = Topology::new(mesh);
    let surface = Surface::new(&mesh.positions, &mesh.triangles);
    let scene = Scene { mesh, rows, surface, tolerance: SHARE * tolerance, spacing: mean_side(mesh) };
    progress(0.1);
    let Patched { mut cover, patches, kept } = triangulate(&scene, &topology);
    progress(0.3);
    let area: f64 = (0..mesh.triangles.len()).map(|t| mesh.area(t)).sum();
    let cube = (area / mesh.triangles.len() as f64 * CUBE_TRIANGLES).sqrt() as f32;
    let mut due = vec![true; mesh.positions.len()];
    for (pass, shift) in SHIFTS.into_iter().enumerate() {
        cover = collapse_in_cubes(&scene, cover, cube, Vec3A::splat(-cube * shift), &mut due);
        progress(0.7 + 0.1 * pass as f32);
    }
    finish(&scene, cover, [patches, kept])
}

fn mean_side(mesh: &TriMesh) -> f32 {
    let around = |t: usize| {
        let [a, b, c] = mesh.corners(t);
        f64::from(a.distance(b) + b.distance(c) + c.distance(a))
    };
    let sides = 3.0 * mesh.triangles.len() as f64;
    ((0..mesh.triangles.len()).map(around).sum::<f64>() / sides) as f32
}

/// Collapses what is `due` in each cube, and then no longer is.
fn collapse_in_cubes(scene: &Scene, cover: Cover, cube: f32, origin: Vec3A, due: &mut [bool]) -> Cover {
    let mut degrees = vec![0; due.len()];
    cover.triangles.iter().flatten().for_each(|&v| degrees[v as usize] += 1);
    let one = |part| collapse(scene, part, |v, n| degrees[v as usize] != n, |v| due[v as usize]);
    let done: Vec<(Cover, Vec<u32>)> = cover.cubes(scene, cube, origin).into_par_iter().map(one).collect();
    let mut cover = Cover::default();
    for (part, settled) in done {
        cover.append(part);
        settled.into_iter().for_each(|v| due[v as usize] = false);
    }
    cover
}

/// Measures what came of it, and leaves out the vertices that nothing needs.
fn finish(scene: &Scene, cover: Cover, [patches, kept_patches]: [usize; 2]) -> Simplified {
    let mut deviations = vec![0.0; scene.rows.columns()];
    for (triangle, over) in cover.triangles.iter().zip(&cover.over) {
        let corners = triangle.map(|v| scene.position(v));
        for v in over.iter().filter_map(|&s| scene.vertex(s)) {
            let (weights, _) = foot(scene.position(v), corners);
            scene.rows.record(v, *triangle, weights, &mut deviations);
        }
    }
    let mut mesh = TriMesh { positions: scene.mesh.positions.clone(), triangles: cover.triangles };
    let kept_vertices = mesh.drop_unused_vertices();
    let after = Surface::new(&mesh.positions, &mesh.triangles);
    let samples = cover.over.par_iter().flatten_iter().map(|&s| scene.place(s));
    // Those without area stayed as they were.
    let solid = |&t: &usize| mesh.area_normal(t).length_squared() > 0.0;
    let rasters = (0..mesh.triangles.len()).into_par_iter().filter(solid);
    let rasters = rasters.flat_map_iter(|t| raster(mesh.corners(t), scene.spacing));
    let max_distance = farthest(samples, &after).max(farthest(rasters, &scene.surface));
    let report = SimplifyReport {
        triangles_before: scene.mesh.triangles.len(),
        triangles_after: mesh.triangles.len(),
        patches,
        kept_patches,
        max_distance,
        deviations,
    };
    Simplified { mesh, kept_vertices, report }
}
