//! Sums over vectors of samples, as tiles hold them.

use pulp::Simd;

use super::super::{BLOCK, Layer};
use super::{Strip, TileView, inputs_together};
use crate::simd::{TILE, add_sums};

/// The gradients of the weights of four outputs for one input, or of their biases.
pub type Block = [f32; BLOCK];

/// Adds the parameter gradients of a strip to `sums`.
///
/// Layer by layer, of four outputs after the other the weights input by input, then the biases.
#[inline(always)]
pub fn accumulate<S: Simd>(simd: S, layers: &[Layer], strip: Strip, sums: &mut [f32]) {
    let count = strip.count;
    // One for all: to make one for every product would take as long as a seventh of it.
    let mut room = [[simd.splat_f32s(0.0); BLOCK]; 6];
    for layer in layers {
        let (weights, biases) = parts(sums, layer);
        let [x, dy] = strip.of(layer);
        for (block, bias) in biases.iter_mut().enumerate() {
            bias_gradient(simd, dy.rows(block * BLOCK), count, bias);
        }
        // The inputs, of which there are more at a time than outputs, stay in the nearest cache while all outputs pass.
        let mut i = 0;
        while i < layer.n_in {
            let wide = inputs_together(layer.n_in - i);
            let x = x.rows(i);
            for (block, weights) in weights.chunks_exact_mut(layer.n_in).enumerate() {
                let (dy, out) = (dy.rows(block * BLOCK), &mut weights[i..i + wide]);
                match wide {
                    6 => outer_product::<S, 6>(simd, dy, x, count, &mut room, out),
                    4 => outer_product::<S, 4>(simd, dy, x, count, &mut room, out),
                    _ => outer_product::<S, 2>(simd, dy, x, count, &mut room, out),
                }
            }
            i += wide;
        }
    }
}

/// Those of all sums that are of a layer's weights, and of its biases.
#[inline(always)]
pub fn parts<'a>(sums: &'a mut [f32], layer: &Layer) -> (&'a mut [Block], &'a mut [Block]) {
    let (weights, biases) =
        sums.as_chunks_mut().0[layer.param / BLOCK..].split_at_mut(layer.weights() / BLOCK);
    (weights, &mut biases[..layer.n_out / BLOCK])
}

/// Adds `sums` to `out`, in the order of the parameters.
pub fn unpack(layers: &[Layer], sums: &[f32], out: &mut [f32]) {
    let (sums, _) = sums.as_chunks::<BLOCK>();
    for layer in layers {
        let (weights, biases) = sums[layer.param / BLOCK..].split_at(layer.weights() / BLOCK);
        let (gw, gb) = out[layer.param..].split_at_mut(layer.weights());
        let rows = gw.chunks_exact_mut(BLOCK * layer.n_in).zip(gb.chunks_exact_mut(BLOCK));
        for ((gw, gb), (weights, bias)) in rows.zip(weights.chunks_exact(layer.n_in).zip(biases)) {
            for (i, block) in weights.iter().enumerate() {
                for (j, sum) in block.iter().enumerate() {
                    gw[j * layer.n_in + i] += sum;
                }
            }
            gb.iter_mut().zip(bias).for_each(|(g, sum)| *g += sum);
        }
    }
}

/// Adds Σ over samples of dy[j] x[k] to `out`, for four outputs and `WIDE` inputs: for half of the outputs at a time where registers
/// are few. In `room` are the sums of the lanes.
#[inline(always)]
fn outer_product<S: Simd, const WIDE: usize>(
    simd: S,
    dy: TileView,
    x: TileView,
    count: usize,
    room: &mut [[S::f32s; BLOCK]],
    out: &mut [Block],
) {
    let Some(sums) = room.first_chunk_mut::<WIDE>() else { return };
    if S::REGISTER_COUNT < 32 {
        outputs_by_inputs::<S, 2, WIDE>(simd, dy, x, count, 0, sums);
        outputs_by_inputs::<S, 2, WIDE>(simd, dy.rows(2), x, count, 2, sums);
    } else {
        outputs_by_inputs::<S, BLOCK, WIDE>(simd, dy, x, count, 0, sums);
    }
    add_vectors::<S, _>(sums, out);
}

/// Σ over samples of dy[j] x[k], but for the sum over lanes, as `out[k][first + j]`.
#[inline(always)]
fn outputs_by_inputs<S: Simd, const OUTPUTS: usize, const INPUTS: usize>(
    simd: S,
    dy: TileView,
    x: TileView,
    count: usize,
    first: usize,
    out: &mut [[S::f32s; BLOCK]; INPUTS],
) {
    let vectors = TILE / S::F32_LANES;
    // Sums of its own and no one else's stay in registers.
    let mut acc = [[simd.splat_f32s(0.0); OUTPUTS]; INPUTS];
    for tile in 0..count {
        let dy = S::as_simd_f32s(dy.of(tile, OUTPUTS)).0;
        let x = S::as_simd_f32s(x.of(tile, INPUTS)).0;
        for v in 0..vectors {
            let mut d = [dy[v]; OUTPUTS];
            for j in 1..OUTPUTS {
                d[j] = dy[j * vectors + v];
            }
            for k in 0..INPUTS {
                let x = x[k * vectors + v];
                for j in 0..OUTPUTS {
                    acc[k][j] = simd.mul_add_e_f32s(d[j], x, acc[k][j]);
                }
            }
        }
    }
    for k in 0..INPUTS {
        for j in 0..OUTPUTS {
            out[k][first + j] = acc[k][j];
        }
    }
}

/// Adds Σ over samples of dy[j] to `out`.
#[inline(always)]
fn bias_gradient<S: Simd>(simd: S, dy: TileView, count: usize, out: &mut Block) {
    let vectors = TILE / S::F32_LANES;
    // Sums of their own for every third vector, so that none waits for the one before it.
    let mut acc = [[simd.splat_f32s(0.0); BLOCK]; 3];
    for tile in 0..count {
        let dy = S::as_simd_f32s(dy.of(tile, BLOCK)).0;
        for v in 0..vectors {
            for j in 0..BLOCK {
                acc[v % 3][j] = simd.add_f32s(acc[v % 3][j], dy[j * vectors + v]);
            }
        }
    }
    for j in 0..BLOCK {
        acc[0][j] = simd.add_f32s(acc[0][j], simd.add_f32s(acc[1][j], acc[2][j]));
    }
    add_vectors::<S, _>(&[acc[0]], std::slice::from_mut(out));
}

/// Adds the sums over the lanes of four vectors each to `out`.
#[inline(always)]
fn add_vectors<S: Simd, const N: usize>(vectors: &[[S::f32s; BLOCK]; N], out: &mut [Block]) {
    add_sums(bytemuck::cast_slice(vectors.as_flattened()), S::F32_LANES, out);
}
