//! What the vector kernels share: aligned storage, the tile width, and transcendental functions that vectorise.
//!
//! Kernels are written once over [`pulp::Simd`]; `pulp` picks AVX-512, AVX2, NEON or plain scalar code at run time, so
//! they need no `unsafe`. Lanes are always samples, never features: every width gives the same forward result
//! for every sample.

pub mod dots;
pub mod floats;
pub mod lanes;
mod machine;
pub mod matrix;
pub mod rows;

pub use machine::{
    Finish, Product, add_sums, columns, fours_of_rows, multiply, prefetch, prefetch_rows, rows_of_fours,
};

use bytemuck::{Pod, Zeroable};
use glam::{Mat4, Vec4};
use half::f16;

use self::floats::Floats;

/// Samples per tile: three AVX-512 vectors, six AVX2 vectors or twelve NEON vectors.
///
/// A product takes three vectors by four outputs at a time where there are 32 registers: twelve sums, which hide the latency of a fused
/// multiply-add on two ports. With AVX2's sixteen, too, but there [`multiply`] says which register is for what; elsewhere it takes two by
/// four, since sums that do not fit go through memory.
pub const TILE: usize = 48;

/// Four rows of four numbers as columns.
#[inline(always)]
pub fn transposed([a, b, c, d]: [Vec4; 4]) -> [Vec4; 4] {
    let columns = Mat4::from_cols(a, b, c, d).transpose();
    [columns.x_axis, columns.y_axis, columns.z_axis, columns.w_axis]
}

/// One cache line of floats; gives [`AlignedVec`] its alignment.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([f32; 16]);

/// A float buffer that starts on a cache line, so that no vector load straddles two.
#[derive(Clone, Default)]
pub struct AlignedVec {
    lines: Vec<Line>,
    len: usize,
}

impl AlignedVec {
    /// `len` zeros.
    pub fn zeros(len: usize) -> Self {
        Self { lines: vec![Line([0.0; 16]); len.div_ceil(16)], len }
    }

    /// Grows to at least `len` floats; what is new is zero.
    pub fn reserve_len(&mut self, len: usize) {
        if len > self.len {
            self.lines.resize(len.div_ceil(16), Line([0.0; 16]));
            self.len = len;
        }
    }

    /// Makes the first `len` floats zeros, and room for them.
    pub fn zero(&mut self, len: usize) {
        self.reserve_len(len);
        self[..len].fill(0.0);
    }
}

impl std::ops::Deref for AlignedVec {
    type Target = [f32];
    #[inline(always)]
    fn deref(&self) -> &[f32] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }
}

impl std::ops::DerefMut for AlignedVec {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.len]
    }
}

/// [`Floats::one_minus_exp_neg`] of one number.
#[inline(always)]
pub fn one_minus_exp_neg(x: f32) -> f32 {
    Floats::one(x).one_minus_exp_neg().value()
}

/// sin(πx) and cos(πx) to 1.5e-7; branch-free, so that loops over it vectorise.
///
/// x is reduced to an eighth of a turn around the nearest quarter, exactly; beyond ±2^21, where floats are whole quarters
/// themselves, it is taken as that.
#[inline(always)]
pub fn sin_cos_pi(x: f32) -> (f32, f32) {
    // As in `Floats::exp`: rounds to the nearest integer and leaves it in the low mantissa bits.
    const ROUND: f32 = 12_582_912.0;
    const LIMIT: f32 = 2_097_152.0;
    let x = x.clamp(-LIMIT, LIMIT);
    let shifted = 2.0 * x + ROUND;
    let quarter = shifted.to_bits();
    let a = (x - 0.5 * (shifted - ROUND)) * std::f32::consts::PI;
    let aa = a * a;
    let sin = a + a * aa * (-1.0 / 6.0 + aa * (1.0 / 120.0 + aa * (-1.0 / 5040.0 + aa * (1.0 / 362_880.0))));
    let cos = 1.0 + aa * (-0.5 + aa * (1.0 / 24.0 + aa * (-1.0 / 720.0 + aa * (1.0 / 40_320.0))));
    let (s, c) = if quarter & 1 == 0 { (sin, cos) } else { (cos, sin) };
    // By quarter turns the sine's sign is + + - - and the cosine's + - - +.
    let flip = |v: f32, bit: u32| f32::from_bits(v.to_bits() ^ (bit & 2) << 30);
    (flip(s, quarter), flip(c, quarter.wrapping_add(1)))
}

/// The whole number below x, at most `last` (< 2^23) and at least 0, as integer and float; 0 for NaN.
///
/// `as u32` saturates lane by lane; adding 2^23 leaves the number in the low mantissa bits and vectorises.
#[inline(always)]
pub fn floor_within(x: f32, last: f32) -> (u32, f32) {
    const SHIFT: f32 = 8_388_608.0;
    let n = x.floor();
    // In this order NaN becomes 0.
    let n = if n > 0.0 { n } else { 0.0 };
    let n = if n < last { n } else { last };
    ((n + SHIFT).to_bits() & 0x007f_ffff, n)
}

