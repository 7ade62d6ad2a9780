//! Marching a dense grid beside its floor and other programs, in one run.
//!
//! `cargo bench --bench march`; `DIVFF_MARCH_SIZE` is the number of corners a side (512). The floor is one read of the
//! grid. `fast-surface-nets` runs on its one thread with new buffers, as our call makes its own; scikit-image where
//! `DIVFF_PYTHON` names a Python that has it.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use divff::bench::fields::Field;
use divff::bench::peers;
use divff::extract::march_dense;
use divff_exporters::write_npy;
use fast_surface_nets::ndshape::RuntimeShape;
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use rayon::prelude::*;

/// Rounds in which every program has its turn.
const ROUNDS: usize = 5;

fn seconds<T>(job: impl FnOnce() -> T) -> f64 {
    let start = Instant::now();
    black_box(job());
    start.elapsed().as_secs_f64()
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

fn main() {
    let size = std::env::var("DIVFF_MARCH_SIZE").ok().and_then(|v| v.parse().ok()).unwrap_or(512);
    let folder = tempfile::tempdir().expect("a folder for the grid that Python reads");
    for field in Field::ALL {
        compare(field, size, folder.path());
    }
}
