//! Sums of vectors of outputs: a panel of columns, sixteen outputs of one sample after the other, times an input of that sample.

use pulp::Simd;

use super::super::Layer;
use super::{Strip, TileView, inputs_together};
use crate::simd::{AlignedVec, TILE, columns};

/// Outputs of a vector.
const LANES: usize = 8;

/// Panels of a layer: the first output of each, and how many there are, of which the last four may be no outputs.
fn panels(layer: &Layer) -> impl Iterator<Item = (usize, usize)> {
    let width = |first: usize| if layer.n_out - first > LANES { 2 * LANES } else { LANES };
    (0..layer.n_out).step_by(2 * LANES).map(move |first| (first, width(first)))
}

/// Numbers that are summed.
pub fn len(layers: &[Layer]) -> usize {
    layers.iter().map(|l| (l.n_in + 1) * l.n_out.next_multiple_of(LANES)).sum()
}

/// Adds the parameter gradients of a strip to `sums`.
///
/// Layer by layer and panel by panel, of all outputs the weights input by input, then the biases.
#[inline(always)]
pub fn accumulate<S: Simd>(
    simd: S,
    layers: &[Layer],
    strip: Strip,
    mut sums: &mut [f32],
    panel: &mut AlignedVec,
) {
    let count = strip.count;
    panel.reserve_len(count * TILE * 2 * LANES);
    for layer in layers {
        let [x, dy] = strip.of(layer);
        for (first, width) in panels(layer) {
            let panel = &mut panel[..count * TILE * width];
            for (tile, panel) in panel.chunks_exact_mut(TILE * width).enumerate() {
                columns(dy.rows(first).of(tile, width.min(layer.n_out - first)), width, panel);
            }
            let out = sums.split_off_mut(..(layer.n_in + 1) * width).unwrap_or_default();
            match width {
                LANES => of_panel::<S, 1>(simd, layer.n_in, x, panel, out),
                _ => of_panel::<S, 2>(simd, layer.n_in, x, panel, out),
            }
        }
    }
}

/// Adds Σ over samples of dy[j] x[i], and Σ dy[j] behind them, to `out`, for the outputs of a panel of `WIDE` vectors.
#[inline(always)]
fn of_panel<S: Simd, const WIDE: usize>(simd: S, n_in: usize, x: TileView, panel: &[f32], out: &mut [f32]) {
    let panel = S::as_simd_f32s(panel).0.as_chunks::<WIDE>().0;
    let (weights, bias) = S::as_mut_simd_f32s(out).0.as_chunks_mut::<WIDE>().0.split_at_mut(n_in);
    let mut i = 0;
    while i < n_in {
        let wide = inputs_together(n_in - i);
        let (x, weights) = (x.rows(i), &mut weights[i..i + wide]);
        match wide {
            6 => products::<S, WIDE, 6>(simd, x, panel, weights),
            4 => products::<S, WIDE, 4>(simd, x, panel, weights),
            _ => products::<S, WIDE, 2>(simd, x, panel, weights),
        }
        i += wide;
    }
    // Sums of their own for every fourth sample, so that none waits for the one before it.
    let mut acc = [[simd.splat_f32s(0.0); WIDE]; 4];
    for dy in panel.as_chunks::<4>().0 {
        for k in 0..4 {
            for v in 0..WIDE {
                acc[k][v] = simd.add_f32s(acc[k][v], dy[k][v]);
            }
        }
    }
    for v in 0..WIDE {
        let [a, b, c, d] = [acc[0][v], acc[1][v], acc[2][v], acc[3][v]];
        let sum = simd.add_f32s(simd.add_f32s(a, b), simd.add_f32s(c, d));
        bias[0][v] = simd.add_f32s(bias[0][v], sum);
    }
}

/// Adds Σ over samples of dy[j] x[k] to `out`, for the outputs of a panel and `INPUTS` inputs.
#[inline(always)]
fn products<S: Simd, const WIDE: usize, const INPUTS: usize>(
    simd: S,
    x: TileView,
    panel: &[[S::f32s; WIDE]],
    out: &mut [[S::f32s; WIDE]],
) {
    let mut acc = [[simd.splat_f32s(0.0); WIDE]; INPUTS];
    acc.copy_from_slice(out);
    for (tile, dy) in panel.as_chunks::<TILE>().0.iter().enumerate() {
        let x = &x.of(tile, INPUTS).as_chunks::<TILE>().0[..INPUTS];
        // Four samples at a time, since counting takes instructions, too.
        for first in (0..TILE).step_by(4) {
            for s in first..first + 4 {
                for k in 0..INPUTS {
                    let x = simd.splat_f32s(x[k][s]);
                    for v in 0..WIDE {
                        acc[k][v] = simd.mul_add_e_f32s(dy[s][v], x, acc[k][v]);
                    }
                }
            }
        }
    }
    out.copy_from_slice(&acc);
}

/// Adds `sums` to `out`, in the order of the parameters.
pub fn unpack(layers: &[Layer], mut sums: &[f32], out: &mut [f32]) {
    for layer in layers {
        let (weights, biases) = out[layer.param..].split_at_mut(layer.weights());
        for (first, width) in panels(layer) {
            let panel = sums.split_off(..(layer.n_in + 1) * width).unwrap_or_default();
            let (rows, bias) = panel.split_at(layer.n_in * width);
            let outputs = weights[first * layer.n_in..].chunks_exact_mut(layer.n_in).take(width);
            for (j, weights) in outputs.enumerate() {
                weights.iter_mut().zip(rows[j..].iter().step_by(width)).for_each(|(w, sum)| *w += sum);
            }
            biases[first..layer.n_out].iter_mut().zip(bias).for_each(|(b, sum)| *b += sum);
        }
    }
}
