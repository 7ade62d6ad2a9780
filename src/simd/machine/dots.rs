//! Dot products of pairs of bf16 (AVX512-BF16).
//!
//! Everything here is behind the safe type [`Dots`]; its twins in plain code are in [`crate::simd::dots`].

use std::arch::x86_64::*;

use super::{Finish, Product, TILE};
use crate::simd::dots::{BLOCK, LANES};
use crate::simd::matrix::Pairs;

/// Vectors of a tile.
const VECTORS: usize = TILE / LANES;

/// Proof that the CPU has these instructions.
#[derive(Clone, Copy)]
pub struct Dots(());

impl Dots {
    /// `None` where there are none.
    #[inline(always)]
    pub fn new() -> Option<Self> {
        let has = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512bf16");
        has.then_some(Self(()))
    }

    /// See [`crate::simd::dots::pair_rows`].
    #[inline(always)]
    pub fn pair_rows(self, rows: &[f32], out: &mut [Pairs]) {
        // SAFETY: the CPU has the instructions (`self`).
        unsafe { pair_rows(rows, out) }
    }

    /// Pairs of neighbouring samples of one tile's rows, the first of which goes to `out` and every next one `stride` behind the one before.
    #[inline(always)]
    pub fn pair_samples(self, rows: &[Pairs], stride: usize, out: &mut [Pairs]) {
        // SAFETY: the CPU has the instructions (`self`).
        unsafe { pair_samples(rows, stride, out) }
    }

    /// See [`crate::simd::dots::multiply`].
    #[inline(always)]
    pub fn multiply(self, product: Product<Pairs>, y: &mut [f32]) {
        assert_fits(&product, y.len() / TILE);
        // SAFETY: the CPU has the instructions (`self`); all lengths are as has been asserted.
        unsafe { multiply::<false>(product, y.len() / TILE, y.as_mut_ptr().cast()) }
    }

    /// See [`crate::simd::dots::multiply_to_pairs`].
    #[inline(always)]
    pub fn multiply_to_pairs(self, product: Product<Pairs>, y: &mut [Pairs]) {
        assert_fits(&product, 2 * y.len() / TILE);
        // SAFETY: likewise.
        unsafe { multiply::<true>(product, 2 * y.len() / TILE, y.as_mut_ptr()) }
    }

    /// See [`crate::simd::dots::outer_product`].
    #[inline(always)]
    pub fn outer_product<const INPUTS: usize>(
        self,
        dy: &[Pairs],
        x: &[Pairs],
        stride: usize,
    ) -> [[[f32; LANES]; BLOCK]; INPUTS] {
        assert!(stride.is_multiple_of(LANES) && dy.len() >= BLOCK * stride && x.len() >= INPUTS * stride);
        // SAFETY: the CPU has the instructions (`self`); as many pairs are there as has been asserted.
        unsafe { outer_product(dy.as_ptr(), x.as_ptr(), stride) }
    }
}

/// Asserts that `product` has so many outputs, in whole blocks.
#[inline(always)]
fn assert_fits(product: &Product<Pairs>, outputs: usize) {
    let Product { w, bias, x, finish, .. } = product;
    assert!(outputs.is_multiple_of(BLOCK) && w.len() == outputs * (x.len() / TILE));
    assert!(bias.is_empty() || bias.len() == outputs);
    assert!(!matches!(finish, Finish::Where(rows) if rows.len() < outputs / 2 * TILE));
}

/// Numbers of 16 bits of one vector, in the order that has each of the lower half before its fellow of the upper half.
pub(super) const INTERLEAVED: [u16; 2 * LANES] = {
    let mut order = [0; 2 * LANES];
    let mut n = 0;
    while n < 2 * LANES {
        order[n] = (n / 2 + n % 2 * LANES) as u16;
        n += 1;
    }
    order
};

/// Every second number of 16 bits of two vectors, from number `first` on.
const fn every_second(first: u16) -> [u16; 2 * LANES] {
    let mut order = [first; 2 * LANES];
    let mut n = 0;
    while n < 2 * LANES {
        order[n] += 2 * n as u16;
        n += 1;
    }
    order
}

#[inline]
#[target_feature(enable = "avx512f")]
pub(super) fn load_order(order: &[u16; 2 * LANES]) -> __m512i {
    // SAFETY: as many numbers as are read.
    unsafe { _mm512_loadu_si512(order.as_ptr().cast()) }
}

