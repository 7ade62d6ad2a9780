//! The forward pass of a chunk of rays: sample, evaluate each stream where it may have density, composite.
//!
//! Training and rendering both go through here; training then walks the same buffers backwards.

use glam::{Vec2, Vec3};
use pulp::Simd;

use super::composite::{Intervals, RayLayout, Weights};
use super::density_grid::{DensityGrid, STRIDE};
use super::rays::{Ray, View};
use super::sampler::{Lanes, RayLanes, Sampler, Sampling, Steer};
use crate::field::batch::StreamBatch;
use crate::field::mlp::{Packed, Precision};
use crate::field::stream::{StreamActivations, StreamSamples, StreamWeights, Tiles};
use crate::field::{Field, Stream, VIEW, view_encoding};
use crate::simd::AlignedVec;
use crate::simd::floats::{Column, ColumnMut};

/// Running densities of the three streams. The actor's is over (u, v, inverse depth) in the camera's frustum.
#[derive(Clone, Debug)]
pub struct Grids {
    /// One grid per stream.
    pub streams: [DensityGrid; 3],
    /// σ above which a stream is evaluated in a cell, 1/unit.
    pub threshold: [f32; 3],
}

impl Grids {
    /// Fresh grids with `cells` cells along the longest side of the box.
    pub fn new(field: &Field, cells: f32) -> Self {
        let empty = field.nets[0].as_ref().map_or(0.0, |n| n.density_bias.exp());
        let grids = Self::layout(field.normalisation.extent, cells);
        let start = [empty, UNKNOWN, UNKNOWN];
        let grid = |s: usize| {
            let (extent, cell, slices) = grids[s];
            DensityGrid::new(extent, cell, slices, start[s])
        };
        Self { streams: [0, 1, 2].map(grid), threshold: [0.0; 3] }
    }

    /// Numbers that each grid of [`Self::new`] holds, for a box of `extent`.
    pub fn cells(extent: Vec3, cells: f32) -> [usize; 3] {
        Self::layout(extent, cells).map(|(extent, cell, slices)| DensityGrid::cells(extent, cell, slices))
    }

    /// Extent, cell and slices of time of each grid.
    fn layout(extent: Vec3, cells: f32) -> [(Vec3, Vec3, usize); 3] {
        [
            (extent, Vec3::splat(1.0 / cells), 1),
            (extent, Vec3::splat(2.0 / cells), TIME_SLICES),
            (Vec3::ONE, Vec3::splat(1.0 / ACTOR_CELLS), TIME_SLICES),
        ]
    }
}

impl Grids {
    /// From now on a stream is skipped in cells that cannot stop the share `alpha` of the light that crosses them.
    pub fn skip_below(&mut self, alpha: f32) {
        for (threshold, grid) in self.threshold.iter_mut().zip(&self.streams) {
            *threshold = alpha / grid.cell().min_element();
        }
        // The actor's cells are in the frustum; across the near half of it they are this small at least.
        self.threshold[2] = self.threshold[1];
    }
}

/// Cells of the actor's grid along each axis of the frustum.
const ACTOR_CELLS: f32 = 24.0;

/// Density of transient cells that were not looked at yet, 1/unit: enough to be looked at.
const UNKNOWN: f32 = 2.0;

/// Slices of time of the dynamic and the actor's grid.
const TIME_SLICES: usize = 32;

/// A field ready to be evaluated: packed weights and the grids that tell where it is worth it.
pub struct Model<'a> {
    /// Shape and tables.
    pub field: &'a Field,
    /// Trunk and head of each stream.
    packed: [Option<(Packed, Packed)>; 3],
    /// Running densities.
    pub grids: &'a Grids,
    /// Streams that take part.
    pub streams: [bool; 3],
}

impl<'a> Model<'a> {
    /// Packs the weights of the streams that the field has and that `streams` asks for; evaluates in f32.
    pub fn new(field: &'a Field, grids: &'a Grids, streams: [bool; 3]) -> Self {
        Self::with_precision(field, grids, streams, Precision::F32)
    }

    /// As [`Self::new`], with the networks multiplied in `precision`.
    pub fn with_precision(
        field: &'a Field,
        grids: &'a Grids,
        streams: [bool; 3],
        precision: Precision,
    ) -> Self {
        let packed = Stream::ALL.map(|s| {
            let net = field.net(s)?;
            let r = &field.layout.streams[s as usize];
            Some((
                net.trunk.pack(&field.weights[r.trunk.clone()], precision),
                net.head.pack(&field.weights[r.head.clone()], precision),
            ))
        });
        let streams = std::array::from_fn(|s| streams[s] && field.nets[s].is_some());
        Self { field, packed, grids, streams }
    }

