//! Sums over pairs of samples, of activations and gradients that are rounded to bf16; kept as those of [`super::by_samples`].

use bytemuck::cast_slice_mut;

use super::super::{BLOCK, Layer};
use super::by_samples::{Block, parts};
use super::{Strip, inputs_together};
use crate::simd::dots::{LANES, outer_product, pair, pair_samples, pairs_of};
use crate::simd::matrix::Pairs;
use crate::simd::{AlignedVec, add_sums};

/// Adds the parameter gradients of a strip to `sums`, in the order of [`super::by_samples::accumulate`]. Pairs of samples are made in
/// `panel`.
#[inline(always)]
pub fn accumulate(layers: &[Layer], strip: Strip<Pairs>, sums: &mut [f32], panel: &mut AlignedVec) {
    let stride = pairs_of(strip.count);
    let widest = layers.iter().map(|l| l.n_in + l.n_out).max().unwrap_or(0);
    panel.reserve_len((widest + 1) * stride);
    // Biases are weights of an input that is 1; beyond the last sample, gradients are 0.
    let (ones, panel) = cast_slice_mut::<_, Pairs>(panel).split_at_mut(stride);
    ones.fill(pair(1.0, 1.0));
    for layer in layers {
        let (weights, biases) = parts(sums, layer);
        let (x, dy) = panel[..(layer.n_in + layer.n_out) * stride].split_at_mut(layer.n_in * stride);
        for tile in 0..strip.count {
            let of = [tile, strip.count];
            pair_samples(strip.values.rows(layer.row / 2).of(tile, layer.n_in / 2), of, x);
            pair_samples(strip.grads.rows((layer.row + layer.n_in) / 2).of(tile, layer.n_out / 2), of, dy);
        }
        for (dy, bias) in dy.chunks_exact(BLOCK * stride).zip(biases) {
            add_product::<1>(dy, ones, stride, std::slice::from_mut(bias));
        }
        // The inputs, of which there are more at a time than outputs, stay in the nearest cache while all outputs pass.
        let mut i = 0;
        while i < layer.n_in {
            let wide = inputs_together(layer.n_in - i);
            let x = &x[i * stride..];
            for (dy, weights) in dy.chunks_exact(BLOCK * stride).zip(weights.chunks_exact_mut(layer.n_in)) {
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
fn add_product<const INPUTS: usize>(dy: &[Pairs], x: &[Pairs], stride: usize, out: &mut [Block]) {
    let sums = outer_product::<INPUTS>(dy, x, stride);
    add_sums(sums.as_flattened().as_flattened(), LANES, out);
}
