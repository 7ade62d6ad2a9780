//! Products of numbers that are rounded to bf16, with f32 sums: by the CPU's dot products of pairs (AVX512-BF16) where it has them, else
//! by plain loops that round alike.
//!
//! Such an instruction adds the products of two pairs to a sum, so that what is summed over stands in pairs: neighbouring rows where
//! those are a network's inputs ([`pair_rows`]), neighbouring samples where it is samples ([`pair_samples`]).

#[cfg(target_arch = "x86_64")]
use super::machine::dots::Dots;
use super::matrix::{Pairs, narrow, widen};
use super::{Finish, Product, TILE};

/// Outputs whose weights stand side by side.
pub const BLOCK: usize = 4;

/// Pairs of a vector: sums of a product of samples that are yet to be added up.
pub const LANES: usize = 16;

/// Pairs that the samples of so many tiles take in a row, whole vectors.
pub fn pairs_of(tiles: usize) -> usize {
    (tiles * TILE / 2).next_multiple_of(LANES)
}

/// Whether this CPU has these instructions.
pub fn available() -> bool {
    #[cfg(target_arch = "x86_64")]
    return Dots::new().is_some();
    #[cfg(not(target_arch = "x86_64"))]
    false
}

/// Two numbers as bf16, the first in the low half.
#[inline(always)]
pub fn pair(low: f32, high: f32) -> Pairs {
    u32::from(narrow(low)) | u32::from(narrow(high)) << 16
}

/// a · b of pairs.
#[inline(always)]
fn dot(a: Pairs, b: Pairs) -> f32 {
    let high = |pair: Pairs| f32::from_bits(pair & 0xffff_0000);
    widen(a as u16) * widen(b as u16) + high(a) * high(b)
}

/// Rounds `rows` `[2 n][TILE]` to pairs of neighbouring rows, `[n][TILE]`.
#[inline(always)]
pub fn pair_rows(rows: &[f32], out: &mut [Pairs]) {
    #[cfg(target_arch = "x86_64")]
    if let Some(dots) = Dots::new() {
        return dots.pair_rows(rows, out);
    }
    pair_rows_one_by_one(rows, out);
}

#[inline(always)]
fn pair_rows_one_by_one(rows: &[f32], out: &mut [Pairs]) {
    for (rows, out) in rows.as_chunks::<{ 2 * TILE }>().0.iter().zip(out.as_chunks_mut::<TILE>().0) {
        for n in 0..TILE {
            out[n] = pair(rows[n], rows[TILE + n]);
        }
    }
}

