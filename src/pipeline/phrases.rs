//! Phrases of the truth held against fields of features, frame by frame.

use super::PipelineError;
use crate::config::Config;
use crate::eval::{PhraseTruth, ScoreSums, Task};
use crate::render::forward::Model;
use crate::render::sampler::Sampling;
use crate::scene::Frame;
use crate::scene::features::Space;
use crate::semantics::layers::{FeatureLayers, FrameFeatures};
use crate::semantics::{SemanticFields, SemanticsError, TextSources};

/// One task asked of one space.
pub(super) struct Asked {
    pub task: Task,
    pub space: Space,
    pub sums: ScoreSums,
    /// Why nothing can be asked.
    pub why: Option<String>,
}

/// Scores of tasks in spaces, added up over frames.
pub(super) struct PhraseEvaluation<'a> {
    truth: PhraseTruth,
    layers: FeatureLayers<'a>,
    asked: Vec<Asked>,
}

impl<'a> PhraseEvaluation<'a> {
    /// Prepares the phrases of tasks for spaces of `fields`; those without an embedding are left out.
    pub(super) fn new(
        truth: PhraseTruth,
        fields: Option<&'a SemanticFields>,
        config: &Config,
        asked: &[(Task, Space)],
        text: &TextSources,
    ) -> Result<Self, SemanticsError> {
        let mut layers = FeatureLayers::new(&config.semantics);
        let mut tasks = Vec::new();
        // All phrases that a space is asked, for its features are rendered once.
        let mut together: [Vec<String>; 2] = Default::default();
        for &(task, space) in asked {
            let wanted = truth.phrases(task);
            let known: Vec<String> =
                wanted.iter().filter(|p| text.embedding(space, p).is_ok()).cloned().collect();
            let why = match fields.map(|f| f.space(space)) {
                _ if wanted.is_empty() => Some("the scene has no truth for it".to_owned()),
                None => Some("the run has no features".to_owned()),
                Some(Err(error)) => Some(error.to_string()),
                Some(Ok(_)) if known.is_empty() || text.canonical(space).is_empty() => Some(format!(
                    "the scene has no embeddings of its phrases, or none of {:?}",
                    space.canonical_phrases()
                )),
                Some(Ok(_)) => None,
            };
            if why.is_none() {
                let phrases = &mut together[space as usize];
                let new: Vec<String> = known.into_iter().filter(|p| !phrases.contains(p)).collect();
                phrases.extend(new);
            }
            tasks.push(Asked { task, space, sums: ScoreSums::new(task), why });
        }
        for (space, phrases) in Space::ALL.into_iter().zip(together) {
            if let (Some(fields), false) = (fields, phrases.is_empty()) {
                layers.add(fields, space, false, &phrases, text, config.semantics.temperature)?;
            }
        }
        Ok(Self { truth, layers, asked: tasks })
    }

    /// Whether nothing can be asked.
    pub(super) fn is_empty(&self) -> bool {
        self.layers.is_empty()
    }

    /// Renders and scores a frame; `None` where nothing can be asked.
    pub(super) fn add(
        &mut self,
        model: &Model,
        frame: &Frame,
        sampling: &Sampling,
    ) -> Result<Option<FrameFeatures>, PipelineError> {
        if self.is_empty() {
            return Ok(None);
        }
        let found = self.layers.render(model, frame, sampling)?;
        for Asked { space, sums, why, .. } in &mut self.asked {
            if why.is_none() {
                let scores = |phrase: &str| found.scores_of(*space, phrase);
                sums.add(&self.truth, frame, scores)?;
            }
        }
        Ok(Some(found))
    }

    /// What was found.
    pub(super) fn finish(self) -> Vec<Asked> {
        self.asked
    }
}