    /// What the networks of one stream read.
    pub fn weights(&self, s: usize) -> Option<StreamWeights<'_>> {
        let (trunk, head) = self.packed[s].as_ref()?;
        Some(StreamWeights { trunk, head })
    }

    /// Actor coordinates of a point at z-depth `z` seen at image fraction `uv`: inverse depth as third coordinate.
    #[inline(always)]
    pub fn actor_point(&self, uv: Vec2, z: f32) -> Vec3 {
        let (near, far) = (self.field.near * 0.5, self.field.actor_far);
        uv.extend(((1.0 - near / z.max(near)) / (1.0 - near / far)).min(1.0))
    }
}

/// The density grids along rays, a lane each.
struct RayGrids<'a> {
    model: &'a Model<'a>,
    /// Image fractions.
    uv: [Lanes; 2],
    /// z-depth of a point at distance 1, before refinement.
    z: Lanes,
    /// Slice of time of each grid.
    slices: [[u32; STRIDE]; 3],
}

impl RayGrids<'_> {
    /// Which points at distances `t` are where the actor can be.
    #[inline(always)]
    fn near(&self, t: &Lanes) -> [bool; STRIDE] {
        let mut near = [false; STRIDE];
        for n in 0..STRIDE {
            near[n] = t[n] * self.z[n] < self.model.field.actor_far;
        }
        near
    }

    /// Actor coordinates of the points at distances `t`.
    #[inline(always)]
    fn actor_points(&self, t: &Lanes) -> [Lanes; 3] {
        let [u, v] = self.uv;
        let mut inverse = [0.0; STRIDE];
        for n in 0..STRIDE {
            inverse[n] = self.model.actor_point(Vec2::ZERO, t[n] * self.z[n]).z;
        }
        [u, v, inverse]
    }
}

/// Cells of the three grids, a lane each.
#[derive(Clone, Copy, Default)]
struct RayCells {
    cells: [[u32; STRIDE]; 3],
    /// Where the actor can be.
    near: [bool; STRIDE],
}

impl Steer for RayGrids<'_> {
    type Cells = RayCells;

    #[inline(always)]
    fn find(&self, points: &[Lanes; 3], t: &Lanes) -> RayCells {
        let Self { model: Model { grids, streams, .. }, slices, .. } = self;
        let mut found = RayCells::default();
        for s in (0..2).filter(|s| streams[*s]) {
            found.cells[s] = grids.streams[s].indices(points, &slices[s]);
            grids.streams[s].fetch(&found.cells[s]);
        }
        if streams[2] {
            found.near = self.near(t);
            if found.near != [false; STRIDE] {
                found.cells[2] = grids.streams[2].indices(&self.actor_points(t), &slices[2]);
                grids.streams[2].fetch(&found.cells[2]);
            }
        }
        found
    }

    #[inline(always)]
    fn sigma(&self, RayCells { cells, near }: &RayCells) -> [Lanes; 2] {
        let Model { grids: Grids { streams: grids, .. }, streams, .. } = self.model;
        let [mut stands, mut moves] = [[0.0; STRIDE]; 2];
        if streams[0] {
            stands = grids[0].of(&cells[0]);
        }
        if streams[1] {
            moves = grids[1].of(&cells[1]);
        }
        if *near != [false; STRIDE] {
            let sigma = grids[2].of(&cells[2]);
            for n in 0..STRIDE {
                moves[n] += if near[n] { sigma[n] } else { 0.0 };
            }
        }
        [stands, moves]
    }
}

/// A ray to be traced.
#[derive(Clone, Copy, Debug)]
pub struct RayInput {
    /// Which of the views it belongs to.
    pub view: u32,
    /// Unit direction in camera axes.
    pub dir_cam: Vec3,
    /// Pixel centre as a fraction of the image.
    pub uv: Vec2,
    /// Random (training) or 0.5 (rendering): shifts the samples.
    pub jitter: f32,
}

/// What is known about one ray of the chunk.
#[derive(Clone, Copy, Debug)]
pub struct TracedRay {
    /// Its geometry.
    pub ray: Ray,
    /// Spherical harmonics of the viewing direction.
    view: [f32; VIEW],
}

