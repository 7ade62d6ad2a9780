//! Compositing against f64, from nothing to solid and from no sample to a hundred thousand.

use divff::render::composite::{Interval, Intervals, LANES, Weights, backward};
use divff::simd::floats::{ColumnMut, Floats};

use crate::rng::Rng;

#[path = "../../src/render/one_ray.rs"]
mod one_ray;
use one_ray::{composited, gradient_of};

/// Seeds of the comparisons with f64.
const SEEDS: u64 = 120;

/// Numbers of samples a ray.
const COUNTS: [usize; 5] = [1, 2, 20, 1000, 100_000];

/// 10 to a power between `low` and `high`.
fn log_uniform(rng: &mut Rng, low: f32, high: f32) -> f32 {
    10f32.powf(low + (high - low) * rng.uniform())
}

#[test]
fn a_ray_without_samples_keeps_its_light() {
    assert_eq!(composited(&[]).1, 1.0);
    assert_eq!(gradient_of(&[], &[], 2.0), [[0.0; 3]; 0]);
}

fn assert_sums_to_one(intervals: &[Interval], what: &str) {
    let (out, left) = composited(intervals);
    assert!(out.as_flattened().iter().all(|w| w.is_finite() && *w >= 0.0), "{what}");
    let sum: f64 = out.as_flattened().iter().copied().map(f64::from).sum::<f64>() + f64::from(left);
    // A rounding for each sample, and the few of an exponential.
    let allowed = (intervals.len() + 2) as f64 * 2f64.powi(-23);
    assert!((sum - 1.0).abs() <= allowed, "{what}: 1 became 1 + {:e}, {allowed:e} are allowed", sum - 1.0);
}

#[test]
fn weights_and_the_light_that_is_left_sum_to_one_at_any_optical_depth() {
    let mut rng = Rng::new(1, 0, 0);
    for n in COUNTS {
        for exponent in -30..=30 {
            let sigma = 10f32.powi(exponent);
            let share = [0.5, 0.3, 0.2].map(|s| s * sigma);
            let even = vec![Interval { sigma: share, delta: 1.0, t: 0.0 }; n];
            assert_sums_to_one(&even, &format!("{n} samples of σδ = 1e{exponent}"));
        }
        for seed in 0..SEEDS / 4 {
            let mixed: Vec<Interval> = (0..n)
                .map(|_| Interval {
                    sigma: [0; 3].map(|_| log_uniform(&mut rng, -30.0, 30.0 * rng_share(seed))),
                    delta: log_uniform(&mut rng, -6.0, 0.0),
                    t: 0.0,
                })
                .collect();
            assert_sums_to_one(&mixed, &format!("{n} mixed samples, seed {seed}"));
        }
    }
}

/// How far up the densities of a seed go: most of the first are thin, the last are solid.
fn rng_share(seed: u64) -> f32 {
    2.0 * seed as f32 / (SEEDS / 4) as f32 - 1.0
}

#[test]
fn a_homogeneous_medium_stops_what_beer_and_lambert_say() {
    for n in COUNTS {
        for exponent in -30..=2 {
            // In all: σL = 10^exponent, in n equal parts that f32 cannot tell exactly.
            let sigma = 10f32.powi(exponent);
            let delta = 1.0 / n as f32;
            let intervals = vec![Interval { sigma: [sigma, 0.0, 0.0], delta, t: 0.0 }; n];
            let (out, _) = composited(&intervals);
            let opacity: f64 = out.iter().map(|w| f64::from(w[0])).sum();
            let truth = -(-f64::from(sigma) * f64::from(delta) * n as f64).exp_m1();
            let off = (opacity / truth - 1.0).abs();
            assert!(off < 1e-5, "{n} samples, σL = 1e{exponent}: off by {off:e}");
        }
    }
}

