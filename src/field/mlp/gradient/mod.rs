//! Gradients of weights: sums over samples of an output's gradient times an input.
//!
//! Vectors of samples are what tiles hold, but then a sum over lanes is left for every weight ([`by_samples`]); where registers are
//! few, it weighs too much, and vectors of outputs are made first ([`by_outputs`]). With factors that are rounded to bf16 it weighs least,
//! since a vector holds twice as many samples ([`by_pairs`]).

mod by_outputs;
mod by_pairs;
mod by_samples;

use pulp::Simd;

use super::{Layer, is_like_avx2, parameters};
use crate::simd::matrix::Pairs;
use crate::simd::{AlignedVec, TILE};

/// Most tiles whose gradients are kept until those of the weights are summed: with what was evaluated there, they stay near
/// the core, and a sum over fewer would not be worth its end.
#[inline(always)]
pub fn strip<S: Simd>(rounded: bool) -> usize {
    if rounded {
        12
    } else if is_like_avx2::<S>() {
        // Sums have no end, so that the nearest cache may decide.
        2
    } else {
        // Six inputs and four outputs of as many tiles fit a nearest cache of 32 KiB.
        9
    }
}

/// Sums of parameters' gradients, in whatever order the arithmetic has them.
#[derive(Default)]
pub struct Sums {
    values: AlignedVec,
    any: bool,
    /// What vectors of outputs, or of rounded numbers, are made in.
    panel: AlignedVec,
}

impl Sums {
    /// Forgets them.
    pub fn clear(&mut self) {
        self.any = false;
    }

    /// Those of `len` parameters or parts of them; where there were none, zeros.
    pub fn of(&mut self, len: usize) -> &mut [f32] {
        if !std::mem::replace(&mut self.any, true) {
            self.values.zero(len);
        }
        &mut self.values[..len]
    }

    /// Adds the gradients of a strip.
    #[inline(always)]
    pub fn add<S: Simd>(&mut self, simd: S, layers: &[Layer], strip: Strip) {
        let mut panel = std::mem::take(&mut self.panel);
        if is_like_avx2::<S>() {
            by_outputs::accumulate(simd, layers, strip, self.of(by_outputs::len(layers)), &mut panel);
        } else {
            by_samples::accumulate(simd, layers, strip, self.of(parameters(layers)));
        }
        self.panel = panel;
    }

    /// As [`Self::add`], of a strip that is rounded to bf16, in pairs of rows: always one or the other.
    #[inline(always)]
    pub fn add_rounded(&mut self, layers: &[Layer], strip: Strip<Pairs>) {
        let mut panel = std::mem::take(&mut self.panel);
        by_pairs::accumulate(layers, strip, self.of(parameters(layers)), &mut panel);
        self.panel = panel;
    }

    /// Adds what has been summed, by [`Self::add_rounded`] if it is `rounded` and else by [`Self::add`], to `out`, in the order of the
    /// parameters, and forgets it.
    #[inline(always)]
    pub fn unpack<S: Simd>(&mut self, layers: &[Layer], rounded: bool, out: &mut [f32]) {
        if std::mem::take(&mut self.any) {
            let by_outputs = is_like_avx2::<S>() && !rounded;
            let unpack = if by_outputs { by_outputs::unpack } else { by_samples::unpack };
            unpack(layers, &self.values, out);
        }
    }

    /// Adds them to `out`, whose order they have, and forgets them.
    pub fn add_to(&mut self, out: &mut [f32]) {
        if std::mem::take(&mut self.any) {
            out.iter_mut().zip(&*self.values).for_each(|(out, sum)| *out += sum);
        }
    }
}

/// Of the inputs that are left (an even number) those of which sums fit the registers beside each other: the more, the less is loaded
/// for a product.
#[inline(always)]
fn inputs_together(left: usize) -> usize {
    match left {
        // Two fours rather than a two at the end.
        2 | 4 | 8 => left.min(4),
        _ => 6,
    }
}

/// Tiles that have gone back through the networks and whose parameter gradients are yet to be summed.
#[derive(Clone, Copy)]
pub struct Strip<'a, T = f32> {
    /// Their activations.
    pub values: TileView<'a, T>,
    /// The gradients of those.
    pub grads: TileView<'a, T>,
    /// How many they are.
    pub count: usize,
}

impl<'a> Strip<'a> {
    /// What goes into a layer, and the gradients of what comes out of it.
    #[inline(always)]
    fn of(self, layer: &Layer) -> [TileView<'a>; 2] {
        [self.values.rows(layer.row), self.grads.rows(layer.row + layer.n_in)]
    }
}

/// The same rows of many tiles: `data[tile * stride + row * TILE ..]`.
#[derive(Clone, Copy)]
pub struct TileView<'a, T = f32> {
    /// Tiles one after the other.
    pub data: &'a [T],
    /// Numbers from one tile to the next.
    pub stride: usize,
    /// Offset of row 0 within a tile.
    pub offset: usize,
}

impl<'a, T: Copy> TileView<'a, T> {
    /// The same from row `row` on.
    #[inline(always)]
    fn rows(self, row: usize) -> Self {
        Self { offset: self.offset + row * TILE, ..self }
    }

    /// The first `rows` rows of tile `tile`.
    #[inline(always)]
    fn of(self, tile: usize, rows: usize) -> &'a [T] {
        &self.data[tile * self.stride + self.offset..][..rows * TILE]
    }
}
