//! One training step.
//!
//! A fixed number of groups of chunks of rays run in parallel, each with its own gradient of the dense weights; hash
//! tables are updated and read by one task a level, which walks all chunks in order while that level's table stays near
//! its core. So the phases of a step are: groups choose rays and place samples, for which no table is needed; levels
//! scatter what the step before has found, update their tables and encode the samples; groups evaluate the networks, the
//! loss and go backward; density grids and dense weights are updated. What the last step has found waits for
//! [`Optimiser::settle`]. There are no atomics in any sum, and the result does not depend on the number of threads.

use std::time::Instant;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use self::group::{Context, Group, Scratch};
use self::update::update;
use super::adam::{Moments, StepSize, TableState};
use super::loss::LossConfig;
use super::pixels::PixelSet;
use super::table_pass::{StreamTables, TableScratch, update_and_encode};
use crate::field::Field;
use crate::field::hashgrid::Row;
use crate::field::mlp::Precision;
use crate::field::stream::StreamNet;
use crate::render::forward::{Chunk, Grids, Model};
use crate::render::rays::View;
use crate::render::sampler::Sampling;
use crate::rng::Rng;
use crate::tasks::{PerThread, Tasks};

#[cfg(test)]
mod gradient_tests;
mod group;
#[cfg(test)]
mod reference;
#[cfg(test)]
mod seed_tests;
mod update;

/// Groups that a step is divided into, unless it has fewer chunks; whatever the number of threads, so that sums are taken in
/// the same order on any machine.
const GROUPS: usize = 16;

/// Rays whose activations are kept together: of 128 × 20 samples some two thirds are not faint, 3 MB. Fewer would fit one core's L2, but
/// more fill the tiles of streams that are evaluated here and there, and that is worth more.
pub const CHUNK_RAYS: usize = 128;

/// Random numbers from here down are those of the frames' times.
const TIMES: u64 = u64::MAX / 2;

/// What changes from step to step.
#[derive(Clone, Copy, Debug)]
pub struct StepPlan {
    /// Number of the step, from 1.
    pub step: u64,
    /// Rays; rounded up to whole chunks per group.
    pub rays: usize,
    /// Rays come in squares of this many pixels: neighbours share grid cells, and so cache lines.
    pub patch: u32,
    /// How fast the density grids follow what is seen, per sample.
    pub grid_rate: f32,
    /// Where samples go.
    pub sampling: Sampling,
    /// See [`crate::train::TrainConfig::faint`].
    pub faint: f32,
    /// See [`crate::train::TrainConfig::time_spread`].
    pub time_spread: f32,
    /// Learning rate of the tables.
    pub table_rate: f32,
    /// Learning rate of networks and codes.
    pub network_rate: f32,
    /// Learning rate of exposures.
    pub exposure_rate: f32,
    /// Learning rate of per-frame poses (rad, units); 0 leaves them alone.
    pub pose_rate: f32,
    /// Learning rate of the rig and the focal length; 0 leaves them alone.
    pub rig_rate: f32,
    /// Streams that take part.
    pub streams: [bool; 3],
    /// What the networks are multiplied in.
    pub precision: Precision,
}

/// Another loss that a step minimises beside that of colours, on rays of its own choice.
pub trait Companion: Sync {
    /// Frame and pixel of each ray of chunk number `chunk`, [`CHUNK_RAYS`] of them; of usable pixels.
    fn rays(&self, chunk: usize) -> Vec<(usize, usize)>;

    /// Adds the gradient of its loss with respect to w^s of every sample of a traced chunk to `weight`.
    fn ask(&self, chunk: usize, traced: &Chunk, weight: &mut [[f32; 3]]);
}

/// Chunks of a step of `rays` rays, as many in every group.
pub fn chunks(rays: usize) -> usize {
    let needed = rays.div_ceil(CHUNK_RAYS);
    needed.next_multiple_of(needed.clamp(1, GROUPS))
}

