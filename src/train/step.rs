//! One training step.
//!
//! Rays go through forward and backward in chunks whose buffers stay in a core's cache; a fixed number of groups of
//! chunks run in parallel, each with its own gradient of the dense weights. Then every hash table, and every density
//! grid, is updated by one task that walks all chunks in order. So there are no atomics, and the result does not
//! depend on the number of threads.

use glam::{Vec2, Vec3};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::adam::{self, Moments, StepSize, TableState};
use super::loss::{self, ChunkGradient, ChunkLoss, LossConfig, RayTarget};
use super::pixels::PixelSet;
use crate::field::Field;
use crate::field::hashgrid::{Level, Row};
use crate::render::density_grid::DensityGrid;
use crate::render::forward::{Chunk, Grids, Model, RayInput};
use crate::render::rays::View;
use crate::render::sampler::Sampling;
use crate::rng::Rng;
use crate::simd::TILE;

#[cfg(test)]
mod gradient_tests;
#[cfg(test)]
mod reference;

/// Groups that a step is divided into; fixed, so that sums are taken in the same order on any machine.
const GROUPS: usize = 16;

/// Rays whose activations are kept together: 32 × 24 samples are 1.2 MB, within one core's L2.
pub const CHUNK_RAYS: usize = 32;

/// Random cells of each density grid that a group looks at in a step.
const REFRESH_CELLS: usize = 2 * TILE;

/// How fast the density grids follow those looks.
const REFRESH_RATE: f32 = 0.3;

/// Pixels of a patch are 1, 2, 4 ... (this many powers of two) apart.
const PATCH_STRIDES: usize = 4;

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
    /// Field evaluations, one stream each.
    pub evaluations: usize,
    /// Samples placed, times streams: what would have been evaluated without occupancy.
    pub candidates: usize,
}

/// What one chunk hands to the table and grid tasks.
#[derive(Default)]
struct ChunkOutput {
    streams: [StreamOutput; 3],
}

#[derive(Default)]
struct StreamOutput {
    observed: Observed,
    /// Gradient of the encoding, `[level][capacity]`.
    encoding: Vec<Row>,
    capacity: usize,
}

/// Densities that were evaluated, for the density grid.
#[derive(Default)]
struct Observed {
    /// Where, tile by tile.
    positions: Vec<[[f32; TILE]; 3]>,
    /// σ there.
    sigma: Vec<f32>,
    /// Slice of time that each falls into.
    slices: Vec<u16>,
}

impl Observed {
    fn clear(&mut self) {
        self.positions.clear();
        self.sigma.clear();
        self.slices.clear();
    }

    fn tell(&self, grid: &mut DensityGrid, rate: f32) {
        for (n, (sigma, slice)) in self.sigma.iter().zip(&self.slices).enumerate() {
            let p = &self.positions[n / TILE];
            let p = Vec3::new(p[0][n % TILE], p[1][n % TILE], p[2][n % TILE]);
            grid.observe(p, usize::from(*slice), *sigma, rate);
        }
    }
}

/// Buffers of one group, kept from step to step.
#[derive(Default)]
struct Group {
    chunk: Chunk,
    gradient: ChunkGradient,
    inputs: Vec<RayInput>,
    targets: Vec<RayTarget>,
    dense: Vec<f32>,
    refreshed: [Observed; 3],
    loss: ChunkLoss,
    evaluations: usize,
}

/// All state of training but the field itself.
pub struct Optimiser {
    /// Moments of the dense weights.
    pub dense: Moments,
    /// State of every table `[stream][level]`.
    pub tables: [Vec<TableState>; 3],
    groups: Vec<Group>,
    outputs: Vec<ChunkOutput>,
    gradient: Vec<f32>,
}

