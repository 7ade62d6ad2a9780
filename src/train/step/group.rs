//! The rays of one group: chosen, traced, and back-propagated to everything but the tables.

use glam::{Vec2, Vec3};
use pulp::Simd;

use super::{CHUNK_RAYS, Companion, StepPlan};
use crate::field::batch::StreamBatch;
use crate::field::stream::{StreamActivations, Tiles};
use crate::render::density_grid::DensityGrid;
use crate::render::forward::{Chunk, Faint, Model, RayInput, Tracer};
use crate::render::rays::View;
use crate::rng::Rng;
use crate::simd::TILE;
use crate::train::loss::flatness::{self, Bend};
use crate::train::loss::{self, Aims, ChunkGradient, ChunkLoss, LossConfig, RayTarget};
use crate::train::pixels::PixelSet;

/// Poses change slowly and their gradient costs time: one of so many chunks of rays is enough.
pub const REFINE_EVERY: u64 = 4;

/// Random cells of each density grid that a group looks at in a step.
const REFRESH_CELLS: usize = 2 * TILE;

/// How fast the density grids follow those looks.
const REFRESH_RATE: f32 = 0.3;

/// Cells from one that is told to the one that is asked for.
const AHEAD: usize = 16;

/// Pixels of a patch are 1, 2, 4 ... (this many powers of two) apart: near ones share cells of the lattices, far ones
/// tell whether a surface as large as a door is flat.
const PATCH_STRIDES: usize = 6;

/// What all groups read.
pub struct Context<'a> {
    pub model: &'a Model<'a>,
    pub pixels: &'a PixelSet,
    pub views: &'a [View],
    pub config: &'a LossConfig,
    pub plan: &'a StepPlan,
    pub seed: u64,
    pub rays: usize,
    pub companion: Option<&'a dyn Companion>,
}

/// One chunk of rays of a step.
#[derive(Default)]
pub struct TrainChunk {
    pub inputs: Vec<RayInput>,
    pub targets: Vec<RayTarget>,
    pub bends: Vec<Bend>,
    pub traced: Chunk,
}

/// Buffers of one thread, used for one chunk after the other: what is there stays in its core's cache.
#[derive(Default)]
pub struct Scratch {
    tracer: Tracer,
    gradient: ChunkGradient,
}

/// Chunks that one task works on, kept from step to step.
#[derive(Default)]
pub struct Group {
    pub chunks: Vec<TrainChunk>,
    /// Number of the first of them.
    first: usize,
    refresh: [Refresh; 3],
    /// Gradient of the dense weights.
    pub dense: Vec<f32>,
    pub loss: ChunkLoss,
    /// Number of the first chunk whose loss is not finite.
    pub diverged: Option<usize>,
    /// Samples at which each stream was evaluated.
    pub evaluations: [usize; 3],
    /// Those of them that gave too little light to be learned from.
    pub faint: [usize; 3],
    /// Steps through the density grids that its rays have taken, and that they were spared.
    pub taken: u64,
    pub spared: u64,
}

impl Group {
    /// Chooses the rays of `chunks` chunks, the first of which has the number `first`, and places their samples.
    #[inline(always)]
    pub fn place(&mut self, context: &Context, scratch: &mut Scratch, first: usize, chunks: usize) {
        self.chunks.resize_with(chunks, TrainChunk::default);
        self.first = first;
        scratch.tracer.sampler.taken = 0;
        scratch.tracer.sampler.spared = 0;
        for (n, chunk) in self.chunks.iter_mut().enumerate() {
            chunk.choose_rays(context, first + n);
            chunk.place(context, &mut scratch.tracer, first + n);
        }
        self.taken = scratch.tracer.sampler.taken;
        self.spared = scratch.tracer.sampler.spared;
        let mut rng = Rng::new(context.seed, context.plan.step, u64::MAX - first as u64);
        for (s, refresh) in self.refresh.iter_mut().enumerate() {
            refresh.place(context, s, &mut rng);
        }
    }

