//! Which corners are inside, as bits.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use crate::extract::ExtractError;

/// The corners of a dense grid as bit rows.
pub(super) struct Inside {
    /// Corners along x, y, z.
    pub(super) dims: [usize; 3],
    /// Words of a row.
    words: usize,
    /// `[dims[2] * dims[1] * words]`: bit x % 64 of word x / 64 of a row; zero past the row's end.
    bits: Vec<u64>,
}

impl Inside {
    /// # Errors
    /// `NonFinite` with the index of the first value that is not finite.
    pub(super) fn new(arch: Arch, values: &[f32], dims: [usize; 3], iso: f32) -> Result<Self, ExtractError> {
        let (words, layer) = (dims[0].div_ceil(64), dims[0] * dims[1]);
        let mut bits = vec![0; words * dims[1] * dims[2]];
        let layers = bits.par_chunks_mut(words * dims[1]).zip(values.par_chunks(layer)).enumerate();
        let bad = layers.filter_map(|(z, (bits, values))| {
            let finite = arch.dispatch(ClassifyLayer { values, width: dims[0], iso, bits, words });
            let first_bad = || values.iter().position(|v| !v.is_finite());
            if finite { None } else { first_bad().map(|i| z * layer + i) }
        });
        match bad.min() {
            Some(index) => Err(ExtractError::NonFinite { stage: "march_dense", index }),
            None => Ok(Self { dims, words, bits }),
        }
    }

    /// The bits of row (y, z).
    #[inline(always)]
    pub(super) fn row(&self, y: usize, z: usize) -> &[u64] {
        let start = (z * self.dims[1] + y) * self.words;
        &self.bits[start..start + self.words]
    }
}

/// Turns a layer's values into bits; whether all are finite.
struct ClassifyLayer<'a> {
    values: &'a [f32],
    width: usize,
    iso: f32,
    bits: &'a mut [u64],
    words: usize,
}

impl WithSimd for ClassifyLayer<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> bool {
        let mut exponents = [0; LANES];
        for (bits, row) in self.bits.chunks_exact_mut(self.words).zip(self.values.chunks_exact(self.width)) {
            let (whole, rest) = row.as_chunks::<64>();
            for (word, values) in bits.iter_mut().zip(whole) {
                *word = inside_word(values, self.iso, &mut exponents);
            }
            if let (false, Some(word)) = (rest.is_empty(), bits.last_mut()) {
                // A value at the iso-level is outside.
                let mut padded = [self.iso; 64];
                padded[..rest.len()].copy_from_slice(rest);
                *word = inside_word(&padded, self.iso, &mut exponents);
            }
        }
        exponents.iter().fold(0, |all, e| all | e) >> 31 == 0
    }
}

/// Numbers that are looked at together; any vector's width divides it.
pub(crate) const LANES: usize = 16;

/// Bit x = value x is above `iso`. Sets the highest bit of one of `exponents` for a value that is not finite.
#[inline(always)]
pub(crate) fn inside_word(values: &[f32; 64], iso: f32, exponents: &mut [u32; LANES]) -> u64 {
    // Each lane collects its own bits of a half; or-ing the lanes puts them together.
    let mut halves = [[0u32; LANES]; 2];
    for (half, values) in halves.iter_mut().zip(values.as_chunks::<32>().0) {
        let (low, high) = values.split_at(LANES);
        for k in 0..LANES {
            let bit = |above: bool, k: usize| if above { 1 << k } else { 0 };
            half[k] = bit(low[k] > iso, k) | bit(high[k] > iso, k + LANES);
            // The exponent of a non-finite number is all ones: adding one to it carries into the sign bit.
            let carries = |v: f32| (v.to_bits() & 0x7fff_ffff) + 0x0080_0000;
            exponents[k] |= carries(low[k]) | carries(high[k]);
        }
    }
    let [low, high] = halves.map(|half| u64::from(half.iter().fold(0, |all, bits| all | bits)));
    low | high << 32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_say_what_is_above_for_every_length_of_a_row() {
        for width in [2, 31, 63, 64, 65, 128, 200] {
            let dims = [width, 3, 2];
            let values: Vec<f32> = (0..width * 6).map(|i| ((i * 37) % 11) as f32 - 5.0).collect();
            let inside = Inside::new(Arch::new(), &values, dims, 0.5).unwrap();
            for (row, values) in values.chunks(width).enumerate() {
                let bits = inside.row(row % 3, row / 3);
                for x in 0..bits.len() * 64 {
                    let above = values.get(x).is_some_and(|v| *v > 0.5);
                    assert_eq!(bits[x / 64] >> (x % 64) & 1 == 1, above, "corner {x} of {width}");
                }
            }
        }
    }

    #[test]
    fn every_bad_value_is_found_and_no_good_one() {
        let extremes = [f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-45, -0.0];
        let mut values: Vec<f32> = (0..70 * 2 * 2).map(|i| extremes[i % extremes.len()]).collect();
        assert!(Inside::new(Arch::new(), &values, [70, 2, 2], 0.0).is_ok());
        for index in 0..values.len() {
            for bad in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let good = std::mem::replace(&mut values[index], bad);
                let found = Inside::new(Arch::new(), &values, [70, 2, 2], 0.0).err();
                assert_eq!(found, Some(ExtractError::NonFinite { stage: "march_dense", index }));
                values[index] = good;
            }
        }
    }
}
