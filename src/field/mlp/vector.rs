//! Networks in f32, on vectors of samples.
//!
//! A tile holds all its layers one after the other: `input | layer 1 | layer 2 | ...`, gradients likewise. Before a layer
//! that sees the input again, there is a copy of it.

use glam::Vec4;
use pulp::Simd;

use super::{BLOCK, Layer};
use crate::simd::{TILE, add_quarter_sums};

/// Weights in the two orders that the kernels stream through, four outputs (or inputs) side by side.
pub struct Packed {
    forward: Vec<f32>,
    backward: Vec<f32>,
    bias: Vec<f32>,
}

impl Packed {
    pub(super) fn new(layers: &[Layer], params: &[f32]) -> Self {
        let mut packed = Self { forward: Vec::new(), backward: Vec::new(), bias: Vec::new() };
        for layer in layers {
            let (w, b) = params[layer.param..].split_at(layer.weights());
            packed.bias.extend_from_slice(&b[..layer.n_out]);
            for o in (0..layer.n_out).step_by(BLOCK) {
                for i in 0..layer.n_in {
                    packed.forward.extend((0..BLOCK).map(|j| w[(o + j) * layer.n_in + i]));
                }
            }
            for i in (0..layer.n_in).step_by(BLOCK) {
                for o in 0..layer.n_out {
                    packed.backward.extend((0..BLOCK).map(|j| w[o * layer.n_in + i + j]));
                }
            }
        }
        packed
    }

    /// Fills all rows below the input of one tile, `[rows][TILE]`; of the output the first `outputs` (a multiple of
    /// [`BLOCK`]).
    #[inline(always)]
    pub(super) fn forward<S: Simd>(&self, simd: S, layers: &[Layer], tile: &mut [f32], outputs: usize) {
        for (n, layer) in layers.iter().enumerate() {
            let n_out = if n + 1 < layers.len() { layer.n_out } else { outputs };
            if layer.again > 0 {
                tile.copy_within(..layer.again * TILE, (layer.row + layer.fresh()) * TILE);
            }
            let (x, y) = tile[layer.row * TILE..].split_at_mut(layer.n_in * TILE);
            let w = &self.forward[layer.weight..][..layer.n_in * n_out];
            let bias = &self.bias[layer.bias..][..n_out];
            let finish = if n + 1 < layers.len() { Finish::Relu } else { Finish::Plain };
            matmul(simd, w, bias, x, &mut y[..n_out * TILE], finish);
        }
    }

    /// Fills the gradient rows of one tile above the output, whose rows the caller has set.
    #[inline(always)]
    pub(super) fn backward<S: Simd>(&self, simd: S, layers: &[Layer], tile: &[f32], grad: &mut [f32]) {
        for (n, layer) in layers.iter().enumerate().rev() {
            let (dx, dy) = grad[layer.row * TILE..].split_at_mut(layer.n_in * TILE);
            let w = &self.backward[layer.weight..][..layer.weights()];
            let (fresh, again) = dx.split_at_mut(layer.fresh() * TILE);
            let (w, w_again) = w.split_at(layer.fresh() * layer.n_out);
            let dy = &dy[..layer.n_out * TILE];
            let x = &tile[layer.row * TILE..][..layer.fresh() * TILE];
            let finish = if n > 0 { Finish::Where(S::as_simd_f32s(x).0) } else { Finish::Plain };
            matmul(simd, w, &[], dy, fresh, finish);
            if layer.again > 0 {
                matmul(simd, w_again, &[], dy, again, Finish::Plain);
            }
        }
        for layer in layers.iter().filter(|l| l.again > 0) {
            let (input, rest) = grad.split_at_mut(layers[0].n_in * TILE);
            let again = &rest[(layer.row + layer.fresh() - layers[0].n_in) * TILE..];
            for (g, again) in input.iter_mut().zip(again) {
                *g += again;
            }
        }
    }
}

/// Four numbers each of four parameters' gradient, which are yet to be summed: number `n` of all sixteen is of parameter `n % 4`.
type Partial = [f32; BLOCK * BLOCK];

