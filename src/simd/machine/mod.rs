//! Single instructions that no safe interface has: the one module of this crate with `unsafe` code.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
pub mod amx;
#[cfg(target_arch = "x86_64")]
pub mod dots;
#[cfg(target_arch = "x86_64")]
mod lanes;
#[cfg(target_arch = "x86_64")]
mod products;
#[cfg(target_arch = "x86_64")]
mod rows;

use glam::Vec4;

use super::lanes::Layout;
use super::rows::Corners;
use super::{TILE, transposed};

/// Asks for the cache line `bytes` behind `value` before it is needed; on other processors than x86-64, their own
/// prediction has to do.
#[inline(always)]
pub fn prefetch<T>(value: &T, bytes: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let at = std::ptr::from_ref(value).cast::<i8>().wrapping_add(bytes);
        // SAFETY: a hint; whatever the address, nothing is read that the program would see, and nothing faults.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(at) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (value, bytes);
}

/// Asks for all cache lines of `rows[at]` and the three that follow it every `stride`.
#[inline(always)]
pub fn prefetch_rows<T>(rows: &[T], at: usize, stride: usize) {
    const LINE: usize = 64;
    let rows = &rows[at..][..3 * stride + 1];
    for j in 0..4 {
        for line in 0..size_of::<T>().div_ceil(LINE) {
            prefetch(&rows[j * stride], line * LINE);
        }
    }
}

/// Adds the sum of each of four rows of `lanes` numbers to a number of `out`, and so on for the next four.
#[inline(always)]
pub fn add_sums(rows: &[f32], lanes: usize, out: &mut [[f32; 4]]) {
    #[cfg(target_arch = "x86_64")]
    if lanes == 16 && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq") {
        // SAFETY: this processor has the instructions.
        return unsafe { lanes::add_sums(rows, out) };
    }
    for (out, rows) in out.iter_mut().zip(rows.chunks_exact(4 * lanes)) {
        out.iter_mut().zip(rows.chunks_exact(lanes)).for_each(|(out, row)| *out += row.iter().sum::<f32>());
    }
}

/// Writes `rows` of a tile as columns: lane `n` of row `j` to `out[n * width + j]`. `width` is a multiple of eight, of which the last
/// may be but four rows; what has no row is 0.
#[inline(always)]
pub fn columns(rows: &[f32], width: usize, out: &mut [f32]) {
    let missing = width * TILE - rows.len();
    assert!(width.is_multiple_of(8) && (missing == 0 || missing == 4 * TILE) && out.len() == width * TILE);
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx") {
        // SAFETY: this processor has the instructions.
        return unsafe { lanes::columns(rows, width, out) };
    }
    columns_one_by_one(rows, width, out);
}

/// Writes a tile of samples, four numbers each, as four rows.
#[inline(always)]
pub fn rows_of_fours(samples: &[[f32; 4]; TILE], out: &mut [[f32; TILE]; 4]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: this processor has the instructions.
        return unsafe { lanes::rows_of_fours(samples, out) };
    }
    for (n, samples) in samples.as_chunks::<4>().0.iter().enumerate() {
        let rows = transposed(samples.map(Vec4::from_array));
        for k in 0..4 {
            out[k][4 * n..][..4].copy_from_slice(&rows[k].to_array());
        }
    }
}

/// Writes four rows of a tile as four numbers a sample, the other way round than [`rows_of_fours`].
#[inline(always)]
pub fn fours_of_rows(rows: &[[f32; TILE]; 4], out: &mut [[f32; 4]; TILE]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: this processor has the instructions.
        return unsafe { lanes::fours_of_rows(rows, out) };
    }
    for (n, out) in out.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        let row = |k: usize| Vec4::from_slice(&rows[k][4 * n..][..4]);
        *out = transposed([row(0), row(1), row(2), row(3)]).map(|sample| sample.to_array());
    }
}

fn columns_one_by_one(rows: &[f32], width: usize, out: &mut [f32]) {
    for (n, out) in out.chunks_exact_mut(width).enumerate() {
        for (j, out) in out.iter_mut().enumerate() {
            *out = rows.get(j * TILE + n).copied().unwrap_or_default();
        }
    }
}

/// What becomes of a sum before it is written.
#[derive(Clone, Copy)]
pub enum Finish<'a, T = f32> {
    /// Nothing.
    Plain,
    /// Negative ones are 0.
    Relu,
    /// 0 except where these rows, of the same place as the output, are positive: the way back through a ReLU.
    Where(&'a [T]),
}

/// y = W x + b for one tile, finished.
#[derive(Clone, Copy)]
pub struct Product<'a, T = f32> {
    /// W `[block][input][4]`, four outputs a block.
    pub w: &'a [T],
    /// b `[output]`, or nothing.
    pub bias: &'a [f32],
    /// x `[input][TILE]`.
    pub x: &'a [T],
    /// What becomes of y.
    pub finish: Finish<'a, T>,
    /// As many rows as y has are asked for from here on meanwhile, since they are needed later; they may be anywhere.
    pub ahead: *const f32,
}

