//! Training of a run: starts, goes on where it stopped, or sees that there is nothing left to do.

use std::fs;
use std::ops::ControlFlow;
use std::time::Duration;

use super::fingerprint::fingerprint;
use super::folder::{RunFolder, first_difference};
use super::log::Log;
use super::{Event, Observer, PipelineError};
use crate::config::Config;
use crate::scene::Scene;
use crate::train::{Trained, Trainer};

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
) -> Result<Trained, PipelineError> {
    config.validate()?;
    run.create()?;
    if fresh {
        discard(run)?;
    }
    let goes_on = run.record_path().is_file() && {
        check_same(scene, config, run)?;
        run.has_checkpoint()
    };
    run.write_record(scene, config)?;
    let mut trainer = match goes_on {
        true => {
            // Without the optimiser's state and the pixels: a finished run needs neither.
            let trained = run.trained()?;
            if trained.progress.finished {
                observer.event(&Event::AlreadyTrained { step: trained.progress.step });
                return Ok(trained);
            }
            observer
                .event(&Event::Resuming { step: trained.progress.step, seconds: trained.progress.seconds });
            drop(trained);
            Trainer::resume(scene, config, run.root())?
        }
        false => Trainer::new(scene, config)?,
    };
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
        None => Ok(trainer.into_trained()),
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

/// Removes what an earlier run left, so that nothing of it can be taken for a result of this one.
fn discard(run: &RunFolder) -> Result<(), PipelineError> {
    let gone = |path: std::path::PathBuf, result: std::io::Result<()>| match result {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(PipelineError::Io { path, source: e }),
        _ => Ok(()),
    };
    // The record last: while it is there, the folder is known to be a run.
    for folder in [run.root().join("checkpoint"), run.map(), run.views()] {
        let result = if run.record_path().is_file() { fs::remove_dir_all(&folder) } else { Ok(()) };
        gone(folder, result)?;
    }
    for file in [run.log_path(), run.metrics_path(), run.report_path(), run.config_path(), run.record_path()]
    {
        let result = if run.record_path().is_file() { fs::remove_file(&file) } else { Ok(()) };
        gone(file, result)?;
    }
    Ok(())
}
