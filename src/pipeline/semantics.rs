//! The fields of features of a run: trained once for a geometry and some settings.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::time::Instant;

use divff_exporters::ExrChannel;

use super::phrases::PhraseEvaluation;
use super::{Event, Observer, PipelineError, RunFolder, Stage};
use crate::config::Config;
use crate::eval::{Metrics, MovedObjects, PhraseTruth, Task};
use crate::render::forward::Model;
use crate::render::sampler::Sampling;
use crate::scene::features::Space;
use crate::scene::{Frame, Scene, Split};
use crate::semantics::agreement::{Compression, compression, feature_cosines};
use crate::semantics::head::train;
use crate::semantics::{SemanticFields, SemanticsError, TextSources};
use crate::train::{Session, Trained};

/// Trains the fields of features on the geometry of `session` and stores them, and the geometry where it was trained
/// with them; those of an earlier call with the same geometry and settings are taken as they are. `None` if the observer
/// said stop.
///
/// # Errors
/// Features that cannot be used, or a file that cannot be written.
pub fn train_features(
    scene: &Scene,
    mut session: Session,
    config: &Config,
    run: &RunFolder,
    observer: &mut dyn Observer,
) -> Result<Option<(SemanticFields, Trained)>, PipelineError> {
    match SemanticFields::load(run.root()) {
        Ok(Some(fields)) if fields.fits(session.trained(), &config.semantics) => {
            return Ok(Some((fields, session.into_trained())));
        }
        // Damaged or of another version: what is derived is made again.
        Ok(_) | Err(SemanticsError::Stored(_)) => {}
        Err(error) => return Err(error.into()),
    }
    observer.event(&Event::Stage(Stage::Features));
    let start = Instant::now();
    let before = session.trained().progress.joint;
    let found = train::train_features(scene, &mut session, config, run.root(), &mut |progress| {
        observer.event(&Event::Features(progress));
        if observer.stop() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    let Some(mut fields) = found else { return Ok(None) };
    for warning in &fields.warnings {
        tracing::warn!("{warning}");
    }
    fields.seconds = start.elapsed().as_secs_f64();
    fields.save(run.root())?;
    if session.trained().progress.joint > before {
        // After the features: a run that is stopped between the two has features of no geometry, and makes both again.
        session.open(scene, config, run.root())?.save(run.root())?;
    }
    Ok(Some((fields, session.into_trained())))
}

/// The fields of features of a run; `None` if none were trained, or on another geometry.
///
/// # Errors
/// A file that is damaged or cannot be read.
pub fn features(run: &RunFolder, trained: &Trained) -> Result<Option<SemanticFields>, PipelineError> {
    let fields = SemanticFields::load(run.root())?;
    Ok(fields.filter(|f| f.fits(trained, &f.config)))
}

/// The measures of the features over the test frames, as far as the scene has truth for them.
pub(super) struct SemanticEvaluation<'a> {
    scene: &'a Scene,
    config: &'a Config,
    fields: Option<&'a SemanticFields>,
    truth: PhraseTruth,
    text: TextSources,
    phrases: PhraseEvaluation<'a>,
    moved: MovedObjects,
}

impl<'a> SemanticEvaluation<'a> {
    /// Prepares the phrases of the truth, those without an embedding aside.
    pub(super) fn new(
        scene: &'a Scene,
        fields: Option<&'a SemanticFields>,
        config: &'a Config,
    ) -> Result<Self, PipelineError> {
        let truth = PhraseTruth::read(scene)?;
        let with = fields.filter(|f| !f.is_empty());
        let text = if with.is_some() { TextSources::of_scene(scene)? } else { TextSources::encoders()? };
        let asked = Task::ALL.map(|task| (task, task.space()));
        let phrases = PhraseEvaluation::new(truth.clone(), with, config, &asked, &text)?;
        let moved = match phrases.is_empty() {
            true => MovedObjects::default(),
            false => MovedObjects::read(scene, &truth)?,
        };
        Ok(Self { scene, config, fields, truth, text, phrases, moved })
    }

    /// Scores a frame; the layers that show it.
    pub(super) fn add(
        &mut self,
        model: &Model,
        frame: &Frame,
        sampling: &Sampling,
    ) -> Result<Vec<ExrChannel>, Box<dyn std::error::Error + Send + Sync>> {
        let Some(found) = self.phrases.add(model, frame, sampling)? else { return Ok(Vec::new()) };
        self.moved.add(self.scene, &self.truth, frame, &found.scores)?;
        Ok(found.channels())
    }

    /// Puts the measures in their place; what compression loses.
    pub(super) fn fill_in(
        self,
        metrics: &mut Metrics,
        model: &Model,
        sampling: &Sampling,
    ) -> Result<BTreeMap<String, Compression>, PipelineError> {
        self.moved.fill_in(metrics);
        for asked in self.phrases.finish() {
            asked.sums.fill_in(metrics, asked.why);
        }
        let Some(fields) = self.fields else { return Ok(BTreeMap::new()) };
        let cosines = feature_cosines(self.scene, model, fields, &self.config.semantics, sampling)?;
        for (space, found) in Space::ALL.into_iter().zip(cosines) {
            let name = format!("feature_cosine_{}", space.name());
            let value = found.map(|f| f.0);
            match space {
                Space::Clip => metrics.feature_cosine_clip = value,
                Space::Egovideo => metrics.feature_cosine_egovideo = value,
            }
            match found {
                Some((_, Split::Test)) => None,
                Some((_, Split::Train)) => metrics
                    .absent
                    .insert(name, "no test frame has features; measured on training frames".into()),
                None => metrics.absent.insert(name, "no frame has features of this space".into()),
            };
        }
        let compression = compression(self.scene, fields, &self.text)?;
        let named = Space::ALL.into_iter().zip(compression);
        Ok(named.filter_map(|(space, c)| Some((space.name().to_owned(), c?))).collect())
    }
}
