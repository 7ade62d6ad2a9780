//! The autoencoder: LangSplat's way of making descriptors short (Qin et al. 2024), with networks of our size.
//!
//! Two small networks with ReLU, trained together on the scene's own descriptors:
//! loss = |x − x̂|² + 1 − cos(x, x̂) per descriptor. Unlike a linear map it cannot be queried without decompressing.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::error::CompressError;
use crate::field::mlp::{Activations, Mlp, Packed, Precision};
use crate::rng::Rng;
use crate::simd::TILE;
use crate::simd::matrix::Unit;
use crate::train::adam::{self, Moments, StepSize};

/// Tiles of a training step, each with its own gradient: sums are taken in the same order on any machine.
const TILES: usize = 8;

/// How an autoencoder is made and trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutoencoderConfig {
    /// Widths of the encoder's hidden layers; the decoder has them in reverse.
    pub hidden: Vec<usize>,
    /// Training steps of 384 descriptors.
    pub steps: u64,
    /// Adam's first step size; it falls to zero along a cosine.
    pub rate: f32,
}

impl Default for AutoencoderConfig {
    fn default() -> Self {
        Self { hidden: vec![128, 64], steps: 1500, rate: 2e-3 }
    }
}

/// A trained autoencoder.
#[derive(Clone, Debug, PartialEq)]
pub struct Autoencoder {
    full: usize,
    dim: usize,
    encoder: Mlp,
    decoder: Mlp,
    /// Subtracted from descriptors before they go in, `[full]`.
    pub(super) mean: Vec<f32>,
    /// Weights of the encoder, then of the decoder.
    pub(super) weights: Vec<f32>,
}

impl Autoencoder {
    fn untrained(full: usize, dim: usize, hidden: &[usize]) -> Self {
        let widths = |ends: [usize; 2], hidden: Vec<usize>| {
            let all: Vec<usize> = [vec![ends[0]], hidden, vec![ends[1]]].concat();
            Mlp::new(&all)
        };
        // Descriptors are what they are.
        let encoder = widths([full, dim], hidden.to_vec());
        let given = encoder.input();
        let encoder = encoder.with_given(given);
        let decoder = widths([dim, full], hidden.iter().rev().copied().collect());
        Self { full, dim, encoder, decoder, mean: vec![0.0; full], weights: Vec::new() }
    }

    /// Trains on `rows` `[n, full]`, finite and not empty.
    ///
    /// # Errors
    /// [`CompressError::Setting`] if training leaves the range of f32.
    pub(super) fn train(
        rows: &[f32],
        full: usize,
        dim: usize,
        config: &AutoencoderConfig,
        seed: u64,
    ) -> Result<Self, CompressError> {
        let mut this = Self::untrained(full, dim, &config.hidden);
        let count = rows.len() / full;
        for row in rows.chunks_exact(full) {
            this.mean.iter_mut().zip(row).for_each(|(m, v)| *m += v / count as f32);
        }
        let mut rng = Rng::new(seed, AUTOENCODER_STREAM, 0);
        this.weights = [&this.encoder, &this.decoder].map(|net| net.init(|| rng.uniform())).concat();
        let mut moments = Moments::new(this.weights.len());
        let mut gradients = vec![vec![0.0; this.weights.len()]; TILES];
        let arch = Arch::new();
        for step in 1..=config.steps {
            let packed = this.pack();
            gradients.par_iter_mut().enumerate().for_each(|(tile, gradient)| {
                let mut pick = Rng::new(seed, AUTOENCODER_STREAM + step, 1 + tile as u64);
                let picked: [usize; TILE] = std::array::from_fn(|_| pick.below(count));
                arch.dispatch(TrainTile { of: &this, packed: &packed, rows, picked, gradient });
            });
            let (sum, others) = gradients.split_at_mut(1);
            for other in others {
                sum[0].iter_mut().zip(other).for_each(|(s, g)| *s += *g);
            }
            sum[0].iter_mut().for_each(|g| *g /= (TILES * TILE) as f32);
            let turn = std::f32::consts::PI * step as f32 / config.steps as f32;
            let rate = StepSize::new(config.rate * 0.5 * (1.0 + turn.cos()), step);
            adam::update(&mut this.weights, &gradients[0], &mut moments.first, &mut moments.second, rate);
        }
        match this.weights.iter().all(|w| w.is_finite()) {
            true => Ok(this),
            false => Err(CompressError::Setting {
                name: "autoencoder.rate",
                value: config.rate.to_string(),
                remedy: "training diverged: choose a smaller rate",
            }),
        }
    }

    /// A stored autoencoder.
    ///
    /// # Errors
    /// [`CompressError::Stored`] if an array has the wrong length or is not finite.
    pub(super) fn checked(
        full: usize,
        dim: usize,
        hidden: &[usize],
        mean: Vec<f32>,
        weights: Vec<f32>,
    ) -> Result<Self, CompressError> {
        let this = Self::untrained(full, dim, hidden);
        let expected = [full, this.encoder.parameters() + this.decoder.parameters()];
        for ((name, values), expected) in [("mean", &mean), ("weights", &weights)].into_iter().zip(expected) {
            if values.len() != expected || values.iter().any(|v| !v.is_finite()) {
                let what = "has the wrong length or is not finite".to_owned();
                return Err(CompressError::Stored { name: name.into(), what });
            }
        }
        Ok(Self { mean, weights, ..this })
    }

    /// Numbers per descriptor before compression.
    pub fn full(&self) -> usize {
        self.full
    }

