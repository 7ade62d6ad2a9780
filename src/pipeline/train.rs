//! Training of a run: starts, goes on where it stopped, or sees that there is nothing left to do.

use std::fs;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Duration;

use super::fingerprint::fingerprint;
use super::folder::{RunFolder, first_difference};
use super::log::Log;
use super::{Event, Observer, PipelineError};
use crate::config::Config;
use crate::error::FileError;
use crate::scene::Scene;
use crate::semantics::head::train::check_features;
use crate::train::{Session, Trainer};

/// Trains `run` on `scene` until the schedule ends or `observer` says stop; in both cases what was trained is stored.
///
/// A run that was stopped goes on; one that is finished is not trained again; `fresh` throws away what is there.
///
/// # Errors
/// [`PipelineError::Differs`] if the folder holds a run of another scene or of other settings; whatever keeps the
/// scene from being read or the checkpoint from being written.
pub fn train(
    scene: &Scene,
    config: &Config,
    run: &RunFolder,
    fresh: bool,
    observer: &mut dyn Observer,
) -> Result<Session, PipelineError> {
    config.validate()?;
    run.create()?;
    if fresh {
        discard(run)?;
    }
    let mut trainer = if run.has_checkpoint() {
        check_same(scene, config, run)?;
        // Without the optimiser's state and the pixels: a finished run needs neither.
        let trained = run.trained()?;
        let progress = trained.progress.clone();
        if progress.finished {
            run.write_record(scene, config)?;
            observer.event(&Event::AlreadyTrained { step: progress.step });
            return Ok(Session::Over(Box::new(trained)));
        }
        drop(trained);
        check_features(scene, &config.semantics)?;
        observer.event(&Event::Resuming { step: progress.step, seconds: progress.seconds });
        Trainer::resume(scene, config, run.root())?
    } else {
        check_features(scene, &config.semantics)?;
        Trainer::new(scene, config)?
    };
    // Not before the scene has been read: a folder whose scene was broken is not yet a run.
    run.write_record(scene, config)?;
    let mut log = Log::resume(&run.log_path(), trainer.trained().progress.step)?;
    let mut failed = None;
    let budget = config.time_budget_s.map(Duration::from_secs_f64);
    trainer.run(run.root(), budget, &mut |progress| {
        if let Err(error) = log.add(progress) {
            failed = Some(error);
            return ControlFlow::Break(());
        }
        observer.event(&Event::Training(progress));
        if observer.stop() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    match failed {
        Some(error) => Err(error),
        None => Ok(Session::Open(Box::new(trainer))),
    }
}

/// Refuses to go on with a run of another scene or of other settings.
fn check_same(scene: &Scene, config: &Config, run: &RunFolder) -> Result<(), PipelineError> {
    let record = run.record()?;
    let differs = |what: String, remedy| PipelineError::Differs { run: run.root().to_owned(), what, remedy };
    if record.scene_id != fingerprint(scene) {
        let what = format!(
            "it was trained on {}, and {} is another scene or has changed",
            record.scene.display(),
            scene.root.display()
        );
        return Err(differs(what, "choose another --out, or start over with --fresh"));
    }
    match first_difference(&run.config()?, config)? {
        Some(what) => Err(differs(
            what,
            "go on with its own settings by --config <RUN>/config.toml, choose another --out, or start over with --fresh",
        )),
        None => Ok(()),
    }
}

/// Removes what an earlier run left, so that nothing of it can be taken for a result of this one. A folder that is not
/// a run is left alone.
fn discard(run: &RunFolder) -> Result<(), PipelineError> {
    if !run.has_checkpoint() && !run.record_path().is_file() {
        return Ok(());
    }
    let gone = |path: PathBuf, result: std::io::Result<()>| match result {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(PipelineError::Io(FileError { path, source }))
        }
        _ => Ok(()),
    };
    for folder in [run.map(), run.views(), run.root().join("checkpoint")] {
        let result = fs::remove_dir_all(&folder);
        gone(folder, result)?;
    }
    // The record last: while it is there, the folder is known to be a run.
    for file in [run.log_path(), run.metrics_path(), run.report_path(), run.config_path(), run.record_path()]
    {
        let result = fs::remove_file(&file);
        gone(file, result)?;
    }
    Ok(())
}
