//! Features and relevancies as layers of rendered frames.

use divff_exporters::{ExrChannel, ExrSamples};
use half::f16;

use super::config::SemanticsConfig;
use super::error::SemanticsError;
use super::fields::{SemanticFields, SpaceField};
use super::head::{FeatureImage, HeadModel, render_features, trace_frame};
use super::relevancy::Queries;
use super::text_source::{TextSources, slug};
use crate::field::mlp::Precision;
use crate::render::forward::Model;
use crate::render::sampler::Sampling;
use crate::scene::Frame;
use crate::scene::features::Space;

/// What is asked of one space.
struct Asked<'a> {
    field: &'a SpaceField,
    heads: HeadModel<'a>,
    /// Whether the features themselves are wanted.
    features: bool,
    phrases: Vec<String>,
    queries: Option<Queries>,
}

/// Phrases to be held against rendered features, and features to be kept.
pub struct FeatureLayers<'a> {
    spaces: Vec<Asked<'a>>,
    samples: usize,
    query_scales: usize,
}

/// Features and scores of one frame.
#[derive(Clone, Debug, Default)]
pub struct FrameFeatures {
    /// Opacity of the streams that were asked for, per pixel.
    pub coverage: Vec<f32>,
    /// Space, phrase and score per pixel.
    pub scores: Vec<(Space, String, Vec<f32>)>,
    /// Features of the spaces that were asked for.
    pub features: Vec<(Space, FeatureImage)>,
}

impl<'a> FeatureLayers<'a> {
    /// Nothing yet.
    pub fn new(config: &SemanticsConfig) -> Self {
        let (samples, query_scales) = (config.samples.max(8), config.query_scales);
        Self { spaces: Vec::new(), samples, query_scales }
    }

    /// Adds the features of a space, if `features`, and the scores of `phrases`; `temperature` is τ.
    ///
    /// # Errors
    /// The run has no such features; a phrase without an embedding, or one that does not fit.
    pub fn add(
        &mut self,
        fields: &'a SemanticFields,
        space: Space,
        features: bool,
        phrases: &[String],
        text: &TextSources,
        temperature: f32,
    ) -> Result<(), SemanticsError> {
        let field = fields.space(space)?;
        let queries = match phrases.is_empty() {
            true => None,
            false => Some(field.queries(text, phrases, temperature)?),
        };
        let heads = HeadModel::new(&field.heads, Precision::F32);
        self.spaces.push(Asked { field, heads, features, phrases: phrases.to_vec(), queries });
        Ok(())
    }

    /// Whether nothing is asked for.
    pub fn is_empty(&self) -> bool {
        self.spaces.is_empty()
    }

    /// Renders a frame with the streams of `model`.
    ///
    /// # Errors
    /// [`SemanticsError::Relevancy`] for features that are not finite.
    pub fn render(
        &self,
        model: &Model,
        frame: &Frame,
        sampling: &Sampling,
    ) -> Result<FrameFeatures, SemanticsError> {
        let sources = trace_frame(model, frame, sampling, self.samples);
        let mut out = FrameFeatures { coverage: sources.opacity.clone(), ..FrameFeatures::default() };
        for asked in &self.spaces {
            let at = |size: f32| render_features(&asked.heads, &sources, frame.time as f32, |_| size);
            let shape = &asked.heads.heads.shape;
            let image = at(shape.middle_size());
            let space = asked.field.space;
            if let Some(queries) = &asked.queries {
                let others = shape.other_sizes(self.query_scales);
                let found = queries.best_scores(&image.values, &others, |size| at(size).values)?;
                let named = asked.phrases.iter().cloned().zip(found);
                out.scores.extend(named.map(|(phrase, scores)| (space, phrase, scores)));
            }
            if asked.features {
                out.features.push((space, image));
            }
        }
        Ok(out)
    }
}

impl FrameFeatures {
    /// The scores of a phrase in a space, per pixel; `None` if it was not asked.
    pub fn scores_of(&self, space: Space, phrase: &str) -> Option<&[f32]> {
        self.scores.iter().find(|s| s.0 == space && s.1 == phrase).map(|s| s.2.as_slice())
    }

    /// As channels: `coverage.Y`, `relevancy_<slug>.Y`, and features in quads `<space>_pca_000.R .G .B .A`.
    pub fn channels(&self) -> Vec<ExrChannel> {
        let half = |name: String, values: &mut dyn Iterator<Item = f32>| ExrChannel {
            name,
            samples: ExrSamples::F16(values.map(f16::from_f32).collect()),
        };
        let mut channels = vec![half("coverage.Y".into(), &mut self.coverage.iter().copied())];
        for (_, phrase, scores) in &self.scores {
            let name = format!("relevancy_{}.Y", slug(phrase));
            // A phrase that is asked in both spaces, or twice, keeps its first layer.
            if channels.iter().all(|c| c.name != name) {
                channels.push(half(name, &mut scores.iter().copied()));
            }
        }
        for (space, image) in &self.features {
            for k in 0..image.dim {
                let component = ["R", "G", "B", "A"][k % 4];
                let name = format!("{}_pca_{:03}.{component}", space.name(), k / 4);
                channels.push(half(name, &mut image.values.chunks_exact(image.dim).map(|f| f[k])));
            }
        }
        channels
    }
}
