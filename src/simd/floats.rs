//! Vectors of numbers that are written like numbers, and columns of them.
//!
//! For formulas with many terms, in which [`pulp`]'s functions would hide what is computed. Loops over short arrays, which the
//! compiler may or may not turn into vectors, are no substitute where terms depend on those of the step before.

use std::ops::{Add, AddAssign, Div, Mul, Sub};

use pulp::Simd;

/// As many numbers as fit a vector.
#[derive(Clone, Copy)]
pub struct Floats<S: Simd> {
    simd: S,
    values: S::f32s,
}

macro_rules! operator {
    ($trait:ident, $name:ident, $function:ident) => {
        impl<S: Simd> $trait for Floats<S> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self { values: self.simd.$function(self.values, other.values), ..self }
            }
        }

        impl<S: Simd> $trait<f32> for Floats<S> {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: f32) -> Self {
                self.$name(Self::new(self.simd, other))
            }
        }

        impl<S: Simd> $trait<Floats<S>> for f32 {
            type Output = Floats<S>;

            #[inline(always)]
            fn $name(self, other: Floats<S>) -> Floats<S> {
                Floats::new(other.simd, self).$name(other)
            }
        }
    };
}

operator!(Add, add, add_f32s);
operator!(Sub, sub, sub_f32s);
operator!(Mul, mul, mul_f32s);
operator!(Div, div, div_f32s);

impl<S: Simd> AddAssign for Floats<S> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl<S: Simd> Floats<S> {
    /// `value` in every lane.
    #[inline(always)]
    pub fn new(simd: S, value: f32) -> Self {
        Self { simd, values: simd.splat_f32s(value) }
    }

    /// `self` where `a` is greater than `b`, else `other`, so where one of them is no number.
    #[inline(always)]
    pub fn where_greater(self, a: Self, b: Self, other: Self) -> Self {
        let Self { simd, values } = self;
        let greater = simd.greater_than_f32s(a.values, b.values);
        Self { values: simd.select_f32s(greater, values, other.values), ..self }
    }

    /// At least `low` and at most `high`; what is no number stays that.
    #[inline(always)]
    pub fn clamp(self, low: f32, high: f32) -> Self {
        let [low, high] = [low, high].map(|bound| Self::new(self.simd, bound));
        let clamped = low.where_greater(low, self, self);
        high.where_greater(clamped, high, clamped)
    }

    /// Without its sign, which zeros keep.
    ///
    /// [`Simd::abs_f32s`] is not always inlined, and then compiled without the caller's vector features.
    #[inline(always)]
    pub fn abs(self) -> Self {
        let zero = Self::new(self.simd, 0.0);
        (zero - self).where_greater(zero, self, self)
    }

    /// Square root.
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        Self { values: self.simd.sqrt_f32s(self.values), ..self }
    }

    /// e^x to 2 ulp for x in [-87, 88], clamped outside.
    ///
    /// Cody–Waite reduction to |r| ≤ ln2/2, degree-6 polynomial, exponent by bit arithmetic.
    #[inline(always)]
    pub fn exp(self) -> Self {
        const LN2_HI: f32 = 0.693_359_4;
        const LN2_LO: f32 = -2.121_944_4e-4;
        // 1.5 * 2^23: adding it rounds to the nearest integer and leaves that integer in the low mantissa bits.
        const ROUND: f32 = 12_582_912.0;
        let simd = self.simd;
        let x = self.clamp(-87.0, 88.0);
        let shifted = x * std::f32::consts::LOG2_E + ROUND;
        let n = shifted - ROUND;
        let r = (x - n * LN2_HI) - n * LN2_LO;
        let p = (1.0 / 720.0) * r + 1.0 / 120.0;
        let p = p * r + 1.0 / 24.0;
        let p = p * r + 1.0 / 6.0;
        let p = p * r + 0.5;
        let p = (p * r) * r + r + 1.0;
        let zero = simd.splat_u32s(ROUND.to_bits().wrapping_sub(127));
        let exponent = simd.sub_u32s(simd.transmute_u32s_f32s(shifted.values), zero);
        let exponent = simd.wrapping_dyn_shl_u32s(exponent, simd.splat_u32s(23));
        p * Self { values: simd.transmute_f32s_u32s(exponent), ..self }
    }

    /// 1 / (1 + e^-x).
    #[inline(always)]
    pub fn sigmoid(self) -> Self {
        1.0 / (1.0 + (0.0 - self).exp())
    }

    /// 1 - e^-x for x ≥ 0 without cancellation for thin samples.
    #[inline(always)]
    pub fn one_minus_exp_neg(self) -> Self {
        // Below 0.25 the difference would lose two bits and more; the series' first neglected term is x^7/5040 < 2e-8 x.
        let x = self;
        let series = 1.0 / 120.0 - x * (1.0 / 720.0);
        let series = 1.0 / 6.0 - x * (1.0 / 24.0 - x * series);
        let series = x * (1.0 - x * (0.5 - x * series));
        series.where_greater(Self::new(self.simd, 0.25), x, 1.0 - (0.0 - x).exp())
    }
}

