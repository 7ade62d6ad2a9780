//! Where along rays to look: intervals of equal weight under the running density grids.
//!
//! Rays go through the grids side by side, a lane each: a step of one waits for its own last step only, and neighbouring rays look
//! up neighbouring cells.

use super::density_grid::STRIDE;
use super::rays::Ray;
use crate::simd::floor_within;

/// Most steps a ray takes through the density grids.
const MAX_STEPS: usize = 768;

/// Steps after which is looked whether any ray goes on.
const LOOK_EVERY: usize = 4;

/// Steps from one whose cells are looked up to the one whose cells are asked for.
const AHEAD: usize = 4;

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

/// A number for each of the rays that are sampled together.
pub type Lanes = [f32; STRIDE];

/// What steers the samples of some rays: the streams' running densities along them.
///
/// A trait and not a closure, which would not be inlined, and so compiled without the caller's vector features.
pub trait Steer {
    /// Where to look it up.
    type Cells: Copy + Default;

    /// Finds the cells of a point of each ray (x, y, z rows) at its distance, and asks for them before they are needed.
    fn find(&self, points: &[Lanes; 3], t: &Lanes) -> Self::Cells;

    /// σ of what stands and of what moves in them.
    fn sigma(&self, cells: &Self::Cells) -> [Lanes; 2];
}

/// Rays that are sampled together, a lane each; those that miss the box, and lanes that are none, are of length 0.
#[derive(Clone, Copy, Debug, Default)]
pub struct RayLanes {
    origin: [Lanes; 3],
    dir: [Lanes; 3],
    start: Lanes,
    length: Lanes,
}

impl RayLanes {
    /// Adds `ray` as lane `n`.
    pub fn set(&mut self, n: usize, ray: &Ray) {
        for axis in 0..3 {
            (self.origin[axis][n], self.dir[axis][n]) = (ray.origin[axis], ray.dir[axis]);
        }
        let (start, end) = ray.range;
        if start < end {
            (self.start[n], self.length[n]) = (start, end - start);
        }
    }

    /// Whether lane `n` is a ray that meets the box.
    pub fn hits(&self, n: usize) -> bool {
        self.length[n] > 0.0
    }

    /// The points at distances `t`, x, y and z rows.
    #[inline(always)]
    pub fn points(&self, t: &Lanes) -> [Lanes; 3] {
        let mut points = [[0.0; STRIDE]; 3];
        for axis in 0..3 {
            let (origin, dir) = (&self.origin[axis], &self.dir[axis]);
            for n in 0..STRIDE {
                points[axis][n] = origin[n] + dir[n] * t[n];
            }
        }
        points
    }
}

/// Buffers of one thread.
pub struct Sampler {
    /// Weight of every step of the rays.
    weights: Vec<Lanes>,
    /// The weights of all steps before it.
    below: Vec<Lanes>,
    /// The step from which on edges are behind it.
    steps: Vec<[u32; STRIDE]>,
    /// A ray is cut off where what stands leaves less than this of its light.
    saturated: f32,
    /// Steps through the grids that rays have taken, so far.
    pub taken: u64,
    /// Steps through the grids that rays were spared because they had been cut off, so far.
    pub spared: u64,
}

impl Default for Sampler {
    fn default() -> Self {
        let [weights, below] = [0; 2].map(|_| vec![[0.0; STRIDE]; MAX_STEPS]);
        Self { weights, below, steps: Vec::new(), saturated: SATURATED, taken: 0, spared: 0 }
    }
}

#[cfg(test)]
impl Sampler {
    /// One that goes on to the end of every ray.
    pub fn without_cut() -> Self {
        Self { saturated: 0.0, ..Self::default() }
    }
}

/// What rays have met on their way through the grids.
struct Walked {
    /// Length of a step.
    dt: Lanes,
    /// Steps up to where a ray was cut off or has ended.
    used: Lanes,
    /// The weights of those.
    total: Lanes,
    /// Steps until all rays had ended.
    steps: usize,
}

impl Sampler {
    /// Writes `count + 1` distances, which increase along every ray, to `edges`; zeros where there is no ray.
    ///
    /// `jitter` in [0, 1) shifts all edges of a ray by a part of one interval's weight.
    #[inline(always)]
    pub fn edges(
        &mut self,
        rays: &RayLanes,
        sampling: &Sampling,
        jitter: &Lanes,
        steer: &impl Steer,
        edges: &mut [Lanes],
    ) {
        let walked = self.walk(rays, sampling, steer);
        self.divide(rays, sampling, jitter, &walked, edges);
    }