/// The equations in f64: weights, light that is left, and the gradient of Σ g w + d T by the densities.
struct Exact {
    weights: Vec<[f64; 3]>,
    left: f64,
    gradient: Vec<[f64; 3]>,
}

fn exact(intervals: &[Interval], g: &[[f32; 3]], d_left: f32) -> Exact {
    let n = intervals.len();
    let sigma: Vec<[f64; 3]> = intervals.iter().map(|i| i.sigma.map(f64::from)).collect();
    let delta: Vec<f64> = intervals.iter().map(|i| f64::from(i.delta)).collect();
    let tau: Vec<f64> = (0..n).map(|k| sigma[k].iter().sum::<f64>() * delta[k]).collect();
    let g: Vec<[f64; 3]> = g.iter().map(|g| g.map(f64::from)).collect();
    let (mut depth, mut light) = (0.0f64, Vec::new());
    for tau in &tau {
        light.push((-depth).exp());
        depth += tau;
    }
    let left = (-depth).exp();
    let phi = |a: f64| if a > 0.0 { -(-a).exp_m1() / a } else { 1.0 };
    // φ'(a) by its series where the closed form cancels.
    let slope = |a: f64| match a > 1e-3 {
        true => ((-a).exp() - phi(a)) / a,
        false => -0.5 + a / 3.0 - a * a / 8.0 + a.powi(3) / 30.0,
    };
    let weights: Vec<[f64; 3]> =
        (0..n).map(|k| sigma[k].map(|s| light[k] * s * delta[k] * phi(tau[k]))).collect();
    let dot = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut behind = left * f64::from(d_left);
    let mut gradient = vec![[0.0; 3]; n];
    for k in (0..n).rev() {
        let shared =
            light[k] * delta[k] * delta[k] * slope(tau[k]) * dot(&sigma[k], &g[k]) - delta[k] * behind;
        gradient[k] = g[k].map(|g| light[k] * delta[k] * phi(tau[k]) * g + shared);
        behind += dot(&weights[k], &g[k]);
    }
    Exact { weights, left, gradient }
}

/// Within one per cent, or a ten-thousandth of the largest where terms cancel.
fn assert_close(found: &[[f32; 3]], truth: &[[f64; 3]], what: &str) {
    let largest = truth.iter().flatten().fold(0.0f64, |m, v| m.max(v.abs()));
    for (n, (a, b)) in found.iter().flatten().zip(truth.iter().flatten()).enumerate() {
        let off = (f64::from(*a) - b).abs();
        assert!(off <= 1e-2 * b.abs() + 1e-4 * largest, "{what}, number {n}: {a:e} is not {b:e}");
    }
}

#[test]
fn forward_and_backward_are_those_of_f64_for_a_hundred_seeds() {
    for seed in 0..SEEDS {
        let mut rng = Rng::new(seed, 7, 0);
        let n = 1 + rng.below(64);
        let (low, high) = (-4.0 - 2.0 * rng.uniform(), 1.0 + 3.0 * rng.uniform());
        let intervals: Vec<Interval> = (0..n)
            .map(|_| Interval {
                sigma: [0; 3].map(|_| log_uniform(&mut rng, low, high)),
                delta: log_uniform(&mut rng, -3.0, -0.5),
                t: 0.0,
            })
            .collect();
        let mut number = || 2.0 * rng.uniform() - 1.0;
        let (g, d_left) = ((0..n).map(|_| [0; 3].map(|_| number())).collect::<Vec<_>>(), number());
        let (out, left) = composited(&intervals);
        let gradient = gradient_of(&intervals, &g, d_left);
        let truth = exact(&intervals, &g, d_left);
        let what = |part: &str| format!("seed {seed}: {part}");
        assert_close(&out, &truth.weights, &what("weights"));
        assert!((f64::from(left) - truth.left).abs() <= 1e-2 * truth.left + 1e-30, "{}", what("light left"));
        assert_close(&gradient, &truth.gradient, &what("gradient"));
    }
}
