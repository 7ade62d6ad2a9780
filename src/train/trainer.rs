//! The training loop.

use std::ops::ControlFlow;
use std::path::Path;
use std::time::{Duration, Instant};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::checkpoint::{Trained, TrainingState};
use super::config::StreamChoice;
use super::error::TrainError;
use super::moving::masks::FrameMasks;
use super::pixels::PixelSet;
use super::step::{Companion, Optimiser, StepReport};
use crate::config::Config;
use crate::field::{Field, FieldShape, Normalisation};
use crate::render::forward::{Grids, Model};
use crate::render::image::render;
use crate::scene::features::FeatureStore;
use crate::scene::{Frame, Scene, Split};

mod poses;
#[cfg(test)]
mod skip_tests;
mod streams;
#[cfg(test)]
mod tests;

/// Steps between two reports.
const REPORT_EVERY: u64 = 50;

/// Steps between two looks at the held-out frames.
const TEST_EVERY: u64 = 500;

/// Pixels of the held-out frames that are looked at while training, about. Most of the error is in few of them: of `kitchen-a` so
/// many tell the PSNR to half a decibel, a quarter of them to one. More would cost a training more than that is worth; `eval`
/// looks at all.
const TEST_PIXELS: f64 = 16_000.0;

/// Share of the light that a cell of a density grid must be able to stop for its stream to be evaluated there.
const OCCUPIED_ALPHA: f32 = 0.005;

/// What the caller hears while training goes on; a line of a run's `log.jsonl`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps taken.
    pub step: u64,
    /// Share of the schedule that is done, 0–1.
    pub fraction: f64,
    /// Seconds spent training, over all sessions.
    pub seconds: f64,
    /// Mean loss since the last report.
    pub loss: f64,
    /// PSNR of the rays since the last report, dB.
    pub psnr: f64,
    /// PSNR of the held-out frames (some of their pixels) when last looked at, dB.
    pub test_psnr: Option<f64>,
    /// Rays per second since the last report.
    pub rays_per_second: f64,
    /// Field evaluations per second since the last report.
    pub samples_per_second: f64,
}

/// Whether to go on.
pub type Control = ControlFlow<()>;

/// What a training session did.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainReport {
    /// How far it came.
    pub state: TrainingState,
    /// Field evaluations, one stream each, per second of training: forward and backward, but for those that are faint
    /// ([`TrainingState::faint`]).
    pub samples_per_second: f64,
    /// Rays per second of training.
    pub rays_per_second: f64,
}

/// Training of one scene's field.
pub struct Trainer {
    config: Config,
    trained: Trained,
    optimiser: Optimiser,
    pixels: PixelSet,
    test: PixelSet,
    /// Until they have told what moves.
    masks: Option<FrameMasks>,
    streams: [bool; 3],
    /// Seconds that stereo of all frames will take, as far as judging the poses tells.
    stereo_cost: Option<f64>,
}

impl Trainer {
    /// A trainer with an untrained field.
    ///
    /// # Errors
    /// A setting that is out of range, or a frame that cannot be read.
    pub fn new(scene: &Scene, config: &Config) -> Result<Self, TrainError> {
        config.validate()?;
        let (pixels, test) = load(scene, config)?;
        let masks = load_masks(scene, config, &pixels)?;
        let all = config.train.streams != StreamChoice::Static;
        let shape = FieldShape {
            config: config.field.clone(),
            normalisation: Normalisation::new(scene.bounds),
            streams: [true, all, all],
            times: pixels.frames.iter().map(|f| f.time as f32).collect(),
            background: pixels.mean_colour(),
        };
        let mut field = Field::zeros(shape);
        field.init(config.seed);
        let grids = Grids::new(&field, config.train.grid_cells);
        let optimiser = Optimiser::new(&field);
        let trained = Trained { field, grids, progress: TrainingState::default() };
        Ok(Self {
            config: config.clone(),
            streams: [true, false, false],
            trained,
            optimiser,
            pixels,
            test,
            masks,
            stereo_cost: None,
        })
    }

