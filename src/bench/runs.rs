//! Sweeps that train: the budget and the encoding.

use std::path::PathBuf;
use std::rc::Rc;

use super::{Bench, Better, Kind, Plot, Row, Sweep};
use crate::config::Config;
use crate::map::Format;
use crate::pipeline::{self, Cost, Event, PipelineError, RunFolder, RunMetrics, Stage};
use crate::semantics::SemanticFields;
use crate::train::Trained;

/// A run and what was measured of it.
pub(super) struct Measured {
    /// Its folder.
    pub(super) run: RunFolder,
    /// Its field.
    pub(super) trained: Trained,
    /// Its fields of features.
    pub(super) fields: SemanticFields,
    /// How good it is, and what it took.
    pub(super) metrics: RunMetrics,
}

/// Encodings: name, and the settings that make it. A new one is a line here; the quick sweep takes the first three.
const ENCODINGS: [(&str, &[&str]); 8] = [
    ("hash", &[]),
    ("dense", &["field.encoding=dense"]),
    (FREQUENCY, &["field.encoding=frequency"]),
    // Tables of 16 MiB, which no core's L2 holds.
    ("dense, 2^20 rows", &["field.encoding=dense", "field.persistent.log2_rows=20"]),
    ("hash, 4 levels", &["field.persistent.levels=4"]),
    ("hash, 12 levels", &["field.persistent.levels=12"]),
    ("hash, 2^14 rows", &["field.persistent.log2_rows=14"]),
    ("hash, 2^19 rows", &["field.persistent.log2_rows=19"]),
];

/// The paper's networks. A step of theirs costs some hundred times as much, so they are given the seconds that the settings
/// as they are took, and not the steps.
const FREQUENCY: &str = "frequency";

/// A quarter as wide, in the quick sweep: pictures and a map of the wide ones take minutes.
const NARROW: [&str; 2] = ["field.frequency.hidden=64", "field.frequency.head=32"];

/// Plots of what a run costs and how good it is.
const PLOTS: [Plot; 3] = [
    Plot { cost: "train_s", quality: "psnr_db", better: Better::Higher },
    Plot { cost: "train_s", quality: "chamfer_m", better: Better::Lower },
    Plot { cost: "train_s", quality: "object_miou", better: Better::Higher },
];

/// Quality over the training budget, as shares of the budget asked for.
pub(super) fn training(bench: &mut Bench) -> Result<Option<Sweep>, PipelineError> {
    let shares: &[(&str, f64)] = bench.choose(
        &[("1/4", 0.25), ("1/2", 0.5), ("1", 1.0)],
        &[("1/8", 0.125), ("1/4", 0.25), ("1/2", 0.5), ("1", 1.0), ("2", 2.0)],
    );
    let mut rows = Vec::new();
    for &(name, share) in shares {
        let setting = match bench.config.time_budget_s {
            Some(seconds) => format!("time_budget_s={:?}", seconds * share),
            None => {
                format!("train.steps={}", ((bench.config.train.steps as f64 * share).round() as u64).max(1))
            }
        };
        let overrides = if share == 1.0 { Vec::new() } else { vec![setting] };
        let Some(row) = run_row(bench, Kind::Training, &format!("{name} of the budget"), overrides)? else {
            return Ok(None);
        };
        rows.push(row);
    }
    let title = "Training budget: quality over seconds of training";
    Ok(Some(Sweep { name: Kind::Training.name(), title, rows, plots: PLOTS.to_vec(), notes: Vec::new() }))
}

/// Quality over the encoding, at the same number of steps but for [`FREQUENCY`].
pub(super) fn encoding(bench: &mut Bench) -> Result<Option<Sweep>, PipelineError> {
    let mut rows = Vec::new();
    for (name, overrides) in &ENCODINGS[..bench.choose(3, ENCODINGS.len())] {
        let mut overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
        if *name == FREQUENCY {
            let narrow: &[&str] = bench.choose(&NARROW, &[]);
            overrides.extend(narrow.iter().map(|s| (*s).to_owned()));
            if bench.config.time_budget_s.is_none() {
                let Some(base) = base(bench)? else { return Ok(None) };
                overrides.push(format!("time_budget_s={:?}", base.trained.progress.seconds));
            }
        }
        let Some(row) = run_row(bench, Kind::Encoding, name, overrides)? else { return Ok(None) };
        rows.push(row);
    }
    let title = "Encoding: quality over seconds of training";
    let widths = bench.choose("a quarter as wide as the paper's", "the paper's");
    let notes = vec![format!(
        "`{FREQUENCY}` trains for as many seconds as the settings as they are, not for as many steps; its networks are {widths}."
    )];
    Ok(Some(Sweep { name: Kind::Encoding.name(), title, rows, plots: PLOTS.to_vec(), notes }))
}