/// Buffers of one thread, used for one chunk after the other.
#[derive(Default)]
pub struct Tracer {
    /// Places samples, and counts what that was spared.
    pub sampler: Sampler,
    edges: Vec<Lanes>,
    /// Densities in the order of a batch.
    sigma: Vec<f32>,
    /// What the networks of each stream left for the way back.
    pub activations: [StreamActivations; 3],
}

/// One chunk of rays: its samples and what the streams said about them.
///
/// Tracing has three steps, which training takes for all chunks together: [`Self::place`], the encoding of
/// [`Self::batches`], [`Self::evaluate`].
#[derive(Default)]
pub struct Chunk {
    codes: [Vec<f32>; 3],
    /// The rays in order.
    pub rays: Vec<TracedRay>,
    /// Of each ray as many, numbered by their layout.
    pub intervals: Intervals,
    /// What the intervals give to their rays.
    pub weights: Weights,
    /// Which samples each stream is evaluated at; after [`Self::evaluate`] those that are not faint.
    pub batches: [StreamBatch; 3],
    /// Samples at which each stream has a density, faint or not, and the cell of its density grid that each is in.
    pub cells: [Vec<Placed>; 3],
    /// What each stream said; zero where it was not evaluated, and left as it was by a stream without a batch.
    pub samples: [StreamSamples; 3],
    /// Σ w c over streams and intervals of each ray, before background and exposure.
    pub rgb: [AlignedVec; 3],
    /// Σ w^d β^d + w^a β^a of each ray.
    pub beta: AlignedVec,
}

/// Which samples of a stream are too faint for more than their density to be looked at; by default none are.
#[derive(Clone, Copy, Debug, Default)]
pub struct Faint {
    /// Share of its pixel's light that a stream has to give at a sample; 0: everything counts.
    pub share: f32,
    /// Price of an optical depth of 1 of what moves: where that has one of so much, it counts, seen or not.
    pub transient: f32,
}

impl Faint {
    /// Whether stream `s` is too faint at sample number `n`.
    #[inline(always)]
    fn is(self, s: usize, intervals: &Intervals, weights: &Weights, n: usize) -> bool {
        let price = if s > 0 { self.transient } else { 0.0 };
        weights.weight[s][n].max(price * intervals.sigma[s][n] * intervals.delta[n]) < self.share
    }
}

/// A sample of a chunk, and the cell of a stream's density grid that it is in.
#[derive(Clone, Copy, Debug)]
pub struct Placed {
    /// Number of the sample in the chunk.
    pub sample: u32,
    /// Number of the cell.
    pub cell: u32,
}

impl Chunk {
    /// Traces `inputs` and fills all buffers but those for the way back.
    #[inline(always)]
    pub fn forward<S: Simd>(
        &mut self,
        simd: S,
        tracer: &mut Tracer,
        model: &Model,
        views: &[View],
        inputs: &[RayInput],
        sampling: &Sampling,
    ) {
        self.place(tracer, model, views, inputs, sampling);
        self.encode(model);
        self.find_colours(simd, tracer, model, Tiles::Passing);
        self.weights.find(simd, &self.intervals);
        self.composite(simd);
    }

    /// As [`Self::forward`], but densities and weights alone: colours and uncertainty are not computed.
    #[inline(always)]
    pub fn densities<S: Simd>(
        &mut self,
        simd: S,
        tracer: &mut Tracer,
        model: &Model,
        views: &[View],
        inputs: &[RayInput],
        sampling: &Sampling,
    ) {
        self.place(tracer, model, views, inputs, sampling);
        self.encode(model);
        self.find_densities(simd, tracer, model, Tiles::Passing);
        self.weights.find(simd, &self.intervals);
    }

    /// Densities at all samples of the batches, and nothing else of the streams.
    #[inline(always)]
    fn find_densities<S: Simd>(&mut self, simd: S, tracer: &mut Tracer, model: &Model, tiles: Tiles) {
        let Self { codes, intervals, batches, .. } = self;
        let Tracer { sigma, activations, .. } = tracer;
        for s in 0..3 {
            let (Some(net), Some(w)) = (&model.field.nets[s], model.weights(s)) else { continue };
            sigma.resize(batches[s].len(), 0.0);
            let code = |r: usize| &codes[s][r * net.code..];
            net.density(simd, &w, &batches[s], &mut activations[s], tiles, code, sigma);
            for (&k, sigma) in batches[s].sample.iter().zip(&*sigma) {
                intervals.sigma[s][k as usize] = *sigma;
            }
        }
    }