    /// A trainer that goes on where the checkpoint in `run` ends.
    ///
    /// # Errors
    /// As [`Self::new`], or a checkpoint that is damaged.
    pub fn resume(scene: &Scene, config: &Config, run: &Path) -> Result<Self, TrainError> {
        config.validate()?;
        let (trained, optimiser) = Trained::resume(run)?;
        let (pixels, test) = load(scene, config)?;
        let masks = load_masks(scene, config, &pixels)?;
        let streams = match trained.progress.streams_settled {
            true => trained.field.shape.streams,
            false => [true, false, false],
        };
        Ok(Self {
            config: config.clone(),
            trained,
            optimiser,
            pixels,
            test,
            masks,
            streams,
            stereo_cost: None,
        })
    }

    /// Trains to the end of the schedule, or until `budget` is used up (the schedule then follows the clock), or
    /// until `watch` says stop; checkpoints go to `run`.
    ///
    /// # Errors
    /// A checkpoint cannot be written, or the numbers diverge; the last good checkpoint stays.
    pub fn run(
        &mut self,
        run: &Path,
        budget: Option<Duration>,
        watch: &mut dyn FnMut(&Progress) -> Control,
    ) -> Result<TrainReport, TrainError> {
        let before = self.trained.progress.seconds;
        let start = Instant::now();
        let mut saved = Instant::now();
        let mut window = Window::new();
        if self.trained.progress.step == 0 {
            self.judge_poses();
            // Only a schedule by the clock needs to know; without one, checkpoints differ in nothing but `seconds`.
            self.trained.progress.prepared = budget.map_or(0.0, |_| before + start.elapsed().as_secs_f64());
        }
        while !self.trained.progress.finished {
            let fraction = self.fraction(budget);
            if !self.trained.progress.streams_settled && self.stands(fraction) {
                self.settle_streams();
                self.leave_out_stereo(budget);
            }
            let due = fraction >= self.config.train.stereo_at || self.trained.progress.stereo_from.is_some();
            if due && !self.stereo_waits(budget) {
                self.look_at_depth();
            }
            let due = self.config.train.align_at.iter().filter(|at| fraction >= **at).count();
            if due > self.trained.progress.aligned
                && self.trained.progress.step >= self.config.train.align_after
                && !self.trained.progress.trusts_poses
            {
                self.align();
                self.trained.progress.aligned = due;
            }
            if self.config.train.skips(self.trained.progress.step + 1, fraction) {
                self.trained.grids.skip_below(OCCUPIED_ALPHA);
            }
            let report = self.begin_step(fraction, None)?;
            self.count(&report);
            window.add(&report);
            self.trained.progress.seconds = before + start.elapsed().as_secs_f64();
            let fraction = self.fraction(budget);
            self.trained.progress.finished = fraction >= 1.0;
            let step = self.trained.progress.step;
            if step.is_multiple_of(TEST_EVERY) || self.trained.progress.finished {
                window.test_psnr = self.test_psnr();
            }
            if step.is_multiple_of(REPORT_EVERY) || self.trained.progress.finished {
                let progress = window.report(&self.trained.progress, fraction);
                if watch(&progress).is_break() {
                    break;
                }
            }
            if saved.elapsed().as_secs_f64() >= self.config.train.checkpoint_seconds {
                self.save(run)?;
                saved = Instant::now();
            }
        }
        self.save(run)?;
        let state = self.trained.progress.clone();
        let seconds = state.seconds.max(1e-9);
        Ok(TrainReport {
            samples_per_second: state.evaluations as f64 / seconds,
            rays_per_second: state.rays as f64 / seconds,
            state,
        })
    }

    /// Makes a field whose schedule is over ready for more steps, which are counted.
    pub fn go_on(&mut self, steps: u64) {
        self.look_at_depth();
        self.trained.progress.joint += steps;
    }

    /// The field as it is now.
    pub fn trained(&self) -> &Trained {
        &self.trained
    }

    /// The field, when training is over.
    pub fn into_trained(self) -> Trained {
        self.trained
    }

