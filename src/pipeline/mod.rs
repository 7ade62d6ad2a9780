//! A whole run: train → map → views → measures → report, each stage a call that also stands by itself.
//!
//! A run lives in a [`RunFolder`]. Every file appears complete or not at all, and training goes on where it was
//! stopped.

mod error;
mod evaluate;
mod fingerprint;
pub mod folder;
pub mod log;
mod map;
pub mod metrics;
mod phrases;
mod semantics;
pub mod tables;
mod train;

use std::path::PathBuf;

pub use error::PipelineError;
pub use evaluate::{evaluate, render_views};
pub use fingerprint::fingerprint;
pub use folder::{RunFolder, RunRecord};
pub use map::export_map;
pub use metrics::{Cost, RunMetrics};
pub use semantics::{features, train_features};
pub use train::train;

use crate::config::Config;
use crate::map::Format;
use crate::scene::Scene;
use crate::semantics::head::train::HeadProgress;
use crate::train::{Progress, Session};
use crate::work::Work;

/// Parts of a run, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stage {
    /// The field learns the scene.
    Training,
    /// The fields of features learn what the scene's features say.
    Features,
    /// Meshes and points are taken from the field.
    Mapping,
    /// The map is written.
    Exporting,
    /// Frames are rendered to files.
    Rendering,
    /// Test frames are rendered and everything is compared with the truth.
    Evaluating,
    /// `report.html` is written.
    Reporting,
}

/// What an [`Observer`] hears.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// A stage begins.
    Stage(Stage),
    /// Training goes on from a checkpoint.
    Resuming {
        /// Steps taken so far.
        step: u64,
        /// Seconds spent so far.
        seconds: f64,
    },
    /// Training had been finished earlier.
    AlreadyTrained {
        /// Steps it took.
        step: u64,
    },
    /// Training moves on.
    Training(&'a Progress),
    /// Training of the fields of features moves on.
    Features(&'a HeadProgress),
    /// A benchmark turns to a setting.
    Setting {
        /// The sweep.
        sweep: &'a str,
        /// The setting.
        setting: &'a str,
    },
    /// The map is being built.
    Mapping(crate::map::Progress),
    /// Frames are being rendered.
    Views {
        /// Frames done.
        done: usize,
        /// Frames in all.
        total: usize,
    },
}

/// Who follows a run: the command line's progress bars, or `()` for nobody.
pub trait Observer {
    /// Hears what happens.
    fn event(&mut self, event: &Event);

    /// Whether to stop at the next opportunity; what is done by then is kept.
    fn stop(&self) -> bool;
}

impl Observer for () {
    fn event(&mut self, _: &Event) {}

    fn stop(&self) -> bool {
        false
    }
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// Everything is there.
    Finished(Box<RunMetrics>),
    /// The observer said stop; the same call goes on from here.
    Stopped {
        /// Training steps taken by then.
        step: u64,
    },
}

/// What a run is told beside its settings.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunOptions {
    /// Throw away what the folder holds and start over.
    pub fresh: bool,
}

/// Trains on `scene`, builds and writes the map, renders and measures the test frames, and writes the report.
///
/// Stages whose results are there already are not repeated by training; maps, views and measures always are, since
/// their settings may have changed.
///
/// # Errors
/// [`PipelineError`]: the first thing that went wrong. What was finished before it stays.
pub fn run(
    scene: &Scene,
    config: &Config,
    out: impl Into<PathBuf>,
    options: &RunOptions,
    observer: &mut dyn Observer,
) -> Result<Outcome, PipelineError> {
    let run = RunFolder::new(out);
    let mut cost = Cost::default();
    observer.event(&Event::Stage(Stage::Training));
    let session = train(scene, config, &run, options.fresh, observer)?;
    let progress = &session.trained().progress;
    if let Session::Over(_) = &session {
        cost.save("finished_training", Work::seconds(progress.seconds));
    }
    let stopped = Outcome::Stopped { step: progress.step };
    if !progress.finished {
        return Ok(stopped);
    }
    let Some((fields, trained)) = train_features(scene, session, config, &run, observer)? else {
        return Ok(stopped);
    };
    cost.feature_seconds = Some(fields.seconds);
    let map = run.map();
    let manifest =
        export_map(scene, &trained, Some(&fields), config, &map, &Format::ALL, &mut cost, observer)?;
    if manifest.is_none() {
        return Ok(stopped);
    }
    observer.event(&Event::Stage(Stage::Evaluating));
    let Some(metrics) = evaluate(scene, &trained, Some(&fields), config, &run, cost, observer)? else {
        return Ok(stopped);
    };
    folder::write_json(&run.metrics_path(), &metrics)?;
    observer.event(&Event::Stage(Stage::Reporting));
    crate::report::write(&run, scene)?;
    Ok(Outcome::Finished(Box::new(metrics)))
}