/// What a step did.
#[derive(Clone, Copy, Debug, Default)]
pub struct StepReport {
    /// Mean loss.
    pub loss: f64,
    /// Mean squared colour error of the rays.
    pub squared: f64,
    /// Rays traced.
    pub rays: usize,
    /// Field evaluations of each stream.
    pub evaluations: [usize; 3],
    /// Random cells of each stream's density grid whose density was looked at beside.
    pub refreshed: [usize; 3],
    /// Of the evaluations those that gave too little light for their colour to be looked at and for anything to be learned from them.
    pub faint: [usize; 3],
    /// Samples placed, times streams: what would have been evaluated without occupancy.
    pub candidates: usize,
    /// Samples placed, times streams that the field does not have.
    pub absent: usize,
    /// Steps through the density grids that rays have taken.
    pub taken: u64,
    /// Steps through the density grids that rays were spared because nothing was left of their light.
    pub spared: u64,
    /// What became of the tables: by the step before, unless [`Optimiser::settle`] was asked in between.
    pub rows: RowReport,
    /// Evaluations from which no pose was to learn, of those from which one would have.
    pub unrefined: usize,
    /// Number of the first chunk of rays whose loss is not finite.
    pub diverged: Option<usize>,
    /// Seconds that placing, the tables, evaluating (both ways) and updating all else took.
    pub seconds: [f64; 4],
}

/// Rows of the tables that a step did and did not change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RowReport {
    /// Rows that were updated, with those beside them on a cache line.
    pub updated: usize,
    /// All other rows of the streams that took part.
    pub unseen: usize,
}

/// All state of training but the field itself.
pub struct Optimiser {
    /// Moments of the dense weights.
    pub dense: Moments,
    /// State of every table `[stream][level]`.
    pub tables: [Vec<TableState>; 3],
    groups: Vec<Group>,
    /// What a step has left to be done.
    put_off: Option<TableUpdate>,
    scratch: PerThread<Scratch>,
    table_scratch: PerThread<TableScratch>,
    gradient: Vec<f32>,
}

/// An update of the tables by what the samples of all groups have found.
struct TableUpdate {
    rate: StepSize,
    streams: [bool; 3],
    /// How many chunks of rays they are of.
    chunks: usize,
}

impl Optimiser {
    /// Fresh state for a field.
    pub fn new(field: &Field) -> Self {
        Self {
            dense: Moments::new(field.layout.len),
            tables: field.tables.each_ref().map(|t| t.iter().map(|t| TableState::new(t.len())).collect()),
            groups: Vec::new(),
            put_off: None,
            scratch: PerThread::default(),
            table_scratch: PerThread::default(),
            gradient: vec![0.0; field.layout.len],
        }
    }

    /// Follows [`super::Trained::keep_streams`]: moments of dropped streams go, those of the dense weights start anew
    /// (their vector has changed its layout, and they forget within some hundred steps).
    pub fn keep_streams(&mut self, field: &Field) {
        for (states, tables) in self.tables.iter_mut().zip(&field.tables) {
            states.truncate(tables.len());
        }
        self.dense = Moments::new(field.layout.len);
        self.gradient = vec![0.0; field.layout.len];
    }

    /// Runs one step, for the colours of random pixels, or for those and another loss of the companion's pixels.
    ///
    /// The tables are updated as the next step begins, which reads them; whoever else does, asks for [`Self::settle`] first.
    #[allow(clippy::too_many_arguments)]
    pub fn step(
        &mut self,
        field: &mut Field,
        grids: &mut Grids,
        pixels: &PixelSet,
        config: &LossConfig,
        plan: &StepPlan,
        seed: u64,
        companion: Option<&dyn Companion>,
    ) -> StepReport {
        let start = Instant::now();
        let chunks = chunks(plan.rays);
        // Other groups could not tell what these have found.
        let settled = self.put_off.as_ref().is_some_and(|p| p.chunks != chunks).then(|| self.settle(field));
        let rays = chunks * CHUNK_RAYS;
        self.groups.resize_with(chunks.min(GROUPS), Group::default);
        let per_group = chunks / self.groups.len().max(1);
        let mut views: Vec<View> = pixels.frames.iter().map(|f| View::new(field, f)).collect();
        for (n, view) in views.iter_mut().enumerate() {
            let mut rng = Rng::new(seed, plan.step, TIMES - n as u64);
            view.time = pixels.time_near(n, plan.time_spread, rng.uniform());
        }
        // Nobody but the pass over them needs them in between.
        let mut tables = std::mem::take(&mut field.tables);
        let model = Model::with_precision(field, grids, plan.streams, plan.precision);
        let context = Context { model: &model, pixels, views: &views, config, plan, seed, rays, companion };
        let arch = pulp::Arch::new();
        // One by one: rayon would hand out several together, and a thread then waits for the other at the end.
        self.groups.par_iter_mut().enumerate().with_max_len(1).for_each(|(n, group)| {
            arch.dispatch(PlacePass {
                context: &context,
                group,
                scratch: &self.scratch,
                first_chunk: n * per_group,
                chunks: per_group,
            });
        });
        let placed = Instant::now();
        let rows = self.update_tables(&model.field.nets, &mut tables);
        let encoded = Instant::now();
        let mut tasks = Tasks::default();
        for group in &mut self.groups {
            let pass = EvaluatePass { context: &context, group, scratch: &self.scratch };
            tasks.add(pass.group.samples(), move || arch.dispatch(pass));
        }
        tasks.run();
        drop(model);
        field.tables = tables;
        let rate = StepSize::new(plan.table_rate, plan.step);
        self.put_off = Some(TableUpdate { rate, streams: plan.streams, chunks });
        let evaluated = Instant::now();
        let mut report = self.report(field, plan, rays);
        report.rows = settled.unwrap_or(rows);
        update(self, field, grids, plan);
        let ends = [placed, encoded, evaluated, Instant::now()];
        let starts = [start, placed, encoded, evaluated];
        report.seconds = std::array::from_fn(|n| (ends[n] - starts[n]).as_secs_f64());
        report
    }