    /// Numbers per descriptor after it.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Codes of `rows` `[n, full]`, to `out` `[n, dim]`.
    pub fn encode(&self, rows: &[f32], out: &mut [f32]) {
        let [packed, _] = self.pack();
        let nets = Half { net: &self.encoder, packed: &packed, from: self.full, to: self.dim };
        let mut centred = rows.to_vec();
        for row in centred.chunks_exact_mut(self.full) {
            row.iter_mut().zip(&self.mean).for_each(|(x, m)| *x -= m);
        }
        Arch::new().dispatch(RunHalf { half: nets, rows: &centred, out });
    }

    /// Descriptors of `codes` `[n, dim]`, to `out` `[n, full]`. Not normalised.
    pub fn decode(&self, codes: &[f32], out: &mut [f32]) {
        let [_, packed] = self.pack();
        let nets = Half { net: &self.decoder, packed: &packed, from: self.dim, to: self.full };
        Arch::new().dispatch(RunHalf { half: nets, rows: codes, out });
    }

    /// Widths of the encoder's hidden layers.
    pub(super) fn hidden(&self) -> &[usize] {
        let widths = self.encoder.widths();
        &widths[1..widths.len() - 1]
    }

    fn pack(&self) -> [Packed; 2] {
        let (encoder, decoder) = self.weights.split_at(self.encoder.parameters());
        // The whole point is a small error: bf16 would add its own.
        [self.encoder.pack(encoder, Precision::F32), self.decoder.pack(decoder, Precision::F32)]
    }
}

/// Random numbers of autoencoders, apart from those of fields.
const AUTOENCODER_STREAM: u64 = 0xAE00_0000_0000;

#[derive(Clone, Copy)]
struct Half<'a> {
    net: &'a Mlp,
    packed: &'a Packed,
    /// Numbers per row in; the network's input may be wider by up to three zeros.
    from: usize,
    /// Numbers per row out.
    to: usize,
}

struct RunHalf<'a> {
    half: Half<'a>,
    rows: &'a [f32],
    out: &'a mut [f32],
}

impl WithSimd for RunHalf<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Half { net, packed, from, to } = self.half;
        let (unit, mut tile) = (Unit::detect(), Activations::default());
        net.reserve(packed, 1, &mut tile);
        for (rows, out) in self.rows.chunks(TILE * from).zip(self.out.chunks_mut(TILE * to)) {
            let input = tile.input(0);
            input.fill(0.0);
            for (lane, row) in rows.chunks_exact(from).enumerate() {
                for (i, v) in row.iter().enumerate() {
                    input[i * TILE + lane] = *v;
                }
            }
            net.forward(simd, &unit, packed, &mut tile, 0);
            for (lane, out) in out.chunks_exact_mut(to).enumerate() {
                for (i, v) in out.iter_mut().enumerate() {
                    *v = tile.output(0)[i * TILE + lane];
                }
            }
        }
    }
}

/// Forward and backward for 48 descriptors; `gradient` is overwritten.
struct TrainTile<'a> {
    of: &'a Autoencoder,
    packed: &'a [Packed; 2],
    rows: &'a [f32],
    picked: [usize; TILE],
    gradient: &'a mut [f32],
}

impl WithSimd for TrainTile<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let (encoder, decoder, full) = (&self.of.encoder, &self.of.decoder, self.of.full);
        let (unit, [pack_encoder, pack_decoder]) = (Unit::detect(), self.packed);
        let (mut code, mut back) = (Activations::default(), Activations::default());
        encoder.reserve(pack_encoder, 1, &mut code);
        decoder.reserve(pack_decoder, 1, &mut back);
        let input = code.input(0);
        input.fill(0.0);
        for (lane, n) in self.picked.iter().enumerate() {
            for i in 0..full {
                input[i * TILE + lane] = self.rows[n * full + i] - self.of.mean[i];
            }
        }
        encoder.forward(simd, &unit, pack_encoder, &mut code, 0);
        back.input(0).copy_from_slice(code.output(0));
        decoder.forward(simd, &unit, pack_decoder, &mut back, 0);
        let output = back.output(0).to_vec();
        decoder.reserve_backward::<S>(1, &mut back);
        encoder.reserve_backward::<S>(1, &mut code);
        let grad = back.output_grad();
        grad.fill(0.0);
        loss_gradient(self.rows, &self.picked, full, &output, grad);
        self.gradient.fill(0.0);
        let (of_encoder, of_decoder) = self.gradient.split_at_mut(encoder.parameters());
        decoder.backward(simd, &unit, pack_decoder, &mut back, 0);
        code.output_grad().copy_from_slice(back.input_grad());
        encoder.backward(simd, &unit, pack_encoder, &mut code, 0);
        decoder.finish(simd, pack_decoder, &mut back, of_decoder);
        encoder.finish(simd, pack_encoder, &mut code, of_encoder);
    }
}

/// d/dx̂ of |x − x̂|² + 1 − cos(x, x̂) for the samples of a tile.
#[inline(always)]
fn loss_gradient(rows: &[f32], picked: &[usize; TILE], full: usize, output: &[f32], grad: &mut [f32]) {
    for (lane, n) in picked.iter().enumerate() {
        let x = &rows[n * full..][..full];
        let (mut product, mut norm2, mut own2) = (0.0f32, 1e-12f32, 1e-12f32);
        for (i, x) in x.iter().enumerate() {
            let y = output[i * TILE + lane];
            product += x * y;
            norm2 += y * y;
            own2 += x * x;
        }
        let along = 1.0 / (norm2 * own2).sqrt();
        for (i, x) in x.iter().enumerate() {
            let y = output[i * TILE + lane];
            grad[i * TILE + lane] = 2.0 * (y - x) - along * (x - product / norm2 * y);
        }
    }
}