    #[inline(always)]
    fn encode(&mut self, model: &Model) {
        for (s, batch) in self.batches.iter_mut().enumerate() {
            if let Some(net) = &model.field.nets[s] {
                batch.encode(&net.encoding, &model.field.tables[s]);
            }
        }
    }

    /// Evaluates the streams at the placed and encoded samples, and composites.
    ///
    /// Where a stream is faint only its density is looked at, which is then done first: such samples leave its batch, and its
    /// colour and uncertainty count as zero there.
    #[inline(always)]
    pub fn evaluate<S: Simd>(&mut self, simd: S, tracer: &mut Tracer, model: &Model, faint: Faint) {
        let tiles = if faint.share > 0.0 { Tiles::Known } else { Tiles::Kept };
        if tiles == Tiles::Known {
            self.find_densities(simd, tracer, model, Tiles::Kept);
            self.weights.find(simd, &self.intervals);
            self.drop_faint(tracer, model, faint);
        }
        self.find_colours(simd, tracer, model, tiles);
        if tiles == Tiles::Kept {
            self.weights.find(simd, &self.intervals);
        }
        self.composite(simd);
    }

    /// Has samples that are faint leave the batches.
    #[inline(always)]
    fn drop_faint(&mut self, tracer: &mut Tracer, model: &Model, faint: Faint) {
        let Self { intervals, weights, batches, .. } = self;
        for (s, batch) in batches.iter_mut().enumerate() {
            let (Some(net), Some(w)) = (&model.field.nets[s], model.weights(s)) else { continue };
            let keep = |n: usize| !faint.is(s, intervals, weights, n);
            net.retain(&w, batch, &mut tracer.activations[s], keep);
        }
    }

    /// What the streams say at the samples of their batches.
    #[inline(always)]
    fn find_colours<S: Simd>(&mut self, simd: S, tracer: &mut Tracer, model: &Model, tiles: Tiles) {
        let Self { codes, rays, intervals, batches, samples, .. } = self;
        for s in 0..3 {
            let (Some(net), Some(w)) = (&model.field.nets[s], model.weights(s)) else { continue };
            if batches[s].is_empty() {
                continue;
            }
            samples[s].reset(intervals.layout.len());
            let code = |r: usize| &codes[s][r * net.code..];
            let view = |r: usize| &rays[r].view[..];
            let activations = &mut tracer.activations[s];
            net.forward(simd, &w, &batches[s], activations, tiles, code, view, &mut samples[s]);
            if tiles != Tiles::Known {
                for &k in &batches[s].sample {
                    intervals.sigma[s][k as usize] = samples[s].sigma[k as usize];
                }
            }
        }
    }

    /// Colours and uncertainties of the rays.
    #[inline(always)]
    fn composite<S: Simd>(&mut self, simd: S) {
        let Self { intervals, weights, batches, samples, rgb, beta, .. } = self;
        let layout = intervals.layout;
        rgb.iter_mut().chain([&mut *beta]).for_each(|column| column.zero(layout.width()));
        for s in 0..3 {
            if batches[s].is_empty() {
                continue;
            }
            for (values, out) in samples[s].rgb.iter().zip(&mut *rgb) {
                add_weighted(simd, layout, &weights.weight[s], values, out);
            }
            if s > 0 {
                add_weighted(simd, layout, &weights.weight[s], &samples[s].beta, beta);
            }
        }
    }

    /// Places the samples of `inputs`, and decides which streams are evaluated at each.
    #[inline(always)]
    pub fn place(
        &mut self,
        tracer: &mut Tracer,
        model: &Model,
        views: &[View],
        inputs: &[RayInput],
        sampling: &Sampling,
    ) {
        self.rays.clear();
        self.intervals.reset(RayLayout { rays: inputs.len(), samples: sampling.count });
        for s in 0..3 {
            self.batches[s].clear();
            self.cells[s].clear();
            let width = model.field.nets[s].as_ref().map_or(0, |net| net.code);
            self.codes[s].resize(inputs.len() * width, 0.0);
        }
        tracer.edges.resize(sampling.count + 1, [0.0; STRIDE]);
        for inputs in inputs.chunks(STRIDE) {
            self.place_rays(tracer, model, views, inputs, sampling);
        }
    }

