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

    /// Rounds the rows of one tile to pairs of neighbouring samples, the first of which goes to `out` and every next one `stride` behind
    /// the one before.
    #[inline(always)]
    pub fn pair_samples(self, rows: &[f32], stride: usize, out: &mut [Pairs]) {
        // SAFETY: the CPU has the instructions (`self`).
        unsafe { pair_samples(rows, stride, out) }
    }

    /// See [`crate::simd::dots::multiply`].
    #[inline(always)]
    pub fn multiply(self, product: Product<Pairs>, y: &mut [f32]) {
        let Product { w, bias, x, finish, .. } = product;
        let (pairs, blocks) = (x.len() / TILE, y.len() / (BLOCK * TILE));
        assert!(y.len() == blocks * BLOCK * TILE && w.len() == blocks * pairs * BLOCK);
        assert!(bias.is_empty() || bias.len() == blocks * BLOCK);
        assert!(!matches!(finish, Finish::Where(rows) if rows.len() < y.len()));
        // SAFETY: the CPU has the instructions (`self`); all lengths are as has been asserted.
        unsafe { multiply(product, y) }
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

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pair_rows(rows: &[f32], out: &mut [Pairs]) {
    const INTERLEAVE: [u16; 2 * LANES] = {
        let mut order = [0; 2 * LANES];
        let mut n = 0;
        while n < 2 * LANES {
            order[n] = (n / 2 + n % 2 * LANES) as u16;
            n += 1;
        }
        order
    };
    // SAFETY: as many numbers as are read.
    let interleave = unsafe { _mm512_loadu_si512(INTERLEAVE.as_ptr().cast()) };
    for (rows, out) in rows.as_chunks::<{ 2 * TILE }>().0.iter().zip(out.as_chunks_mut::<TILE>().0) {
        for v in (0..TILE).step_by(LANES) {
            // SAFETY: vectors within two rows and one of pairs.
            unsafe {
                let low = _mm512_loadu_ps(rows.as_ptr().add(v));
                let high = _mm512_loadu_ps(rows.as_ptr().add(TILE + v));
                let both = as_integers(_mm512_cvtne2ps_pbh(high, low));
                let pairs = _mm512_permutexvar_epi16(interleave, both);
                _mm512_storeu_si512(out.as_mut_ptr().add(v).cast(), pairs);
            }
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pair_samples(rows: &[f32], stride: usize, out: &mut [Pairs]) {
    for (rows, out) in rows.as_chunks::<TILE>().0.iter().zip(out.chunks_mut(stride)) {
        let out = &mut out[..TILE / 2];
        // SAFETY: three vectors are a row, one and a half of pairs what it becomes.
        unsafe {
            let [a, b, c] = [0, 1, 2].map(|n| _mm512_loadu_ps(rows.as_ptr().add(n * LANES)));
            _mm512_storeu_si512(out.as_mut_ptr().cast(), as_integers(_mm512_cvtne2ps_pbh(b, a)));
            let last = as_integers(_mm512_cvtne2ps_pbh(c, c));
            _mm256_storeu_si256(out.as_mut_ptr().add(LANES).cast(), _mm512_castsi512_si256(last));
        }
    }
}

/// # Safety
/// The CPU has the instructions, and the lengths of `product` and `y` fit each other.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn multiply(product: Product<Pairs>, y: &mut [f32]) {
    let blocks = y.len() / (BLOCK * TILE);
    let mut block = 0;
    while block < blocks {
        // SAFETY: the caller vouches for the lengths; so many blocks are left.
        unsafe {
            if block + 2 <= blocks {
                multiply_blocks::<2>(&product, block, y.as_mut_ptr());
                block += 2;
            } else {
                multiply_blocks::<1>(&product, block, y.as_mut_ptr());
                block += 1;
            }
        }
    }
}

/// Blocks of outputs number `block` and, if `BLOCKS` are two, the next: as many sums as registers hold beside what is multiplied.
///
/// # Safety
/// The CPU has the instructions, and the blocks are there in `product` and `y`.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn multiply_blocks<const BLOCKS: usize>(product: &Product<Pairs>, block: usize, y: *mut f32) {
    let pairs = product.x.len() / TILE;
    let (mut w, mut x) = (product.w.as_ptr().wrapping_add(block * BLOCK * pairs), product.x.as_ptr());
    let first = block * BLOCK;
    let mut sums = [[[_mm512_setzero_ps(); VECTORS]; BLOCK]; BLOCKS];
    if !product.bias.is_empty() {
        for (n, sums) in sums.as_flattened_mut().iter_mut().enumerate() {
            *sums = [_mm512_set1_ps(product.bias[first + n]); VECTORS];
        }
    }
    for n in 0..BLOCKS * BLOCK {
        for v in 0..VECTORS {
            _mm_prefetch::<_MM_HINT_T0>(product.ahead.wrapping_add((first + n) * TILE + v * LANES).cast());
        }
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
                    let w =
                        as_pairs(_mm512_set1_ps(w.wrapping_add(n * BLOCK * pairs + j).cast::<f32>().read()));
                    for v in 0..VECTORS {
                        sums[n][j][v] = _mm512_dpbf16_ps(sums[n][j][v], w, as_pairs(vectors[v]));
                    }
                }
            }
        }
        (w, x) = (w.wrapping_add(BLOCK), x.wrapping_add(TILE));
    }
    for n in 0..BLOCKS {
        for j in 0..BLOCK {
            let at = (first + n * BLOCK + j) * TILE;
            for v in 0..VECTORS {
                let sum = sums[n][j][v];
                let finished = match product.finish {
                    Finish::Plain => sum,
                    // The second operand where one of them is not a number.
                    Finish::Relu => _mm512_max_ps(_mm512_setzero_ps(), sum),
                    Finish::Where(rows) => {
                        // SAFETY: the caller vouches for as many rows.
                        let row = unsafe { _mm512_loadu_ps(rows.as_ptr().add(at + v * LANES)) };
                        let positive = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(row, _mm512_setzero_ps());
                        _mm512_maskz_mov_ps(positive, sum)
                    }
                };
                // SAFETY: the caller vouches for the outputs.
                unsafe { _mm512_storeu_ps(y.wrapping_add(at + v * LANES), finished) };
            }
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
