//! Networks with bf16 products and f32 sums, on the CPU's matrix units.
//!
//! Activations and gradients stay feature-major, so that the right operand of every product (pairs of features) is
//! made of the f32 rows of the product before it without moving anything between lanes. What backward and the weight
//! gradients need is kept as bf16 rows over all samples of the chunk.

use bytemuck::{cast_slice, cast_slice_mut};

use super::Layer;
use crate::simd::matrix::{Keep, Narrowed, Pairs, TILE_DEPTH, TILE_ROWS, Unit, narrow, widen};
use crate::simd::{AlignedVec, TILE};

/// Rows of a block of weight gradients.
const OUTER: usize = 32;

/// Weights as left operands, padded with zeros to whole tiles.
pub struct Packed {
    layers: Vec<PackedLayer>,
}

struct PackedLayer {
    /// W `[outputs / 16][inputs / 32][16][32]`.
    forward: Vec<u16>,
    /// Wᵀ `[inputs / 16][outputs / 32][16][32]`.
    backward: Vec<u16>,
    bias: Vec<f32>,
    /// First row of its input among the saved activations, and of its output's gradient among the saved gradients.
    x_row: usize,
    dy_row: usize,
}

/// What a chunk's tiles keep for the way back; rows run over all samples of the chunk.
#[derive(Default)]
pub struct Saved {
    /// Samples of a row, whole tiles of the inner dimension.
    capacity: usize,
    /// Inputs of all layers, bf16 `[rows][capacity]`.
    x: AlignedVec,
    /// Gradients of all layers' outputs, likewise.
    dy: AlignedVec,
    /// The operand of the product that is being made, pairs `[features / 2][TILE]`.
    pairs: AlignedVec,
    /// Its result, `[features][TILE]`.
    product: AlignedVec,
    /// Transposed inputs for the weight gradients, pairs.
    columns: [AlignedVec; 2],
}

impl Packed {
    pub(super) fn new(layers: &[Layer], params: &[f32]) -> Self {
        let (mut x_row, mut dy_row) = (0, 0);
        let layers = layers.iter().map(|l| {
            let w = &params[l.param..][..l.weights()];
            let packed = PackedLayer {
                forward: tiles(l.n_out, l.n_in, |o, i| w[o * l.n_in + i]),
                backward: tiles(l.n_in, l.n_out, |i, o| w[o * l.n_in + i]),
                bias: params[l.param + l.weights()..][..l.n_out].to_vec(),
                x_row,
                dy_row,
            };
            x_row += l.n_in.next_multiple_of(OUTER);
            dy_row += l.n_out.next_multiple_of(OUTER);
            packed
        });
        Self { layers: layers.collect() }
    }

    /// Makes room for `tiles` tiles; rows that pad to whole tiles are and stay zero.
    pub(super) fn reserve(&self, layers: &[Layer], tiles: usize, saved: &mut Saved) {
        let needed = (tiles * TILE).next_multiple_of(TILE_DEPTH);
        if needed <= saved.capacity {
            return;
        }
        let rows = |width: fn(&Layer) -> usize| {
            layers.iter().map(|l| width(l).next_multiple_of(OUTER)).sum::<usize>()
        };
        let widest = layers.iter().map(|l| l.n_in.max(l.n_out)).max().unwrap_or(0);
        *saved = Saved {
            capacity: needed,
            x: AlignedVec::zeros(rows(|l| l.n_in) * needed / 2),
            dy: AlignedVec::zeros(rows(|l| l.n_out) * needed / 2),
            pairs: AlignedVec::zeros(widest.next_multiple_of(TILE_DEPTH) / 2 * TILE),
            product: AlignedVec::zeros(widest.next_multiple_of(TILE_ROWS) * TILE),
            columns: [0; 2].map(|_| AlignedVec::zeros(needed / 2 * TILE_ROWS)),
        };
    }