/// Two vectors of sums, rounded, as one of pairs.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn paired(low: __m512, high: __m512, interleaved: __m512i) -> __m512i {
    _mm512_permutexvar_epi16(interleaved, as_integers(_mm512_cvtne2ps_pbh(high, low)))
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pair_rows(rows: &[f32], out: &mut [Pairs]) {
    let interleaved = load_order(&INTERLEAVED);
    for (rows, out) in rows.as_chunks::<{ 2 * TILE }>().0.iter().zip(out.as_chunks_mut::<TILE>().0) {
        for v in (0..TILE).step_by(LANES) {
            // SAFETY: vectors within two rows and one of pairs.
            unsafe {
                let low = _mm512_loadu_ps(rows.as_ptr().add(v));
                let high = _mm512_loadu_ps(rows.as_ptr().add(TILE + v));
                _mm512_storeu_si512(out.as_mut_ptr().add(v).cast(), paired(low, high, interleaved));
            }
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw")]
fn pair_samples(rows: &[Pairs], stride: usize, out: &mut [Pairs]) {
    let [even, odd] = [load_order(&every_second(0)), load_order(&every_second(1))];
    for (rows, out) in rows.as_chunks::<TILE>().0.iter().zip(out.chunks_mut(2 * stride)) {
        let out = &mut out[..stride + TILE / 2];
        // SAFETY: three vectors are a row of pairs, one and a half each of the two rows that it becomes.
        unsafe {
            let [a, b, c] = [0, 1, 2].map(|n| _mm512_loadu_si512(rows.as_ptr().add(n * LANES).cast()));
            for (order, at) in [(even, 0), (odd, stride)] {
                let out = out.as_mut_ptr().add(at);
                _mm512_storeu_si512(out.cast(), _mm512_permutex2var_epi16(a, order, b));
                let last = _mm512_permutexvar_epi16(order, c);
                _mm256_storeu_si256(out.add(LANES).cast(), _mm512_castsi512_si256(last));
            }
        }
    }
}

/// Writes `outputs` rows, as they are or as half as many of `PAIRED` ones.
///
/// # Safety
/// The CPU has the instructions, `product` fits as many outputs, and there is room for them at `y`.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn multiply<const PAIRED: bool>(product: Product<Pairs>, outputs: usize, y: *mut u32) {
    let blocks = outputs / BLOCK;
    // SAFETY: so many blocks are there, as the caller vouches.
    unsafe {
        for block in (0..blocks / 2 * 2).step_by(2) {
            multiply_blocks::<2, PAIRED>(&product, block, y);
        }
        if !blocks.is_multiple_of(2) {
            multiply_blocks::<1, PAIRED>(&product, blocks - 1, y);
        }
    }
}

/// Blocks of outputs number `block` and, if `BLOCKS` are two, the next: as many sums as registers hold beside what is multiplied.
///
/// # Safety
/// As of [`multiply`], which has these blocks.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn multiply_blocks<const BLOCKS: usize, const PAIRED: bool>(
    product: &Product<Pairs>,
    block: usize,
    y: *mut u32,
) {
    let pairs = product.x.len() / TILE;
    let (mut w, mut x) = (product.w.as_ptr().wrapping_add(block * BLOCK * pairs), product.x.as_ptr());
    let first = block * BLOCK;
    let mut sums = [[[_mm512_setzero_ps(); VECTORS]; BLOCK]; BLOCKS];
    if !product.bias.is_empty() {
        for (n, sums) in sums.as_flattened_mut().iter_mut().enumerate() {
            *sums = [_mm512_set1_ps(product.bias[first + n]); VECTORS];
        }
    }
    let (row, rows) = if PAIRED { (first / 2, BLOCKS * BLOCK / 2) } else { (first, BLOCKS * BLOCK) };
    for n in row * VECTORS..(row + rows) * VECTORS {
        _mm_prefetch::<_MM_HINT_T0>(product.ahead.wrapping_add(n * LANES).cast());
    }
    for _ in 0..pairs {
        // SAFETY: the caller vouches for so many pairs of inputs, and for the weights of each.
        unsafe {
            let mut vectors = [_mm512_setzero_ps(); VECTORS];
            for v in 0..VECTORS {
                vectors[v] = _mm512_loadu_ps(x.wrapping_add(v * LANES).cast());
            }
            for n in 0..BLOCKS {
                for j in 0..BLOCK {
                    let w = _mm512_set1_ps(w.wrapping_add(n * BLOCK * pairs + j).cast::<f32>().read());
                    for v in 0..VECTORS {
                        sums[n][j][v] = _mm512_dpbf16_ps(sums[n][j][v], as_pairs(w), as_pairs(vectors[v]));
                    }
                }
            }
        }
        (w, x) = (w.wrapping_add(BLOCK), x.wrapping_add(TILE));
    }
    let interleaved = load_order(&INTERLEAVED);
    for n in 0..BLOCKS {
        for j in (0..BLOCK).step_by(2) {
            let output = first + n * BLOCK + j;
            for v in 0..VECTORS {
                let place = output / 2 * TILE + v * LANES;
                // SAFETY: the caller vouches for as many rows to choose by and for the outputs.
                unsafe {
                    let [low, high] = finished([sums[n][j][v], sums[n][j + 1][v]], product.finish, place);
                    if PAIRED {
                        _mm512_storeu_si512(y.wrapping_add(place).cast(), paired(low, high, interleaved));
                    } else {
                        let y = y.wrapping_add(output * TILE + v * LANES);
                        _mm512_storeu_ps(y.cast(), low);
                        _mm512_storeu_ps(y.wrapping_add(TILE).cast(), high);
                    }
                }
            }
        }
    }
}

/// Vectors of two outputs, finished by those of pairs of rows number `place`.
///
/// # Safety
/// The CPU has the instructions; a vector can be read at `place`.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn finished(sums: [__m512; 2], finish: Finish<Pairs>, place: usize) -> [__m512; 2] {
    match finish {
        Finish::Plain => sums,
        // The second operand where one of them is not a number.
        Finish::Relu => sums.map(|sum| _mm512_max_ps(_mm512_setzero_ps(), sum)),
        Finish::Where(rows) => {
            // SAFETY: the caller vouches for it.
            let rows = unsafe { _mm512_loadu_si512(rows.as_ptr().wrapping_add(place).cast()) };
            let [low, high] =
                [0x7fff, 0x7fff_0000].map(|bits| _mm512_test_epi32_mask(rows, _mm512_set1_epi32(bits)));
            [_mm512_maskz_mov_ps(low, sums[0]), _mm512_maskz_mov_ps(high, sums[1])]
        }
    }
}

