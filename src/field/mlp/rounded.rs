//! Networks on vectors of samples, of which activations and gradients are rounded to bf16 and summed in f32, for dot products of pairs.
//!
//! A tile holds what each of its layers sees, one after the other and in pairs of neighbouring rows, then the output in f32. Before a
//! layer that sees the input again, there is a copy of it. Of gradients there are those of what comes out of layers, at the same places.

use super::{BLOCK, Layer, vector};
use crate::simd::dots::{multiply, multiply_to_pairs, pair, pair_rows};
use crate::simd::matrix::Pairs;
use crate::simd::{Finish, Product, TILE};

/// Weights in the two orders that the kernels stream through: four outputs (or inputs) side by side, two inputs (or outputs) a pair.
pub struct Packed {
    forward: Vec<Pairs>,
    backward: Vec<Pairs>,
    bias: Vec<f32>,
}

/// Place of row `row`, an even number, among a tile's pairs; so many rows take as many pairs.
fn pairs(row: usize) -> usize {
    row / 2 * TILE
}

/// Weights `[block][input][4]`, rounded, as `[block][input / 2][4]`.
fn rounded(weights: &[f32]) -> Vec<Pairs> {
    let two_inputs = weights.as_chunks::<{ 2 * BLOCK }>().0;
    two_inputs.iter().flat_map(|w| (0..BLOCK).map(|j| pair(w[j], w[BLOCK + j]))).collect()
}

impl Packed {
    pub(super) fn new(layers: &[Layer], params: &[f32]) -> Self {
        let vector::Packed { forward, backward, bias } = vector::Packed::new(layers, params);
        Self { forward: rounded(&forward), backward: rounded(&backward), bias }
    }

    /// From the `input` rows of a tile `[input][TILE]` to all of `tile`; of the `output` the first rows, a multiple of [`BLOCK`].
    /// Meanwhile the tile `ahead` pairs behind it may be asked for.
    #[inline(always)]
    pub(super) fn forward(
        &self,
        layers: &[Layer],
        input: &[f32],
        tile: &mut [Pairs],
        output: &mut [f32],
        ahead: usize,
    ) {
        pair_rows(input, &mut tile[..input.len() / 2]);
        for (n, layer) in layers.iter().enumerate() {
            if layer.again > 0 {
                tile.copy_within(..pairs(layer.again), pairs(layer.row + layer.fresh()));
            }
            let (x, y) = tile[pairs(layer.row)..].split_at_mut(pairs(layer.n_in));
            let (w, bias) = (&self.forward[layer.weight / 2..], &self.bias[layer.bias..]);
            let ahead = y.as_ptr().wrapping_add(ahead).cast();
            if n + 1 < layers.len() {
                let (w, bias) = (&w[..layer.weights() / 2], &bias[..layer.n_out]);
                let product = Product { w, bias, x, finish: Finish::Relu, ahead };
                multiply_to_pairs(product, &mut y[..pairs(layer.n_out)]);
            } else {
                let outputs = output.len() / TILE;
                let (w, bias) = (&w[..layer.n_in * outputs / 2], &bias[..outputs]);
                multiply(Product { w, bias, x, finish: Finish::Plain, ahead }, output);
            }
        }
    }

    /// From the gradient of a tile's `output` rows to that of the first of its `input` rows, as many as there are, and to all of `grad` but
    /// the input's place. Meanwhile the tile `ahead` pairs behind `tile` may be asked for. In `again` is room for the whole input.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        layers: &[Layer],
        tile: &[Pairs],
        grad: &mut [Pairs],
        output: &[f32],
        [input, again]: [&mut [f32]; 2],
        ahead: usize,
    ) {
        let Some(last) = layers.last() else { return };
        pair_rows(output, &mut grad[pairs(last.row + last.n_in)..][..pairs(last.n_out)]);
        for (n, layer) in layers.iter().enumerate().rev() {
            let (dx, dy) = grad[pairs(layer.row)..].split_at_mut(pairs(layer.n_in));
            let w = &self.backward[layer.weight / 2..][..layer.weights() / 2];
            let (w, w_again) = w.split_at(layer.fresh() * layer.n_out / 2);
            let rows = if n > 0 { layer.fresh() } else { input.len() / TILE };
            let w = &w[..rows * layer.n_out / 2];
            let x = &tile[pairs(layer.row)..][..pairs(rows)];
            let product = Product {
                w,
                bias: &[],
                x: &dy[..pairs(layer.n_out)],
                finish: Finish::Plain,
                ahead: x.as_ptr().wrapping_add(ahead).cast(),
            };
            if n > 0 {
                let product = Product { finish: Finish::Where(x), ..product };
                multiply_to_pairs(product, &mut dx[..x.len()]);
            } else {
                multiply(product, input);
            }
            if layer.again > 0 {
                multiply(Product { w: w_again, ..product }, again);
            }
        }
        if layers.iter().any(|layer| layer.again > 0) {
            input.iter_mut().zip(again).for_each(|(g, again)| *g += *again);
        }
    }
}