/// Adds the parameter gradients of `count` tiles to `sums`, four numbers a parameter.
///
/// Layer by layer, of four outputs after the other the weights input by input, then the biases.
#[inline(always)]
pub(super) fn accumulate<S: Simd>(
    simd: S,
    layers: &[Layer],
    tiles: TileView,
    grads: TileView,
    count: usize,
    sums: &mut [f32],
) {
    let (sums, _) = sums.as_chunks_mut();
    for layer in layers {
        let (weights, biases) = sums[layer.param / BLOCK..].split_at_mut(layer.weights() / BLOCK);
        let x = tiles.rows(layer.row);
        let dy = grads.rows(layer.row + layer.n_in);
        for (block, (weights, bias)) in weights.chunks_exact_mut(layer.n_in).zip(biases).enumerate() {
            let dy = dy.rows(block * BLOCK);
            bias_gradient(simd, dy, count, bias);
            let mut i = 0;
            while i < layer.n_in {
                let wide = inputs_together::<S>(layer.n_in - i);
                let (x, out) = (x.rows(i), &mut weights[i..i + wide]);
                match wide {
                    6 => outer_product::<S, 6>(simd, dy, x, count, out),
                    4 => outer_product::<S, 4>(simd, dy, x, count, out),
                    _ => outer_product::<S, 2>(simd, dy, x, count, out),
                }
                i += wide;
            }
        }
    }
}

/// Of the inputs that are left (an even number) those of which sums fit the registers beside each other: the more, the less is loaded
/// for a product.
#[inline(always)]
fn inputs_together<S: Simd>(left: usize) -> usize {
    match left {
        _ if S::REGISTER_COUNT < 32 => 2,
        // Two fours rather than a two at the end.
        2 | 4 | 8 => left.min(4),
        _ => 6,
    }
}

/// Adds `sums` to `out`, in the order of the parameters.
pub(super) fn unpack(layers: &[Layer], sums: &[f32], out: &mut [f32]) {
    let (sums, _) = sums.as_chunks();
    for layer in layers {
        let (weights, biases) = sums[layer.param / BLOCK..].split_at(layer.weights() / BLOCK);
        let (gw, gb) = out[layer.param..].split_at_mut(layer.weights());
        let rows = gw.chunks_exact_mut(BLOCK * layer.n_in).zip(gb.chunks_exact_mut(BLOCK));
        for ((gw, gb), (weights, bias)) in rows.zip(weights.chunks_exact(layer.n_in).zip(biases)) {
            for (i, partial) in weights.iter().enumerate() {
                for (j, sum) in summed(partial).into_iter().enumerate() {
                    gw[j * layer.n_in + i] += sum;
                }
            }
            gb.iter_mut().zip(summed(bias)).for_each(|(g, sum)| *g += sum);
        }
    }
}

fn summed(partial: &Partial) -> [f32; BLOCK] {
    let [a, b, c, d] = [0, 1, 2, 3].map(|n| Vec4::from_slice(&partial[n * BLOCK..]));
    ((a + b) + (c + d)).to_array()
}

/// The same rows of many tiles: `data[tile * stride + row * TILE ..]`.
#[derive(Clone, Copy)]
pub struct TileView<'a> {
    /// Tiles one after the other.
    pub data: &'a [f32],
    /// Floats from one tile to the next.
    pub stride: usize,
    /// Float offset of row 0 within a tile.
    pub offset: usize,
}

impl<'a> TileView<'a> {
    #[inline(always)]
    fn rows(self, row: usize) -> Self {
        Self { offset: self.offset + row * TILE, ..self }
    }

    #[inline(always)]
    fn block<S: Simd>(self, tile: usize, rows: usize) -> &'a [S::f32s] {
        S::as_simd_f32s(&self.data[tile * self.stride + self.offset..][..rows * TILE]).0
    }
}

/// What becomes of a sum before it is written.
#[derive(Clone, Copy)]
enum Finish<'a, V> {
    /// Nothing.
    Plain,
    /// Negative ones are 0.
    Relu,
    /// 0 except where these rows, of the same place as the output, are positive: the way back through a ReLU.
    Where(&'a [V]),
}

