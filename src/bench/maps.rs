//! Sweeps over one trained field: how its surface is taken.
//!
//! Whatever else `[map]` can be told is swept the same way: a list of overrides, a [`Kind`], and the two columns to plot.

use std::path::Path;
use std::time::Instant;

use divff_exporters::write_npy;

use super::fields::Field;
use super::runs::{base, slug};
use super::{Bench, Better, Cell, Kind, Plot, Row, Sweep, peers};
use crate::eval::{Metrics, evaluate_geometry};
use crate::extract::march_dense;
use crate::field::Stream;
use crate::map::{self, Format};
use crate::pipeline::{Event, PipelineError, Stage};

/// Error over what a surface takes.
const PLOTS: [Plot; 2] = [
    Plot { cost: "triangles", quality: "chamfer_m", better: Better::Lower },
    Plot { cost: "extract_s", quality: "chamfer_m", better: Better::Lower },
];

/// The surface over the side of a voxel.
pub(super) fn voxel(bench: &mut Bench) -> Result<Option<Sweep>, PipelineError> {
    let Some(run) = base(bench)? else { return Ok(None) };
    let size = bench.config.map.voxel_size;
    let normal = size.unwrap_or_else(|| map::default_voxel(&run.trained.field.normalisation));
    let factors: &[f64] = bench.choose(&[1.0, 1.5, 2.0, 3.0], &[0.7, 1.0, 1.4, 2.0, 2.8, 4.0]);
    let mut rows = Vec::new();
    for factor in factors {
        let voxel = normal * factor;
        let name = format!("{voxel:.4} m");
        let Some(row) = map_row(bench, Kind::Voxel, &name, vec![format!("map.voxel_size={voxel:?}")])? else {
            return Ok(None);
        };
        let extent = run.trained.field.normalisation;
        let dims =
            extent.extent.to_array().map(|e| (f64::from(e) * extent.scale / voxel).ceil() as usize + 1);
        rows.push(marching(bench, row, dims)?);
    }
    let note = "dense_march_s: a thin structure on a dense grid of as many voxels as the box has, and how many times as \
                long scikit-image takes for it";
    let (name, title) = (Kind::Voxel.name(), "Side of a voxel: error over triangles and seconds");
    Ok(Some(Sweep { name, title, rows, plots: PLOTS.to_vec(), notes: vec![note.to_owned()] }))
}

/// The surface over the way in which it is found.
pub(super) fn method(bench: &mut Bench) -> Result<Option<Sweep>, PipelineError> {
    let mut rows = Vec::new();
    for method in ["tsdf", "both", "density"] {
        let row = map_row(bench, Kind::Method, method, vec![format!("map.method={method}")])?;
        let Some(row) = row else { return Ok(None) };
        rows.push(row);
    }
    let plots = vec![PLOTS[1], PLOTS[0]];
    let (name, title) =
        (Kind::Method.name(), "Surface from fused depth, density, or both: error over seconds");
    Ok(Some(Sweep { name, title, rows, plots, notes: Vec::new() }))
}

/// Takes what stays from the shared field with some settings, and compares it with the truth.
fn map_row(
    bench: &mut Bench,
    kind: Kind,
    name: &str,
    overrides: Vec<String>,
) -> Result<Option<Row>, PipelineError> {
    let Some(run) = base(bench)? else { return Ok(None) };
    bench.announce(kind, name);
    let mut config = bench.with(&overrides)?;
    config.map.streams = vec![Stream::Persistent];
    bench.observer.event(&Event::Stage(Stage::Mapping));
    let start = Instant::now();
    let observer = &mut *bench.observer;
    let map = map::build(bench.scene, &run.trained, &config, &mut |p| observer.event(&Event::Mapping(p)))?;
    let seconds = start.elapsed().as_secs_f64();
    if bench.observer.stop() {
        return Ok(None);
    }
    let folder = bench.out.join("maps").join(slug(&overrides));
    let manifest = map::write(&map, &folder, &[Format::Ply])?;
    let mesh = manifest.files.iter().find(|f| f.path.starts_with(Stream::Persistent.name()));
    let mut metrics = Metrics::default();
    evaluate_geometry(bench.scene, &folder, &mut metrics)?;
    let surface = metrics.persistent;
    let row = Row::new(name, overrides)
        .with("extract_s", seconds)
        .with("triangles", mesh.map(|f| f.faces as f64))
        .with("mesh_mb", mesh.and_then(|f| megabytes(&folder.join(&f.path))))
        .with("chamfer_m", surface.map(|s| s.chamfer_m))
        .with("fscore_5cm", surface.map(|s| s.fscore_5cm));
    Ok(Some(row))
}

/// Size of a file.
pub(super) fn megabytes(path: &Path) -> Option<f64> {
    Some(std::fs::metadata(path).ok()?.len() as f64 / 1e6)
}

/// Adds what marching a dense grid of `dims` corners takes, and how many times that a peer takes.
fn marching(bench: &Bench, row: Row, dims: [usize; 3]) -> Result<Row, PipelineError> {
    let values = Field::Thin.sample(dims);
    let mut least = f64::INFINITY;
    for _ in 0..3 {
        let start = Instant::now();
        march_dense(&values, dims, 0.0).map_err(map::MapError::extract("dense grid"))?;
        least = least.min(start.elapsed().as_secs_f64());
    }
    let ratio = match std::env::var_os("DIVFF_PYTHON") {
        Some(_) => peer(&bench.out.join("maps"), &values, dims, least)?,
        None => peers::ratio(peers::SKIMAGE_MARCH, &[], least),
    };
    Ok(row.with("dense_march_s", least).with("skimage_ratio", ratio))
}

fn peer(folder: &Path, values: &[f32], dims: [usize; 3], ours: f64) -> Result<Cell, PipelineError> {
    let path = folder.join("grid.npy");
    let [x, y, z] = dims;
    write_npy(&path, &[z, y, x], values)?;
    let found = peers::ratio(peers::SKIMAGE_MARCH, &[&path], ours);
    // It is large and of no further use.
    let _ = std::fs::remove_file(&path);
    Ok(found)
}
