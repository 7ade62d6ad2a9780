//! Codes that vary with time, as low-rank trajectories: z(t) = B(t) Γ with B fixed and Γ learned.
//!
//! NeuralDiff's basis is the identity, sines and cosines. Ours are hat functions on given knots (linear interpolation
//! between neighbouring rows of Γ): as low-rank, defined at every time, and local, so that an object which is put
//! down once does not ripple through the whole video.

use serde::{Deserialize, Serialize};

/// Where a time falls between two knots.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knots {
    /// Row of Γ before the time, and its weight.
    pub a: (usize, f32),
    /// Row of Γ after the time, and its weight.
    pub b: (usize, f32),
}

/// The fixed basis of a trajectory of `width`-dimensional codes; Γ is `[knots][width]`, kept by the owner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// Knot times, strictly increasing.
    pub knots: Vec<f32>,
    /// Width of a code.
    pub width: usize,
}

impl Trajectory {
    /// `count` knots spread evenly over [0, 1].
    pub fn even(count: usize, width: usize) -> Self {
        let count = count.max(1);
        let step = 1.0 / (count.max(2) - 1) as f32;
        Self { knots: (0..count).map(|k| k as f32 * step).collect(), width }
    }

    /// A knot at each of the given times.
    pub fn at(mut times: Vec<f32>, width: usize) -> Self {
        times.sort_by(f32::total_cmp);
        times.dedup();
        Self { knots: times, width }
    }

    /// Number of parameters in Γ.
    pub fn parameters(&self) -> usize {
        self.knots.len() * self.width
    }

    /// The two knots around `time`, clamped to the first and last.
    pub fn locate(&self, time: f32) -> Knots {
        let after = self.knots.partition_point(|&k| k <= time);
        if after == 0 {
            return Knots { a: (0, 1.0), b: (0, 0.0) };
        }
        if after == self.knots.len() {
            return Knots { a: (after - 1, 1.0), b: (after - 1, 0.0) };
        }
        let (t0, t1) = (self.knots[after - 1], self.knots[after]);
        let f = (time - t0) / (t1 - t0);
        Knots { a: (after - 1, 1.0 - f), b: (after, f) }
    }

    /// z(t) into `out` `[width]`.
    pub fn evaluate(&self, gamma: &[f32], at: Knots, out: &mut [f32]) {
        let row = |k: usize| &gamma[k * self.width..][..self.width];
        for ((o, a), b) in out.iter_mut().zip(row(at.a.0)).zip(row(at.b.0)) {
            *o = at.a.1 * a + at.b.1 * b;
        }
    }

    /// Adds the gradient of a loss with respect to z(t) to the gradient of Γ.
    pub fn backward(&self, at: Knots, grad: &[f32], gamma_grad: &mut [f32]) {
        for (k, w) in [at.a, at.b] {
            for (o, g) in gamma_grad[k * self.width..][..self.width].iter_mut().zip(grad) {
                *o += w * g;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_a_partition_of_unity_everywhere() {
        for t in
            [Trajectory::even(1, 2), Trajectory::even(7, 2), Trajectory::at(vec![0.9, 0.1, 0.15, 0.1], 2)]
        {
            for n in -10..110 {
                let at = t.locate(n as f32 / 100.0);
                assert!((at.a.1 + at.b.1 - 1.0).abs() < 1e-6 && at.a.1 >= 0.0 && at.b.1 >= 0.0, "{at:?}");
                assert!(at.a.0.max(at.b.0) < t.knots.len());
            }
        }
    }

    #[test]
    fn codes_are_linear_between_knots_and_constant_outside() {
        let t = Trajectory::at(vec![0.6, 0.2], 1);
        let z = |time: f32| {
            let mut out = [0.0];
            t.evaluate(&[10.0, 20.0], t.locate(time), &mut out);
            out[0]
        };
        assert_eq!([z(-1.0), z(0.2), z(0.6), z(5.0), z(f32::NEG_INFINITY)], [10.0, 10.0, 20.0, 20.0, 10.0]);
        assert!((z(0.3) - 12.5).abs() < 1e-5);
    }

    #[test]
    fn backward_is_the_transpose_of_evaluate() {
        let t = Trajectory::even(5, 3);
        let gamma: Vec<f32> = (0..15).map(|n| (n as f32).sin()).collect();
        for time in [0.0, 0.1, 0.5, 0.77, 1.0] {
            let at = t.locate(time);
            let g = [1.0, -0.5, 2.0];
            let mut z = [0.0; 3];
            t.evaluate(&gamma, at, &mut z);
            let mut scattered = vec![0.0; 15];
            t.backward(at, &g, &mut scattered);
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
            assert!((dot(&z, &g) - dot(&gamma, &scattered)).abs() < 1e-5);
        }
    }
}
