//! Networks in f32, on vectors of samples.
//!
//! A tile holds all its layers one after the other: `input | layer 1 | layer 2 | ...`, gradients likewise. Before a layer
//! that sees the input again, there is a copy of it.

use pulp::Simd;

use super::{BLOCK, Layer, is_like_avx2};
use crate::simd::{Finish, Product, TILE, multiply, prefetch_rows};

/// Weights in the two orders that the kernels stream through, four outputs (or inputs) side by side.
pub struct Packed {
    pub(super) forward: Vec<f32>,
    pub(super) backward: Vec<f32>,
    pub(super) bias: Vec<f32>,
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
    /// [`BLOCK`]). Meanwhile the tile `ahead` floats behind it may be asked for.
    #[inline(always)]
    pub(super) fn forward<S: Simd>(
        &self,
        simd: S,
        layers: &[Layer],
        tile: &mut [f32],
        outputs: usize,
        ahead: usize,
    ) {
        for (n, layer) in layers.iter().enumerate() {
            let n_out = if n + 1 < layers.len() { layer.n_out } else { outputs };
            if layer.again > 0 {
                tile.copy_within(..layer.again * TILE, (layer.row + layer.fresh()) * TILE);
            }
            let (x, y) = tile[layer.row * TILE..].split_at_mut(layer.n_in * TILE);
            let w = &self.forward[layer.weight..][..layer.n_in * n_out];
            let bias = &self.bias[layer.bias..][..n_out];
            let finish = if n + 1 < layers.len() { Finish::Relu } else { Finish::Plain };
            let ahead = y.as_ptr().wrapping_add(ahead);
            matmul(simd, Product { w, bias, x, finish, ahead }, &mut y[..n_out * TILE]);
        }
    }

    /// Fills the gradient rows of one tile above the output, whose rows the caller has set; of the input's the first `asked`, unless a
    /// layer sees it again. Meanwhile the tile `ahead` floats behind `tile` may be asked for.
    #[inline(always)]
    pub(super) fn backward<S: Simd>(
        &self,
        simd: S,
        layers: &[Layer],
        tile: &[f32],
        grad: &mut [f32],
        asked: usize,
        ahead: usize,
    ) {
        for (n, layer) in layers.iter().enumerate().rev() {
            let (dx, dy) = grad[layer.row * TILE..].split_at_mut(layer.n_in * TILE);
            let w = &self.backward[layer.weight..][..layer.weights()];
            let (fresh, again) = dx.split_at_mut(layer.fresh() * TILE);
            let (w, w_again) = w.split_at(layer.fresh() * layer.n_out);
            let rows = if n > 0 { layer.fresh() } else { asked };
            let (w, fresh) = (&w[..rows * layer.n_out], &mut fresh[..rows * TILE]);
            let dy = &dy[..layer.n_out * TILE];
            let x = &tile[layer.row * TILE..][..rows * TILE];
            let finish = if n > 0 { Finish::Where(x) } else { Finish::Plain };
            let product = Product { w, bias: &[], x: dy, finish, ahead: x.as_ptr().wrapping_add(ahead) };
            matmul(simd, product, fresh);
            if layer.again > 0 {
                matmul(simd, Product { w: w_again, finish: Finish::Plain, ..product }, again);
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

/// As [`multiply`], on any processor.
#[inline(always)]
fn matmul<S: Simd>(simd: S, product: Product, y: &mut [f32]) {
    let vectors = TILE / S::F32_LANES;
    if is_like_avx2::<S>() {
        multiply(product, y);
    } else if S::REGISTER_COUNT < 32 && vectors.is_multiple_of(2) {
        // Sums that do not fit the registers would go through memory.
        matmul_of::<S, 2>(simd, product, y);
    } else {
        matmul_of::<S, 3>(simd, product, y);
    }
}

/// Biases of a block of outputs; without any, zeros.
#[inline(always)]
fn bias_of(bias: &[f32], block: usize) -> [f32; BLOCK] {
    bias.as_chunks().0.get(block).copied().unwrap_or_default()
}

/// [`matmul`], `WIDE` vectors, of which a tile has some multiple, side by side.
#[inline(always)]
fn matmul_of<S: Simd, const WIDE: usize>(simd: S, product: Product, y: &mut [f32]) {
    let Product { w, bias, x, finish, .. } = product;
    let groups = TILE / S::F32_LANES / WIDE;
    let n_in = x.len() / TILE;
    let x = S::as_simd_f32s(x).0.as_chunks::<WIDE>().0;
    let y = S::as_mut_simd_f32s(y).0.as_chunks_mut::<WIDE>().0;
    for group in 0..groups {
        for (block, w) in w.chunks_exact(BLOCK * n_in).enumerate() {
            let mut acc = [[simd.splat_f32s(0.0); WIDE]; BLOCK];
            for (acc, b) in acc.iter_mut().zip(bias_of(bias, block)) {
                *acc = [simd.splat_f32s(b); WIDE];
            }
            let at = block * BLOCK * groups + group;
            // There are more tiles in a chunk than a near cache holds.
            prefetch_rows(y, at, groups);
            if let Finish::Where(x) = finish {
                prefetch_rows(S::as_simd_f32s(x).0.as_chunks::<WIDE>().0, at, groups);
            }
            // Four inputs at a time, since counting takes instructions, too; and without iterators, of which the compiler may
            // leave calls, for which all sums would go through memory.
            let mut from = group;
            for w in w.as_chunks::<{ BLOCK * BLOCK }>().0 {
                let x = &x[from..from + 3 * groups + 1];
                for k in 0..BLOCK {
                    let x = &x[k * groups];
                    for j in 0..BLOCK {
                        let w = simd.splat_f32s(w[k * BLOCK + j]);
                        for v in 0..WIDE {
                            acc[j][v] = simd.mul_add_e_f32s(w, x[v], acc[j][v]);
                        }
                    }
                }
                from += BLOCK * groups;
            }
            finish_rows(simd, &acc, finish, at, groups, y);
        }
    }
}

/// Writes the sums of four rows, finished: `out[at]` and the three that follow it every `stride` are theirs.
///
/// One short loop for each way to finish: the compiler unrolls them, and so keeps the sums in registers.
#[inline(always)]
fn finish_rows<S: Simd, const WIDE: usize>(
    simd: S,
    sums: &[[S::f32s; WIDE]; BLOCK],
    finish: Finish,
    at: usize,
    stride: usize,
    out: &mut [[S::f32s; WIDE]],
) {
    let out = &mut out[at..][..3 * stride + 1];
    let zero = simd.splat_f32s(0.0);
    match finish {
        Finish::Plain => {
            for j in 0..BLOCK {
                out[j * stride] = sums[j];
            }
        }
        Finish::Relu => {
            for j in 0..BLOCK {
                for v in 0..WIDE {
                    out[j * stride][v] = simd.max_f32s(sums[j][v], zero);
                }
            }
        }
        Finish::Where(x) => {
            let x = &S::as_simd_f32s(x).0.as_chunks::<WIDE>().0[at..][..3 * stride + 1];
            for j in 0..BLOCK {
                for v in 0..WIDE {
                    let positive = simd.greater_than_f32s(x[j * stride][v], zero);
                    out[j * stride][v] = simd.select_f32s(positive, sums[j][v], zero);
                }
            }
        }
    }
}