    /// Forgets all samples but for what was found out about the tables.
    pub fn put_off(&mut self) {
        self.chunks.iter_mut().for_each(TrainChunk::put_off);
        self.refresh.iter_mut().for_each(|refresh| refresh.batch.clear());
    }

    /// All samples that are evaluated, with the number of their stream.
    pub fn batches(&mut self) -> impl Iterator<Item = (usize, &mut StreamBatch)> {
        let chunks = self.chunks.iter_mut().flat_map(|c| c.traced.batches.iter_mut().enumerate());
        chunks.chain(self.refresh.iter_mut().map(|r| &mut r.batch).enumerate())
    }

    /// Random cells of the density grid of stream `s` that it looks at.
    pub fn refreshed(&self, s: usize) -> usize {
        self.refresh[s].cells.len()
    }

    /// Samples that are placed in all streams.
    pub fn samples(&self) -> usize {
        self.chunks.iter().flat_map(|chunk| &chunk.traced.batches).map(StreamBatch::len).sum()
    }

    /// Evaluates the encoded samples and goes all the way back to their encodings.
    #[inline(always)]
    pub fn evaluate<S: Simd>(&mut self, simd: S, context: &Context, scratch: &mut Scratch) {
        let Self { chunks, first, refresh, dense, loss, diverged, evaluations, faint, .. } = self;
        let Scratch { tracer, gradient } = scratch;
        // A panic may have left some.
        tracer.activations.iter_mut().for_each(StreamActivations::clear);
        dense.clear();
        dense.resize(context.model.field.layout.len, 0.0);
        (*loss, *diverged, *evaluations, *faint) = (ChunkLoss::default(), None, [0; 3], [0; 3]);
        for (number, chunk) in (*first..).zip(chunks) {
            let l = chunk.evaluate(simd, context, tracer, gradient, number);
            loss.total += l.total;
            loss.squared += l.squared;
            *diverged = diverged.or((!l.total.is_finite()).then_some(number));
            for (s, (cells, batch)) in chunk.traced.cells.iter().zip(&chunk.traced.batches).enumerate() {
                evaluations[s] += cells.len();
                faint[s] += cells.len() - batch.len();
            }
            chunk.backward(simd, context, tracer, gradient, dense);
        }
        finish(simd, context, tracer, dense);
        for (s, refresh) in refresh.iter_mut().enumerate() {
            refresh.evaluate(simd, context, s, tracer);
        }
    }

    /// Tells the density grid of stream `s` what densities were seen.
    pub fn tell(&self, s: usize, grid: &mut DensityGrid, rate: f32) {
        for Chunk { cells, intervals, .. } in self.chunks.iter().map(|c| &c.traced) {
            for (n, at) in cells[s].iter().enumerate() {
                if let Some(ahead) = cells[s].get(n + AHEAD) {
                    grid.fetch(&[ahead.cell]);
                }
                grid.observe(at.cell as usize, intervals.sigma[s][at.sample as usize], rate);
            }
        }
    }

    /// Tells the density grid of stream `s` what its random cells hold.
    pub fn tell_refreshed(&self, s: usize, grid: &mut DensityGrid) {
        let Refresh { cells, sigma, .. } = &self.refresh[s];
        for (cell, sigma) in cells.iter().zip(sigma) {
            grid.observe(*cell, *sigma, REFRESH_RATE);
        }
    }
}

/// Adds the gradients of the networks' weights, of all chunks that have gone backward, to `dense`.
#[inline(always)]
pub fn finish<S: Simd>(simd: S, context: &Context, tracer: &mut Tracer, dense: &mut [f32]) {
    let field = context.model.field;
    for (s, r) in field.layout.streams.iter().enumerate() {
        let (Some(net), Some(w)) = (&field.nets[s], context.model.weights(s)) else { continue };
        // Trunk and head follow one another in the layout.
        let (trunk, head) = dense[r.trunk.start..r.head.end].split_at_mut(r.trunk.len());
        net.finish(simd, &w, &mut tracer.activations[s], [trunk, head]);
    }
}

