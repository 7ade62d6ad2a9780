//! The loss of one chunk of rays and its gradient with respect to everything that compositing saw.
//!
//! As in compositing, vectors hold samples of different rays.

use std::ops::Range;

use pulp::Simd;
use serde::{Deserialize, Serialize};

use self::flatness::Bend;
use crate::field::stream::StreamSamples;
use crate::render::composite::{self, Intervals, LANES};
use crate::render::forward::{Chunk, TracedRay};
use crate::render::sampler::RayLanes;
use crate::simd::AlignedVec;
use crate::simd::floats::{Column, ColumnMut, Floats};
use crate::train::moving::Volume;

pub mod flatness;

/// Relative error of stereo depth that costs nothing.
pub(super) const STEREO_ERROR: f32 = 0.01;

/// How much more a pixel that the actor explains costs where things are that move: a hand may hold what it hides.
pub const WHERE_THINGS_MOVE: f32 = 2.5;

/// Share of the schedule from which veils cost something.
const VEIL_FROM: f32 = 0.3;

/// Relative error of depth from which on a ray's end is simply elsewhere.
pub(super) const FAR_OFF: f32 = 0.08;

/// Weights of the loss's terms.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// β_min: uncertainty of the persistent stream, in colour units.
    pub beta_min: f32,
    /// λ_u: price of dynamic and actor density (mean σ·δ over a ray).
    pub transient: f32,
    /// Price of a pixel that is explained by the dynamic or the actor stream, in nats: the prior odds against it. Where things
    /// are that move the first is 0 and the second [`WHERE_THINGS_MOVE`] times as high.
    pub transient_opacity: [f32; 2],
    /// Price of persistent light where things are that move, though they may be at rest, in nats; dynamic light is free
    /// there. 0: what moves is not looked for.
    pub moving: f32,
    /// Price of a pixel that the dynamic or the actor stream covers in part, at the schedule's end: times A (1 − A) of its
    /// opacity A. What moves is opaque; a veil of its colour over what is behind it would do for the picture alone.
    pub veil: f32,
    /// Distortion (Barron et al. 2022, mip-NeRF 360, eq. 15): pulls a ray's weight together.
    pub distortion: f32,
    /// Softness Σ_k T_k α_k (1 − α_k) of a ray: surfaces are hard, air is empty.
    pub entropy: f32,
    /// Price of stopping light where stereo says that a ray passes or that it has already ended.
    pub depth: f32,
    /// Price of a bend in depth where the picture is even.
    pub flatness: f32,
    /// Price of per-frame exposure away from none: times half the squares of its six numbers.
    pub exposure: f32,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self {
            beta_min: 0.03,
            transient: 0.01,
            transient_opacity: [8.0, 1.2],
            moving: 20.0,
            veil: 5.5,
            distortion: 0.3,
            entropy: 0.0,
            depth: 4.0,
            flatness: 2.0,
            exposure: 0.1,
        }
    }
}

impl LossConfig {
    /// The weights at the share `fraction` of the schedule: veils cost nothing while what moves takes form.
    pub fn at(&self, fraction: f64) -> Self {
        let ramp = ((fraction as f32 - VEIL_FROM) / (1.0 - VEIL_FROM)).clamp(0.0, 1.0);
        Self { veil: self.veil * ramp, ..self.clone() }
    }

    /// Price of explaining a pixel by each stream, in nats; `moving` where there are things that move.
    pub fn prices(&self, moving: bool) -> [f32; 3] {
        let [dynamic, actor] = self.transient_opacity;
        if moving { [self.moving, 0.0, WHERE_THINGS_MOVE * actor] } else { [0.0, dynamic, actor] }
    }
}

/// What a chunk cost.
#[derive(Clone, Copy, Debug, Default)]
pub struct ChunkLoss {
    /// Sum of the whole loss over rays.
    pub total: f64,
    /// Sum over rays of the mean squared colour error.
    pub squared: f64,
}