fn run_row(
    bench: &mut Bench,
    kind: Kind,
    name: &str,
    overrides: Vec<String>,
) -> Result<Option<Row>, PipelineError> {
    bench.announce(kind, name);
    let measured = match overrides.is_empty() {
        true => base(bench)?,
        false => {
            let config = bench.with(&overrides)?;
            measure(bench, &slug(&overrides), &config)?.map(Rc::new)
        }
    };
    let Some(measured) = measured else { return Ok(None) };
    let (quality, cost) = (&measured.metrics.quality, &measured.metrics.cost);
    let megabytes = std::fs::metadata(Trained::path(measured.run.root())).map_or(0, |m| m.len()) as f64 / 1e6;
    let row = Row::new(name, overrides)
        .with("steps", cost.train_steps.map(|n| n as f64))
        .with("train_s", cost.train_seconds)
        .with("features_s", cost.feature_seconds)
        .with("checkpoint_mb", megabytes)
        .with("psnr_db", quality.psnr)
        .with("chamfer_m", quality.persistent.map(|s| s.chamfer_m))
        .with("object_miou", quality.object_miou);
    Ok(Some(row))
}

/// The run with the settings as they are, made at most once.
pub(super) fn base(bench: &mut Bench) -> Result<Option<Rc<Measured>>, PipelineError> {
    if bench.base.is_none() {
        let config = bench.config.clone();
        bench.base = measure(bench, "base", &config)?.map(Rc::new);
    }
    Ok(bench.base.clone())
}

/// Trains `runs/<name>`, makes its map and measures both; `None` if the observer said stop.
pub(super) fn measure(
    bench: &mut Bench,
    name: &str,
    config: &Config,
) -> Result<Option<Measured>, PipelineError> {
    let run = RunFolder::new(folder(bench, name));
    let scene = bench.scene;
    bench.observer.event(&Event::Stage(Stage::Training));
    let session = pipeline::train(scene, config, &run, false, bench.observer)?;
    if !session.trained().progress.finished {
        return Ok(None);
    }
    let Some((fields, trained)) = pipeline::train_features(scene, session, config, &run, bench.observer)?
    else {
        return Ok(None);
    };
    let mut cost = Cost { feature_seconds: Some(fields.seconds), ..Cost::default() };
    let (with, formats) = (Some(&fields), [Format::Ply]);
    let map = run.map();
    let made =
        pipeline::export_map(scene, &trained, with, config, &map, &formats, &mut cost, bench.observer)?;
    if made.is_none() {
        return Ok(None);
    }
    bench.observer.event(&Event::Stage(Stage::Evaluating));
    let metrics = pipeline::evaluate(scene, &trained, with, config, &run, cost, bench.observer)?;
    Ok(metrics.map(|metrics| Measured { run, trained, fields, metrics }))
}

/// Where the run of this name is.
pub(super) fn folder(bench: &Bench, name: &str) -> PathBuf {
    bench.out.join("runs").join(name)
}

/// A name for a folder.
pub(super) fn slug(overrides: &[String]) -> String {
    crate::semantics::slug(&overrides.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::EncodingKind;

    #[test]
    fn every_encoding_is_a_setting_that_can_be_asked_for() {
        for (name, overrides) in ENCODINGS {
            let mut config = Config::default();
            for setting in overrides {
                config = config.with_setting(setting).unwrap();
            }
            config.validate().unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(config == Config::default(), overrides.is_empty(), "{name}");
            assert_eq!(name.starts_with("hash"), config.field.encoding == EncodingKind::Hash, "{name}");
        }
        // The names of the quick sweep.
        assert_eq!(ENCODINGS.map(|e| e.0)[..3], ["hash", "dense", FREQUENCY]);
    }
}