/// [`Floats::sigmoid`] of one number.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    Floats::one(x).sigmoid().value()
}

/// Half precision as f32, exactly; branch-free, so that it vectorises without instructions for it.
#[inline(always)]
pub fn widen(from: &[f16], to: &mut [f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        let bits = u32::from(from.to_bits());
        let (sign, exponent, magnitude) = ((bits & 0x8000) << 16, bits & 0x7c00, (bits & 0x7fff) << 13);
        // Exponents are biased by 15 there and by 127 here.
        let normal = magnitude + (112 << 23);
        // A subnormal is its mantissa above 2^-14: put there, the leading one is taken off again.
        let subnormal = (f32::from_bits(magnitude + (113 << 23)) - f32::from_bits(113 << 23)).to_bits();
        let special = magnitude | 0x7f80_0000;
        let finite = if exponent == 0 { subnormal } else { normal };
        *to = f32::from_bits(sign | if exponent == 0x7c00 { special } else { finite });
    }
}

/// Σ a b of as many numbers as both have, in sixteen sums that vectorise.
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    let mut sums = [0.0f32; 16];
    for (a, b) in a.iter().zip(b) {
        for k in 0..16 {
            sums[k] += a[k] * b[k];
        }
    }
    sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_half_widens_as_it_is_defined() {
        let all: Vec<f16> = (0..=u16::MAX).map(f16::from_bits).collect();
        let mut wide = vec![0.0; all.len()];
        widen(&all, &mut wide);
        for (half, wide) in all.iter().zip(wide) {
            assert!(
                wide.to_bits() == half.to_f32().to_bits() || wide.is_nan() && half.is_nan(),
                "{half:?} → {wide}"
            );
        }
    }

    #[test]
    fn exp_is_within_2_ulp() {
        for i in 0..200_000 {
            let x = -86.0 + i as f32 * (173.0 / 200_000.0);
            let truth = f64::from(x).exp();
            let err = (f64::from(Floats::one(x).exp().value()) - truth).abs() / truth;
            assert!(err < 2.5e-7, "exp({x}) is off by {err:e}");
        }
    }

    #[test]
    fn sines_and_cosines_are_within_their_error() {
        for i in 0..400_000 {
            // Evenly over some turns, and over far ones.
            let x = if i % 2 == 0 { -4.0 + i as f32 * 2e-5 } else { (i - 200_000) as f32 * 0.37 };
            let (sin, cos) = sin_cos_pi(x);
            let turn = std::f64::consts::PI * (f64::from(x) % 2.0);
            let error = (f64::from(sin) - turn.sin()).abs().max((f64::from(cos) - turn.cos()).abs());
            assert!(error < 1.5e-7, "{x} half turns are off by {error:e}");
        }
        assert_eq!(
            [0.0, 0.5, 1.0, 1.5, 2.0, -0.5].map(|x| sin_cos_pi(x).0),
            [0.0, 1.0, 0.0, -1.0, 0.0, -1.0]
        );
        for far in [1e9, f32::MAX, f32::INFINITY, f32::NEG_INFINITY] {
            let (sin, cos) = sin_cos_pi(far);
            assert!(sin.abs() <= 1.0 && cos.abs() <= 1.0, "{far}: {sin}, {cos}");
        }
        assert!(sin_cos_pi(f32::NAN).0.is_nan());
    }

    #[test]
    fn floors_stay_within_their_range() {
        let cases =
            [(0.0, 0), (0.99, 0), (1.0, 1), (6.999, 6), (7.0, 7), (8.5, 7), (-0.1, 0), (1e30, 7), (-1e30, 0)];
        for (x, n) in cases.into_iter().chain([(f32::NAN, 0), (f32::INFINITY, 7), (f32::NEG_INFINITY, 0)]) {
            assert_eq!(floor_within(x, 7.0), (n, n as f32), "{x}");
        }
        assert_eq!(floor_within(8_388_606.0, 8_388_607.0).0, 8_388_606);
    }

    #[test]
    fn one_minus_exp_neg_is_relatively_exact() {
        for i in 1..100_000 {
            let x = (i as f32 * 1e-4).powi(3);
            let truth = -(-f64::from(x)).exp_m1();
            let err = (f64::from(one_minus_exp_neg(x)) - truth).abs() / truth;
            // The error of e^-x (2.5e-7) times e^-x / (1 - e^-x), which is 3.5 where the series ends.
            assert!(err < 9e-7, "1 - exp(-{x}) is off by {err:e}");
        }
        assert_eq!(one_minus_exp_neg(0.0), 0.0);
    }
}
