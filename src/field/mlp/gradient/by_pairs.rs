//! Sums over vectors of samples of which both factors are rounded to bf16, in pairs of samples; kept as those of [`by_samples`].

use bytemuck::cast_slice_mut;
use pulp::Simd;

use super::super::{BLOCK, Layer};
use super::by_samples::{Partial, bias_gradient, parts};
use super::{Strip, inputs_together};
use crate::simd::dots::{LANES, outer_product, pair_samples, pairs_of};
use crate::simd::matrix::Pairs;
use crate::simd::{AlignedVec, add_quarter_sums};

/// Adds the parameter gradients of a strip to `sums`, in the order of [`super::by_samples::accumulate`]; what is rounded goes to `rounded`.
#[inline(always)]
pub fn accumulate<S: Simd>(
    simd: S,
    layers: &[Layer],
    strip: Strip,
    sums: &mut [f32],
    rounded: &mut AlignedVec,
) {
    let stride = pairs_of(strip.count);
    let widest = layers.iter().map(|l| l.n_in + l.n_out).max().unwrap_or(0);
    rounded.reserve_len(widest * stride);
    let rounded: &mut [Pairs] = cast_slice_mut(rounded);
    for layer in layers {
        let (weights, biases) = parts(sums, layer);
        let [x, dy] = strip.of(layer);
        for (block, bias) in biases.iter_mut().enumerate() {
            bias_gradient(simd, dy.rows(block * BLOCK), strip.count, bias);
        }
        let (x_pairs, dy_pairs) =
            rounded[..(layer.n_in + layer.n_out) * stride].split_at_mut(layer.n_in * stride);
        for tile in 0..strip.count {
            pair_samples(x.of(tile, layer.n_in), [tile, strip.count], x_pairs);
            pair_samples(dy.of(tile, layer.n_out), [tile, strip.count], dy_pairs);
        }
        // The inputs, of which there are more at a time than outputs, stay in the nearest cache while all outputs pass.
        let mut i = 0;
        while i < layer.n_in {
            let wide = inputs_together(layer.n_in - i);
            let x = &x_pairs[i * stride..];
            for (dy, weights) in
                dy_pairs.chunks_exact(BLOCK * stride).zip(weights.chunks_exact_mut(layer.n_in))
            {
                let out = &mut weights[i..i + wide];
                match wide {
                    6 => add_product::<6>(dy, x, stride, out),
                    4 => add_product::<4>(dy, x, stride, out),
                    _ => add_product::<2>(dy, x, stride, out),
                }
            }
            i += wide;
        }
    }
}

#[inline(always)]
fn add_product<const INPUTS: usize>(dy: &[Pairs], x: &[Pairs], stride: usize, out: &mut [Partial]) {
    let sums = outer_product::<INPUTS>(dy, x, stride);
    add_quarter_sums(sums.as_flattened().as_flattened(), LANES, out);
}
