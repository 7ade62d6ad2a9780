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
    for (n, eight) in kept.chunks(EIGHT).enumerate().skip(first / EIGHT) {
        let to = layout.place(n * EIGHT);
        let sources = Sources::<EIGHT>::of(layout, eight, to, values.len());
        // SAFETY: as many numbers as are read.
        let lanes = unsafe { _mm256_loadu_si256(sources.lanes.as_ptr().cast()) };
        let bits = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
        let mut masks = [_mm256_setzero_ps(); EIGHT];
        for (mask, part) in masks.iter_mut().zip(sources.parts()) {
            let set = _mm256_and_si256(bits, _mm256_set1_epi32(part.lanes.into()));
            *mask = _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, bits));
        }
        // Rows lie far apart: the processor does not foresee what will be read.
        let next = kept.get((n + 2) * EIGHT).map_or(to, |lane| layout.place(*lane as usize));
        for row in 0..layout.rows {
            let at = values.as_mut_ptr().wrapping_add(row * TILE);
            _mm_prefetch::<_MM_HINT_T0>(at.wrapping_add(next).cast());
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

/// As [`super::add_sums`] of sixteen: first a quarter of a register has a part of the sums of four rows.
#[target_feature(enable = "avx512f,avx512dq")]
pub fn add_sums(rows: &[f32], out: &mut [[f32; 4]]) {
    for (out, [a, b, c, d]) in out.iter_mut().zip(rows.as_chunks::<LANES>().0.as_chunks::<4>().0) {
        let a = _mm512_castps_pd(add_halves(load(a), load(b)));
        let b = _mm512_castps_pd(add_halves(load(c), load(d)));
        let quarters = _mm512_add_ps(
            _mm512_castpd_ps(_mm512_unpacklo_pd(a, b)),
            _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)),
        );
        let halves = _mm256_add_ps(_mm512_castps512_ps256(quarters), _mm512_extractf32x8_ps::<1>(quarters));
        let sums = _mm_add_ps(_mm256_castps256_ps128(halves), _mm256_extractf128_ps::<1>(halves));
        // SAFETY: as many floats as are read and written.
        unsafe { _mm_storeu_ps(out.as_mut_ptr(), _mm_add_ps(_mm_loadu_ps(out.as_ptr()), sums)) };
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

/// As [`super::columns`], which has asserted that all lengths fit.
#[target_feature(enable = "avx")]
pub fn columns(rows: &[f32], width: usize, out: &mut [f32]) {
    for (j, rows) in rows.chunks(EIGHT * TILE).enumerate() {
        for n in (0..TILE).step_by(EIGHT) {
            let columns = match rows.len() / TILE {
                EIGHT => transposed::<EIGHT>(&rows[n..]),
                _ => transposed::<4>(&rows[n..]),
            };
            let out = &mut out[n * width + j * EIGHT..];
            assert!(out.len() >= (EIGHT - 1) * width + EIGHT);
            for k in 0..EIGHT {
                // SAFETY: as many floats as has been asserted.
                unsafe { _mm256_storeu_ps(out.as_mut_ptr().add(k * width), columns[k]) };
            }
        }
    }
}

/// Eight numbers of each of eight rows of a tile, as columns; of four rows, and zeros below them.
#[inline]
#[target_feature(enable = "avx")]
fn transposed<const ROWS: usize>(rows: &[f32]) -> [__m256; EIGHT] {
    const { assert!(ROWS == 4 || ROWS == EIGHT) };
    assert!(rows.len() >= (ROWS - 1) * TILE + EIGHT);
    // Numbers `n` to `n + 3` of rows `j` and `j + 4`.
    let halves = |j: usize, n: usize| {
        let at = rows.as_ptr().wrapping_add(j * TILE + n);
        // SAFETY: four floats of one or two of the rows, of which there are as many as has been asserted.
        unsafe {
            let low = _mm_loadu_ps(at);
            let high = if ROWS > 4 { _mm_loadu_ps(at.wrapping_add(4 * TILE)) } else { _mm_setzero_ps() };
            _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), high)
        }
    };
    let columns = |n: usize| {
        let [a, b, c, d] = [halves(0, n), halves(1, n), halves(2, n), halves(3, n)];
        let [ab, cd] = [_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d)];
        let [ef, gh] = [_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d)];
        [
            _mm256_shuffle_ps::<0x44>(ab, cd),
            _mm256_shuffle_ps::<0xee>(ab, cd),
            _mm256_shuffle_ps::<0x44>(ef, gh),
            _mm256_shuffle_ps::<0xee>(ef, gh),
        ]
    };
    let [[a, b, c, d], [e, f, g, h]] = [columns(0), columns(4)];
    [a, b, c, d, e, f, g, h]
}

/// As [`super::rows_of_fours`].
#[target_feature(enable = "avx512f")]
pub fn rows_of_fours(samples: &[[f32; 4]; TILE], out: &mut [[f32; TILE]; 4]) {
    // Numbers 0 of eight samples, and then numbers 1; or numbers 2, and then 3.
    let first_two = _mm512_setr_epi32(0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
    let orders = [first_two, _mm512_add_epi32(first_two, _mm512_set1_epi32(2))];
    for (n, samples) in samples.as_flattened().as_chunks::<LANES>().0.as_chunks::<4>().0.iter().enumerate() {
        let [a, b, c, d] = [load(&samples[0]), load(&samples[1]), load(&samples[2]), load(&samples[3])];
        for (order, out) in orders.into_iter().zip(out.as_chunks_mut::<2>().0) {
            let (low, high) = (_mm512_permutex2var_ps(a, order, b), _mm512_permutex2var_ps(c, order, d));
            store(_mm512_shuffle_f32x4::<0x44>(low, high), &mut out[0], n);
            store(_mm512_shuffle_f32x4::<0xee>(low, high), &mut out[1], n);
        }
    }
}

/// As [`super::fours_of_rows`].
#[target_feature(enable = "avx512f")]
pub fn fours_of_rows(rows: &[[f32; TILE]; 4], out: &mut [[f32; 4]; TILE]) {
    // Twos of eight samples, then of the next; fours of four samples, then of the next.
    let twos = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    let twos = [twos, _mm512_add_epi32(twos, _mm512_set1_epi32(8))];
    let fours = _mm512_setr_epi64(0, 8, 1, 9, 2, 10, 3, 11);
    let fours = [fours, _mm512_add_epi64(fours, _mm512_set1_epi64(4))];
    for n in 0..TILE / LANES {
        let row = |k: usize| load(&rows[k].as_chunks::<LANES>().0[n]);
        let [a, b, c, d] = [row(0), row(1), row(2), row(3)];
        for (half, order) in twos.into_iter().enumerate() {
            let ab = _mm512_castps_pd(_mm512_permutex2var_ps(a, order, b));
            let cd = _mm512_castps_pd(_mm512_permutex2var_ps(c, order, d));
            for (part, order) in fours.into_iter().enumerate() {
                let samples = _mm512_castpd_ps(_mm512_permutex2var_pd(ab, order, cd));
                store(samples, out.as_flattened_mut(), 4 * n + 2 * half + part);
            }
        }
    }
}

/// Writes vector number `n` of `out`.
#[inline]
#[target_feature(enable = "avx512f")]
fn store(v: __m512, out: &mut [f32], n: usize) {
    let out = &mut out[n * LANES..][..LANES];
    // SAFETY: as many floats as are written.
    unsafe { _mm512_storeu_ps(out.as_mut_ptr(), v) };
}
