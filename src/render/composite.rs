//! Compositing of three streams along rays (NeuralDiff's improved colour mixing), forward and backward.
//!
//! Σ = σ^p + σ^d + σ^a; α_k = 1 − e^(−δ_k Σ_k); T_k = e^(−Σ_{j<k} δ_j Σ_j);
//! w^s_k = T_k σ^s_k δ_k φ(δ_k Σ_k) with φ(a) = (1 − e^−a)/a, so that Σ_s w^s_k = T_k α_k without a division by Σ.
//!
//! Along a ray every sample waits for the one before it, so vectors hold samples of different rays: their numbers are
//! columns, in each of which the first samples of all rays come first ([`RayLayout`]).

use pulp::Simd;

use super::density_grid::STRIDE;
use crate::simd::AlignedVec;
use crate::simd::floats::{Column, ColumnMut, Floats};

/// Numbers of rays are padded to a multiple of this, which any vector's lanes divide: to whole groups that are placed together.
pub const LANES: usize = STRIDE;

/// How the samples of some rays are numbered, each of which has as many.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RayLayout {
    /// Rays.
    pub rays: usize,
    /// Samples of each.
    pub samples: usize,
}

impl RayLayout {
    /// Numbers from one sample of a ray to its next: the rays, and lanes of nobody up to whole vectors.
    #[inline(always)]
    pub fn width(self) -> usize {
        self.rays.next_multiple_of(LANES)
    }

    /// Length of a column.
    #[inline(always)]
    pub fn len(self) -> usize {
        self.samples * self.width()
    }

    /// Whether there are no samples.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Number of sample `k` of ray `ray`.
    #[inline(always)]
    pub fn number(self, ray: usize, k: usize) -> usize {
        k * self.width() + ray
    }

    /// The ray of sample number `number`.
    #[inline(always)]
    pub fn ray(self, number: usize) -> usize {
        number % self.width()
    }

    /// Numbers of a ray's samples, front to back.
    #[inline(always)]
    pub fn of_ray(self, ray: usize) -> impl DoubleEndedIterator<Item = usize> {
        (0..self.samples).map(move |k| self.number(ray, k))
    }

    /// Vectors of as many rays as have lanes.
    #[inline(always)]
    pub fn vectors<S: Simd>(self) -> usize {
        self.width() / S::F32_LANES
    }

    /// Numbers of the vectors with the samples of vector `rays` of the rays, front to back.
    #[inline(always)]
    pub fn of_vector<S: Simd>(self, rays: usize) -> impl Iterator<Item = usize> {
        (rays..self.len() / S::F32_LANES).step_by(self.vectors::<S>())
    }
}

/// One interval of a ray: densities of the three streams, its length and where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Interval {
    /// σ of each stream, 1/unit.
    pub sigma: [f32; 3],
    /// Length, units.
    pub delta: f32,
    /// Distance of its middle, units.
    pub t: f32,
}

/// Intervals of some rays, as columns.
#[derive(Clone, Default)]
pub struct Intervals {
    /// Where those of a ray are.
    pub layout: RayLayout,
    /// σ of each stream, 1/unit.
    pub sigma: [AlignedVec; 3],
    /// Lengths, units.
    pub delta: AlignedVec,
    /// Distances of their middles, units.
    pub t: AlignedVec,
}

impl Intervals {
    /// Of length 0 and without density, all of them.
    pub fn reset(&mut self, layout: RayLayout) {
        self.layout = layout;
        for column in self.sigma.iter_mut().chain([&mut self.delta, &mut self.t]) {
            column.zero(layout.len());
        }
    }

    /// Those of one ray.
    pub fn of_ray(intervals: &[Interval]) -> Self {
        let mut columns = Self::default();
        columns.reset(RayLayout { rays: 1, samples: intervals.len() });
        for (n, i) in columns.layout.of_ray(0).zip(intervals) {
            (0..3).for_each(|s| columns.sigma[s][n] = i.sigma[s]);
            (columns.delta[n], columns.t[n]) = (i.delta, i.t);
        }
        columns
    }

    /// Number `n`.
    #[inline(always)]
    pub fn at(&self, n: usize) -> Interval {
        Interval { sigma: [0, 1, 2].map(|s| self.sigma[s][n]), delta: self.delta[n], t: self.t[n] }
    }

    /// Leaves the densities of stream `s` alone.
    pub fn keep_stream(&mut self, s: usize) {
        let len = self.layout.len();
        let others = self.sigma.iter_mut().enumerate().filter(|(n, _)| *n != s);
        others.for_each(|(_, sigma)| sigma.zero(len));
    }
}

/// What compositing gives intervals, as columns.
#[derive(Default)]
pub struct Weights {
    /// w^s: share of the pixel's light that each stream contributes.
    pub weight: [AlignedVec; 3],
    /// T: light left before the interval.
    pub transmittance: AlignedVec,
    /// φ(δΣ).
    phi: AlignedVec,
    /// 1 − α = e^(−δΣ): the share of the arriving light that goes on.
    pub pass: AlignedVec,
    /// Light left behind the last interval of each ray.
    pub left: AlignedVec,
}

impl Weights {
    /// T α of interval `n`, the weight of all streams together.
    #[inline(always)]
    pub fn total(&self, n: usize) -> f32 {
        self.weight[0][n] + self.weight[1][n] + self.weight[2][n]
    }