impl Optimiser {
    /// Fresh state for a field.
    pub fn new(field: &Field) -> Self {
        Self {
            dense: Moments::new(field.layout.len),
            tables: field.tables.each_ref().map(|t| t.iter().map(|t| TableState::new(t.len())).collect()),
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            outputs: Vec::new(),
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

    /// Runs one step.
    pub fn step(
        &mut self,
        field: &mut Field,
        grids: &mut Grids,
        pixels: &PixelSet,
        config: &LossConfig,
        plan: &StepPlan,
        seed: u64,
    ) -> StepReport {
        let chunks = plan.rays.div_ceil(CHUNK_RAYS * GROUPS);
        let rays = chunks * CHUNK_RAYS * GROUPS;
        self.outputs.resize_with(chunks * GROUPS, ChunkOutput::default);
        let views: Vec<View> = pixels.frames.iter().map(|f| View::new(field, f)).collect();
        let model = Model::new(field, grids, plan.streams);
        let context = Context { model: &model, pixels, views: &views, config, plan, seed, rays };
        let arch = pulp::Arch::new();
        self.groups.par_iter_mut().zip(self.outputs.par_chunks_mut(chunks)).enumerate().for_each(
            |(n, (group, outputs))| {
                arch.dispatch(GroupPass { context: &context, group, outputs, first_chunk: n * chunks });
            },
        );
        drop(model);
        let mut report = StepReport { rays, ..StepReport::default() };
        for g in &self.groups {
            report.loss += g.loss.total / rays as f64;
            report.squared += g.loss.squared / rays as f64;
            report.evaluations += g.evaluations;
        }
        let live = plan.streams.iter().filter(|s| **s).count();
        report.candidates = rays * plan.sampling.count * live;
        self.update(field, grids, plan);
        report
    }

    fn update(&mut self, field: &mut Field, grids: &mut Grids, plan: &StepPlan) {
        let Self { dense, tables, groups, outputs, gradient } = self;
        let groups = &*groups;
        let arch = pulp::Arch::new();
        let rate = StepSize::new(plan.table_rate, plan.step);
        let outputs = &*outputs;
        rayon::scope(|scope| {
            // Finest levels first: they take longest.
            for (s, (tables, states)) in field.tables.iter_mut().zip(tables).enumerate() {
                let Some(net) = &field.nets[s] else { continue };
                if !plan.streams[s] {
                    continue;
                }
                let levels = net.grid.levels.iter().enumerate();
                for ((n, level), (table, state)) in levels.zip(tables.iter_mut().zip(states)).rev() {
                    scope.spawn(move |_| {
                        arch.dispatch(TablePass {
                            outputs,
                            stream: s,
                            level_index: n,
                            level,
                            table,
                            state,
                            rate,
                        })
                    });
                }
            }
            for (s, grid) in grids.streams.iter_mut().enumerate() {
                if !plan.streams[s] {
                    continue;
                }
                scope.spawn(move |_| {
                    for o in outputs {
                        o.streams[s].observed.tell(grid, plan.grid_rate);
                    }
                    for group in groups {
                        group.refreshed[s].tell(grid, REFRESH_RATE);
                    }
                });
            }
            gradient.fill(0.0);
            for group in groups {
                for (g, d) in gradient.iter_mut().zip(&group.dense) {
                    *g += d;
                }
            }
        });
        let layout = &field.layout;
        let mut apply = |range: std::ops::Range<usize>, rate: f32| {
            if rate == 0.0 || range.is_empty() {
                return;
            }
            let Moments { first, second } = &mut *dense;
            adam::update(
                &mut field.weights[range.clone()],
                &gradient[range.clone()],
                &mut first[range.clone()],
                &mut second[range],
                StepSize::new(rate, plan.step),
            );
        };
        for (s, r) in layout.streams.iter().enumerate() {
            if plan.streams[s] {
                apply(r.trunk.clone(), plan.network_rate);
                apply(r.head.clone(), plan.network_rate);
                apply(r.code.clone(), plan.network_rate);
            }
        }
        apply(layout.exposure.clone(), plan.exposure_rate);
        apply(layout.pose.clone(), plan.pose_rate);
        apply(layout.rig.clone(), plan.rig_rate);
    }
}

/// What all groups read.
struct Context<'a> {
    model: &'a Model<'a>,
    pixels: &'a PixelSet,
    views: &'a [View],
    config: &'a LossConfig,
    plan: &'a StepPlan,
    seed: u64,
    rays: usize,
}

struct GroupPass<'a> {
    context: &'a Context<'a>,
    group: &'a mut Group,
    outputs: &'a mut [ChunkOutput],
    first_chunk: usize,
}