/// # Safety
/// The CPU has the instructions, and [`BLOCK`] and `INPUTS` rows of `stride` pairs, whole vectors, can be read.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn outer_product<const INPUTS: usize>(
    dy: *const Pairs,
    x: *const Pairs,
    stride: usize,
) -> [[[f32; LANES]; BLOCK]; INPUTS] {
    let mut sums = [[_mm512_setzero_ps(); BLOCK]; INPUTS];
    for at in (0..stride).step_by(LANES) {
        // SAFETY: the caller vouches for as many vectors of each row.
        unsafe {
            let mut outputs = [_mm512_setzero_ps(); BLOCK];
            for j in 0..BLOCK {
                outputs[j] = _mm512_loadu_ps(dy.wrapping_add(j * stride + at).cast());
            }
            for k in 0..INPUTS {
                let x = as_pairs(_mm512_loadu_ps(x.wrapping_add(k * stride + at).cast()));
                for j in 0..BLOCK {
                    sums[k][j] = _mm512_dpbf16_ps(sums[k][j], as_pairs(outputs[j]), x);
                }
            }
        }
    }
    let mut out = [[[0.0; LANES]; BLOCK]; INPUTS];
    for k in 0..INPUTS {
        for j in 0..BLOCK {
            // SAFETY: as many numbers as are written.
            unsafe { _mm512_storeu_ps(out[k][j].as_mut_ptr(), sums[k][j]) };
        }
    }
    out
}

#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn as_pairs(v: __m512) -> __m512bh {
    // SAFETY: both are 64 bytes, of which every value is valid.
    unsafe { std::mem::transmute(v) }
}

#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn as_integers(v: __m512bh) -> __m512i {
    // SAFETY: likewise.
    unsafe { std::mem::transmute(v) }
}
