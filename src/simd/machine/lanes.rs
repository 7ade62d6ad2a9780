//! Lanes of which some stay, and sums over lanes: sixteen at a time (AVX-512), or eight (AVX2).

use std::arch::x86_64::*;

use crate::simd::TILE;
use crate::simd::lanes::Layout;

/// Lanes of a register of AVX-512.
const LANES: usize = 16;

/// Lanes of a register of AVX.
const EIGHT: usize = 8;

/// Lanes of one register that come from another.
#[derive(Clone, Copy)]
struct Part {
    /// Place of the register that they come from.
    from: usize,
    /// Those lanes.
    lanes: u16,
}

/// Where the lanes of one register come from.
struct Sources<const N: usize> {
    /// The registers, in the order of the lanes.
    parts: [Part; N],
    /// How many they are.
    count: usize,
    /// Which lane of its register each of them is.
    lanes: [i32; N],
}

impl<const N: usize> Sources<N> {
    /// Those of as many of the lanes `kept`, or fewer, for the register at `to`; asserts that all are among `values` numbers.
    #[inline(always)]
    fn of(layout: Layout, kept: &[u32], to: usize, values: usize) -> Self {
        let last = (layout.rows - 1) * TILE;
        assert!(to + last + N <= values, "places of lanes that are kept are in some tile");
        let mut sources = Self { parts: [Part { from: to, lanes: 0 }; N], count: 0, lanes: [0; N] };
        let mut register = usize::MAX;
        for (n, lane) in kept.iter().map(|lane| *lane as usize).enumerate() {
            if lane / N != register {
                register = lane / N;
                let from = layout.place(register * N);
                assert!(from + last + N <= values, "lanes that are kept are in some tile");
                sources.parts[sources.count].from = from;
                sources.count += 1;
            }
            sources.lanes[n] = (lane % N) as i32;
            sources.parts[sources.count - 1].lanes |= 1 << n;
        }
        sources
    }

    /// Those registers. All of them are to be read before anything is written, which may be where one was read. Few have lanes of
    /// more than two.
    #[inline(always)]
    fn parts(&self) -> &[Part] {
        &self.parts[..self.count.max(2)]
    }
}

/// As [`crate::simd::lanes::keep`], but for the zeros, from the lanes around number `first` of those kept: the lanes that are at
/// their places among those of the first register that has one which is not move nowhere.
#[target_feature(enable = "avx512f")]
pub fn keep(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) {
    for (n, kept) in kept.chunks(LANES).enumerate().skip(first / LANES) {
        let to = layout.place(n * LANES);
        let sources = Sources::<LANES>::of(layout, kept, to, values.len());
        // SAFETY: as many numbers as are read.
        let lanes = unsafe { _mm512_loadu_epi32(sources.lanes.as_ptr()) };
        for row in 0..layout.rows {
            let at = values.as_mut_ptr().wrapping_add(row * TILE);
            let mut sum = _mm512_setzero_ps();
            for part in sources.parts() {
                // SAFETY: within the values, as `Sources::of` has asserted.
                let x = unsafe { _mm512_loadu_ps(at.wrapping_add(part.from)) };
                sum = _mm512_mask_permutexvar_ps(sum, part.lanes, lanes, x);
            }
            // SAFETY: likewise.
            unsafe { _mm512_storeu_ps(at.wrapping_add(to), sum) };
        }
    }
}

/// As [`keep`], eight lanes at a time.
#[target_feature(enable = "avx2")]
pub fn keep_eights(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) {
    for (n, kept) in kept.chunks(EIGHT).enumerate().skip(first / EIGHT) {
        let to = layout.place(n * EIGHT);
        let sources = Sources::<EIGHT>::of(layout, kept, to, values.len());
        // SAFETY: as many numbers as are read.
        let lanes = unsafe { _mm256_loadu_si256(sources.lanes.as_ptr().cast()) };
        let bits = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
        let mut masks = [_mm256_setzero_ps(); EIGHT];
        for (mask, part) in masks.iter_mut().zip(sources.parts()) {
            let set = _mm256_and_si256(bits, _mm256_set1_epi32(part.lanes.into()));
            *mask = _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, bits));
        }
        for row in 0..layout.rows {
            let at = values.as_mut_ptr().wrapping_add(row * TILE);
            let mut sum = _mm256_setzero_ps();
            for (part, mask) in sources.parts().iter().zip(&masks) {
                // SAFETY: within the values, as `Sources::of` has asserted.
                let x = unsafe { _mm256_loadu_ps(at.wrapping_add(part.from)) };
                sum = _mm256_blendv_ps(sum, _mm256_permutevar8x32_ps(x, lanes), *mask);
            }
            // SAFETY: likewise.
            unsafe { _mm256_storeu_ps(at.wrapping_add(to), sum) };
        }
    }
}

/// As [`super::add_quarter_sums`] of sixteen: a quarter of a register has a part of four rows.
#[target_feature(enable = "avx512f")]
pub fn add_quarter_sums(rows: &[f32], out: &mut [[f32; LANES]]) {
    for (out, [a, b, c, d]) in out.iter_mut().zip(rows.as_chunks::<LANES>().0.as_chunks::<4>().0) {
        let a = _mm512_castps_pd(add_halves(load(a), load(b)));
        let b = _mm512_castps_pd(add_halves(load(c), load(d)));
        let sums = _mm512_add_ps(
            _mm512_castpd_ps(_mm512_unpacklo_pd(a, b)),
            _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)),
        );
        // SAFETY: as many floats as are written.
        unsafe { _mm512_storeu_ps(out.as_mut_ptr(), _mm512_add_ps(load(out), sums)) };
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load(row: &[f32; LANES]) -> __m512 {
    // SAFETY: as many floats as are read.
    unsafe { _mm512_loadu_ps(row.as_ptr()) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn add_halves(a: __m512, b: __m512) -> __m512 {
    _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b))
}

/// As [`super::add_quarter_sums`] of eight: a half of a register has a part of four rows, and half of the numbers stay as they are.
#[target_feature(enable = "avx")]
pub fn add_half_sums(rows: &[f32], out: &mut [[f32; LANES]]) {
    for (out, rows) in out.iter_mut().zip(rows.as_chunks::<EIGHT>().0.as_chunks::<4>().0) {
        // SAFETY: as many floats as are read of each row, and fewer than there are read and written.
        unsafe {
            let ab = _mm256_hadd_ps(_mm256_loadu_ps(rows[0].as_ptr()), _mm256_loadu_ps(rows[1].as_ptr()));
            let cd = _mm256_hadd_ps(_mm256_loadu_ps(rows[2].as_ptr()), _mm256_loadu_ps(rows[3].as_ptr()));
            let sums = _mm256_hadd_ps(ab, cd);
            let sums = _mm256_add_ps(_mm256_loadu_ps(out.as_ptr()), sums);
            _mm256_storeu_ps(out.as_mut_ptr(), sums);
        }
    }
}