impl WithSimd for GroupPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { context, group, outputs, first_chunk } = self;
        group.dense.clear();
        group.dense.resize(context.model.field.layout.len, 0.0);
        group.loss = ChunkLoss::default();
        group.evaluations = 0;
        for (n, output) in outputs.iter_mut().enumerate() {
            group.choose_rays(context, first_chunk + n);
            let Group { chunk, inputs, .. } = group;
            chunk.forward(simd, context.model, context.views, inputs, &context.plan.sampling);
            let count = context.plan.sampling.count;
            let scale = 1.0 / context.rays as f32;
            let l = loss::backward(
                context.config,
                &group.chunk,
                &group.targets,
                count,
                scale,
                &mut group.gradient,
            );
            group.loss.total += l.total;
            group.loss.squared += l.squared;
            group.backward(simd, context, output, first_chunk + n);
        }
        group.refresh(simd, context, first_chunk);
    }
}

impl Group {
    fn choose_rays(&mut self, context: &Context, chunk: usize) {
        self.inputs.clear();
        self.targets.clear();
        let pixels = context.pixels;
        let side = context.plan.patch;
        let mut rng = Rng::new(context.seed, context.plan.step, chunk as u64);
        let mut corner = (0, 0, 1);
        for k in 0..CHUNK_RAYS {
            let in_patch = k as u32 % (side * side);
            if in_patch == 0 {
                corner = loop {
                    let frame = rng.below(pixels.frames.len());
                    if let Some(pixel) = pixels.pick(frame, rng.uniform()) {
                        break (frame, pixel, 1 << rng.below(PATCH_STRIDES));
                    }
                };
            }
            let (frame, first, stride) = corner;
            let camera = &pixels.frames[frame].camera;
            let x = (first as u32 % camera.width + in_patch % side * stride).min(camera.width - 1);
            let y = (first as u32 / camera.width + in_patch / side * stride).min(camera.height - 1);
            let pixel = match pixels.is_usable(frame, x + y * camera.width) {
                true => (x + y * camera.width) as usize,
                false => first,
            };
            let (x, y) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
            let uv =
                Vec2::new((x as f32 + 0.5) / camera.width as f32, (y as f32 + 0.5) / camera.height as f32);
            self.inputs.push(RayInput {
                view: frame as u32,
                dir_cam: pixels.directions(frame)[pixel],
                uv,
                jitter: rng.uniform(),
            });
            let field = context.model.field;
            let mut exposure = [0.0; 6];
            let gamma = &field.weights[field.layout.exposure.clone()];
            field.exposure.evaluate(gamma, context.views[frame].knots, &mut exposure);
            self.targets.push(RayTarget {
                rgb: pixels.images[frame][pixel].map(|c| f32::from(c) / 255.0),
                background: [rng.uniform(), rng.uniform(), rng.uniform()],
                exposure,
                depth: pixels.stereo_distance(frame, pixel),
            });
        }
    }

    #[inline(always)]
    fn backward<S: Simd>(&mut self, simd: S, context: &Context, output: &mut ChunkOutput, number: usize) {
        let Self { chunk, gradient, inputs, dense, evaluations, .. } = self;
        let model = context.model;
        let field = model.field;
        let count = context.plan.sampling.count;
        for s in 0..3 {
            let out = &mut output.streams[s];
            out.observed.clear();
            let batch = &mut chunk.batches[s];
            let (Some(net), Some(w)) = (&field.nets[s], model.weights(s)) else { continue };
            if batch.is_empty() {
                continue;
            }
            let r = &field.layout.streams[s];
            // Trunk and head follow one another in the layout.
            let (trunk, head) = dense[r.trunk.start..r.head.end].split_at_mut(r.trunk.len());
            net.backward(simd, &w, batch, &chunk.samples[s], &gradient.samples[s], trunk, head);
            *evaluations += batch.len();
            out.capacity = batch.len();
            out.encoding.resize(net.grid.levels.len() * out.capacity, Row::ZERO);
            net.encoding_gradient(batch, out.capacity, &mut out.encoding);
            let grid = &model.grids.streams[s];
            out.observed.positions.extend_from_slice(batch.tiles());
            for k in &batch.sample {
                let view = &context.views[inputs[*k as usize / count].view as usize];
                out.observed.sigma.push(chunk.samples[s].sigma[*k as usize]);
                out.observed.slices.push(grid.slice(view.time) as u16);
            }
            if let Some(code) = &field.codes[s] {
                let gamma = &mut dense[r.code.clone()];
                let mut per_ray = vec![0.0; inputs.len() * code.width];
                net.code_gradient(batch, |k, c, g| per_ray[k as usize / count * code.width + c] += g);
                for (input, g) in inputs.iter().zip(per_ray.chunks_exact(code.width)) {
                    if let Some(at) = context.views[input.view as usize].code_knots[s] {
                        code.backward(at, g, gamma);
                    }
                }
            }
        }
        let exposure = &mut dense[field.layout.exposure.clone()];
        for (input, g) in inputs.iter().zip(&gradient.exposure) {
            field.exposure.backward(context.views[input.view as usize].knots, g, exposure);
        }
        // Poses change slowly and their gradient costs a second gather: a quarter of the chunks is enough.
        let refine = context.plan.pose_rate > 0.0 || context.plan.rig_rate > 0.0;
        if refine && (number as u64 + context.plan.step).is_multiple_of(4) {
            self.pose_gradient(context);
        }
    }