    /// Places the samples of some rays that follow those that are placed.
    #[inline(always)]
    fn place_rays(
        &mut self,
        tracer: &mut Tracer,
        model: &Model,
        views: &[View],
        inputs: &[RayInput],
        sampling: &Sampling,
    ) {
        let Tracer { sampler, edges, .. } = tracer;
        let (field, first) = (model.field, self.rays.len());
        let mut grids =
            RayGrids { model, uv: [[0.0; STRIDE]; 2], z: [0.0; STRIDE], slices: [[0; STRIDE]; 3] };
        let mut rays = RayLanes::default();
        let [mut jitter, mut times] = [[0.0; STRIDE]; 2];
        for (n, input) in inputs.iter().enumerate() {
            let view = &views[input.view as usize];
            let ray = view.ray(input.dir_cam, field.normalisation.extent, field.near);
            rays.set(n, &ray);
            (jitter[n], times[n]) = (input.jitter, view.time);
            (grids.uv[0][n], grids.uv[1][n], grids.z[n]) = (input.uv.x, input.uv.y, input.dir_cam.z);
            for s in 1..3 {
                grids.slices[s][n] = model.grids.streams[s].slice(view.time) as u32;
                if let (Some(code), Some(at)) = (&field.codes[s], view.code_knots[s]) {
                    let gamma = &field.weights[field.layout.streams[s].code.clone()];
                    let of_ray = (first + n) * code.width..(first + n + 1) * code.width;
                    code.evaluate(gamma, at, &mut self.codes[s][of_ray]);
                }
            }
            let unit = ray.dir.normalize_or_zero();
            self.rays.push(TracedRay { ray, view: view_encoding(unit) });
        }
        sampler.edges(&rays, sampling, &jitter, &grids, edges);
        let mut hits = [false; STRIDE];
        (0..STRIDE).for_each(|n| hits[n] = rays.hits(n));
        for (k, edges) in edges.windows(2).enumerate() {
            let [mut t, mut delta] = [[0.0; STRIDE]; 2];
            for n in 0..STRIDE {
                t[n] = 0.5 * (edges[0][n] + edges[1][n]);
                delta[n] = edges[1][n] - edges[0][n];
            }
            let number = self.intervals.layout.number(first, k);
            self.intervals.t[number..number + STRIDE].copy_from_slice(&t);
            self.intervals.delta[number..number + STRIDE].copy_from_slice(&delta);
            let points = rays.points(&t);
            for s in (0..2).filter(|s| model.streams[*s]) {
                self.push(&grids, s, [number, first], &points, &times, &hits);
            }
            let mut near = grids.near(&t);
            (0..STRIDE).for_each(|n| near[n] &= hits[n]);
            if model.streams[2] && near != [false; STRIDE] {
                self.push(&grids, 2, [number, first], &grids.actor_points(&t), &times, &near);
            }
        }
    }

    /// Has stream `s` evaluated at those of the `lanes` of `points` where its density grid says that something is there; the first is
    /// sample number `number`, of ray number `ray`, and the others follow.
    #[inline(always)]
    fn push(
        &mut self,
        grids: &RayGrids,
        s: usize,
        [number, ray]: [usize; 2],
        points: &[Lanes; 3],
        times: &Lanes,
        lanes: &[bool; STRIDE],
    ) {
        let (grid, threshold) = (&grids.model.grids.streams[s], grids.model.grids.threshold[s]);
        let cells = grid.indices(points, &grids.slices[s]);
        let sigma = grid.of(&cells);
        // Bits, since which lanes are taken is nothing that a processor could foresee one by one.
        let mut taken = 0u32;
        for n in 0..STRIDE {
            taken |= u32::from(lanes[n] & (sigma[n] >= threshold)) << n;
        }
        while taken != 0 {
            let n = taken.trailing_zeros() as usize;
            taken &= taken - 1;
            let p = Vec3::from_array([0, 1, 2].map(|axis| points[axis][n]));
            self.batches[s].push(number + n, ray + n, p, times[n]);
            self.cells[s].push(Placed { sample: (number + n) as u32, cell: cells[n] });
        }
    }
}

/// Adds the weight times the value of every sample to its ray's number in `out`.
#[inline(always)]
fn add_weighted<S: Simd>(simd: S, layout: RayLayout, weights: &[f32], values: &[f32], out: &mut [f32]) {
    let [weights, values] = [weights, values].map(|column| Column::new(simd, column));
    let mut out = ColumnMut::new(simd, out);
    for rays in 0..layout.vectors::<S>() {
        let mut sum = out.at(rays);
        for at in layout.of_vector::<S>(rays) {
            sum += weights.at(at) * values.at(at);
        }
        out.set(rays, sum);
    }
}
