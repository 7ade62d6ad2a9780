//! The fields of features of a run: trained once for a geometry and some settings.

use std::ops::ControlFlow;
use std::time::Instant;

use super::{Event, Observer, PipelineError, RunFolder, Stage};
use crate::config::Config;
use crate::scene::Scene;
use crate::semantics::head::train;
use crate::semantics::{SemanticFields, SemanticsError};
use crate::train::Trained;

/// Trains the fields of features at the geometry of `trained` and stores them; those of an earlier call with the same
/// geometry and settings are taken as they are. `None` if the observer said stop.
///
/// # Errors
/// Features that cannot be used, or a file that cannot be written.
pub fn train_features(
    scene: &Scene,
    trained: &Trained,
    config: &Config,
    run: &RunFolder,
    observer: &mut dyn Observer,
) -> Result<Option<SemanticFields>, PipelineError> {
    match SemanticFields::load(run.root()) {
        Ok(Some(fields)) if fields.fits(trained, &config.semantics) => return Ok(Some(fields)),
        // Damaged or of another version: what is derived is made again.
        Ok(_) | Err(SemanticsError::Stored { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    observer.event(&Event::Stage(Stage::Features));
    let start = Instant::now();
    let fields = train::train_features(scene, trained, config, &mut |progress| {
        observer.event(&Event::Features(progress));
        if observer.stop() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    let Some(mut fields) = fields else { return Ok(None) };
    for warning in &fields.warnings {
        tracing::warn!("{warning}");
    }
    fields.seconds = start.elapsed().as_secs_f64();
    fields.save(run.root())?;
    Ok(Some(fields))
}

/// The fields of features of a run; `None` if none were trained, or on another geometry.
///
/// # Errors
/// A file that is damaged or cannot be read.
pub fn features(run: &RunFolder, trained: &Trained) -> Result<Option<SemanticFields>, PipelineError> {
    let fields = SemanticFields::load(run.root())?;
    Ok(fields.filter(|f| f.fits(trained, &f.config)))
}