    /// Evaluates random cells of the density grids, so that what was empty can fill again.
    #[inline(always)]
    fn refresh<S: Simd>(&mut self, simd: S, context: &Context, first_chunk: usize) {
        let Self { chunk, refreshed, .. } = self;
        let field = context.model.field;
        let mut rng = Rng::new(context.seed, context.plan.step, u64::MAX - first_chunk as u64);
        for (s, out) in refreshed.iter_mut().enumerate() {
            out.clear();
            let (true, Some(net), Some(w)) =
                (context.plan.streams[s], &field.nets[s], context.model.weights(s))
            else {
                continue;
            };
            let grid = &context.model.grids.streams[s];
            let batch = &mut chunk.batches[s];
            batch.clear();
            let mut codes = vec![0.0; REFRESH_CELLS * net.code];
            for k in 0..REFRESH_CELLS {
                let cell = rng.below(grid.sigma.len());
                let u = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
                let (p, time) = grid.point(cell, u, rng.uniform());
                batch.push(k, p);
                out.slices.push(grid.slice(time) as u16);
                if let Some(code) = &field.codes[s] {
                    let gamma = &field.weights[field.layout.streams[s].code.clone()];
                    code.evaluate(gamma, code.locate(time), &mut codes[k * net.code..][..net.code]);
                }
            }
            out.sigma.resize(REFRESH_CELLS, 0.0);
            net.density(simd, &w, batch, |k| &codes[k as usize * net.code..], &mut out.sigma);
            out.positions.extend_from_slice(batch.tiles());
        }
    }

    #[inline(always)]
    fn pose_gradient(&mut self, context: &Context) {
        let Self { chunk, inputs, dense, .. } = self;
        let field = context.model.field;
        let count = context.plan.sampling.count;
        let mut per_ray = vec![(Vec3::ZERO, Vec3::ZERO); inputs.len()];
        for s in 0..2 {
            let batch = &chunk.batches[s];
            let (Some(net), Some(w)) = (&field.nets[s], context.model.weights(s)) else { continue };
            net.position_gradient(&w, batch, |k, g| {
                let ray = &mut per_ray[k as usize / count];
                ray.0 += g;
                ray.1 += g * chunk.intervals[k as usize].t;
            });
        }
        for ((input, ray), (d_origin, d_dir)) in inputs.iter().zip(&chunk.rays).zip(per_ray) {
            let view = &context.views[input.view as usize];
            let (g, focal) = view.backward(&ray.ray, d_origin, d_dir);
            field.pose.backward(view.knots, &g, &mut dense[field.layout.pose.clone()]);
            let rig = &mut dense[field.layout.rig.clone()];
            for (r, g) in rig.iter_mut().zip(g) {
                *r += g;
            }
            rig[6] += focal;
        }
    }
}

/// Scatters one level's gradients and updates its table.
struct TablePass<'a> {
    outputs: &'a [ChunkOutput],
    stream: usize,
    level_index: usize,
    level: &'a Level,
    table: &'a mut [Row],
    state: &'a mut TableState,
    rate: StepSize,
}

impl WithSimd for TablePass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self { outputs, stream, level_index, level, table, state, rate } = self;
        for o in outputs {
            let o = &o.streams[stream];
            if o.observed.positions.is_empty() {
                continue;
            }
            let grads = &o.encoding[level_index * o.capacity..][..o.capacity];
            for (pos, g) in o.observed.positions.iter().zip(grads.chunks(TILE)) {
                level.scatter(&mut state.grad, pos, g);
            }
        }
        state.update(table, rate);
    }
}
