//! Training of the fields of features, for all spaces that a scene has features of: at frozen geometry, and then
//! together with it (DIV-FF, 4.1: "only the semantic heads ..., followed by the full model").

use std::ops::ControlFlow;
use std::path::Path;

use half::f16;
use rayon::prelude::*;

use super::cache::Sources;
use super::render::pixel_ray;
use super::scale::pyramid_targets;
use super::step::{Bags, HeadOptimiser, HeadStep, JointPlan, RayTargets};
use super::told::{Report, Told};
use super::{HeadShape, Heads};
use crate::config::Config;
use crate::field::mlp::Precision;
use crate::render::forward::{Model, RayInput};
use crate::render::rays::{View, pixel_directions};
use crate::rng::Rng;
use crate::scene::features::{FeatureStore, Space};
use crate::scene::{Frame, Scene, Split};
use crate::semantics::compress::{CompressConfig, Compressor};
use crate::semantics::config::SemanticsConfig;
use crate::semantics::error::SemanticsError;
use crate::semantics::fields::{SemanticFields, SpaceField};
use crate::semantics::targets::{EncodedTable, ImageMode, ImageTargets, PartTargets, VideoTargets};
use crate::train::{Session, Trained, Trainer, step};

/// Streams of random numbers: which pixels are kept, and the steps of each space.
const PIXEL_STREAM: u64 = 0x7069_7865;
const SPACE_SEED: u64 = 0x7370_6163;

/// Every so many pixels along rows and columns are looked at to tell how many have targets.
const SAMPLED: usize = 8;

/// Steps over which the learning rates rise to their full size.
const WARM_UP: f32 = 50.0;

/// Joint training goes through the schedules' rates from this share to their end.
const JOINT_FROM: f64 = 0.85;

/// How far training of the fields of features has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeadProgress {
    /// Name of the space, or that all are trained together with geometry.
    pub what: &'static str,
    /// Steps done.
    pub step: u64,
    /// Share of all steps that are done, 0–1.
    pub fraction: f64,
    /// Mean loss of the last step.
    pub loss: f64,
}

/// A pixel of the cache.
#[derive(Clone, Copy)]
pub(super) struct Pixel {
    pub frame: u32,
    pub x: u32,
    pub y: u32,
}

/// Targets of all spaces, for the training frames.
struct Targets {
    image: Option<ImageTargets>,
    video: Option<VideoTargets>,
    parts: Option<PartTargets>,
}

impl Targets {
    fn load(scene: &Scene, frames: &[Frame], config: &SemanticsConfig) -> Result<Self, SemanticsError> {
        let store = FeatureStore::open(scene)?;
        let video = VideoTargets::load(&store, frames, config.video)?;
        // Part features only shape the encoding that the video-language features are read from.
        let wanted = config.part_weight > 0.0 && video.is_some();
        let parts = if wanted { PartTargets::load(&store, frames)? } else { None };
        Ok(Self { image: ImageTargets::load(&store, frames, config.image)?, video, parts })
    }

