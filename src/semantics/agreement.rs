//! How well rendered features agree with what they were learned from.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::compress::Compressor;
use super::config::SemanticsConfig;
use super::error::SemanticsError;
use super::fields::{SemanticFields, SpaceField};
use super::head::{HeadModel, render_features, trace_pixels};
use super::relevancy::Points;
use super::targets::{ImageTargets, TargetTable, VideoTargets};
use super::text_source::TextSources;
use crate::field::mlp::Precision;
use crate::render::forward::Model;
use crate::render::sampler::Sampling;
use crate::scene::features::{Blend, FeatureStore, Space};
use crate::scene::{Frame, Scene, Split};

/// Frames of a split that are looked at, evenly spread; not all of them have features.
const FRAMES: usize = 24;

/// Scale at which fields with scales are compared, as a share of the image's height: the middle of LERF's pyramid.
const SHARE: f32 = 1.0 / 3.0;

/// Phrases that compressed descriptors are asked.
const PHRASES: usize = 256;

/// A descriptor answers a phrase where its relevancy is above this.
const ANSWERS: f32 = 0.5;

/// Every so many pixels along a frame's rows and columns.
const STRIDE: u32 = 4;

/// Mean cosine between rendered descriptors and those of the scene, for each space: over test frames if they have
/// features, else over training frames. With the split; `None` where there is nothing to compare.
///
/// # Errors
/// Features that cannot be read.
pub fn feature_cosines(
    scene: &Scene,
    model: &Model,
    fields: &SemanticFields,
    config: &SemanticsConfig,
    sampling: &Sampling,
) -> Result<[Option<(f64, Split)>; 2], SemanticsError> {
    let store = FeatureStore::open(scene)?;
    let mut found = [None, None];
    for split in [Split::Test, Split::Train] {
        let all: Vec<&Frame> = scene.frames.iter().filter(|f| f.split == split).collect();
        let frames: Vec<Frame> = spread(&all).cloned().collect();
        for (n, field) in fields.spaces.iter().enumerate() {
            let (Some(field), None) = (field, found[n]) else { continue };
            let heads = HeadModel::new(&field.heads, Precision::F32);
            let rendered = |frame: &Frame, wanted: &[Wanted]| {
                let sources =
                    trace_pixels(model, frame, wanted.iter().map(|w| w.0), sampling, config.samples);
                // Fields with scales are held against patches of one scale, at the size that this is at every pixel.
                let height = SHARE * (f64::from(frame.camera.height) / frame.camera.fy) as f32;
                let size = |ray: usize| height * sources.depth[ray];
                render_features(&heads, &sources, frame.time as f32, size).values
            };
            let of = Compared { compressor: &field.compressor, frames: &frames };
            let mean = match field.space {
                Space::Clip => ImageTargets::load(&store, &frames, config.image)?.and_then(|t| {
                    let scaled = field.heads.shape.scales.is_some();
                    let target = |f, x, y| if scaled { t.at_scale(f, x, y, SHARE) } else { t.at(f, x, y) };
                    of.mean(&t.table, t.frames().collect(), rendered, target)
                }),
                Space::Egovideo => VideoTargets::load(&store, &frames, config.video)?.and_then(|t| {
                    of.mean(&t.table, t.frames().collect(), rendered, |f, x, y| t.at(f, x, y).patch)
                }),
            };
            found[n] = mean.map(|m| (m, split));
        }
    }
    Ok(found)
}

/// What compressing the descriptors of a space loses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Compression {
    /// Numbers per compressed descriptor.
    pub dimensions: usize,
    /// Numbers per descriptor of the scene.
    pub of: usize,
    /// 1 − mean cosine between descriptors and what comes back of them.
    pub cosine_error: f64,
    /// Mean over phrases of the IoU of the descriptors that answer them compressed with those that do as they are;
    /// `None` where no phrase is known that any of them answers.
    pub answers_iou: Option<f64>,
}

/// What compression loses for each space, over descriptors of training frames and phrases that are known without an
/// encoder.
///
/// # Errors
/// Features or phrases that cannot be used.
pub fn compression(
    scene: &Scene,
    fields: &SemanticFields,
    text: &TextSources,
) -> Result<[Option<Compression>; 2], SemanticsError> {
    let (store, config) = (FeatureStore::open(scene)?, &fields.config);
    let all: Vec<&Frame> = scene.frames.iter().filter(|f| f.split == Split::Train).collect();
    let frames: Vec<Frame> = spread(&all).cloned().collect();
    let mut found = [None, None];
    for field in fields.spaces.iter().flatten() {
        let table = match field.space {
            Space::Clip => ImageTargets::load(&store, &frames, config.image)?.map(|t| t.table),
            Space::Egovideo => VideoTargets::load(&store, &frames, config.video)?.map(|t| t.table),
        };
        let answers_iou = match table {
            Some(table) => answers_iou(&table, field, text, config.temperature)?,
            None => None,
        };
        let compressor = &field.compressor;
        let (dimensions, of, cosine_error) = (compressor.dim(), compressor.full(), compressor.error);
        found[field.space as usize] = Some(Compression { dimensions, of, cosine_error, answers_iou });
    }
    Ok(found)
}

