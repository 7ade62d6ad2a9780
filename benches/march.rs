//! Marching a dense grid beside its floor and other programs, in one run.
//!
//! Then the same fields cut down to a ball, so that few blocks hold a surface: what a sparse grid of those takes beside the
//! dense one.
//!
//! `cargo bench --bench march`; `DIVFF_MARCH_SIZE` is the number of corners a side (512). The floor is one read of the
//! grid. `fast-surface-nets` runs on its one thread with new buffers, as our call makes its own; scikit-image where
//! `DIVFF_PYTHON` names a Python that has it.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use divff::bench::fields::Field;
use divff::bench::peers;
use divff::extract::{GridSpec, SparseGrid, TriMesh, march, march_dense};
use divff_exporters::write_npy;
use fast_surface_nets::ndshape::RuntimeShape;
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::Vec3A;
use rayon::prelude::*;

/// Rounds in which every program has its turn.
const ROUNDS: usize = 5;

/// How long a job takes, without giving back the memory of what comes out.
fn seconds<T>(job: impl FnOnce() -> T) -> f64 {
    let start = Instant::now();
    let out = black_box(job());
    let seconds = start.elapsed().as_secs_f64();
    drop(out);
    seconds
}

/// Reads every value once, on all threads.
fn read(values: &[f32]) -> u32 {
    values
        .par_chunks(1 << 16)
        .map(|c| c.iter().fold(0, |all, v| all | v.to_bits()))
        .reduce(|| 0, |a, b| a | b)
}

fn nets(negative: &[f32], size: usize) -> usize {
    let shape = RuntimeShape::<u32, 3>::new([size as u32; 3]);
    let mut buffer = SurfaceNetsBuffer::default();
    surface_nets(negative, &shape, [0; 3], [size as u32 - 1; 3], &mut buffer);
    buffer.indices.len() / 3
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn compare(field: Field, size: usize, folder: &Path) {
    let dims = [size; 3];
    let values = field.sample(dims);
    // There, negative is inside.
    let negative: Vec<f32> = values.par_iter().map(|v| -v).collect();
    let triangles = march_dense(&values, dims, 0.0).map_or(0, |m| m.triangles.len());
    let mut times = [const { Vec::new() }; 3];
    for _ in 0..ROUNDS {
        times[0].push(seconds(|| read(&values)));
        times[1].push(seconds(|| march_dense(&values, dims, 0.0)));
        times[2].push(seconds(|| nets(&negative, size)));
    }
    let [floor, ours, nets] = times.map(median);
    println!(
        "{} {size}³: {triangles} triangles in {:.1} ms; reading the grid {:.1} ms ({:.1} × that); \
         fast-surface-nets {:.1} ms ({:.1} × ours)",
        field.name(),
        1e3 * ours,
        1e3 * floor,
        ours / floor,
        1e3 * nets,
        nets / ours
    );
    let path = folder.join("grid.npy");
    let theirs = match write_npy(&path, &dims, &values) {
        Ok(()) => peers::seconds(peers::SKIMAGE_MARCH, &[&path]),
        Err(error) => Err(error.to_string()),
    };
    match theirs {
        Ok(theirs) => println!("    scikit-image {:.1} ms ({:.1} × ours)", 1e3 * theirs, theirs / ours),
        Err(why) => println!("    scikit-image: {why}"),
    }
}

/// Radii of the balls, as shares of the grid's side.
const RADII: [f32; 2] = [0.1, 0.2];

/// Cells along the side of a sparse grid's block.
const BLOCK: usize = 8;

/// Keeps what lies within a ball in the middle.
fn cut(values: &mut [f32], size: usize, radius: f32) {
    let (middle, radius) = (0.5 * (size - 1) as f32, radius * size as f32);
    values.par_chunks_mut(size * size).enumerate().for_each(|(z, layer)| {
        for (i, v) in layer.iter_mut().enumerate() {
            let p = Vec3A::from_array([i % size, i / size, z].map(|c| c as f32));
            *v = v.min(1.0 - p.distance(Vec3A::splat(middle)) / radius);
        }
    });
}

/// Whether a block has corners on both sides, for each.
fn mixed_blocks(values: &[f32], size: usize) -> Vec<bool> {
    let side = (size - 1).div_ceil(BLOCK);
    let corners = |b: usize| (b * BLOCK)..=(b * BLOCK + BLOCK).min(size - 1);
    let is_mixed = |n: usize| {
        let [x, y, z] = [n % side, n / side % side, n / (side * side)].map(corners);
        let rows = z.flat_map(|z| y.clone().map(move |y| (z * size + y) * size));
        let mut inside =
            rows.flat_map(|row| values[row + x.start()..=row + x.end()].iter().map(|v| *v > 0.0));
        let first = inside.next();
        inside.any(|v| Some(v) != first)
    };
    (0..side.pow(3)).into_par_iter().map(is_mixed).collect()
}

/// Only the blocks with a surface, as empty-space skipping leaves them.
fn sparse(values: &[f32], size: usize) -> SparseGrid {
    let (mixed, side) = (mixed_blocks(values, size), (size - 1).div_ceil(BLOCK));
    let may_hold = |center: Vec3A, half: f32| {
        let [x, y, z] = ((center - half) / BLOCK as f32).as_uvec3().to_array().map(|c| c as usize);
        half > 0.5 * BLOCK as f32 || mixed[(z * side + y) * side + x]
    };
    let value = |p: &Vec3A| {
        let [x, y, z] = p.to_array().map(|c| c as usize);
        values[(z * size + y) * size + x]
    };
    let spec = GridSpec::new([0.0; 3], [size as u32 - 1; 3], 1.0);
    let sample = |p: &[Vec3A], out: &mut [f32]| out.iter_mut().zip(p).for_each(|(v, p)| *v = value(p));
    SparseGrid::sample(&spec, &may_hold, &sample).expect("the field is finite")
}

fn compare_sparse(field: Field, size: usize, radius: f32) {
    let mut values = field.sample([size; 3]);
    cut(&mut values, size, radius);
    let grid = sparse(&values, size);
    let mut times = [const { Vec::new() }; 2];
    for _ in 0..ROUNDS {
        times[0].push(seconds(|| march_dense(&values, [size; 3], 0.0)));
        times[1].push(seconds(|| march(&grid, 0.0)));
    }
    let of = |mesh: Result<TriMesh, _>| mesh.map_or(0, |m| m.triangles.len());
    let triangles = [of(march_dense(&values, [size; 3], 0.0)), of(march(&grid, 0.0))];
    let [dense, sparse] = times.map(median);
    let report = grid.report();
    let share = report.evaluated_blocks as f64 / (report.evaluated_blocks + report.skipped_blocks) as f64;
    assert_eq!(triangles[0], triangles[1], "the same surface");
    println!(
        "{} {size}³ in a ball of radius {radius}: {} triangles in {:.2} % of the blocks; dense {:.1} ms, sparse {:.1} ms \
         ({:.1} × as fast; bar 5)",
        field.name(),
        triangles[0],
        100.0 * share,
        1e3 * dense,
        1e3 * sparse,
        dense / sparse
    );
}

fn main() {
    let size = std::env::var("DIVFF_MARCH_SIZE").ok().and_then(|v| v.parse().ok()).unwrap_or(512);
    let folder = tempfile::tempdir().expect("a folder for the grid that Python reads");
    for field in Field::ALL {
        compare(field, size, folder.path());
        RADII.into_iter().for_each(|radius| compare_sparse(field, size, radius));
    }
}