    fn fraction(&self, budget: Option<Duration>) -> f64 {
        let p = &self.trained.progress;
        match budget {
            Some(budget) => {
                let left = (budget.as_secs_f64() - p.prepared).max(1e-3);
                ((p.seconds - p.prepared) / left).clamp(0.0, 1.0)
            }
            None => (p.step as f64 / self.config.train.steps as f64).min(1.0),
        }
    }

    /// Stores the field and what is needed to go on training it.
    ///
    /// # Errors
    /// A number that is not finite, or a file that cannot be written; an older one is then untouched.
    pub fn save(&mut self, run: &Path) -> Result<(), TrainError> {
        self.settle();
        // A row that has diverged shows in the loss when a ray passes it next, which may be never.
        let rows = self.trained.field.tables.iter().flatten().flatten();
        if let Some(index) = rows.into_iter().position(|row| !row.is_finite()) {
            return Err(TrainError::NonFinite {
                stage: "a row of the tables",
                step: self.trained.progress.step,
                index,
            });
        }
        self.trained.save(run, self.config.train.grid_cells, Some(&self.optimiser))
    }

    /// Rates and savings are those of the schedule: joint steps after it are not counted.
    fn count(&mut self, report: &StepReport) {
        let progress = &mut self.trained.progress;
        progress.rays += report.rays as u64;
        progress.evaluations += report.evaluations.iter().sum::<usize>() as u64;
        progress.faint += report.faint.iter().sum::<usize>() as u64;
        progress.candidates += report.candidates as u64;
        progress.absent += report.absent as u64;
        progress.spared += report.spared;
        progress.unseen += report.rows.unseen as u64;
        if progress.trusts_poses {
            progress.unrefined += report.unrefined as u64;
        }
    }

    /// Takes one step as at the share `fraction` of the schedule, with the loss of a companion where there is one.
    ///
    /// # Errors
    /// The numbers diverge.
    pub fn step(
        &mut self,
        fraction: f64,
        companion: Option<&dyn Companion>,
    ) -> Result<StepReport, TrainError> {
        let report = self.begin_step(fraction, companion)?;
        Ok(StepReport { rows: self.optimiser.settle(&mut self.trained.field), ..report })
    }

    /// Takes `count` steps as at the share `fraction` of the schedule.
    ///
    /// # Errors
    /// The numbers diverge.
    pub fn steps(&mut self, fraction: f64, count: usize) -> Result<Vec<StepReport>, TrainError> {
        let mut reports = Vec::with_capacity(count);
        for _ in 0..count {
            reports.push(self.begin_step(fraction, None)?);
        }
        // The rows of a step are known when the next one has begun.
        let mut rows = self.optimiser.settle(&mut self.trained.field);
        for report in reports.iter_mut().rev() {
            std::mem::swap(&mut report.rows, &mut rows);
        }
        Ok(reports)
    }

    /// Takes a step but for the tables, which take what it has found as the next one begins, or when they are
    /// [settled](Self::settle).
    fn begin_step(
        &mut self,
        fraction: f64,
        companion: Option<&dyn Companion>,
    ) -> Result<StepReport, TrainError> {
        let Trained { field, grids, progress } = &mut self.trained;
        progress.step += 1;
        let mut plan =
            self.config.train.plan(self.config.field.encoding, progress.step, fraction, self.streams);
        if progress.streams_settled && self.streams == [true, false, false] {
            plan.sampling.sharpness = self.config.train.still_sharpness;
        }
        if progress.trusts_poses {
            (plan.pose_rate, plan.rig_rate) = (0.0, 0.0);
        }
        let Config { loss, seed, .. } = &self.config;
        let report =
            self.optimiser.step(field, grids, &self.pixels, &loss.at(fraction), &plan, *seed, companion);
        let non_finite = |stage, index| TrainError::NonFinite { stage, step: progress.step, index };
        if let Some(chunk) = report.diverged {
            return Err(non_finite("the loss of a chunk of rays", chunk));
        }
        match field.weights.iter().position(|w| !w.is_finite()) {
            Some(index) => Err(non_finite("a network weight", index)),
            None => Ok(report),
        }
    }

    /// Has the tables take what the last step has found, before anyone else looks at them.
    fn settle(&mut self) {
        let rows = self.optimiser.settle(&mut self.trained.field);
        self.trained.progress.unseen += rows.unseen as u64;
    }

