//! The fields of features of a run: trained once for a geometry and some settings.

use std::ops::ControlFlow;
use std::time::Instant;

use divff_exporters::ExrChannel;

use super::{Event, Observer, PipelineError, RunFolder, Stage};
use crate::config::Config;
use crate::eval::{Metrics, MovedObjects, PhraseTruth, ScoreSums};
use crate::render::forward::Model;
use crate::render::sampler::Sampling;
use crate::scene::features::Space;
use crate::scene::{Frame, Scene, Split};
use crate::semantics::agreement::feature_cosines;
use crate::semantics::head::train;
use crate::semantics::layers::FeatureLayers;
use crate::semantics::{SemanticFields, SemanticsError, TextSources};
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

/// The measures of the features over the test frames, as far as the scene has truth for them.
pub(super) struct SemanticEvaluation<'a> {
    scene: &'a Scene,
    config: &'a Config,
    fields: Option<&'a SemanticFields>,
    truth: PhraseTruth,
    layers: FeatureLayers<'a>,
    sums: ScoreSums,
    moved: MovedObjects,
    /// Why a space has no score.
    why: [Option<String>; 2],
}

impl<'a> SemanticEvaluation<'a> {
    /// Prepares the phrases of the truth, those without an embedding aside.
    pub(super) fn new(
        scene: &'a Scene,
        fields: Option<&'a SemanticFields>,
        config: &'a Config,
    ) -> Result<Self, PipelineError> {
        let truth = PhraseTruth::read(scene)?;
        let mut layers = FeatureLayers::new(&config.semantics);
        let mut why = [None, None];
        let fields = fields.filter(|f| !f.is_empty());
        let text = if fields.is_some() { TextSources::of_scene(scene)? } else { TextSources::encoders()? };
        for space in Space::ALL {
            let asked = truth.phrases(space);
            let known = |p: &String| text.embedding(space, p).is_ok();
            let phrases: Vec<String> = asked.iter().filter(|p| known(p)).cloned().collect();
            let reason = match fields.map(|f| f.space(space)) {
                _ if asked.is_empty() => Some("the scene has no truth for it".to_owned()),
                None => Some("the run has no features".to_owned()),
                Some(Err(error)) => Some(error.to_string()),
                Some(Ok(_)) if phrases.is_empty() || text.canonical(space).is_empty() => Some(format!(
                    "the scene has no embeddings of its phrases, or none of {:?}",
                    space.canonical_phrases()
                )),
                Some(Ok(_)) => None,
            };
            if let (None, Some(fields)) = (&reason, fields) {
                layers.add(fields, space, false, &phrases, &text, config.semantics.temperature)?;
            }
            why[space as usize] = reason;
        }
        let moved =
            if layers.is_empty() { MovedObjects::default() } else { MovedObjects::read(scene, &truth)? };
        Ok(Self { scene, config, fields, truth, layers, sums: ScoreSums::default(), moved, why })
    }

    /// Scores a frame; the layers that show it.
    pub(super) fn add(
        &mut self,
        model: &Model,
        frame: &Frame,
        sampling: &Sampling,
    ) -> Result<Vec<ExrChannel>, Box<dyn std::error::Error + Send + Sync>> {
        if self.layers.is_empty() {
            return Ok(Vec::new());
        }
        let found = self.layers.render(model, frame, sampling)?;
        self.sums.add(&self.truth, frame, &found.scores)?;
        self.moved.add(self.scene, &self.truth, frame, &found.scores)?;
        Ok(found.channels())
    }

    /// Puts the measures in their place.
    pub(super) fn fill_in(
        self,
        metrics: &mut Metrics,
        model: &Model,
        sampling: &Sampling,
    ) -> Result<(), PipelineError> {
        self.moved.fill_in(metrics);
        self.sums.fill_in(metrics, self.why);
        let Some(fields) = self.fields else { return Ok(()) };
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
        Ok(())
    }
}