    /// From the input rows of `tile` (`input | output`) to its output rows.
    #[inline(always)]
    pub(super) fn forward(
        &self,
        unit: &Unit,
        layers: &[Layer],
        tile: &mut [f32],
        saved: &mut Saved,
        n: usize,
    ) {
        let Saved { capacity, x, pairs, product, .. } = saved;
        let (x, pairs) = (cast_slice_mut(x), cast_slice_mut(pairs));
        let place = (*capacity, n * TILE);
        let (input, output) = tile.split_at_mut(layers[0].n_in * TILE);
        store(unit, input, &[], Kept::All, pairs, x, place);
        for (n, (layer, packed)) in layers.iter().zip(&self.layers).enumerate() {
            let rows = multiply(unit, &packed.forward, layer.n_in, pairs, product, layer.n_out);
            match self.layers.get(n + 1) {
                Some(next) => {
                    let x = &mut x[next.x_row * *capacity..];
                    store(unit, rows, &packed.bias, Kept::Positive, pairs, x, place);
                    if layers[n + 1].again > 0 {
                        let (pairs, x) =
                            (&mut pairs[layer.n_out / 2 * TILE..], &mut x[layer.n_out * *capacity..]);
                        store(unit, input, &[], Kept::All, pairs, x, place);
                    }
                }
                None => {
                    let rows = rows.as_chunks::<TILE>().0.iter().zip(output.as_chunks_mut::<TILE>().0);
                    for ((row, out), b) in rows.zip(&packed.bias) {
                        for (v, out) in row.iter().zip(out) {
                            *out = v + b;
                        }
                    }
                }
            }
        }
    }

    /// From the output rows of `grad` (`input | output`) to its input rows.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        unit: &Unit,
        layers: &[Layer],
        grad: &mut [f32],
        saved: &mut Saved,
        n: usize,
    ) {
        let Saved { capacity, x, dy, pairs, product, .. } = saved;
        let (x, dy, pairs): (&[u16], &mut [u16], _) =
            (cast_slice(x), cast_slice_mut(dy), cast_slice_mut(pairs));
        let place = (*capacity, n * TILE);
        let (input, output) = grad.split_at_mut(layers[0].n_in * TILE);
        let last = &self.layers[layers.len() - 1];
        let skips = layers.iter().any(|l| l.again > 0);
        store(unit, output, &[], Kept::All, pairs, &mut dy[last.dy_row * *capacity..], place);
        for (n, (layer, packed)) in layers.iter().zip(&self.layers).enumerate().rev() {
            let rows = multiply(unit, &packed.backward, layer.n_out, pairs, product, layer.n_in);
            if n == 0 && skips {
                input.iter_mut().zip(rows).for_each(|(g, row)| *g += row);
                break;
            } else if n == 0 {
                input.copy_from_slice(rows);
                break;
            }
            let (rows, again) = rows.split_at(layer.fresh() * TILE);
            if layer.again > 0 {
                input.copy_from_slice(again);
            }
            let kept = Kept::Where(&x[packed.x_row * *capacity..]);
            let dy = &mut dy[self.layers[n - 1].dy_row * *capacity..];
            store(unit, rows, &[], kept, pairs, dy, place);
        }
    }

    /// Adds the parameter gradients of the first `tiles` tiles to `out`.
    #[inline(always)]
    pub(super) fn accumulate(
        &self,
        unit: &Unit,
        layers: &[Layer],
        saved: &mut Saved,
        tiles: usize,
        out: &mut [f32],
    ) {
        let Saved { capacity, x, dy, columns, .. } = saved;
        let capacity = *capacity;
        clear_after(tiles * TILE, capacity, cast_slice_mut(x));
        clear_after(tiles * TILE, capacity, cast_slice_mut(dy));
        let (x, dy): (&[Pairs], &[u16]) = (cast_slice(x), cast_slice(dy));
        let blocks = (tiles * TILE).div_ceil(TILE_DEPTH);
        let mut product = [[0.0; 256]; 4];
        for (layer, packed) in layers.iter().zip(&self.layers) {
            let (gw, gb) = out[layer.param..].split_at_mut(layer.weights());
            let dy = &dy[packed.dy_row * capacity..];
            for (o, gb) in gb[..layer.n_out].iter_mut().enumerate() {
                *gb += sum(&dy[o * capacity..][..blocks * TILE_DEPTH]);
            }
            for i in (0..layer.n_in).step_by(OUTER) {
                for (half, columns) in columns.iter_mut().enumerate() {
                    let first = packed.x_row + i + half * TILE_ROWS;
                    let columns: &mut [Pairs] = cast_slice_mut(columns);
                    for (block, out) in columns.as_chunks_mut().0.iter_mut().take(blocks).enumerate() {
                        unit.transpose(&x[(first * capacity + block * TILE_DEPTH) / 2..], capacity / 2, out);
                    }
                }
                for o in (0..layer.n_out).step_by(OUTER) {
                    let columns = [cast_slice(&columns[0]), cast_slice(&columns[1])];
                    unit.outer(&dy[o * capacity..], capacity, columns, blocks, &mut product);
                    for j in 0..OUTER.min(layer.n_out - o) {
                        let gw = &mut gw[(o + j) * layer.n_in + i..][..OUTER.min(layer.n_in - i)];
                        for (half, gw) in gw.chunks_mut(TILE_ROWS).enumerate() {
                            let row = &product[j / 16 * 2 + half][j % 16 * 16..];
                            gw.iter_mut().zip(row).for_each(|(g, p)| *g += p);
                        }
                    }
                }
            }
        }
    }
}