/// Frame and pixel of each ray of a chunk, patch by patch.
fn draw_patches(context: &Context, rng: &mut Rng) -> Vec<(usize, usize)> {
    let (pixels, side) = (context.pixels, context.plan.patch);
    let mut rays = Vec::with_capacity(CHUNK_RAYS);
    while rays.len() < CHUNK_RAYS {
        let (frame, middle) = pixels.draw(rng);
        let stride = 1u32 << rng.below(PATCH_STRIDES);
        let camera = &pixels.frames[frame].camera;
        // A patch that sticks out is moved back into the picture, as far as it fits.
        let along = |middle: u32, size: u32, n: u32| {
            let start = middle.saturating_sub((side - 1) * stride / 2);
            let start = start.min(size.saturating_sub((side - 1) * stride + 1));
            (start + n * stride).min(size - 1)
        };
        let left = (CHUNK_RAYS - rays.len()).min((side * side) as usize) as u32;
        rays.extend((0..left).map(|n| {
            let x = along(middle as u32 % camera.width, camera.width, n % side);
            let y = along(middle as u32 / camera.width, camera.height, n / side);
            let pixel = x + y * camera.width;
            (frame, if pixels.is_usable(frame, pixel) { pixel as usize } else { middle })
        }));
    }
    rays
}

impl TrainChunk {
    pub fn choose_rays(&mut self, context: &Context, chunk: usize) {
        self.inputs.clear();
        self.targets.clear();
        let mut rng = Rng::new(context.seed, context.plan.step, chunk as u64);
        let (rays, side) = match context.companion {
            // Rays that somebody else has chosen are no patches.
            Some(companion) => (companion.rays(chunk), 1),
            None => (draw_patches(context, &mut rng), context.plan.patch as usize),
        };
        // They are all over the frames.
        rays.iter().for_each(|(frame, pixel)| context.pixels.fetch(*frame, *pixel));
        rays.iter().for_each(|(frame, pixel)| context.pixels.fetch_depth(*frame, *pixel));
        for (frame, pixel) in rays {
            self.add_ray(context, &mut rng, frame, pixel);
        }
        flatness::find(&self.inputs, &self.targets, side, &mut self.bends);
    }

