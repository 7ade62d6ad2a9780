//! Where along a ray to look: intervals of equal weight under the running density grids.

use super::density_grid::STRIDE;
use super::rays::Ray;

/// Most steps a ray takes through the density grids; whole blocks of [`STRIDE`].
const MAX_STEPS: usize = 768;

/// See [`Sampler`]: a share of the light that does not show.
const SATURATED: f32 = 1e-4;

/// Light that what moves leaves at least, as far as samples go: its grids hold for a span of time, in part of which it may
/// be elsewhere, and then what is behind it must be looked at.
const SEEN_PAST: f32 = 0.3;

/// Settings of the sampler.
#[derive(Clone, Copy, Debug)]
pub struct Sampling {
    /// Intervals per ray.
    pub count: usize,
    /// Step through the grids, units.
    pub step: f32,
    /// Share of the samples spread evenly over what is not hidden, whatever the grids say.
    pub explore: f32,
    /// The grids' densities are multiplied by this.
    pub sharpness: f32,
}

/// What steers the samples of one ray: the streams' running densities along it.
///
/// A trait and not a closure, which would not be inlined, and so compiled without the caller's vector features.
pub trait Steer {
    /// σ of what stands and of what moves, at some points of the ray (x, y, z rows) and their distances.
    fn sigma(&self, points: &[[f32; STRIDE]; 3], t: &[f32; STRIDE]) -> [[f32; STRIDE]; 2];
}

/// Products of all factors before each, and of all of them.
///
/// Blocks do not wait for one another: what is left before a block comes to it afterwards.
#[inline(always)]
fn products(factors: [f32; STRIDE]) -> ([f32; STRIDE], f32) {
    let (mut before, mut product) = ([0.0; STRIDE], 1.0);
    for (before, factor) in before.iter_mut().zip(factors) {
        *before = product;
        product *= factor;
    }
    (before, product)
}

/// Buffers of one thread.
pub struct Sampler {
    weights: Vec<f32>,
    /// A ray is cut off where what stands leaves less than this of its light.
    saturated: f32,
    /// Steps through the grids that rays have taken, so far.
    pub taken: u64,
    /// Steps through the grids that rays were spared because they had been cut off, so far.
    pub spared: u64,
}

impl Default for Sampler {
    fn default() -> Self {
        Self { weights: vec![0.0; MAX_STEPS], saturated: SATURATED, taken: 0, spared: 0 }
    }
}

#[cfg(test)]
impl Sampler {
    /// One that goes on to the end of every ray.
    pub fn without_cut() -> Self {
        Self { saturated: 0.0, ..Self::default() }
    }
}

impl Sampler {
    /// Writes `count + 1` increasing distances to `edges`; false if the ray misses the box.
    ///
    /// `jitter` in [0, 1) shifts all edges by a part of one interval's weight.
    #[inline(always)]
    pub fn edges(
        &mut self,
        ray: &Ray,
        sampling: &Sampling,
        jitter: f32,
        steer: &impl Steer,
        edges: &mut [f32],
    ) -> bool {
        let (start, end) = ray.range;
        if start >= end {
            return false;
        }
        let steps = (((end - start) / sampling.step).ceil() as usize).clamp(1, MAX_STEPS);
        let dt = (end - start) / steps as f32;
        let (mut left, mut past) = (1.0f32, 1.0f32);
        let mut totals = [0.0; STRIDE];
        let mut used = 0;
        let scale = sampling.sharpness * dt;
        for block in self.weights.as_chunks_mut::<STRIDE>().0.iter_mut().take(steps.div_ceil(STRIDE)) {
            let mut t = [0.0; STRIDE];
            for (n, t) in t.iter_mut().enumerate() {
                *t = start + ((used + n) as f32 + 0.5) * dt;
            }
            let mut points = [[0.0; STRIDE]; 3];
            for axis in 0..3 {
                for n in 0..STRIDE {
                    points[axis][n] = ray.origin[axis] + ray.dir[axis] * t[n];
                }
            }
            let [mut stands, mut moves] = steer.sigma(&points, &t);
            let mut alphas = [0.0; STRIDE];
            for n in 0..STRIDE {
                // e^-tau to first order, and cheaper; only steers the samples.
                let passes = |sigma: f32| 1.0 / (1.0 + sigma * scale);
                alphas[n] = 1.0 - passes(stands[n] + moves[n]);
                (stands[n], moves[n]) = (passes(stands[n]), passes(moves[n]));
            }
            let ((stands, all), (moves, all_move)) = (products(stands), products(moves));
            let mut ahead = [0.0; STRIDE];
            for n in 0..STRIDE {
                ahead[n] = left * stands[n];
                block[n] = ahead[n] * (past * moves[n]).max(SEEN_PAST) * alphas[n];
            }
            let len = block.len().min(steps - used);
            (left, past) = (left * all, past * all_move);
            let mut seen = len;
            if left < self.saturated {
                // The step after which nothing is left is the last.
                seen = ahead[1..len].iter().position(|left| *left < self.saturated).map_or(len, |n| n + 1);
            }
            if seen < STRIDE {
                block[seen..].fill(0.0);
            }
            for n in 0..STRIDE {
                totals[n] += block[n];
            }
            used += seen;
            if left < self.saturated {
                break;
            }
        }
        self.taken += used as u64;
        self.spared += (steps - used) as u64;
        let total = totals.iter().sum::<f32>();
        let span = used as f32;
        let floor = sampling.explore * total.max(0.05) / ((1.0 - sampling.explore) * span);
        let total = total + floor * span;
        let n = sampling.count;
        let (mut bin, mut below) = (0, 0.0);
        edges[0] = start;
        for (k, edge) in edges[1..n].iter_mut().enumerate() {
            let target = (k as f32 + 0.5 + jitter) / n as f32 * total;
            while bin + 1 < used && below + self.weights[bin] + floor < target {
                below += self.weights[bin] + floor;
                bin += 1;
            }
            let inside = ((target - below) / (self.weights[bin] + floor)).clamp(0.0, 1.0);
            *edge = start + (bin as f32 + inside) * dt;
        }
        edges[n] = start + span * dt;
        // Rounding may let two edges meet; intervals of zero length are harmless, decreasing ones are not.
        for k in 1..=n {
            edges[k] = edges[k].max(edges[k - 1]);
        }
        true
    }
}