impl Floats<pulp::Scalar> {
    /// A single number.
    #[inline(always)]
    pub fn one(value: f32) -> Self {
        Self::new(pulp::Scalar::new(), value)
    }

    /// It.
    #[inline(always)]
    pub fn value(self) -> f32 {
        self.values
    }
}

/// Numbers one after the other as vectors, as far as those are whole.
#[derive(Clone, Copy)]
pub struct Column<'a, S: Simd> {
    simd: S,
    vectors: &'a [S::f32s],
}

impl<'a, S: Simd> Column<'a, S> {
    /// The vectors of `values`.
    #[inline(always)]
    pub fn new(simd: S, values: &'a [f32]) -> Self {
        Self { simd, vectors: S::as_simd_f32s(values).0 }
    }

    /// Vector number `n`.
    #[inline(always)]
    pub fn at(&self, n: usize) -> Floats<S> {
        Floats { simd: self.simd, values: self.vectors[n] }
    }
}

/// As [`Column`], to be written.
pub struct ColumnMut<'a, S: Simd> {
    simd: S,
    vectors: &'a mut [S::f32s],
}

impl<'a, S: Simd> ColumnMut<'a, S> {
    /// The vectors of `values`.
    #[inline(always)]
    pub fn new(simd: S, values: &'a mut [f32]) -> Self {
        Self { simd, vectors: S::as_mut_simd_f32s(values).0 }
    }

    /// Vector number `n`.
    #[inline(always)]
    pub fn at(&self, n: usize) -> Floats<S> {
        Floats { simd: self.simd, values: self.vectors[n] }
    }

    /// Makes vector number `n` `values`.
    #[inline(always)]
    pub fn set(&mut self, n: usize, values: Floats<S>) {
        self.vectors[n] = values.values;
    }
}

#[cfg(test)]
mod tests {
    use pulp::WithSimd;

    use super::*;

    /// The functions of all of some numbers, a whole number of the widest vectors.
    struct All<'a>(&'a [f32]);

    impl WithSimd for All<'_> {
        type Output = Vec<[f32; 3]>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<[f32; 3]> {
            let mut out = [(); 3].map(|()| vec![0.0; self.0.len()]);
            let x = Column::new(simd, self.0);
            for n in 0..self.0.len() / S::F32_LANES {
                let x = x.at(n);
                let found = [x.exp(), x.abs().one_minus_exp_neg(), x.sigmoid()];
                for (out, found) in out.iter_mut().zip(found) {
                    ColumnMut::new(simd, out).set(n, found);
                }
            }
            (0..self.0.len()).map(|n| [out[0][n], out[1][n], out[2][n]]).collect()
        }
    }

    #[test]
    fn every_width_says_the_same() {
        let extreme = [0.0, -0.0, f32::MAX, f32::MIN, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 1e-40];
        let x: Vec<f32> = extreme.into_iter().chain((0..1016).map(|n| 0.2 * (n - 508) as f32)).collect();
        for (x, found) in x.iter().zip(pulp::Arch::new().dispatch(All(&x))) {
            let alone = Floats::one(*x);
            let alone = [alone.exp(), alone.abs().one_minus_exp_neg(), alone.sigmoid()].map(Floats::value);
            for (a, b) in found.into_iter().zip(alone) {
                assert!(a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan(), "{x}: {a} and {b}");
            }
        }
    }

    #[test]
    fn what_is_no_number_stays_that_and_is_greater_than_nothing() {
        let [nan, one, two] = [f32::NAN, 1.0, 2.0].map(Floats::one);
        assert!(nan.clamp(0.0, 1.0).value().is_nan());
        assert_eq!([-3.0, 0.5, 7.0].map(|x| Floats::one(x).clamp(0.0, 1.0).value()), [0.0, 0.5, 1.0]);
        for (a, b, chosen) in
            [(one, two, 2.0), (two, one, 1.0), (nan, one, 2.0), (one, nan, 2.0), (one, one, 2.0)]
        {
            assert_eq!(one.where_greater(a, b, two).value(), chosen);
        }
    }
}
