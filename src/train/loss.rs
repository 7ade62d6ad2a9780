//! The loss of one chunk of rays and its gradient with respect to everything that compositing saw.

use serde::{Deserialize, Serialize};

use self::flatness::Bend;
use crate::field::stream::StreamSamples;
use crate::render::composite::{Interval, Weighted};
use crate::render::forward::Chunk;
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
    /// With respect to w^s.
    pub weight: Vec<[f32; 3]>,
    /// With respect to σ^s.
    pub sigma: Vec<[f32; 3]>,
    /// With respect to σ, colour and β of each stream.
    pub samples: [StreamSamples; 3],
    /// With respect to the six exposure numbers of each ray.
    pub exposure: Vec<[f32; 6]>,
    /// What other losses ask of w^s, set before; empty: nothing.
    pub asked: Vec<[f32; 3]>,
    /// With respect to the disparity of each ray.
    disparity: Vec<f32>,
    /// Whether things move where the samples of a ray are.
    moving: Vec<bool>,
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

/// Evaluates the loss of a traced chunk and fills `grad`. `scale` multiplies the whole gradient (1 / rays).
#[inline(always)]
pub fn backward(
    config: &LossConfig,
    chunk: &Chunk,
    aims: &Aims,
    count: usize,
    scale: f32,
    grad: &mut ChunkGradient,
) -> ChunkLoss {
    let Aims { targets, bends, moving } = *aims;
    let total = chunk.intervals.len();
    grad.weight.resize(total, [0.0; 3]);
    grad.sigma.resize(total, [0.0; 3]);
    grad.exposure.resize(targets.len(), [0.0; 6]);
    for s in &mut grad.samples {
        s.resize(total);
    }
    let bent = flatness::backward(config.flatness, chunk, bends, count, scale, &mut grad.disparity);
    let mut loss = ChunkLoss { total: f64::from(bent), ..ChunkLoss::default() };
    for (r, target) in targets.iter().enumerate() {
        let ray = &chunk.rays[r];
        let range = r * count..(r + 1) * count;
        let beta = config.beta_min + ray.beta;
        let precision = 1.0 / (beta * beta);
        let mut squared = 0.0;
        let mut d_rgb = [0.0; 3];
        for c in 0..3 {
            let gain = target.exposure[c].exp();
            let raw = ray.rgb[c] + ray.left * target.background[c];
            let colour = gain * raw + target.exposure[3 + c];
            let error = colour - target.rgb[c];
            squared += error * error;
            let d = scale * precision * error;
            d_rgb[c] = d * gain;
            let d_exposure = scale * config.exposure;
            grad.exposure[r][c] = d * gain * raw + d_exposure * target.exposure[c];
            grad.exposure[r][3 + c] = d + d_exposure * target.exposure[3 + c];
        }
        loss.squared += f64::from(squared) / 3.0;
        loss.total += f64::from(0.5 * squared * precision + beta.ln());
        let d_beta = scale * (1.0 / beta - squared * precision / beta);
        let d_left = (0..3).map(|c| d_rgb[c] * target.background[c]).sum::<f32>();
        let exposure = target.exposure.iter().map(|e| e * e).sum::<f32>();
        let mut extra = 0.5 * config.exposure * exposure;
        let cover = covers(&chunk.weighted[range.clone()]);
        let veil = [0.0, 1.0, 1.0].map(|v| v * config.veil);
        extra += (0..3).map(|s| veil[s] * cover[s] * (1.0 - cover[s])).sum::<f32>();
        // All of them first: these reads are from all over memory, and so do not wait for one another.
        grad.moving.clear();
        grad.moving.extend(chunk.intervals[range.clone()].iter().map(|i| moving.contains(ray.ray.at(i.t))));
        for k in range.clone() {
            let prices = config.prices(grad.moving[k - range.start]);
            for s in 0..3 {
                let w = chunk.weighted[k].weight[s];
                let rgb = chunk.samples[s].rgb[k];
                let mut g = grad.asked.get(k).map_or(0.0, |asked| asked[s]);
                for c in 0..3 {
                    g += d_rgb[c] * rgb[c];
                    grad.samples[s].rgb[k][c] = d_rgb[c] * w;
                }
                extra += prices[s] * w;
                g += scale * (prices[s] + veil[s] * (1.0 - 2.0 * cover[s]));
                if s > 0 {
                    g += d_beta * chunk.samples[s].beta[k];
                    grad.samples[s].beta[k] = d_beta * w;
                }
                grad.weight[k][s] = g;
            }
        }
        if config.distortion > 0.0 {
            extra += config.distortion
                * distortion(
                    &chunk.intervals[range.clone()],
                    &chunk.weighted[range.clone()],
                    scale * config.distortion,
                    &mut grad.weight[range.clone()],
                );
        }
        if target.depth > 0.0 {
            for k in range.clone() {
                let price = config.depth * wrong_depth(chunk.intervals[k].t, target.depth);
                extra += price * chunk.weighted[k].total();
                for g in &mut grad.weight[k] {
                    *g += scale * price;
                }
            }
        }
        if config.flatness > 0.0 {
            let d = grad.disparity[r] / ray.ray.refined_cam.z;
            for k in range.clone() {
                for g in &mut grad.weight[k] {
                    *g += d * flatness::inverse(chunk.intervals[k].t);
                }
            }
        }
        if config.entropy > 0.0 {
            // Σ_k T α (1 − α) = Σ_k w (1 − α), w the weight of all streams: here its gradient by w.
            for (w, g) in chunk.weighted[range.clone()].iter().zip(&mut grad.weight[range.clone()]) {
                extra += config.entropy * w.total() * w.pass();
                for g in g {
                    *g += scale * config.entropy * w.pass();
                }
            }
        }
        crate::render::composite::backward(
            &chunk.intervals[range.clone()],
            &chunk.weighted[range.clone()],
            ray.left,
            &grad.weight[range.clone()],
            d_left,
            &mut grad.sigma[range.clone()],
        );
        let d_transient = scale * config.transient;
        for k in range {
            let delta = chunk.intervals[k].delta;
            let mut direct = 0.0;
            if config.entropy > 0.0 {
                // And by 1 − α = e^(−δΣ).
                let w = &chunk.weighted[k];
                direct = -scale * config.entropy * w.total() * w.pass() * delta;
            }
            for s in 0..3 {
                let transient = if s > 0 { d_transient * delta } else { 0.0 };
                grad.samples[s].sigma[k] = grad.sigma[k][s] + direct + transient;
            }
            let [_, dynamic, actor] = chunk.intervals[k].sigma;
            extra += config.transient * delta * (dynamic + actor);
        }
        loss.total += f64::from(extra);
    }
    loss
}