    /// Finds the weights of all steps.
    #[inline(always)]
    fn walk<S: Steer>(&mut self, rays: &RayLanes, sampling: &Sampling, steer: &S) -> Walked {
        let [mut steps, mut dt, mut scale] = [[0.0; STRIDE]; 3];
        let mut most = 0.0f32;
        for n in (0..STRIDE).filter(|n| rays.hits(*n)) {
            steps[n] = (rays.length[n] / sampling.step).ceil().clamp(1.0, MAX_STEPS as f32);
            dt[n] = rays.length[n] / steps[n];
            scale[n] = sampling.sharpness * dt[n];
            most = most.max(steps[n]);
        }
        let [mut left, mut past] = [[1.0; STRIDE]; 2];
        let [mut total, mut used] = [[0.0; STRIDE]; 2];
        let mut walked = 0;
        let mut ahead = [S::Cells::default(); AHEAD];
        for (step, cells) in ahead.iter_mut().enumerate() {
            *cells = cells_at(rays, &dt, step, steer);
        }
        for (step, weights) in self.weights.iter_mut().take(most as usize).enumerate() {
            let at = step as f32;
            let cells = &mut ahead[step % AHEAD];
            let [stands, moves] = steer.sigma(cells);
            *cells = cells_at(rays, &dt, step + AHEAD, steer);
            let [mut weight, mut goes_on] = [[0.0; STRIDE]; 2];
            for n in 0..STRIDE {
                // The step after which nothing is left is the last.
                goes_on[n] = if (at < steps[n]) & (left[n] >= self.saturated) { 1.0 } else { 0.0 };
                let alpha = 1.0 - passes((stands[n] + moves[n]) * scale[n]);
                weight[n] = goes_on[n] * (left[n] * past[n].max(SEEN_PAST) * alpha);
            }
            for n in 0..STRIDE {
                left[n] *= passes(stands[n] * scale[n]);
                past[n] *= passes(moves[n] * scale[n]);
                total[n] += weight[n];
                used[n] += goes_on[n];
            }
            *weights = weight;
            walked = step + 1;
            if walked % LOOK_EVERY == 0 && goes_on.iter().sum::<f32>() == 0.0 {
                break;
            }
        }
        let [of_rays, taken] = [steps, used].map(|steps| steps.iter().sum::<f32>() as u64);
        self.taken += taken;
        self.spared += of_rays - taken;
        Walked { dt, used, total, steps: walked }
    }

    /// Divides the weights, and a floor below them, into equal parts.
    #[inline(always)]
    fn divide(
        &mut self,
        rays: &RayLanes,
        sampling: &Sampling,
        jitter: &Lanes,
        walked: &Walked,
        edges: &mut [Lanes],
    ) {
        let count = sampling.count;
        let Walked { dt, used, .. } = walked;
        let [mut floor, mut total, mut per_weight] = [[0.0; STRIDE]; 3];
        for n in 0..STRIDE {
            let even = sampling.explore * walked.total[n].max(0.05) / (1.0 - sampling.explore);
            floor[n] = even / used[n].max(1.0);
            total[n] = walked.total[n] + floor[n] * used[n];
            per_weight[n] = count as f32 / total[n];
        }
        // Edge number k + 1 is where the weights have come to (k + 1/2 + jitter) / count of all: of every step the first k that is
        // behind it.
        self.steps.clear();
        self.steps.resize(count, [0; STRIDE]);
        let mut sum = [0.0; STRIDE];
        for (step, (weights, below)) in
            self.weights.iter().zip(&mut self.below).take(walked.steps).enumerate()
        {
            *below = sum;
            let mut behind = [0; STRIDE];
            for n in 0..STRIDE {
                sum[n] += weights[n] + floor[n];
                let k = sum[n] * per_weight[n] - jitter[n] + 0.5;
                behind[n] = floor_within(k, (count - 1) as f32).0;
            }
            for n in 0..STRIDE {
                self.steps[behind[n] as usize][n] = step as u32 + 1;
            }
        }
        let mut latest = [0; STRIDE];
        let mut edge = rays.start;
        edges[0] = edge;
        for k in 1..count {
            let [mut below, mut weight, mut bin] = [[0.0; STRIDE]; 3];
            for n in 0..STRIDE {
                latest[n] = latest[n].max(self.steps[k - 1][n]);
                let step = latest[n].min((used[n] as u32).max(1) - 1) as usize;
                (below[n], weight[n], bin[n]) = (self.below[step][n], self.weights[step][n], step as f32);
            }
            for n in 0..STRIDE {
                let target = (k as f32 - 0.5 + jitter[n]) / count as f32 * total[n];
                let inside = ((target - below[n]) / (weight[n] + floor[n])).clamp(0.0, 1.0);
                let next = rays.start[n] + (bin[n] + inside) * dt[n];
                // Rounding may let two edges meet; intervals of zero length are harmless, decreasing ones are not.
                edge[n] = if next > edge[n] { next } else { edge[n] };
            }
            edges[k] = edge;
        }
        for n in 0..STRIDE {
            edge[n] = edge[n].max(rays.start[n] + used[n] * dt[n]);
        }
        edges[count] = edge;
    }
}

/// The cells that rays pass in the middle of step `step`, of which each has its own length.
#[inline(always)]
fn cells_at<S: Steer>(rays: &RayLanes, dt: &Lanes, step: usize, steer: &S) -> S::Cells {
    let mut t = [0.0; STRIDE];
    for n in 0..STRIDE {
        t[n] = rays.start[n] + (step as f32 + 0.5) * dt[n];
    }
    steer.find(&rays.points(&t), &t)
}

/// e^-tau to first order, and cheaper; only steers the samples.
#[inline(always)]
fn passes(tau: f32) -> f32 {
    1.0 / (1.0 + tau)
}