    fn add_ray(&mut self, context: &Context, rng: &mut Rng, frame: usize, pixel: usize) {
        let pixels = context.pixels;
        let camera = &pixels.frames[frame].camera;
        let (x, y) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
        let uv = Vec2::new((x as f32 + 0.5) / camera.width as f32, (y as f32 + 0.5) / camera.height as f32);
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

    /// Places the samples of the chunk with number `number`.
    #[inline(always)]
    pub fn place(&mut self, context: &Context, tracer: &mut Tracer, number: usize) {
        let plan = context.plan;
        self.put_off();
        self.traced.place(tracer, context.model, context.views, &self.inputs, &plan.sampling);
        let refine = plan.pose_rate > 0.0 || plan.rig_rate > 0.0;
        let slopes = refine && (number as u64 + plan.step).is_multiple_of(REFINE_EVERY);
        // The actor's coordinates are the camera's: they do not depend on its pose.
        for (batch, slopes) in self.traced.batches.iter_mut().zip([slopes, slopes, false]) {
            batch.slopes = slopes;
        }
    }

    /// Leaves what was found out about the tables for later.
    pub fn put_off(&mut self) {
        self.traced.batches.iter_mut().for_each(StreamBatch::put_off);
    }

    /// Evaluates the streams and the loss of the chunk with number `number`.
    #[inline(always)]
    pub fn evaluate<S: Simd>(
        &mut self,
        simd: S,
        context: &Context,
        tracer: &mut Tracer,
        gradient: &mut ChunkGradient,
        number: usize,
    ) -> ChunkLoss {
        let faint = Faint { share: context.plan.faint, transient: context.config.transient };
        self.traced.evaluate(simd, tracer, context.model, faint);
        gradient.asked.clear();
        if let Some(companion) = context.companion {
            gradient.asked.resize(self.traced.intervals.layout.len(), [0.0; 3]);
            companion.ask(number, &self.traced, &mut gradient.asked);
        }
        let scale = 1.0 / context.rays as f32;
        let aims = Aims { targets: &self.targets, bends: &self.bends, moving: &context.pixels.moving };
        loss::backward(simd, context.config, &self.traced, &aims, scale, gradient)
    }

    /// Adds the gradients of all dense weights but those of the networks, which [`finish`] adds, to `dense`, and leaves those
    /// of the encodings in the batches.
    #[inline(always)]
    pub fn backward<S: Simd>(
        &mut self,
        simd: S,
        context: &Context,
        tracer: &mut Tracer,
        gradient: &ChunkGradient,
        dense: &mut [f32],
    ) {
        let Self { inputs, traced, .. } = self;
        let model = context.model;
        let field = model.field;
        let refine = traced.batches.iter().any(|b| b.slopes);
        let mut rays = vec![(Vec3::ZERO, Vec3::ZERO); if refine { inputs.len() } else { 0 }];
        for s in 0..3 {
            let batch = &mut traced.batches[s];
            let (Some(net), Some(w)) = (&field.nets[s], model.weights(s)) else { continue };
            if batch.is_empty() {
                continue;
            }
            let r = &field.layout.streams[s];
            let mut codes = vec![0.0; inputs.len() * net.code];
            net.backward(
                simd,
                &w,
                batch,
                &mut tracer.activations[s],
                &traced.samples[s],
                &gradient.samples[s],
                |ray, first, g| {
                    let code = codes[ray * net.code..][..net.code][first..].iter_mut();
                    code.zip(g.to_array()).for_each(|(sum, g)| *sum += g);
                },
                |ray, sample, g| {
                    let (origin, dir) = &mut rays[ray];
                    *origin += g;
                    *dir += g * traced.intervals.t[sample];
                },
            );
            if let Some(code) = &field.codes[s] {
                let gamma = &mut dense[r.code.clone()];
                for (input, g) in inputs.iter().zip(codes.chunks_exact(code.width)) {
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
        for ((input, ray), (d_origin, d_dir)) in inputs.iter().zip(&traced.rays).zip(rays) {
            let view = &context.views[input.view as usize];
            let (g, lens) = view.backward(&ray.ray, d_origin, d_dir);
            field.pose.backward(view.knots, &g, &mut dense[field.layout.pose.clone()]);
            let rig = &mut dense[field.layout.rig.clone()];
            for (r, g) in rig.iter_mut().zip(g) {
                *r += g;
            }
            rig[6] += lens[0];
            rig[7] += lens[1];
        }
    }
}

/// Random cells of one density grid, looked at so that what was empty can fill again.
#[derive(Default)]
struct Refresh {
    batch: StreamBatch,
    codes: Vec<f32>,
    cells: Vec<usize>,
    sigma: Vec<f32>,
}

impl Refresh {
    fn place(&mut self, context: &Context, s: usize, rng: &mut Rng) {
        let field = context.model.field;
        self.batch.clear();
        self.cells.clear();
        let (true, Some(net)) = (context.plan.streams[s], &field.nets[s]) else { return };
        let grid = &context.model.grids.streams[s];
        self.codes.resize(REFRESH_CELLS * net.code, 0.0);
        for k in 0..REFRESH_CELLS {
            let cell = rng.below(grid.sigma.len());
            let u = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
            let (p, time) = grid.point(cell, u, rng.uniform());
            self.batch.push(k, k, p, time);
            self.cells.push(cell);
            if let Some(code) = &field.codes[s] {
                let gamma = &field.weights[field.layout.streams[s].code.clone()];
                code.evaluate(gamma, code.locate(time), &mut self.codes[k * net.code..][..net.code]);
            }
        }
    }

    #[inline(always)]
    fn evaluate<S: Simd>(&mut self, simd: S, context: &Context, s: usize, tracer: &mut Tracer) {
        let Self { batch, codes, sigma, .. } = self;
        let (Some(net), Some(w)) = (&context.model.field.nets[s], context.model.weights(s)) else { return };
        sigma.resize(batch.len(), 0.0);
        let code = |k: usize| &codes[k * net.code..];
        net.density(simd, &w, batch, &mut tracer.activations[s], Tiles::Passing, code, sigma);
    }
}
