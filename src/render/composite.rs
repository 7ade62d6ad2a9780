//! Compositing of three streams along one ray (NeuralDiff's improved colour mixing), forward and backward.
//!
//! Σ = σ^p + σ^d + σ^a; α_k = 1 − e^(−δ_k Σ_k); T_k = e^(−Σ_{j<k} δ_j Σ_j);
//! w^s_k = T_k σ^s_k δ_k φ(δ_k Σ_k) with φ(a) = (1 − e^−a)/a, so that Σ_s w^s_k = T_k α_k without a division by Σ.

use crate::simd::{exp, one_minus_exp_neg};

/// One interval of a ray: densities of the three streams and its length.
#[derive(Clone, Copy, Debug, Default)]
pub struct Interval {
    /// σ of each stream, 1/unit.
    pub sigma: [f32; 3],
    /// Length, units.
    pub delta: f32,
    /// Distance of its middle, units.
    pub t: f32,
}

/// What compositing gives each interval.
#[derive(Clone, Copy, Debug, Default)]
pub struct Weighted {
    /// w^s: share of the pixel's light that each stream contributes here.
    pub weight: [f32; 3],
    /// T: light left before this interval.
    pub transmittance: f32,
    /// φ(δΣ).
    phi: f32,
    /// e^(−δΣ).
    pass: f32,
}

impl Weighted {
    /// T α, the weight of all streams together.
    #[inline(always)]
    pub fn total(&self) -> f32 {
        self.weight[0] + self.weight[1] + self.weight[2]
    }

    /// 1 − α = e^(−δΣ): the share of the arriving light that goes on.
    #[inline(always)]
    pub fn pass(&self) -> f32 {
        self.pass
    }
}

/// Intervals of which exponentials are taken together.
const LANES: usize = 16;

/// Weights of all intervals of a ray, front to back; returns the light that is left behind the last.
///
/// The weights and the returned transmittance sum to 1 up to rounding.
#[inline(always)]
pub fn weights(intervals: &[Interval], out: &mut [Weighted]) -> f32 {
    // A sum of 10⁵ equal numbers in f32 is off by 10⁻³, always to the same side.
    let mut optical_depth = 0.0f64;
    for (intervals, out) in intervals.chunks(LANES).zip(out.chunks_mut(LANES)) {
        let (mut tau, mut before) = ([0.0; LANES], [0.0; LANES]);
        for (n, i) in intervals.iter().enumerate() {
            tau[n] = (i.sigma[0] + i.sigma[1] + i.sigma[2]) * i.delta;
            before[n] = -optical_depth as f32;
            optical_depth += f64::from(tau[n]);
        }
        let (mut alpha, mut phi) = ([0.0; LANES], [0.0; LANES]);
        for n in 0..LANES {
            alpha[n] = one_minus_exp_neg(tau[n]);
            phi[n] = if tau[n] > 1e-6 { alpha[n] / tau[n] } else { 1.0 - 0.5 * tau[n] };
            before[n] = exp(before[n]);
        }
        for (n, (i, o)) in intervals.iter().zip(out).enumerate() {
            *o = Weighted {
                weight: i.sigma.map(|s| before[n] * s * i.delta * phi[n]),
                transmittance: before[n],
                phi: phi[n],
                pass: 1.0 - alpha[n],
            };
        }
    }
    exp(-optical_depth as f32)
}

/// Gradient with respect to σ of a loss whose gradient with respect to w^s_k is `d_weight`, and with respect to the
/// light left behind the last interval `d_left`.
#[inline(always)]
pub fn backward(
    intervals: &[Interval],
    weighted: &[Weighted],
    left: f32,
    d_weight: &[[f32; 3]],
    d_left: f32,
    d_sigma: &mut [[f32; 3]],
) {
    // What later intervals and the background lose when this one gets denser.
    let mut behind = left * d_left;
    for k in (0..intervals.len()).rev() {
        let (i, w, g) = (&intervals[k], &weighted[k], &d_weight[k]);
        let tau = (i.sigma[0] + i.sigma[1] + i.sigma[2]) * i.delta;
        // φ'(a) = (e^−a − φ)/a; its series −1/2 + a/3 − a²/8 where the difference cancels.
        let d_phi = if tau > 0.05 {
            (w.pass - w.phi) / tau
        } else {
            -0.5 + tau * (1.0 / 3.0 - tau * (0.125 - tau / 30.0))
        };
        let mixed = i.sigma[0] * g[0] + i.sigma[1] * g[1] + i.sigma[2] * g[2];
        // In this order no product leaves f32: δ Σ s g φ' is at most of the size of g where δΣ is large.
        let shared = w.transmittance * i.delta * (i.delta * mixed * d_phi) - i.delta * behind;
        for s in 0..3 {
            d_sigma[k][s] = w.transmittance * i.delta * w.phi * g[s] + shared;
        }
        behind += w.weight[0] * g[0] + w.weight[1] * g[1] + w.weight[2] * g[2];
    }
}