    fn frames(&self) -> Vec<usize> {
        let image = self.image.iter().flat_map(ImageTargets::frames);
        let video = self.video.iter().flat_map(VideoTargets::frames);
        let mut all: Vec<usize> = image.chain(video).collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    fn any(&self, p: &Pixel) -> bool {
        let image = self.image.as_ref().is_some_and(|t| t.at(p.frame as usize, p.x, p.y).is_some());
        let video = || self.video.as_ref().map(|t| t.at(p.frame as usize, p.x, p.y));
        image || video().is_some_and(|v| v.patch.is_some() || v.clip.is_some())
    }
}

/// Reads all features that training would read, so that what is wrong with them shows before geometry is trained.
///
/// # Errors
/// [`SemanticsError`] for features that cannot be used.
pub fn check_features(scene: &Scene, config: &SemanticsConfig) -> Result<(), SemanticsError> {
    if config.enabled {
        let frames: Vec<Frame> = scene.frames.iter().filter(|f| f.split == Split::Train).cloned().collect();
        Targets::load(scene, &frames, config)?;
    }
    Ok(())
}

/// Trains the fields of all spaces that the scene has features of; what is absent is told in
/// [`SemanticFields::skipped`]. Geometry is trained with them in the end, where settings want it; `run` is where its
/// checkpoint is. Nothing is stored.
///
/// `None` if `report` says stop.
///
/// # Errors
/// [`SemanticsError`] for features that cannot be used, [`SemanticsError::NonFinite`] where their training diverges,
/// [`SemanticsError::Train`] if geometry cannot be trained on.
pub fn train_features(
    scene: &Scene,
    session: &mut Session,
    config: &Config,
    run: &Path,
    report: &mut Report,
) -> Result<Option<SemanticFields>, SemanticsError> {
    let (settings, trained) = (&config.semantics, session.trained());
    let mut fields = SemanticFields::empty(settings.clone(), trained);
    if !settings.enabled {
        fields.skip("clip", "semantics.enabled is off");
        fields.skip("egovideo", "semantics.enabled is off");
        return Ok(Some(fields));
    }
    let frames: Vec<Frame> = scene.frames.iter().filter(|f| f.split == Split::Train).cloned().collect();
    let targets = Targets::load(scene, &frames, settings)?;
    let warnings = targets.image.iter().flat_map(|t| &t.warnings);
    let warnings = warnings.chain(targets.video.iter().flat_map(|t| &t.warnings));
    fields.warnings = warnings.chain(targets.parts.iter().flat_map(|t| &t.warnings)).cloned().collect();
    let pixels = choose_pixels(&targets, &frames, settings, config.seed)?;
    let sources = trace(trained, config, &frames, &pixels);
    let store = FeatureStore::open(scene)?;
    let mut spaces = Vec::new();
    for space in Space::ALL {
        let trainer = match space {
            Space::Clip => SpaceTrainer::image(&targets, &pixels, &frames, &sources, config)?,
            Space::Egovideo => SpaceTrainer::video(&targets, &pixels, &frames, config)?,
        };
        match trainer {
            Some(trainer) => spaces.push(trainer.start(space, trained, config, &sources)),
            None => fields.skip(space.name(), "the scene has no features that its settings can use"),
        }
    }
    if targets.video.is_some() && targets.parts.is_none() {
        fields.skip("parts", "the scene has no part features, or their weight is 0");
    }
    let steps = spaces.len() as u64 * settings.steps + settings.joint_steps;
    let mut alone = Told { report: &mut *report, done: 0, steps };
    for space in &mut spaces {
        if space.train(config, &sources, &mut alone)?.is_break() {
            return Ok(None);
        }
    }
    drop(sources);
    let usable = spaces.iter().any(|s| !s.targets.usable.is_empty());
    if settings.joint_steps > 0 && trained.progress.joint == 0 && usable {
        let trainer = session.open(scene, config, run)?;
        if train_jointly(&mut spaces, trainer, &pixels, &frames, config, &mut alone)?.is_break() {
            return Ok(None);
        }
        fields.belongs_to(trainer.trained());
    }
    for SpaceTraining { space, heads, compressor, .. } in spaces {
        let model = store.model(space).map(str::to_owned);
        fields.spaces[space as usize] = Some(SpaceField { space, heads, compressor, model });
    }
    Ok(Some(fields))
}

/// Trains everything: by turns geometry alone, by all its losses, and geometry with the features of one space.
fn train_jointly(
    spaces: &mut [SpaceTraining],
    trainer: &mut Trainer,
    pixels: &[Pixel],
    frames: &[Frame],
    config: &Config,
    told: &mut Told,
) -> Result<ControlFlow<()>, SemanticsError> {
    let settings = &config.semantics;
    let joint = JointPlan {
        chunks: step::chunks(config.train.rays),
        samples: settings.samples,
        weight: settings.joint_weight,
    };
    let pixel = |ray: u32| {
        let Pixel { frame, x, y } = pixels[ray as usize];
        (frame as usize, (y * frames[frame as usize].camera.width + x) as usize)
    };
    trainer.go_on(settings.joint_steps);
    for n in 1..=settings.joint_steps {
        let share = JOINT_FROM + (1.0 - JOINT_FROM) * (n as f64 / settings.joint_steps as f64);
        let mut loss = 0.0;
        trainer.step(share, None)?;
        for space in spaces.iter_mut().filter(|s| !s.targets.usable.is_empty()) {
            let SpaceTraining { space, targets, heads, optimiser, .. } = space;
            let plan = plan(settings, config, settings.steps + n, share as f32, *space);
            let geometry = |companion: &dyn step::Companion| trainer.step(share, Some(companion)).map(drop);
            loss += optimiser.joint_step(heads, targets, pixel, (&plan, joint), geometry)?;
            optimiser.check(heads, *space, plan.step, n == settings.joint_steps)?;
        }
        if told.add("with geometry", n, n == settings.joint_steps, loss).is_break() {
            return Ok(ControlFlow::Break(()));
        }
    }
    Ok(ControlFlow::Continue(()))
}

/// One pixel, at random, of each square of a size that keeps to the number of rays, where it has a target and no mask
/// forbids it.
fn choose_pixels(
    targets: &Targets,
    frames: &[Frame],
    settings: &SemanticsConfig,
    seed: u64,
) -> Result<Vec<Pixel>, SemanticsError> {
    let with = targets.frames();
    // Some frames have targets in a corner only: what counts is how many pixels have one, by a sample of them.
    let sampled = |n: &usize| {
        let c = &frames[*n].camera;
        let lattice =
            (0..c.height).step_by(SAMPLED).flat_map(|y| (0..c.width).step_by(SAMPLED).map(move |x| (x, y)));
        lattice.filter(|(x, y)| targets.any(&Pixel { frame: *n as u32, x: *x, y: *y })).count()
    };
    let with_target = with.par_iter().map(sampled).sum::<usize>() * SAMPLED * SAMPLED;
    let side =
        (1..64u32).find(|side| with_target / (side * side) as usize <= settings.cached_rays).unwrap_or(64);
    let chosen: Vec<Result<Vec<Pixel>, SemanticsError>> = with
        .par_iter()
        .map(|n| {
            let frame = &frames[*n];
            let (width, height) = (frame.camera.width, frame.camera.height);
            let mask = frame.load_mask()?;
            let mut rng = Rng::new(seed, PIXEL_STREAM, *n as u64);
            let mut pixels = Vec::new();
            for (y, x) in (0..height)
                .step_by(side as usize)
                .flat_map(|y| (0..width).step_by(side as usize).map(move |x| (y, x)))
            {
                let (dx, dy) = (rng.below(side as usize) as u32, rng.below(side as usize) as u32);
                let (x, y) = ((x + dx).min(width - 1), (y + dy).min(height - 1));
                let pixel = Pixel { frame: *n as u32, x, y };
                let usable = mask.as_ref().is_none_or(|m| m[(y * width + x) as usize]);
                if usable && targets.any(&pixel) {
                    pixels.push(pixel);
                }
            }
            Ok(pixels)
        })
        .collect();
    let mut all = Vec::new();
    for pixels in chosen {
        all.extend(pixels?);
    }
    Ok(all)
}

fn trace(trained: &Trained, config: &Config, frames: &[Frame], pixels: &[Pixel]) -> Sources {
    let model = Model::new(&trained.field, &trained.grids, [true; 3]);
    let views: Vec<View> = frames.iter().map(|f| View::new(&trained.field, f)).collect();
    let mut inputs: Vec<RayInput> = Vec::with_capacity(pixels.len());
    for of_frame in pixels.chunk_by(|a, b| a.frame == b.frame) {
        let frame = &frames[of_frame[0].frame as usize];
        let directions = pixel_directions(&frame.camera);
        let ray = |p: &Pixel| {
            let pixel = (p.y * frame.camera.width + p.x) as usize;
            pixel_ray(frame, &directions, p.frame, pixel)
        };
        inputs.extend(of_frame.iter().map(ray));
    }
    Sources::trace(&model, &views, &inputs, &config.train.render_sampling(), config.semantics.samples)
}

/// What one space is trained with.
struct SpaceTrainer {
    compressor: Compressor,
    targets: RayTargets,
    parts: usize,
    frames: usize,
}

/// Target of one pixel: what it adds to `[width]` and the weights of its two parts.
pub(super) type Target = Option<(Vec<f32>, [f32; 2])>;

impl SpaceTrainer {
    fn image(
        targets: &Targets,
        pixels: &[Pixel],
        frames: &[Frame],
        sources: &Sources,
        config: &Config,
    ) -> Result<Option<Self>, SemanticsError> {
        let Some(image) = &targets.image else { return Ok(None) };
        let compressor = Compressor::fit(&image.table, &config.semantics.compress, config.seed)?;
        let encoded = image.table.encode(&compressor);
        let dim = compressor.dim();
        let of = |p: &Pixel| {
            let blend = image.at(p.frame as usize, p.x, p.y)?;
            let mut z = vec![0.0; dim];
            encoded.blend(&blend, &mut z);
            Some((z, [1.0, 0.0]))
        };
        let targets = match config.semantics.image.mode {
            ImageMode::ScaledPatches => pyramid_targets(image, &encoded, pixels, frames, &sources.depth),
            _ => gather(pixels, frames, dim, dim, of),
        };
        let frames = image.frames().count();
        Ok((!targets.usable.is_empty()).then_some(Self { compressor, targets, parts: 0, frames }))
    }

