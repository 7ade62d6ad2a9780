//! Damaged files: whatever the bytes, a reader gives a valid result or an error that blames the file, in a second and
//! in memory bounded by the file's size.
//!
//! `DIVFF_MUTATIONS` sets how many damaged files each reader gets (default 10,000). A failure names sample and seed; the
//! same seed gives the same file.

mod finds;
mod kit;
mod mutate;
mod samples;

use divff_exporters::npz::read_npz_matrices;
use divff_exporters::{
    Error, Geometry, Manifest, Result, read_exr, read_glb, read_npy, read_npy_header, read_npz, read_ply,
    read_ply_positions,
};
use kit::{Bench, assert_survives_damage};
use peak_alloc::PeakAlloc;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

fn valid(geometry: Geometry) -> Result<()> {
    geometry.validate()
}

fn ply(bench: &Bench) -> Result<()> {
    // Both, because they take different columns of the same rows.
    let positions = read_ply_positions(&bench.path);
    let geometry = read_ply(&bench.path)?;
    assert_eq!(positions?.len(), geometry.positions.len());
    valid(geometry)
}

fn glb(bench: &Bench) -> Result<()> {
    read_glb(&bench.path)?.geometries.into_iter().try_for_each(valid)
}

fn npz(bench: &Bench) -> Result<()> {
    let _ = read_npz_matrices(&bench.path);
    read_npz(&bench.path).and_then(valid)
}

fn npy(bench: &Bench) -> Result<()> {
    let header = read_npy_header(&bench.path);
    let array = read_npy(&bench.path)?;
    let values = array.to_f32().len();
    assert_eq!(header?, array.header);
    assert_eq!(array.to_i64().map_or(values, |integers| integers.len()), values);
    Ok(())
}

fn exr(bench: &Bench) -> Result<()> {
    let image = read_exr(&bench.path)?;
    assert!(image.width * image.height > 0 && !image.channels.is_empty());
    Ok(())
}

fn manifest(bench: &Bench) -> Result<()> {
    let folder = bench.path.parent().expect("the file is in a folder");
    let manifest = Manifest::read(folder)?;
    // Files that are not there or lead elsewhere are errors of another kind; neither is a panic.
    let _ = manifest.verify(folder);
    Ok(())
}

#[test]
fn ply_survives_damage() {
    assert_survives_damage("a.ply", &samples::ply(), ply);
}

#[test]
fn glb_survives_damage() {
    assert_survives_damage("a.glb", &samples::glb(), glb);
}

#[test]
fn npz_survives_damage() {
    assert_survives_damage("a.npz", &samples::npz(), npz);
}

#[test]
fn npy_survives_damage() {
    assert_survives_damage("a.npy", &samples::npy(), npy);
}

#[test]
fn exr_survives_damage() {
    assert_survives_damage("a.exr", &samples::exr(), exr);
}

#[test]
fn manifest_survives_damage() {
    assert_survives_damage("manifest.json", &samples::manifest(), manifest);
}

/// Whether an error says that the file is to blame.
fn blames_the_file(error: &Error) -> bool {
    matches!(error, Error::Invalid { .. } | Error::Unsupported { .. } | Error::NonFinite { .. })
}