fn answers_iou(
    table: &TargetTable,
    field: &SpaceField,
    text: &TextSources,
    temperature: f32,
) -> Result<Option<f64>, SemanticsError> {
    let (space, compressor) = (field.space, &field.compressor);
    let phrases = text.phrases(space, PHRASES);
    if phrases.is_empty() || text.canonical(space).is_empty() {
        return Ok(None);
    }
    let rows = table.sample(usize::MAX);
    let mut codes = vec![0.0; rows.len() / compressor.full() * compressor.dim()];
    compressor.encode(&rows, &mut codes);
    let whole = text.plain_queries(space, &phrases, temperature)?.score(Points::F32(&rows))?.scores;
    let short = text.queries(space, compressor, &phrases, temperature)?.score(Points::F32(&codes))?.scores;
    Ok(mean_answers_iou(&whole, &short))
}

/// Mean over phrases of the IoU of what answers them by two lists of scores; `None` if nothing answers any of them.
pub(crate) fn mean_answers_iou(a: &[Vec<f32>], b: &[Vec<f32>]) -> Option<f64> {
    let iou = |(a, b): (&Vec<f32>, &Vec<f32>)| {
        let pairs = || a.iter().zip(b).map(|(a, b)| (*a > ANSWERS, *b > ANSWERS));
        let (both, any) = (pairs().filter(|p| p.0 && p.1).count(), pairs().filter(|p| p.0 || p.1).count());
        (any > 0).then(|| both as f64 / any as f64)
    };
    let ious: Vec<f64> = a.iter().zip(b).filter_map(iou).collect();
    (!ious.is_empty()).then(|| ious.iter().sum::<f64>() / ious.len() as f64)
}

/// At most [`FRAMES`] of a list, evenly spread.
fn spread<'a>(all: &'a [&'a Frame]) -> impl Iterator<Item = &'a Frame> {
    let count = all.len().min(FRAMES);
    (0..count).map(move |n| all[n * all.len() / count])
}

/// Number of a pixel and its target.
type Wanted = (usize, Blend);

struct Compared<'a> {
    compressor: &'a Compressor,
    frames: &'a [Frame],
}

impl Compared<'_> {
    fn mean(
        &self,
        table: &TargetTable,
        with: Vec<usize>,
        rendered: impl Fn(&Frame, &[Wanted]) -> Vec<f32>,
        target: impl Fn(usize, u32, u32) -> Option<Blend> + Sync,
    ) -> Option<f64> {
        let (full, dim) = (table.dim(), self.compressor.dim());
        let (mut sum, mut count) = (0.0, 0usize);
        for n in with {
            let camera = &self.frames[n].camera;
            let wanted: Vec<Wanted> = (0..camera.height)
                .step_by(STRIDE as usize)
                .flat_map(|y| (0..camera.width).step_by(STRIDE as usize).map(move |x| (x, y)))
                .filter_map(|(x, y)| Some(((y * camera.width + x) as usize, target(n, x, y)?)))
                .collect();
            if wanted.is_empty() {
                continue;
            }
            let codes = rendered(&self.frames[n], &wanted);
            let cosines: Vec<f64> = wanted
                .par_iter()
                .zip(codes.par_chunks_exact(dim))
                .map(|((_, blend), code)| {
                    let (mut truth, mut ours) = (vec![0.0; full], vec![0.0; full]);
                    table.blend(blend, &mut truth);
                    self.compressor.decode(code, &mut ours);
                    cosine(&truth, &ours)
                })
                .collect();
            sum += cosines.iter().sum::<f64>();
            count += cosines.len();
        }
        (count > 0).then(|| sum / count as f64)
    }
}

/// Cosine of two vectors; 0 where one is zero.
pub(crate) fn cosine(a: &[f32], b: &[f32]) -> f64 {
    let dot =
        |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let norms = (dot(a, a) * dot(b, b)).sqrt();
    if norms > 0.0 { dot(a, b) / norms } else { 0.0 }
}