/// Gradients of one chunk with respect to the outputs of the forward pass.
#[derive(Default)]
pub struct ChunkGradient {
    /// With respect to σ, colour and β of each stream that has a batch.
    pub samples: [StreamSamples; 3],
    /// With respect to the six exposure numbers of each ray.
    pub exposure: Vec<[f32; 6]>,
    /// What other losses ask of w^s, set before; empty: nothing.
    pub asked: Vec<[f32; 3]>,
    /// With respect to the disparity of each ray.
    disparity: AlignedVec,
    /// 1 where things move where the samples are, else 0.
    moves: AlignedVec,
    targets: TargetColumns,
}

/// The colour that a ray should have, and how it was exposed.
#[derive(Clone, Copy, Debug)]
pub struct RayTarget {
    /// sRGB 0–1.
    pub rgb: [f32; 3],
    /// What is behind the last sample in this step.
    pub background: [f32; 3],
    /// log gain and offset of the three channels.
    pub exposure: [f32; 6],
    /// Distance along the ray at which it ends according to stereo, units; 0 where that is not known.
    pub depth: f32,
}

/// What the rays of a chunk should come to.
#[derive(Clone, Copy)]
pub struct Aims<'a> {
    /// Ray by ray.
    pub targets: &'a [RayTarget],
    /// Rows of three rays.
    pub bends: &'a [Bend],
    /// Where things are that move.
    pub moving: &'a Volume,
}

/// What rays should come to, as columns.
#[derive(Default)]
struct TargetColumns {
    rgb: [AlignedVec; 3],
    background: [AlignedVec; 3],
    exposure: [AlignedVec; 6],
    depth: AlignedVec,
    /// z-depth of a point of the ray at distance 1.
    z: AlignedVec,
}

impl TargetColumns {
    /// Lanes behind the last ray are nobody's; what they hold is harmless.
    fn fill(&mut self, targets: &[RayTarget], rays: &[TracedRay], width: usize) {
        let Self { rgb, background, exposure, depth, z } = self;
        let columns = rgb.iter_mut().chain(background).chain(exposure).chain([&mut *depth, &mut *z]);
        columns.for_each(|column| column.zero(width));
        z.fill(1.0);
        for (r, (target, traced)) in targets.iter().zip(rays).enumerate() {
            for c in 0..3 {
                self.rgb[c][r] = target.rgb[c];
                self.background[c][r] = target.background[c];
            }
            for c in 0..6 {
                self.exposure[c][r] = target.exposure[c];
            }
            (self.depth[r], self.z[r]) = (target.depth, traced.ray.refined_cam.z);
        }
    }
}

/// Evaluates the loss of a traced chunk and fills `grad`. `scale` multiplies the whole gradient (1 / rays).
#[inline(always)]
pub fn backward<S: Simd>(
    simd: S,
    config: &LossConfig,
    chunk: &Chunk,
    aims: &Aims,
    scale: f32,
    grad: &mut ChunkGradient,
) -> ChunkLoss {
    let layout = chunk.intervals.layout;
    grad.exposure.resize(aims.targets.len(), [0.0; 6]);
    grad.samples.iter_mut().for_each(|samples| samples.reserve(layout.len()));
    grad.targets.fill(aims.targets, &chunk.rays, layout.width());
    find_moving(aims.moving, chunk, &mut grad.moves);
    let bent = flatness::backward(simd, config.flatness, chunk, aims.bends, scale, &mut grad.disparity);
    let mut loss = ChunkLoss { total: f64::from(bent), ..ChunkLoss::default() };
    let zero = Floats::new(simd, 0.0);
    let mut gradient = vec![[zero; 3]; layout.samples];
    for rays in 0..layout.vectors::<S>() {
        let mut terms = Terms { simd, config, chunk, scale, rays, cost: zero };
        let composited = terms.colours(grad, &mut loss);
        terms.weights(&composited, grad, &mut gradient);
        composite::backward(simd, &chunk.intervals, &chunk.weights, rays, &mut gradient, composited.left);
        terms.densities(&gradient, &mut grad.samples);
        for cost in terms.of_rays(terms.cost) {
            loss.total += f64::from(cost);
        }
    }
    loss
}