/// Opacity of each stream along a ray.
fn covers(weighted: &[Weighted]) -> [f32; 3] {
    let mut cover = [0.0; 3];
    for w in weighted {
        for s in 0..3 {
            cover[s] += w.weight[s];
        }
    }
    cover
}

/// How wrong it is for a ray to end at `t` where stereo says `depth`, 0 to 1: nothing within its error, and no more
/// beyond [`FAR_OFF`], so that a false match costs a bounded price.
fn wrong_depth(t: f32, depth: f32) -> f32 {
    (((t - depth).abs() / depth - STEREO_ERROR) / (FAR_OFF - STEREO_ERROR)).clamp(0.0, 1.0)
}

/// Σ_ij w_i w_j |t_i − t_j| + ⅓ Σ w_i² δ_i; adds its gradient with respect to the weights times `scale`, in O(n).
#[inline(always)]
fn distortion(intervals: &[Interval], weighted: &[Weighted], scale: f32, grad: &mut [[f32; 3]]) -> f32 {
    let (mut all, mut all_t) = (0.0, 0.0);
    for (i, w) in intervals.iter().zip(weighted) {
        all += w.total();
        all_t += w.total() * i.t;
    }
    let (mut before, mut before_t, mut sum) = (0.0, 0.0, 0.0);
    for ((i, w), g) in intervals.iter().zip(weighted).zip(grad) {
        let (w, wt) = (w.total(), w.total() * i.t);
        let (after, after_t) = (all - before - w, all_t - before_t - wt);
        let d = 2.0 * (i.t * before - before_t + after_t - i.t * after) + (2.0 / 3.0) * w * i.delta;
        for g in g.iter_mut() {
            *g += scale * d;
        }
        // A quadratic form is half the weights times its gradient.
        sum += 0.5 * w * d;
        before += w;
        before_t += wt;
    }
    sum
}
