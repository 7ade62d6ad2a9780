//! The loss of one chunk of rays and its gradient with respect to everything that compositing saw.

use serde::{Deserialize, Serialize};

use crate::field::stream::StreamSamples;
use crate::render::composite::{Interval, Weighted};
use crate::render::forward::Chunk;

/// Weights of the loss's terms.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// β_min: uncertainty of the persistent stream, in colour units.
    pub beta_min: f32,
    /// λ_u: price of dynamic and actor density (mean σ·δ over a ray).
    pub transient: f32,
    /// Price of a pixel that is explained by the dynamic or the actor stream, in nats: the prior odds against it.
    pub transient_opacity: [f32; 2],
    /// Distortion (Barron et al. 2022, mip-NeRF 360, eq. 15): pulls a ray's weight together.
    pub distortion: f32,
    /// Entropy of a ray's opacity per interval: surfaces are hard, air is empty.
    pub entropy: f32,
    /// Curvature of inverse depth across a patch of pixels: what has no texture is taken to be flat.
    pub smoothness: f32,
    /// Price of per-frame exposure away from none.
    pub exposure: f32,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self {
            beta_min: 0.03,
            transient: 0.01,
            transient_opacity: [8.0, 6.0],
            distortion: 0.3,
            entropy: 0.0,
            smoothness: 0.5,
            exposure: 0.1,
        }
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
    /// With respect to each ray's inverse depth.
    inverse_depth: Vec<f32>,
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
}

/// How a chunk's rays and samples are arranged.
#[derive(Clone, Copy, Debug)]
pub struct ChunkShape {
    /// Samples per ray.
    pub samples: usize,
    /// Rays come in squares of `patch`² neighbours, row by row.
    pub patch: usize,
}

/// Evaluates the loss of a traced chunk and fills `grad`. `scale` multiplies the whole gradient (1 / rays).
pub fn backward(
    config: &LossConfig,
    chunk: &Chunk,
    targets: &[RayTarget],
    shape: ChunkShape,
    scale: f32,
    grad: &mut ChunkGradient,
) -> ChunkLoss {
    let count = shape.samples;
    let total = chunk.intervals.len();
    grad.weight.resize(total, [0.0; 3]);
    grad.sigma.resize(total, [0.0; 3]);
    grad.exposure.resize(targets.len(), [0.0; 6]);
    for s in &mut grad.samples {
        s.reset(total);
    }
    let mut loss = ChunkLoss::default();
    smoothness(config, chunk, targets, shape, scale, &mut grad.inverse_depth);
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
        for k in range.clone() {
            for s in 0..3 {
                let w = chunk.weighted[k].weight[s];
                let rgb = chunk.samples[s].rgb[k];
                let mut g = 0.0;
                for c in 0..3 {
                    g += d_rgb[c] * rgb[c];
                    grad.samples[s].rgb[k][c] = d_rgb[c] * w;
                }
                if s > 0 {
                    g += scale * config.transient_opacity[s - 1];
                    g += d_beta * chunk.samples[s].beta[k];
                    grad.samples[s].beta[k] = d_beta * w;
                }
                grad.weight[k][s] = g;
            }
        }
        let d_inverse = grad.inverse_depth[r] / ray.ray.dir_cam.z;
        if d_inverse != 0.0 {
            for k in range.clone() {
                let d = d_inverse / chunk.intervals[k].t;
                grad.weight[k] = grad.weight[k].map(|g| g + d);
            }
        }
        if config.distortion > 0.0 {
            distortion(
                &chunk.intervals[range.clone()],
                &chunk.weighted[range.clone()],
                scale * config.distortion,
                &mut grad.weight[range.clone()],
            );
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
            if config.entropy > 0.0 {
                let w = &chunk.weighted[k];
                let alpha = (w.total() / w.transmittance.max(1e-6)).clamp(0.0, 1.0);
                // d/dσ of α(1−α), weighted by the light that arrives: hard surfaces or nothing.
                let d =
                    scale * config.entropy * w.transmittance * (1.0 - 2.0 * alpha) * (1.0 - alpha) * delta;
                grad.sigma[k][0] += d;
            }
            for s in 0..3 {
                let extra = if s > 0 { d_transient * delta } else { 0.0 };
                grad.samples[s].sigma[k] = grad.sigma[k][s] + extra;
            }
        }
    }
    loss
}

