//! Compositing on known answers and at the ends of f32.

use pulp::{Simd, WithSimd};

use super::composite::{Interval, Intervals, LANES, RayLayout, Weights, backward};
use crate::rng::Rng;
use crate::simd::floats::{ColumnMut, Floats};

#[path = "one_ray.rs"]
mod one_ray;
use one_ray::{composited, gradient_of};

#[test]
fn weights_plus_transmittance_is_one() {
    let mut rng = Rng::new(1, 0, 0);
    for n in [1, 2, 7, 24, 64, 256] {
        for opacity in [0.01, 1.0, 30.0] {
            let intervals: Vec<Interval> = (0..n)
                .map(|_| Interval {
                    sigma: [rng.uniform(), rng.uniform(), rng.uniform()].map(|u| opacity * u * u),
                    delta: 3.0 * rng.uniform() / n as f32,
                    t: 0.0,
                })
                .collect();
            let (out, left) = composited(&intervals);
            let sum: f64 = out.as_flattened().iter().copied().map(f64::from).sum::<f64>() + f64::from(left);
            // Half an ulp for each addition to the optical depth, and a few ulp of the exponential.
            let allowed = (n + 8) as f64 * 2f64.powi(-23);
            assert!((sum - 1.0).abs() < allowed, "{n} intervals: 1 became {sum}");
        }
    }
}

#[test]
fn a_homogeneous_medium_has_the_opacity_of_beer_and_lambert() {
    let mut rng = Rng::new(2, 0, 0);
    for depth in [1e-4, 1e-2, 0.5, 3.0, 20.0] {
        let lengths: Vec<f32> = (0..40).map(|_| 0.01 + rng.uniform()).collect();
        let total: f32 = lengths.iter().sum();
        let share = [0.5, 0.3, 0.2].map(|s| s * depth / total);
        let intervals: Vec<Interval> =
            lengths.iter().map(|&delta| Interval { sigma: share, delta, t: 0.0 }).collect();
        let (out, left) = composited(&intervals);
        let opacity: f64 = out.as_flattened().iter().copied().map(f64::from).sum();
        let tau: f64 = intervals
            .iter()
            .map(|i| i.sigma.iter().map(|s| f64::from(*s)).sum::<f64>() * f64::from(i.delta))
            .sum();
        let truth = -(-tau).exp_m1();
        assert!((opacity / truth - 1.0).abs() < 1e-5, "depth {depth}: {opacity} is not {truth}");
        assert!((f64::from(left) - (-tau).exp()).abs() < 1e-5 * (-tau).exp());
        let persistent: f64 = out.iter().map(|w| f64::from(w[0])).sum();
        assert!((persistent / opacity - 0.5).abs() < 1e-5, "streams share by density");
    }
}

#[test]
fn extreme_densities_and_lengths_stay_finite_both_ways() {
    let sizes = [0.0, f32::MIN_POSITIVE, 1e-30, 1e-15, 1e-6, 0.06, 1.0, 90.0, 1e6, 1e15];
    for sigma in sizes {
        for delta in sizes {
            for other in [0.0, sigma] {
                let middle = Interval { sigma: [sigma, other, 0.0], delta, t: 1.0 };
                let thin = Interval { sigma: [0.1, 0.0, 0.2], delta: 0.1, t: 0.5 };
                check_finite(&[thin, middle, thin]);
            }
        }
    }
}

fn check_finite(intervals: &[Interval; 3]) {
    let (out, left) = composited(intervals);
    let sum = out.as_flattened().iter().sum::<f32>() + left;
    assert!((sum - 1.0).abs() < 1e-5, "{intervals:?} sums to {sum}");
    let gradient = gradient_of(intervals, &[[1.0, -2.0, 0.5]; 3], 3.0);
    assert!(
        gradient.as_flattened().iter().all(|g| g.is_finite()),
        "{intervals:?} has the gradient {gradient:?}"
    );
}

/// Analytic against f64 differences through both branches of φ and φ'.
#[test]
fn gradient_is_the_derivative_for_thin_and_thick_intervals() {
    let g = [[1.0, -2.0, 0.5], [0.3, 0.7, -1.0], [2.0, 0.1, 0.4]];
    let d_left = -0.8;
    for thickness in [1e-7f32, 1e-4, 0.02, 0.049, 0.051, 0.3, 4.0] {
        let intervals = [0.5, 1.0, 0.25].map(|delta| Interval {
            sigma: [0.6, 0.3, 0.1].map(|s| s * thickness / delta),
            delta,
            t: 0.0,
        });
        let gradient = gradient_of(&intervals, &g, d_left);
        for k in 0..3 {
            for s in 0..3 {
                let at = |h: f64| value(&intervals, &g, d_left, (k, s, h));
                let h = 1e-6 * f64::from(thickness);
                let truth = (at(h) - at(-h)) / (2.0 * h);
                let error = (f64::from(gradient[k][s]) - truth).abs();
                assert!(
                    error < 1e-5 * (1.0 + truth.abs()),
                    "thickness {thickness}: {} is not {truth}",
                    gradient[k][s]
                );
            }
        }
    }
}

/// Σ g w + d_left T in f64, with density `s` of interval `k` changed by `h`; without cancellation.
fn value(intervals: &[Interval; 3], g: &[[f32; 3]; 3], d_left: f32, (k, s, h): (usize, usize, f64)) -> f64 {
    let (mut depth, mut sum) = (0.0f64, 0.0);
    for (n, i) in intervals.iter().enumerate() {
        let mut sigma = i.sigma.map(f64::from);
        if n == k {
            sigma[s] += h;
        }
        let tau = sigma.iter().sum::<f64>() * f64::from(i.delta);
        let opacity = (-depth).exp() * -(-tau).exp_m1();
        for c in 0..3 {
            sum += f64::from(g[n][c]) * opacity * sigma[c] / sigma.iter().sum::<f64>();
        }
        depth += tau;
    }
    sum + f64::from(d_left) * (-depth).exp_m1() // minus the constant d_left
}

/// Some rays of as many samples together.
struct Rays<'a>(&'a Intervals);

impl WithSimd for Rays<'_> {
    type Output = Weights;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Weights {
        let mut weights = Weights::default();
        weights.find(simd, self.0);
        weights
    }
}

#[test]
fn rays_side_by_side_are_as_if_each_were_alone() {
    let mut rng = Rng::new(5, 0, 0);
    for rays in [1, 15, 16, 17, 40] {
        let alone: Vec<Vec<Interval>> = (0..rays)
            .map(|_| {
                let sigma = |rng: &mut Rng| [0; 3].map(|_| 20.0 * rng.uniform());
                (0..7).map(|_| Interval { sigma: sigma(&mut rng), delta: rng.uniform(), t: 0.0 }).collect()
            })
            .collect();
        let mut intervals = Intervals::default();
        intervals.reset(RayLayout { rays, samples: 7 });
        let layout = intervals.layout;
        for (r, ray) in alone.iter().enumerate() {
            for (n, i) in layout.of_ray(r).zip(ray) {
                (0..3).for_each(|s| intervals.sigma[s][n] = i.sigma[s]);
                intervals.delta[n] = i.delta;
                assert_eq!(layout.ray(n), r);
            }
        }
        let weights = pulp::Arch::new().dispatch(Rays(&intervals));
        for (r, ray) in alone.iter().enumerate() {
            let found: Vec<_> = layout.of_ray(r).map(|n| weights.at(n)).collect();
            assert_eq!((found, weights.left[r]), composited(ray), "ray {r} of {rays}");
        }
    }
}