/// A matrix as left operand.
fn tiles(rows: usize, depth: usize, at: impl Fn(usize, usize) -> f32) -> Vec<u16> {
    let mut out = Vec::new();
    for row in (0..rows).step_by(TILE_ROWS) {
        for k in (0..depth).step_by(TILE_DEPTH) {
            for n in 0..TILE_ROWS * TILE_DEPTH {
                let (row, k) = (row + n / TILE_DEPTH, k + n % TILE_DEPTH);
                out.push(if row < rows && k < depth { narrow(at(row, k)) } else { 0 });
            }
        }
    }
    out
}

/// Multiplies packed weights with the first `depth` features in `pairs`; the result's first `rows` rows.
#[inline(always)]
fn multiply<'a>(
    unit: &Unit,
    weights: &[u16],
    depth: usize,
    pairs: &mut [Pairs],
    product: &'a mut [f32],
    rows: usize,
) -> &'a [f32] {
    let padded = depth.next_multiple_of(TILE_DEPTH);
    // Zero weights do not undo what is left over from a wider layer if that is not finite.
    pairs[depth / 2 * TILE..padded / 2 * TILE].fill(0);
    let panels = weights.chunks_exact(TILE_ROWS * padded).zip(product.chunks_exact_mut(TILE_ROWS * TILE));
    for (weights, out) in panels {
        unit.panel(weights, &pairs[..padded / 2 * TILE], out);
    }
    &product[..rows * TILE]
}

/// Rounds `rows` `[features][TILE]`, after adding `bias` if there is one, to bf16: as rows of `out` from `column` on, and
/// as operand of the next product.
#[inline(always)]
fn store(
    unit: &Unit,
    rows: &[f32],
    bias: &[f32],
    kept: Kept,
    pairs: &mut [Pairs],
    out: &mut [u16],
    (capacity, column): (usize, usize),
) {
    let pairs = pairs.as_chunks_mut::<TILE>().0;
    for (k, (rows, pairs)) in rows.as_chunks::<{ 2 * TILE }>().0.iter().zip(pairs).enumerate() {
        let at = 2 * k * capacity + column;
        let (low, high) = out[at..].split_at_mut(capacity);
        let (Some(low), Some(high)) = (low.first_chunk_mut(), high.first_chunk_mut()) else { continue };
        let keep = match kept {
            Kept::All => Keep::All,
            Kept::Positive => Keep::Positive,
            Kept::Where(x) => match (x[at..].first_chunk(), x[at + capacity..].first_chunk()) {
                (Some(low), Some(high)) => Keep::Where([low, high]),
                _ => continue,
            },
        };
        let bias = bias.get(2 * k..2 * k + 2).map_or([0.0; 2], |b| [b[0], b[1]]);
        unit.narrow(rows, bias, keep, Narrowed { pairs, rows: [low, high] });
    }
}

/// As [`Keep`], for all rows.
#[derive(Clone, Copy)]
enum Kept<'a> {
    All,
    Positive,
    Where(&'a [u16]),
}

/// Zeros what earlier chunks may have left in the columns that pad `used` to a whole tile.
fn clear_after(used: usize, capacity: usize, rows: &mut [u16]) {
    let end = used.next_multiple_of(TILE_DEPTH).min(capacity);
    for row in rows.chunks_exact_mut(capacity) {
        row[used..end].fill(0);
    }
}

/// Σ of bf16 numbers, sixteen sums at a time.
#[inline(always)]
fn sum(row: &[u16]) -> f32 {
    let mut lanes = [0.0; 16];
    for row in row.chunks_exact(16) {
        for (l, v) in lanes.iter_mut().zip(row) {
            *l += widen(*v);
        }
    }
    lanes.iter().sum()
}