/// Finds where things move of the samples of a chunk.
#[inline(always)]
fn find_moving(moving: &Volume, chunk: &Chunk, moves: &mut AlignedVec) {
    let Intervals { layout, t, .. } = &chunk.intervals;
    moves.zero(layout.len());
    if moving.is_empty() {
        return;
    }
    for (group, rays) in chunk.rays.chunks(LANES).enumerate() {
        let mut lanes = RayLanes::default();
        rays.iter().enumerate().for_each(|(n, traced)| lanes.set(n, &traced.ray));
        for first in (0..layout.samples).map(|k| layout.number(group * LANES, k)) {
            let Some(t) = t[first..].first_chunk::<LANES>() else { continue };
            for (out, moves) in moves[first..].iter_mut().zip(moving.contains(&lanes.points(t))) {
                *out = f32::from(u8::from(moves));
            }
        }
    }
}

/// The loss of one vector of rays.
struct Terms<'a, S: Simd> {
    simd: S,
    config: &'a LossConfig,
    chunk: &'a Chunk,
    scale: f32,
    /// Number of the vector.
    rays: usize,
    /// What the rays cost beside their colours.
    cost: Floats<S>,
}

/// Gradient with respect to what compositing gives rays.
struct Composited<S: Simd> {
    /// Three channels and β.
    values: [Floats<S>; 4],
    left: Floats<S>,
}