/// From pairs of neighbouring rows `[n][TILE]`, of tile number `tile` of `tiles`, to pairs of neighbouring samples: row after row of
/// [`pairs_of`] them, the last vector of which ends with zeros.
#[inline(always)]
pub fn pair_samples(rows: &[Pairs], [tile, tiles]: [usize; 2], out: &mut [Pairs]) {
    let stride = pairs_of(tiles);
    let (first, end) = (tile * TILE / 2, (tile + 1) * TILE / 2);
    if tile + 1 == tiles && end < stride {
        out.chunks_exact_mut(stride).for_each(|row| row[end..].fill(0));
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(dots) = Dots::new() {
        return dots.pair_samples(rows, stride, &mut out[first..]);
    }
    pair_samples_one_by_one(rows, stride, &mut out[first..]);
}

#[inline(always)]
fn pair_samples_one_by_one(rows: &[Pairs], stride: usize, out: &mut [Pairs]) {
    for (rows, out) in rows.as_chunks::<TILE>().0.iter().zip(out.chunks_mut(2 * stride)) {
        for (n, [even, odd]) in rows.as_chunks().0.iter().enumerate() {
            out[n] = even & 0xffff | odd << 16;
            out[stride + n] = even >> 16 | odd & 0xffff_0000;
        }
    }
}

/// As [`super::multiply`], y = W x + b for one tile, finished, of W `[block][input / 2][4]` and x `[input / 2][TILE]`.
#[inline(always)]
pub fn multiply(product: Product<Pairs>, y: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if let Some(dots) = Dots::new() {
        return dots.multiply(product, y);
    }
    multiply_one_by_one(product, y);
}

/// As [`multiply`], with y rounded to pairs of rows `[output / 2][TILE]`.
#[inline(always)]
pub fn multiply_to_pairs(product: Product<Pairs>, y: &mut [Pairs]) {
    #[cfg(target_arch = "x86_64")]
    if let Some(dots) = Dots::new() {
        return dots.multiply_to_pairs(product, y);
    }
    multiply_to_pairs_one_by_one(product, y);
}

#[inline(always)]
fn multiply_one_by_one(product: Product<Pairs>, y: &mut [f32]) {
    for (output, y) in y.as_chunks_mut::<TILE>().0.iter_mut().enumerate() {
        *y = output_row(&product, output);
    }
}

#[inline(always)]
fn multiply_to_pairs_one_by_one(product: Product<Pairs>, y: &mut [Pairs]) {
    for (n, y) in y.as_chunks_mut::<TILE>().0.iter_mut().enumerate() {
        let [low, high] = [output_row(&product, 2 * n), output_row(&product, 2 * n + 1)];
        for n in 0..TILE {
            y[n] = pair(low[n], high[n]);
        }
    }
}

/// One row of a product, finished.
#[inline(always)]
fn output_row(Product { w, bias, x, finish, .. }: &Product<Pairs>, output: usize) -> [f32; TILE] {
    let x = x.as_chunks::<TILE>().0;
    let w = w[output / BLOCK * BLOCK * x.len()..].iter().skip(output % BLOCK).step_by(BLOCK);
    let mut sums = [bias.get(output).copied().unwrap_or_default(); TILE];
    for (w, x) in w.zip(x) {
        for n in 0..TILE {
            sums[n] += dot(*w, x[n]);
        }
    }
    match finish {
        Finish::Plain => {}
        Finish::Relu => sums.iter_mut().for_each(|sum| *sum = if *sum < 0.0 { 0.0 } else { *sum }),
        Finish::Where(rows) => {
            let row = &rows[output / 2 * TILE..][..TILE];
            for n in 0..TILE {
                sums[n] = if row[n] >> (output % 2 * 16) & 0x7fff == 0 { 0.0 } else { sums[n] };
            }
        }
    }
    sums
}

/// Σ over samples of `dy[j] x[k]`, of four rows dy and `INPUTS` rows x of pairs of samples, `stride` pairs each, but for the sum of
/// [`LANES`] parts: `[k][j][part]`.
#[inline(always)]
pub fn outer_product<const INPUTS: usize>(
    dy: &[Pairs],
    x: &[Pairs],
    stride: usize,
) -> [[[f32; LANES]; BLOCK]; INPUTS] {
    #[cfg(target_arch = "x86_64")]
    if let Some(dots) = Dots::new() {
        return dots.outer_product(dy, x, stride);
    }
    outer_product_one_by_one(dy, x, stride)
}

#[inline(always)]
fn outer_product_one_by_one<const INPUTS: usize>(
    dy: &[Pairs],
    x: &[Pairs],
    stride: usize,
) -> [[[f32; LANES]; BLOCK]; INPUTS] {
    let mut out = [[[0.0; LANES]; BLOCK]; INPUTS];
    for k in 0..INPUTS {
        for j in 0..BLOCK {
            let dy = dy[j * stride..][..stride].as_chunks::<LANES>().0;
            let x = x[k * stride..][..stride].as_chunks::<LANES>().0;
            // Sums of its own stay in registers.
            let mut sums = [0.0; LANES];
            for (dy, x) in dy.iter().zip(x) {
                for n in 0..LANES {
                    sums[n] += dot(dy[n], x[n]);
                }
            }
            out[k][j] = sums;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    fn numbers(rng: &mut Rng, n: usize) -> Vec<f32> {
        (0..n).map(|_| 2.0 * rng.uniform() - 1.0).collect()
    }

    fn pairs(rng: &mut Rng, n: usize) -> Vec<Pairs> {
        (0..n).map(|_| pair(2.0 * rng.uniform() - 1.0, 2.0 * rng.uniform() - 1.0)).collect()
    }

    /// Sums of `terms` products below 1: every partial sum is rounded once, in whatever order.
    fn assert_close(a: &[f32], b: &[f32], terms: usize) {
        assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(b) {
            assert!((a - b).abs() <= 1e-7 * terms as f32 * (1.0 + b.abs()), "{a} and {b}");
        }
    }

    #[test]
    fn rows_are_rounded_to_pairs_alike() {
        let mut rng = Rng::new(1, 0, 0);
        let mut rows = numbers(&mut rng, 6 * TILE);
        rows[TILE + 3] = f32::INFINITY;
        let [mut fast, mut slow] = [(); 2].map(|()| vec![7; 3 * TILE]);
        pair_rows(&rows, &mut fast);
        pair_rows_one_by_one(&rows, &mut slow);
        assert_eq!(fast, slow);
        assert_eq!(fast[TILE + 5], pair(rows[2 * TILE + 5], rows[3 * TILE + 5]));
        assert_eq!(fast[3] >> 16, u32::from(narrow(f32::INFINITY)));
    }

    #[test]
    fn what_is_no_number_stays_that() {
        let mut out = [0; TILE];
        pair_rows(&[f32::NAN; 2 * TILE], &mut out);
        assert!(out.iter().all(|pair| widen(*pair as u16).is_nan() && widen((pair >> 16) as u16).is_nan()));
        let product = Product {
            w: &[pair(1.0, 1.0); 4],
            bias: &[],
            x: &out,
            finish: Finish::Relu,
            ahead: std::ptr::null(),
        };
        let mut y = [0.0; 4 * TILE];
        multiply(product, &mut y);
        assert!(y.iter().all(|y| y.is_nan()), "{y:?}");
    }

    #[test]
    fn samples_of_tiles_follow_one_another_and_zeros_the_last() {
        let mut rng = Rng::new(2, 0, 0);
        for tiles in 1..4 {
            let values: Vec<Vec<Pairs>> = (0..tiles).map(|_| pairs(&mut rng, 3 * TILE)).collect();
            let stride = pairs_of(tiles);
            let [mut out, mut slow] = [(); 2].map(|()| vec![7; 6 * stride]);
            for (n, tile) in values.iter().enumerate() {
                pair_samples(tile, [n, tiles], &mut out);
                pair_samples_one_by_one(tile, stride, &mut slow[n * TILE / 2..]);
            }
            for (row, (out, slow)) in out.chunks_exact(stride).zip(slow.chunks_exact(stride)).enumerate() {
                let half = |pair: Pairs| pair >> (row % 2 * 16) & 0xffff;
                let samples: Vec<u32> = values
                    .iter()
                    .flat_map(|tile| tile[row / 2 * TILE..][..TILE].iter().map(|pair| half(*pair)))
                    .collect();
                let truth: Vec<Pairs> =
                    samples.as_chunks().0.iter().map(|[low, high]| low | high << 16).collect();
                assert_eq!(out[..truth.len()], truth);
                assert_eq!(slow[..truth.len()], truth);
                assert!(out[truth.len()..].iter().all(|pair| *pair == 0));
            }
        }
    }

    #[test]
    fn products_are_those_of_plain_loops() {
        for (inputs, blocks) in [(4, 1), (8, 2), (12, 3), (64, 5)] {
            let mut rng = Rng::new(inputs as u64, 0, 0);
            let (w, x) = (pairs(&mut rng, inputs / 2 * BLOCK * blocks), pairs(&mut rng, inputs / 2 * TILE));
            let mut rows = pairs(&mut rng, BLOCK * blocks / 2 * TILE);
            // Either, neither and one of them below 0, which counts as well.
            (0..8).for_each(|n| rows[n] &= [0, 0x8000_8000, 0xffff, 0xffff_0000][n % 4]);
            let bias = numbers(&mut rng, BLOCK * blocks);
            for finish in [Finish::Plain, Finish::Relu, Finish::Where(&rows)] {
                for bias in [&bias[..], &[]] {
                    let product = Product { w: &w, bias, x: &x, finish, ahead: std::ptr::null() };
                    let [mut fast, mut slow] = [(); 2].map(|()| vec![2.0; BLOCK * blocks * TILE]);
                    multiply(product, &mut fast);
                    multiply_one_by_one(product, &mut slow);
                    assert_close(&fast, &slow, inputs);
                    let mut paired = vec![7; fast.len() / 2];
                    multiply_to_pairs(product, &mut paired);
                    let mut truth = paired.clone();
                    pair_rows(&fast, &mut truth);
                    assert_eq!(paired, truth, "rounding comes last");
                    multiply_to_pairs_one_by_one(product, &mut paired);
                    pair_rows(&slow, &mut truth);
                    assert_eq!(paired, truth);
                }
            }
        }
    }

    #[test]
    fn outer_products_are_those_of_plain_loops() {
        for tiles in [1, 2, 5] {
            let (mut rng, stride) = (Rng::new(tiles as u64, 0, 0), pairs_of(tiles));
            let (dy, x) = (pairs(&mut rng, BLOCK * stride), pairs(&mut rng, 6 * stride));
            let [fast, slow] =
                [outer_product::<6>(&dy, &x, stride), outer_product_one_by_one::<6>(&dy, &x, stride)];
            let flat = |sums: [[[f32; LANES]; BLOCK]; 6]| sums.as_flattened().as_flattened().to_vec();
            assert_close(&flat(fast), &flat(slow), 2 * stride / LANES);
        }
    }
}