/// y = W x + b for one tile, finished; `w` is packed four outputs side by side.
#[inline(always)]
fn matmul<S: Simd>(simd: S, w: &[f32], bias: &[f32], x: &[f32], y: &mut [f32], finish: Finish<S::f32s>) {
    let vectors = TILE / S::F32_LANES;
    let n_in = x.len() / TILE;
    let x = S::as_simd_f32s(x).0;
    let y = S::as_mut_simd_f32s(y).0;
    let threes = x.as_chunks::<3>().0;
    let zero = simd.splat_f32s(0.0);
    for group in (0..vectors).step_by(3) {
        for (block, w) in w.chunks_exact(BLOCK * n_in).enumerate() {
            let mut acc = [[zero; 3]; BLOCK];
            if let Some(b) = bias.get(block * BLOCK..(block + 1) * BLOCK) {
                for (a, b) in acc.iter_mut().zip(b) {
                    *a = [simd.splat_f32s(*b); 3];
                }
            }
            let w = w.as_chunks::<BLOCK>().0;
            for (k, w) in w.iter().enumerate() {
                let x = &threes[(k * vectors + group) / 3];
                for j in 0..BLOCK {
                    let w = simd.splat_f32s(w[j]);
                    for v in 0..3 {
                        acc[j][v] = simd.mul_add_e_f32s(w, x[v], acc[j][v]);
                    }
                }
            }
            for (j, a) in acc.iter().enumerate() {
                let at = (block * BLOCK + j) * vectors + group;
                let Some(out) = y[at..].first_chunk_mut::<3>() else { continue };
                match finish {
                    Finish::Plain => *out = *a,
                    Finish::Relu => {
                        for v in 0..3 {
                            out[v] = simd.max_f32s(a[v], zero);
                        }
                    }
                    Finish::Where(x) => {
                        let x = &x[at..][..3];
                        for v in 0..3 {
                            out[v] = simd.select_f32s(simd.greater_than_f32s(x[v], zero), a[v], zero);
                        }
                    }
                }
            }
        }
    }
}

/// Adds Σ over samples of dy[j] x[k] to `out`, for four outputs and `WIDE` inputs.
#[inline(always)]
fn outer_product<S: Simd, const WIDE: usize>(
    simd: S,
    dy: TileView,
    x: TileView,
    count: usize,
    out: &mut [Partial],
) {
    let vectors = TILE / S::F32_LANES;
    let mut acc = [[simd.splat_f32s(0.0); BLOCK]; WIDE];
    for tile in 0..count {
        let dy = dy.block::<S>(tile, BLOCK);
        let x = x.block::<S>(tile, WIDE);
        for v in 0..vectors {
            let d = [dy[v], dy[vectors + v], dy[2 * vectors + v], dy[3 * vectors + v]];
            for k in 0..WIDE {
                let x = x[k * vectors + v];
                for j in 0..BLOCK {
                    acc[k][j] = simd.mul_add_e_f32s(d[j], x, acc[k][j]);
                }
            }
        }
    }
    add_sums(simd, &acc, out);
}

/// Adds Σ over samples of dy[j] to `out`.
#[inline(always)]
fn bias_gradient<S: Simd>(simd: S, dy: TileView, count: usize, out: &mut Partial) {
    let vectors = TILE / S::F32_LANES;
    // Sums of their own for every third vector, so that none waits for the one before it.
    let mut acc = [[simd.splat_f32s(0.0); BLOCK]; 3];
    for tile in 0..count {
        let dy = dy.block::<S>(tile, BLOCK);
        for v in 0..vectors {
            for j in 0..BLOCK {
                acc[v % 3][j] = simd.add_f32s(acc[v % 3][j], dy[j * vectors + v]);
            }
        }
    }
    for j in 0..BLOCK {
        acc[0][j] = simd.add_f32s(acc[0][j], simd.add_f32s(acc[1][j], acc[2][j]));
    }
    add_sums(simd, &[acc[0]], std::slice::from_mut(out));
}

/// Adds the lanes of four vectors each to `out`, as far as they are summed there.
#[inline(always)]
fn add_sums<S: Simd, const N: usize>(simd: S, vectors: &[[S::f32s; BLOCK]; N], out: &mut [Partial]) {
    if S::F32_LANES == BLOCK * BLOCK {
        let mut rows = [[[0.0; BLOCK * BLOCK]; BLOCK]; N];
        for (rows, vectors) in rows.iter_mut().zip(vectors) {
            for j in 0..BLOCK {
                S::as_mut_simd_f32s(&mut rows[j]).0[0] = vectors[j];
            }
        }
        return add_quarter_sums(&rows, out);
    }
    // Plain loops: a closure behind `map` may be compiled without the caller's vector features.
    for (out, vectors) in out.iter_mut().zip(vectors) {
        for j in 0..BLOCK {
            out[j] += simd.reduce_sum_f32s(vectors[j]);
        }
    }
}