/// Writes y `[output][TILE]`: a fused multiply-add an input, of which there is a multiple of four. For processors with vectors of
/// eight numbers and sixteen registers, of which compilers would keep some sums in memory.
#[inline(always)]
pub fn multiply(product: Product, y: &mut [f32]) {
    let Product { w, bias, x, .. } = product;
    let (inputs, outputs) = (x.len() / TILE, y.len() / TILE);
    assert!(inputs > 0 && inputs.is_multiple_of(4) && w.len() == inputs * outputs);
    assert!(outputs.is_multiple_of(4) && (bias.is_empty() || bias.len() == outputs));
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx") && is_x86_feature_detected!("fma") {
        // SAFETY: this processor has the instructions.
        return unsafe { products::multiply(product, y) };
    }
    multiply_one_by_one(product, y);
}

fn multiply_one_by_one(Product { w, bias, x, finish, .. }: Product, y: &mut [f32]) {
    let inputs = x.len() / TILE;
    for (at, y) in y.iter_mut().enumerate() {
        let (output, n) = (at / TILE, at % TILE);
        let w = w[output / 4 * 4 * inputs..][..4 * inputs].iter().skip(output % 4).step_by(4);
        let bias = bias.get(output).copied().unwrap_or_default();
        let sum = w.zip(x.chunks_exact(TILE)).fold(bias, |sum, (w, x)| w.mul_add(x[n], sum));
        *y = match finish {
            Finish::Plain => sum,
            Finish::Relu => sum.max(0.0),
            Finish::Where(rows) if rows[at] > 0.0 => sum,
            Finish::Where(_) => 0.0,
        };
    }
}

/// As [`super::lanes::keep`], from number `first` of those kept on and without the zeros; false, and nothing is done, where there
/// are no instructions for it.
#[inline]
pub fn keep_lanes(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) -> bool {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: this processor has the instructions.
        unsafe { lanes::keep(values, layout, kept, first) };
        return true;
    } else if is_x86_feature_detected!("avx2") {
        // SAFETY: likewise.
        unsafe { lanes::keep_eights(values, layout, kept, first) };
        return true;
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (values, layout, kept, first);
    false
}

/// As [`super::rows::interpolate`], with the rows around `ahead` asked for; false, and nothing is done, where there are no instructions
/// for it.
#[inline(always)]
pub fn interpolate(table: &[Vec4], corners: &Corners, ahead: Option<&Corners>, out: &mut [Vec4]) -> bool {
    assert!(out.len() <= TILE && corners.are_within(out.len(), table.len()));
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx") {
        // SAFETY: this processor has the instructions, and the table the rows.
        unsafe { rows::interpolate(table, corners, ahead, out) };
        return true;
    }
    let _ = ahead;
    false
}

/// As [`super::rows::scatter`], likewise.
#[inline(always)]
pub fn scatter(table: &mut [Vec4], corners: &Corners, ahead: Option<&Corners>, g: &[Vec4]) -> bool {
    assert!(g.len() <= TILE && corners.are_within(g.len(), table.len()));
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx") {
        // SAFETY: this processor has the instructions, and the table the rows.
        unsafe { rows::scatter(table, corners, ahead, g) };
        return true;
    }
    let _ = ahead;
    false
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn columns_are_those_of_one_number_after_the_other() {
        for (rows, width) in [(4, 8), (8, 8), (12, 16), (16, 16)] {
            let rows: Vec<f32> = (1..=rows * TILE).map(|n| n as f32).collect();
            let [mut fast, mut slow] = [(); 2].map(|()| vec![-1.0; width * TILE]);
            columns(&rows, width, &mut fast);
            columns_one_by_one(&rows, width, &mut slow);
            assert_eq!(fast, slow);
        }
    }

    #[test]
    fn fours_become_rows_and_rows_fours() {
        let samples: [[f32; 4]; TILE] = std::array::from_fn(|n| std::array::from_fn(|k| (4 * n + k) as f32));
        let mut rows = [[-1.0; TILE]; 4];
        rows_of_fours(&samples, &mut rows);
        assert!((0..4).all(|k| (0..TILE).all(|n| rows[k][n] == samples[n][k])));
        let mut again = [[-1.0; 4]; TILE];
        fours_of_rows(&rows, &mut again);
        assert_eq!(again, samples);
    }

    #[test]
    fn products_are_those_of_one_number_after_the_other() {
        for (inputs, blocks) in [(4, 1), (8, 3), (64, 2)] {
            let mut rng = Rng::new(inputs as u64, 0, 0);
            let mut number = move || rng.uniform() - 0.5;
            let [w, bias, x, rows] = [4 * inputs * blocks, 4 * blocks, inputs * TILE, 4 * blocks * TILE]
                .map(|n| (0..n).map(|_| number()).collect::<Vec<f32>>());
            for finish in [Finish::Plain, Finish::Relu, Finish::Where(&rows)] {
                for bias in [&bias[..], &[]] {
                    let product = Product { w: &w, bias, x: &x, finish, ahead: std::ptr::null() };
                    let [mut fast, mut slow] = [(); 2].map(|()| vec![2.0; 4 * blocks * TILE]);
                    multiply(product, &mut fast);
                    multiply_one_by_one(product, &mut slow);
                    assert_eq!(fast, slow);
                }
            }
        }
    }
}