    fn video(
        targets: &Targets,
        pixels: &[Pixel],
        frames: &[Frame],
        config: &Config,
    ) -> Result<Option<Self>, SemanticsError> {
        let Some(video) = &targets.video else { return Ok(None) };
        let settings = &config.semantics;
        let compressor = Compressor::fit(&video.table, &settings.compress, config.seed)?;
        let encoded = video.table.encode(&compressor);
        let parts: Option<(&PartTargets, EncodedTable)> = match &targets.parts {
            Some(parts) => {
                let dim = settings.part_dim.min(parts.table.dim());
                let config = CompressConfig { dim: Some(dim), ..CompressConfig::default() };
                let map = Compressor::fit(&parts.table, &config, 0)?;
                Some((parts, parts.table.encode(&map)))
            }
            None => None,
        };
        let dim = compressor.dim();
        let part_dim = parts.as_ref().map_or(0, |p| p.1.dim);
        let of = |p: &Pixel| {
            let frame = p.frame as usize;
            let found = video.at(frame, p.x, p.y);
            let (mut z, mut count) = (vec![0.0; dim + part_dim], 0.0f32);
            if let Some(blend) = &found.patch {
                encoded.blend(blend, &mut z[..dim]);
                count += 1.0;
            }
            if let Some(row) = found.clip {
                z.iter_mut().zip(encoded.row(row)).for_each(|(z, v)| *z += v);
                count += 1.0;
            }
            if count == 0.0 {
                return None;
            }
            if settings.pooled_rays > 0 {
                // Descriptors are held against bags of rays.
                z[..dim].fill(0.0);
                count = 0.0;
            }
            // |f − a|² + |f − b|² = 2 |f − (a + b)/2|² and a constant.
            z[..dim].iter_mut().for_each(|v| *v /= count.max(1.0));
            let part = parts.as_ref().and_then(|(t, e)| Some(e.row(t.at(frame, p.x, p.y)?)));
            if let Some(part) = part {
                z[dim..].copy_from_slice(part);
            }
            Some((z, [count, if part.is_some() { settings.part_weight } else { 0.0 }]))
        };
        let mut targets = gather(pixels, frames, dim + part_dim, dim, of);
        if settings.pooled_rays > 0 {
            targets.bags = bags(video, &encoded, pixels);
            targets.usable = targets.bags.members.clone();
        }
        let frames = video.frames().count();
        Ok((!targets.usable.is_empty()).then_some(Self { compressor, targets, parts: part_dim, frames }))
    }