    /// What the groups have done.
    fn report(&self, field: &Field, plan: &StepPlan, rays: usize) -> StepReport {
        let mut report = StepReport { rays, ..StepReport::default() };
        for g in &self.groups {
            report.loss += g.loss.total / rays as f64;
            report.squared += g.loss.squared / rays as f64;
            for s in 0..3 {
                report.evaluations[s] += g.evaluations[s];
                report.faint[s] += g.faint[s];
                report.refreshed[s] += g.refreshed(s);
            }
            report.taken += g.taken;
            report.spared += g.spared;
            report.diverged = report.diverged.or(g.diverged);
        }
        let live = plan.streams.iter().filter(|s| **s).count();
        report.candidates = rays * plan.sampling.count * live;
        report.absent = rays * plan.sampling.count * field.nets.iter().filter(|net| net.is_none()).count();
        if plan.pose_rate == 0.0 && plan.rig_rate == 0.0 {
            let [evaluations, faint] = [report.evaluations, report.faint].map(|n| n.iter().sum::<usize>());
            report.unrefined = (evaluations - faint) / group::REFINE_EVERY as usize;
        }
        report
    }

    /// Updates the tables by what the last step has found, unless that is done.
    pub fn settle(&mut self, field: &mut Field) -> RowReport {
        if self.put_off.is_none() {
            return RowReport::default();
        }
        self.groups.iter_mut().for_each(Group::put_off);
        self.update_tables(&field.nets, &mut field.tables)
    }

    /// Updates the tables by what was put off, and encodes what the groups have placed.
    fn update_tables(&mut self, nets: &[Option<StreamNet>; 3], tables: &mut [Vec<Vec<Row>>; 3]) -> RowReport {
        let Self { tables: states, groups, put_off, table_scratch, .. } = self;
        let put_off = put_off.take();
        let rate = |s: usize| put_off.as_ref().filter(|p| p.streams[s]).map(|p| p.rate);
        let all: usize = (0..3).filter(|s| rate(*s).is_some()).flat_map(|s| &tables[s]).map(Vec::len).sum();
        let streams = nets.iter().zip(tables).zip(states).enumerate().map(|(s, ((net, tables), states))| {
            Some(StreamTables { encoding: &net.as_ref()?.encoding, tables, states, rate: rate(s) })
        });
        let updated = update_and_encode(streams, groups.iter_mut().flat_map(Group::batches), table_scratch);
        RowReport { updated, unseen: all - updated }
    }
}

struct PlacePass<'a> {
    context: &'a Context<'a>,
    group: &'a mut Group,
    scratch: &'a PerThread<Scratch>,
    first_chunk: usize,
    chunks: usize,
}

impl WithSimd for PlacePass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        self.group.place(self.context, &mut self.scratch.mine(), self.first_chunk, self.chunks);
    }
}

struct EvaluatePass<'a> {
    context: &'a Context<'a>,
    group: &'a mut Group,
    scratch: &'a PerThread<Scratch>,
}

impl WithSimd for EvaluatePass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        self.group.evaluate(simd, self.context, &mut self.scratch.mine());
    }
}