    fn test_psnr(&mut self) -> Option<f64> {
        if self.test.frames.is_empty() {
            return None;
        }
        self.settle();
        let model = Model::new(&self.trained.field, &self.trained.grids, self.streams);
        let sampling = self.config.train.look_sampling();
        let pixels: usize = self.test.images.iter().map(Vec::len).sum();
        let stride = (pixels as f64 / TEST_PIXELS).sqrt().ceil() as u32;
        // So few pixels of each that a frame is one piece of work.
        let frames = self.test.frames.par_iter().zip(&self.test.images);
        let sums: Vec<(f64, usize)> = frames
            .map(|(frame, truth)| {
                let image = render(&model, frame, &sampling, stride);
                let mut squared = 0.0;
                for (n, rgb) in image.rgb.iter().enumerate() {
                    let (x, y) = (n as u32 % image.width * stride, n as u32 / image.width * stride);
                    let truth = truth[(y * frame.camera.width + x) as usize];
                    for c in 0..3 {
                        squared += (f64::from(rgb[c]) - f64::from(truth[c]) / 255.0).powi(2);
                    }
                }
                (squared, 3 * image.rgb.len())
            })
            .collect();
        // In the frames' order, so that the sum does not depend on the threads.
        let (squared, count) = sums.into_iter().fold((0.0, 0), |(a, n), (b, m)| (a + b, n + m));
        Some(psnr(squared / count as f64))
    }
}

fn load(scene: &Scene, config: &Config) -> Result<(PixelSet, PixelSet), TrainError> {
    let of =
        |split: Split| -> Vec<Frame> { scene.frames.iter().filter(|f| f.split == split).cloned().collect() };
    let size = (scene.bounds.max - scene.bounds.min).length();
    let load = |split, novelty| PixelSet::load(of(split), size, novelty);
    let pixels = load(Split::Train, config.train.novelty)?;
    if !pixels.has_usable() {
        return Err(TrainError::NoPixels);
    }
    Ok((pixels, load(Split::Test, 0.0)?))
}

/// The masks that tell what moves, where that is asked.
fn load_masks(scene: &Scene, config: &Config, pixels: &PixelSet) -> Result<Option<FrameMasks>, TrainError> {
    let asked = config.train.streams != StreamChoice::Static
        && config.train.stereo_at < 1.0
        && config.loss.moving > 0.0;
    if !asked {
        return Ok(None);
    }
    let masks = FrameMasks::load(&FeatureStore::open(scene)?, &pixels.frames)?;
    Ok((!masks.frames().is_empty()).then_some(masks))
}

fn psnr(mean_squared: f64) -> f64 {
    -10.0 * mean_squared.max(1e-12).log10()
}

/// Sums between two reports.
struct Window {
    start: Instant,
    steps: usize,
    rays: usize,
    evaluations: usize,
    loss: f64,
    squared: f64,
    test_psnr: Option<f64>,
}

impl Window {
    fn new() -> Self {
        Self {
            start: Instant::now(),
            steps: 0,
            rays: 0,
            evaluations: 0,
            loss: 0.0,
            squared: 0.0,
            test_psnr: None,
        }
    }

    fn add(&mut self, report: &StepReport) {
        self.steps += 1;
        self.rays += report.rays;
        self.evaluations += report.evaluations.iter().sum::<usize>();
        self.loss += report.loss;
        self.squared += report.squared;
    }

    fn report(&mut self, state: &TrainingState, fraction: f64) -> Progress {
        let seconds = self.start.elapsed().as_secs_f64().max(1e-9);
        let steps = self.steps.max(1) as f64;
        let progress = Progress {
            step: state.step,
            fraction,
            seconds: state.seconds,
            loss: self.loss / steps,
            psnr: psnr(self.squared / steps),
            test_psnr: self.test_psnr,
            rays_per_second: self.rays as f64 / seconds,
            samples_per_second: self.evaluations as f64 / seconds,
        };
        *self = Self { test_psnr: self.test_psnr, ..Self::new() };
        progress
    }
}