impl<S: Simd> Terms<'_, S> {
    /// The numbers of those lanes that are rays.
    #[inline(always)]
    fn of_rays(&self, values: Floats<S>) -> impl Iterator<Item = f32> {
        let mut lanes = [0.0; LANES];
        ColumnMut::new(self.simd, &mut lanes).set(0, values);
        lanes.into_iter().take(self.ray_numbers().len())
    }

    /// Numbers of the rays.
    #[inline(always)]
    fn ray_numbers(&self) -> Range<usize> {
        let (first, all) = (self.rays * S::F32_LANES, self.chunk.intervals.layout.rays);
        first.min(all)..(first + S::F32_LANES).min(all)
    }

    /// The loss of the colours, and of how they were exposed: adds it to `loss` and writes the gradient of exposures.
    #[inline(always)]
    fn colours(&self, grad: &mut ChunkGradient, loss: &mut ChunkLoss) -> Composited<S> {
        let Self { simd, config, chunk, scale, rays, .. } = *self;
        let ChunkGradient { targets, exposure, .. } = grad;
        let zero = Floats::new(simd, 0.0);
        let left = Column::new(simd, &chunk.weights.left).at(rays);
        let beta = Column::new(simd, &chunk.beta).at(rays) + config.beta_min;
        let precision = 1.0 / (beta * beta);
        let mut d = Composited { values: [zero; 4], left: zero };
        let (mut squared, mut exposed, mut d_exposure) = (zero, zero, [zero; 6]);
        let per_exposure = scale * config.exposure;
        for c in 0..3 {
            let [found, aim, background, log_gain, offset] = [
                &chunk.rgb[c],
                &targets.rgb[c],
                &targets.background[c],
                &targets.exposure[c],
                &targets.exposure[3 + c],
            ]
            .map(|column| Column::new(simd, column).at(rays));
            let gain = log_gain.exp();
            let raw = found + left * background;
            let error = gain * raw + offset - aim;
            squared += error * error;
            exposed += log_gain * log_gain + offset * offset;
            let by_colour = scale * precision * error;
            d.values[c] = by_colour * gain;
            d.left += d.values[c] * background;
            d_exposure[c] = d.values[c] * raw + per_exposure * log_gain;
            d_exposure[3 + c] = by_colour + per_exposure * offset;
        }
        d.values[3] = scale * (1.0 / beta - squared * precision / beta);
        let fit = 0.5 * squared * precision + (0.5 * config.exposure) * exposed;
        for ((squared, fit), beta) in self.of_rays(squared).zip(self.of_rays(fit)).zip(self.of_rays(beta)) {
            loss.squared += f64::from(squared) / 3.0;
            loss.total += f64::from(fit + beta.ln());
        }
        for (c, d) in d_exposure.into_iter().enumerate() {
            for (exposure, d) in exposure[self.ray_numbers()].iter_mut().zip(self.of_rays(d)) {
                exposure[c] = d;
            }
        }
        d
    }

    /// What the weights cost by where they are and how they lie along their rays: writes the gradient with respect to them, front
    /// to back, to `gradient`, and that with respect to colours and β.
    #[inline(always)]
    fn weights(
        &mut self,
        composited: &Composited<S>,
        grad: &mut ChunkGradient,
        gradient: &mut [[Floats<S>; 3]],
    ) {
        let Self { simd, config, chunk, scale, rays, .. } = *self;
        let Chunk { intervals, weights, samples, .. } = chunk;
        let [t, delta, pass, moves] = [&intervals.t, &intervals.delta, &weights.pass, &grad.moves]
            .map(|column| Column::new(simd, column));
        let weight = weights.weight.each_ref().map(|column| Column::new(simd, column));
        // Colours and β.
        let values = samples.each_ref().map(|StreamSamples { rgb: [r, g, b], beta, .. }| {
            [r, g, b, beta].map(|column| Column::new(simd, column))
        });
        let mut d_values = grad.samples.each_mut().map(|StreamSamples { rgb: [r, g, b], beta, .. }| {
            [r, g, b, beta].map(|column| ColumnMut::new(simd, column))
        });
        let [flat, z, depth] = [&grad.disparity, &grad.targets.z, &grad.targets.depth]
            .map(|column| Column::new(simd, column).at(rays));
        let flat = flat / z;
        let [resting, moving] =
            [false, true].map(|moving| config.prices(moving).map(|price| Floats::new(simd, price)));
        let along = Along::of(simd, chunk, rays);
        let (zero, mut cost) = (Floats::new(simd, 0.0), self.cost);
        // Price of a stream wherever it covers a ray, as things are.
        let mut veil = [zero; 3];
        for s in 1..3 {
            cost += config.veil * along.cover[s] * (1.0 - along.cover[s]);
            veil[s] = config.veil * (1.0 - 2.0 * along.cover[s]);
        }
        let (mut before, mut before_t) = (zero, zero);
        for (k, gradient) in gradient.iter_mut().enumerate() {
            let at = k * intervals.layout.vectors::<S>() + rays;
            let (t, delta, moves) = (t.at(at), delta.at(at), moves.at(at));
            let w = [weight[0].at(at), weight[1].at(at), weight[2].at(at)];
            let all = w[0] + w[1] + w[2];
            // Distortion is half the weights times the gradient of Σ_ij w_i w_j |t_i − t_j| + ⅓ Σ w_i² δ_i.
            let (after, after_t) = (along.all - before - all, along.all_t - before_t - all * t);
            let bent = 2.0 * (t * before - before_t + after_t - t * after) + (2.0 / 3.0) * all * delta;
            // Σ_k T α (1 − α) = Σ_k w (1 − α), w the weight of all streams: here its gradient by w.
            let soft = config.entropy * pass.at(at);
            let depth = config.depth * wrong_depth(simd, t, depth);
            cost += all * (0.5 * config.distortion * bent + depth + soft);
            let shared = scale * (config.distortion * bent + depth + soft) + flat * flatness::inverse(t);
            for s in 0..3 {
                let price = moving[s].where_greater(moves, zero, resting[s]);
                cost += price * w[s];
                let mut g = shared + scale * (price + veil[s]);
                if let Some(asked) = grad.asked.get(at * S::F32_LANES..(at + 1) * S::F32_LANES) {
                    let mut of_stream = [0.0; LANES];
                    of_stream.iter_mut().zip(asked).for_each(|(to, asked)| *to = asked[s]);
                    g += Column::new(simd, &of_stream).at(0);
                }
                if !chunk.batches[s].is_empty() {
                    // The persistent stream's β is that of all light.
                    for c in 0..if s > 0 { 4 } else { 3 } {
                        g += composited.values[c] * values[s][c].at(at);
                        d_values[s][c].set(at, composited.values[c] * w[s]);
                    }
                }
                gradient[s] = g;
            }
            (before, before_t) = (before + all, before_t + all * t);
        }
        self.cost = cost;
    }

    /// What densities cost themselves: adds its gradient to `gradient`, that of weights with respect to them, and writes it where
    /// streams have a batch.
    #[inline(always)]
    fn densities(&mut self, gradient: &[[Floats<S>; 3]], samples: &mut [StreamSamples; 3]) {
        let Self { simd, config, chunk, scale, rays, .. } = *self;
        let Chunk { intervals, weights, batches, .. } = chunk;
        let [delta, pass] = [&intervals.delta, &weights.pass].map(|column| Column::new(simd, column));
        let weight = weights.weight.each_ref().map(|column| Column::new(simd, column));
        let sigma = intervals.sigma.each_ref().map(|column| Column::new(simd, column));
        let mut out = samples.each_mut().map(|s| ColumnMut::new(simd, &mut s.sigma));
        for (k, gradient) in gradient.iter().enumerate() {
            let at = k * intervals.layout.vectors::<S>() + rays;
            let delta = delta.at(at);
            let all = weight[0].at(at) + weight[1].at(at) + weight[2].at(at);
            // Of the softness by 1 − α = e^(−δΣ), and of what moves by its optical depth.
            let soft = (-scale * config.entropy) * all * pass.at(at) * delta;
            let transient = config.transient * delta;
            self.cost += transient * (sigma[1].at(at) + sigma[2].at(at));
            for s in (0..3).filter(|s| !batches[*s].is_empty()) {
                let direct = if s > 0 { soft + scale * transient } else { soft };
                out[s].set(at, gradient[s] + direct);
            }
        }
    }
}