/// Contrast between neighbours at which a depth edge costs 1/e of what it costs on a plain surface.
const EDGE_CONTRAST: f32 = 0.1;

/// Relative curvature below which the price is quadratic rather than linear.
const FLAT: f32 = 0.01;

/// Gradient, with respect to each ray's inverse z-depth, of the curvature of inverse depth across a patch.
///
/// Inverse depth is linear in the image on any plane, whatever its slant, so a plane costs nothing. The curvature is
/// taken relative to the inverse depth itself, and weighted down where the image has an edge.
fn smoothness(
    config: &LossConfig,
    chunk: &Chunk,
    targets: &[RayTarget],
    shape: ChunkShape,
    scale: f32,
    grad: &mut Vec<f32>,
) {
    grad.clear();
    grad.resize(targets.len(), 0.0);
    let side = shape.patch;
    if config.smoothness == 0.0 || side < 3 {
        return;
    }
    let inverse: Vec<f32> = (0..targets.len())
        .map(|r| {
            let range = r * shape.samples..(r + 1) * shape.samples;
            let sum = |k: usize| chunk.weighted[k].total() / chunk.intervals[k].t.max(1e-6);
            range.map(sum).sum::<f32>() / chunk.rays[r].ray.dir_cam.z
        })
        .collect();
    let contrast = |a: usize, b: usize| -> f32 {
        (0..3).map(|c| (targets[a].rgb[c] - targets[b].rgb[c]).abs()).sum::<f32>() / 3.0
    };
    for first in (0..targets.len()).step_by(side * side) {
        for line in 0..side {
            for at in 0..side - 2 {
                for (start, step) in [(line * side + at, 1), (at * side + line, side)] {
                    let a = first + start;
                    let [a, b, c] = [a, a + step, a + 2 * step];
                    let size = inverse[b].max(1e-3);
                    let curvature = (inverse[a] - 2.0 * inverse[b] + inverse[c]) / size;
                    let edge = (-(contrast(a, b) + contrast(b, c)) / EDGE_CONTRAST).exp();
                    // Charbonnier: √(κ² + flat²); its derivative is bounded by 1.
                    let slope = curvature / (curvature * curvature + FLAT * FLAT).sqrt();
                    let d = scale * config.smoothness * edge * slope / size;
                    grad[a] += d;
                    grad[b] -= 2.0 * d;
                    grad[c] += d;
                }
            }
        }
    }
}

/// Adds the gradient of Σ_ij w_i w_j |t_i − t_j| + ⅓ Σ w_i² δ_i with respect to the weights, in O(n).
fn distortion(intervals: &[Interval], weighted: &[Weighted], scale: f32, grad: &mut [[f32; 3]]) {
    let (mut all, mut all_t) = (0.0, 0.0);
    for (i, w) in intervals.iter().zip(weighted) {
        all += w.total();
        all_t += w.total() * i.t;
    }
    let (mut before, mut before_t) = (0.0, 0.0);
    for ((i, w), g) in intervals.iter().zip(weighted).zip(grad) {
        let (w, wt) = (w.total(), w.total() * i.t);
        let (after, after_t) = (all - before - w, all_t - before_t - wt);
        let d = 2.0 * (i.t * before - before_t + after_t - i.t * after) + (2.0 / 3.0) * w * i.delta;
        for g in g.iter_mut() {
            *g += scale * d;
        }
        before += w;
        before_t += wt;
    }
}