    /// w^s of interval `n`.
    #[inline(always)]
    pub fn at(&self, n: usize) -> [f32; 3] {
        [0, 1, 2].map(|s| self.weight[s][n])
    }

    /// Weights of all intervals, and what is left.
    ///
    /// A ray's weights and the light that is left sum to 1 up to rounding.
    #[inline(always)]
    pub fn find<S: Simd>(&mut self, simd: S, intervals: &Intervals) {
        let layout = intervals.layout;
        let columns = self.weight.iter_mut().chain([&mut self.transmittance, &mut self.phi, &mut self.pass]);
        columns.for_each(|column| column.reserve_len(layout.len()));
        self.left.reserve_len(layout.width());
        let sigma = intervals.sigma.each_ref().map(|column| Column::new(simd, column));
        let delta = Column::new(simd, &intervals.delta);
        let mut weight = self.weight.each_mut().map(|column| ColumnMut::new(simd, column));
        let [mut transmittance, mut phis, mut passes, mut left] =
            [&mut self.transmittance, &mut self.phi, &mut self.pass, &mut self.left]
                .map(|column| ColumnMut::new(simd, column));
        let zero = Floats::new(simd, 0.0);
        for rays in 0..layout.vectors::<S>() {
            let mut depth = Sum { sum: zero, rest: zero };
            for at in layout.of_vector::<S>(rays) {
                let delta = delta.at(at);
                let tau = (sigma[0].at(at) + sigma[1].at(at) + sigma[2].at(at)) * delta;
                let alpha = tau.one_minus_exp_neg();
                let phi = (alpha / tau).where_greater(tau, Floats::new(simd, 1e-6), 1.0 - 0.5 * tau);
                let before = depth.passes();
                for s in 0..3 {
                    weight[s].set(at, before * sigma[s].at(at) * delta * phi);
                }
                transmittance.set(at, before);
                phis.set(at, phi);
                passes.set(at, 1.0 - alpha);
                // Behind so much nothing is left in f32, and sums stay finite.
                depth.add(tau.clamp(0.0, OPAQUE));
            }
            left.set(rays, depth.passes());
        }
    }
}

/// An optical depth behind which no light is left.
const OPAQUE: f32 = 200.0;

/// Optical depth so far, and what rounding took from it: a sum of 10⁵ equal numbers in f32 alone is off by 10⁻³, always
/// to the same side.
struct Sum<S: Simd> {
    sum: Floats<S>,
    rest: Floats<S>,
}

impl<S: Simd> Sum<S> {
    /// Adds `more`, with the exact error of the sum (Knuth's two-sum).
    #[inline(always)]
    fn add(&mut self, more: Floats<S>) {
        let sum = self.sum + more;
        let added = sum - self.sum;
        self.rest += (self.sum - (sum - added)) + (more - added);
        self.sum = sum;
    }

    /// The light that goes on.
    #[inline(always)]
    fn passes(&self) -> Floats<S> {
        (0.0 - (self.sum + self.rest)).exp()
    }
}

/// Turns the gradient of a loss with respect to w^s of the samples of vector `rays` of the rays, front to back, into that with respect
/// to their σ^s; `d_left` is that with respect to the light left behind the last.
#[inline(always)]
pub fn backward<S: Simd>(
    simd: S,
    intervals: &Intervals,
    weights: &Weights,
    rays: usize,
    gradient: &mut [[Floats<S>; 3]],
    d_left: Floats<S>,
) {
    let layout = intervals.layout;
    let sigma = intervals.sigma.each_ref().map(|values| Column::new(simd, values));
    let weight = weights.weight.each_ref().map(|values| Column::new(simd, values));
    let [delta, transmittance, phi, pass, left] =
        [&intervals.delta, &weights.transmittance, &weights.phi, &weights.pass, &weights.left]
            .map(|values| Column::new(simd, values));
    let thin = Floats::new(simd, 0.05);
    // What later intervals and the background lose when this one gets denser.
    let mut behind = left.at(rays) * d_left;
    for (k, gradient) in gradient.iter_mut().enumerate().rev() {
        let at = k * layout.vectors::<S>() + rays;
        let (a, b, c, g) = (sigma[0].at(at), sigma[1].at(at), sigma[2].at(at), *gradient);
        let (phi, pass, delta) = (phi.at(at), pass.at(at), delta.at(at));
        let tau = (a + b + c) * delta;
        // φ'(a) = (e^−a − φ)/a; its series −1/2 + a/3 − a²/8 where the difference cancels.
        let closed = (pass - phi) / tau;
        let series = tau * (1.0 / 3.0 - tau * (0.125 - tau * (1.0 / 30.0))) - 0.5;
        let d_phi = closed.where_greater(tau, thin, series);
        let mixed = a * g[0] + b * g[1] + c * g[2];
        let lit = transmittance.at(at) * delta;
        // In this order no product leaves f32: δ Σ s g φ' is at most of the size of g where δΣ is large.
        let shared = lit * (delta * mixed * d_phi) - delta * behind;
        for s in 0..3 {
            gradient[s] = lit * phi * g[s] + shared;
        }
        behind += weight[0].at(at) * g[0] + weight[1].at(at) * g[1] + weight[2].at(at) * g[2];
    }
}