/// Sums over the samples of a vector of rays.
struct Along<S: Simd> {
    /// Opacity of each stream.
    cover: [Floats<S>; 3],
    /// Σ w, and Σ w t.
    all: Floats<S>,
    all_t: Floats<S>,
}

impl<S: Simd> Along<S> {
    #[inline(always)]
    fn of(simd: S, chunk: &Chunk, rays: usize) -> Self {
        let layout = chunk.intervals.layout;
        let t = Column::new(simd, &chunk.intervals.t);
        let weight = chunk.weights.weight.each_ref().map(|column| Column::new(simd, column));
        let zero = Floats::new(simd, 0.0);
        let mut along = Self { cover: [zero; 3], all: zero, all_t: zero };
        for at in layout.of_vector::<S>(rays) {
            let w = [weight[0].at(at), weight[1].at(at), weight[2].at(at)];
            for s in 0..3 {
                along.cover[s] += w[s];
            }
            along.all += w[0] + w[1] + w[2];
            along.all_t += (w[0] + w[1] + w[2]) * t.at(at);
        }
        along
    }
}

/// How wrong it is for a ray to end at `t` where stereo says `depth`, 0 to 1: nothing within its error, and no more
/// beyond [`FAR_OFF`], so that a false match costs a bounded price; nor where stereo says nothing (0).
#[inline(always)]
fn wrong_depth<S: Simd>(simd: S, t: Floats<S>, depth: Floats<S>) -> Floats<S> {
    let wrong = ((t - depth).abs() / depth - STEREO_ERROR) * (1.0 / (FAR_OFF - STEREO_ERROR));
    let nothing = Floats::new(simd, 0.0);
    wrong.clamp(0.0, 1.0).where_greater(depth, nothing, nothing)
}