    /// Untrained fields for the geometry of `trained`.
    fn start(self, space: Space, trained: &Trained, config: &Config, sources: &Sources) -> SpaceTraining {
        let Self { compressor, mut targets, parts, frames } = self;
        let seen = |n: &u32| !sources.of(*n as usize).is_empty();
        targets.usable.retain(seen);
        targets.bags = targets.bags.only(targets.dim, seen);
        let settings = &config.semantics;
        let mut shape = HeadShape::new(settings, &trained.field.shape, frames, compressor.dim(), parts);
        shape.scales = targets.pyramid.as_ref().map(|p| p.sizes(&targets.usable));
        let mut heads = Heads::zeros(shape);
        heads.init(config.seed.wrapping_add(space as u64));
        let optimiser = HeadOptimiser::new(&heads);
        SpaceTraining { space, compressor, targets, heads, optimiser }
    }
}

/// A space in training.
struct SpaceTraining {
    space: Space,
    compressor: Compressor,
    targets: RayTargets,
    heads: Heads,
    optimiser: HeadOptimiser,
}

impl SpaceTraining {
    /// Trains at frozen geometry.
    fn train(
        &mut self,
        config: &Config,
        sources: &Sources,
        told: &mut Told,
    ) -> Result<ControlFlow<()>, SemanticsError> {
        let Self { space, targets, heads, optimiser, .. } = self;
        let steps = config.semantics.steps;
        for step in 1..=if targets.usable.is_empty() { 0 } else { steps } {
            let share = (step - 1) as f32 / steps as f32;
            let plan = plan(&config.semantics, config, step, share, *space);
            let loss = optimiser.step(heads, sources, targets, &plan);
            optimiser.check(heads, *space, step, step == steps)?;
            if told.add(space.name(), step, step == steps, loss).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }
}

/// Warm-up, then cosine annealing, at the share `at` of the schedule.
fn plan(settings: &SemanticsConfig, config: &Config, step: u64, at: f32, space: Space) -> HeadStep {
    let rate = 0.5 * (1.0 + (std::f32::consts::PI * at).cos()) * (step as f32 / WARM_UP).min(1.0);
    HeadStep {
        step,
        rays: settings.rays,
        bag: settings.pooled_rays,
        table_rate: settings.table_rate * rate,
        network_rate: settings.network_rate * rate,
        precision: Precision::Auto,
        seed: config.seed ^ (SPACE_SEED + space as u64),
    }
}

/// The rays of each patch, and of the clip's hotspot in each frame, with their descriptors.
fn bags(video: &VideoTargets, encoded: &EncodedTable, pixels: &[Pixel]) -> Bags {
    let mut bags = Bags::default();
    let mut first = 0u32;
    for of_frame in pixels.chunk_by(|a, b| a.frame == b.frame) {
        let frame = of_frame[0].frame as usize;
        let numbered = || (first..).zip(of_frame);
        for ([left, top, right, bottom], row) in video.patches(frame) {
            let inside = |p: &Pixel| {
                let (x, y) = (f64::from(p.x) + 0.5, f64::from(p.y) + 0.5);
                (left..right).contains(&x) && (top..bottom).contains(&y)
            };
            bags.push(numbered().filter(|(_, p)| inside(p)).map(|(n, _)| n), encoded.row(row));
        }
        let clip = |p: &Pixel| video.at(frame, p.x, p.y).clip;
        if let Some(row) = of_frame.iter().find_map(clip) {
            bags.push(numbered().filter(|(_, p)| clip(p).is_some()).map(|(n, _)| n), encoded.row(row));
        }
        first += of_frame.len() as u32;
    }
    bags
}

/// The targets of all pixels as one table.
pub(super) fn gather(
    pixels: &[Pixel],
    frames: &[Frame],
    width: usize,
    dim: usize,
    of: impl Fn(&Pixel) -> Target + Sync,
) -> RayTargets {
    let mut values = vec![f16::ZERO; pixels.len() * width];
    let weights: Vec<[f32; 2]> = values
        .par_chunks_mut(width)
        .zip(pixels)
        .map(|(out, pixel)| {
            let Some((z, weights)) = of(pixel) else { return [0.0; 2] };
            out.iter_mut().zip(z).for_each(|(o, v)| *o = f16::from_f32(v));
            weights
        })
        .collect();
    let usable = (0..pixels.len() as u32).filter(|n| weights[*n as usize][0] > 0.0).collect();
    let times = pixels.iter().map(|p| frames[p.frame as usize].time as f32).collect();
    RayTargets { width, dim, values, weights, usable, times, ..RayTargets::default() }
}
