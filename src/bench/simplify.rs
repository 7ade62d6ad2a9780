//! Fewer triangles over how far the surface and its features may move.

use std::time::Instant;

use super::maps::megabytes;
use super::runs::base;
use super::{Bench, Better, Cell, Kind, Plot, Row, Sweep};
use crate::eval::{Metrics, evaluate_geometry};
use crate::field::Stream;
use crate::map::{self, Format, SemanticMap, Simplify};
use crate::pipeline::{Event, PipelineError, Stage};
use crate::semantics::bake::annotate;

/// The mesh of what stays over the tolerance within which it is simplified.
pub(super) fn simplify(bench: &mut Bench) -> Result<Option<Sweep>, PipelineError> {
    let Some(run) = base(bench)? else { return Ok(None) };
    bench.announce(Kind::Simplify, "map");
    let mut config = bench.config.clone();
    config.map.streams = vec![Stream::Persistent];
    bench.observer.event(&Event::Stage(Stage::Mapping));
    let observer = &mut *bench.observer;
    let mut full =
        map::build(bench.scene, &run.trained, &config, &mut |p| observer.event(&Event::Mapping(p)))?;
    annotate(&mut full, bench.scene, &run.trained, &run.fields, &config.semantics)?;
    let factors: &[f64] = bench.choose(&[0.25, 0.5], &[0.1, 0.25, 0.5, 1.0, 2.0]);
    let tolerances = factors.iter().map(|factor| Simplify::Within(factor * full.voxel_size));
    let mut rows = Vec::new();
    for simplify in std::iter::once(Simplify::None).chain(tolerances) {
        if bench.observer.stop() {
            return Ok(None);
        }
        rows.push(row(bench, full.clone(), simplify)?);
    }
    let plots = vec![
        Plot { cost: "triangles", quality: "hausdorff_m", better: Better::Lower },
        Plot { cost: "triangles", quality: "feature_error", better: Better::Lower },
        Plot { cost: "simplify_s", quality: "triangles", better: Better::Lower },
    ];
    let notes = vec![NOTE.to_owned()];
    let (name, title) = (Kind::Simplify.name(), "Simplification: shape and features over triangles");
    Ok(Some(Sweep { name, title, rows, plots, notes }))
}

/// How to read the columns.
const NOTE: &str = "hausdorff_m: the largest distance between the mesh before and after, from both sides; feature_error: \
    how far a feature is at most from what it was at a vertex before, as a share of the features' length";

fn row(bench: &mut Bench, mut map: SemanticMap, simplify: Simplify) -> Result<Row, PipelineError> {
    let name = match simplify {
        Simplify::None => "none".to_owned(),
        Simplify::Within(tolerance) => format!("{tolerance:.4} m"),
    };
    bench.announce(Kind::Simplify, &name);
    let overrides = match simplify {
        Simplify::None => Vec::new(),
        Simplify::Within(tolerance) => vec![format!("map.simplify={tolerance:?}")],
    };
    let mut config = bench.config.map.clone();
    config.simplify = simplify;
    let start = Instant::now();
    map::simplify(&mut map, &config, &mut |_| {})?;
    let seconds = start.elapsed().as_secs_f64();
    let folder = bench.out.join("maps").join(format!("simplify_{}", super::runs::slug(&overrides)));
    let manifest = map::write(&map, &folder, &[Format::Ply])?;
    let mut metrics = Metrics::default();
    evaluate_geometry(bench.scene, &folder, &mut metrics)?;
    let mesh = manifest.files.iter().find(|f| f.path.starts_with(Stream::Persistent.name()));
    let done = map.simplified.iter().find(|s| s.name == Stream::Persistent.name());
    let of_features = |name: &str| name.ends_with("_pca");
    let feature_error = done.map_or(Some(0.0), |done| {
        let features = done.deviations.iter().filter(|d| of_features(&d.name));
        // The tolerance is this share of their length.
        let shares = features.map(|d| d.largest / d.tolerance * f64::from(config.simplify_feature));
        shares.reduce(f64::max)
    });
    Ok(Row::new(name, overrides)
        .with("simplify_s", seconds)
        .with("triangles", mesh.map(|f| f.faces as f64))
        .with("mesh_mb", mesh.and_then(|f| megabytes(&folder.join(&f.path))))
        .with("hausdorff_m", done.map_or(0.0, |done| done.largest_distance))
        .with(
            "feature_error",
            feature_error.map_or_else(|| Cell::Missing("no features".into()), Cell::Number),
        )
        .with("chamfer_m", metrics.persistent.map(|s| s.chamfer_m))
        .with("fscore_2cm", metrics.persistent.map(|s| s.fscore_2cm)))
}
