//! One stream of the field: encoding → trunk → (density, geometry features) → head → (colour, uncertainty).
//!
//! All three streams are this network; they differ in what it is conditioned on. The persistent stream's head sees
//! the viewing direction; the trunks of the dynamic and the actor stream see the frame's code (DESIGN: z^d_t, z^a_t).

use std::ops::Range;

use glam::Vec3;
use pulp::Simd;

use super::batch::StreamBatch;
use super::config::Widths;
use super::encoding::Encoding;
use super::hashgrid::{FEATURES, Row};
use super::mlp::{Activations, Mlp, Packed};
use crate::simd::floats::{Column, ColumnMut};
use crate::simd::matrix::Unit;
use crate::simd::{AlignedVec, TILE, transposed};

/// Raw densities are clamped to this before the exponential, so that neither σ nor its gradient overflows.
const RAW_SIGMA_LIMIT: f32 = 15.0;

/// Largest uncertainty of a stream, in colour units.
///
/// NeuralDiff's softplus has no bound, so that a trace of density with an enormous β can excuse any error; bounded, a
/// stream must really stand in front of a pixel to excuse it.
pub(crate) const BETA_MAX: f32 = 0.1;

/// Shape of one stream's network.
#[derive(Clone, Debug, PartialEq)]
pub struct StreamNet {
    /// Encoding of the position.
    pub encoding: Encoding,
    /// (encoding, code) → (raw density, geometry features).
    pub trunk: Mlp,
    /// (geometry features, view) → (raw colour, raw uncertainty).
    pub head: Mlp,
    /// Width of the frame code that the trunk sees; 0 for none.
    pub code: usize,
    /// Width of the view encoding that the head sees; 0 for none.
    pub view: usize,
    /// Added to the raw density: the field starts nearly empty.
    pub density_bias: f32,
}

/// A stream's networks as the kernels read them during one step.
pub struct StreamWeights<'a> {
    /// Packed trunk.
    pub trunk: &'a Packed,
    /// Packed head.
    pub head: &'a Packed,
}

/// What a stream says about each of a chunk's samples, and on the way back the loss's gradient with respect to it; as columns.
#[derive(Clone, Default)]
pub struct StreamSamples {
    /// σ, 1/unit.
    pub sigma: AlignedVec,
    /// Colour, 0–1.
    pub rgb: [AlignedVec; 3],
    /// Uncertainty β ≥ 0.
    pub beta: AlignedVec,
}

impl StreamSamples {
    fn columns(&mut self) -> impl Iterator<Item = &mut AlignedVec> {
        self.rgb.iter_mut().chain([&mut self.sigma, &mut self.beta])
    }

    /// Zeros for `n` samples.
    pub fn reset(&mut self, n: usize) {
        self.columns().for_each(|column| column.zero(n));
    }

    /// Room for `n` samples; what is there already is left.
    pub fn reserve(&mut self, n: usize) {
        self.columns().for_each(|column| column.reserve_len(n));
    }
}

/// What becomes of the activations of a batch's tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tiles {
    /// Every tile takes the place of the one before it, which stays near the core.
    Passing,
    /// All are kept, for the way back or for [`StreamNet::forward`] after [`StreamNet::density`].
    Kept,
    /// They are there already, kept by [`StreamNet::density`], whose work is not done again.
    Known,
}

/// Activations of one stream's networks over the samples of a chunk.
#[derive(Default)]
pub struct StreamActivations {
    trunk: Activations,
    head: Activations,
}

impl StreamActivations {
    /// Forgets gradients that nobody has asked for.
    pub fn clear(&mut self) {
        self.trunk.clear();
        self.head.clear();
    }
}

impl StreamNet {
    /// Assembles the network around an encoding.
    pub fn new(encoding: Encoding, widths: &Widths, code: usize, view: usize, bias: f32) -> Self {
        let mut trunk = vec![encoding.width() + code];
        trunk.extend(std::iter::repeat_n(widths.hidden, widths.layers));
        trunk.push(widths.geometry);
        let trunk = Mlp::with_skip(&trunk, widths.skip);
        let head = Mlp::new(&[trunk.output() + view, widths.head, 4]).with_given(view);
        Self { encoding, trunk, head, code, view, density_bias: bias }
    }

    /// Evaluates all samples of an encoded `batch`; `code` and `view` give the conditioning of a ray.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub fn forward<'c, S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        batch: &StreamBatch,
        activations: &mut StreamActivations,
        tiles: Tiles,
        code: impl Fn(usize) -> &'c [f32],
        view: impl Fn(usize) -> &'c [f32],
        out: &mut StreamSamples,
    ) {
        let unit = Unit::detect();
        let StreamActivations { trunk, head } = activations;
        let known = tiles == Tiles::Known && w.trunk.keeps_tiles();
        let kept = if tiles == Tiles::Passing { 1 } else { batch.pos.len() };
        if !known {
            self.trunk.reserve(w.trunk, kept, trunk);
        }
        self.head.reserve(w.head, kept, head);
        for (tile, lanes) in batch.sample.chunks(TILE).enumerate() {
            let n = if tiles == Tiles::Passing { 0 } else { tile };
            if !known {
                self.trunk_forward(simd, &unit, w, batch, tile, trunk, n, &code, self.trunk.output());
            }
            let geometry = trunk.output(n);
            let (features, rest) = head.input(n).split_at_mut(geometry.len());
            features.copy_from_slice(geometry);
            condition(rest, self.view, batch.rays(tile), &view);
            self.head.forward(simd, &unit, w.head, head, n);
            let mut sigma = [0.0; TILE];
            self.densities(simd, geometry, &mut sigma);
            let mut rest = [0.0; 4 * TILE];
            let (raw, mut rows) = (Column::new(simd, head.output(n)), ColumnMut::new(simd, &mut rest));
            for v in 0..4 * TILE / S::F32_LANES {
                rows.set(v, raw.at(v).sigmoid());
            }
            let (rows, _) = rest.as_chunks::<TILE>();
            for (lane, &s) in lanes.iter().enumerate() {
                let s = s as usize;
                out.sigma[s] = sigma[lane];
                for c in 0..3 {
                    out.rgb[c][s] = rows[c][lane];
                }
                out.beta[s] = BETA_MAX * rows[3][lane];
            }
        }
    }

    /// Densities alone of all samples of an encoded `batch`, in lane order; colours and uncertainty are not computed. What can
    /// be is kept, if that is asked for, so that some of the samples, by [`Self::retain`], can go through [`Self::forward`].
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub fn density<'c, S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        batch: &StreamBatch,
        activations: &mut StreamActivations,
        tiles: Tiles,
        code: impl Fn(usize) -> &'c [f32],
        out: &mut [f32],
    ) {
        let unit = Unit::detect();
        let trunk = &mut activations.trunk;
        let kept = tiles == Tiles::Kept && w.trunk.keeps_tiles();
        let (room, outputs) = if kept { (batch.pos.len(), self.trunk.output()) } else { (1, 1) };
        self.trunk.reserve(w.trunk, room, trunk);
        for (tile, out) in out[..batch.len()].chunks_mut(TILE).enumerate() {
            let n = if kept { tile } else { 0 };
            self.trunk_forward(simd, &unit, w, batch, tile, trunk, n, &code, outputs);
            let mut sigma = [0.0; TILE];
            self.densities(simd, trunk.output(n), &mut sigma);
            out.copy_from_slice(&sigma[..out.len()]);
        }
    }

    /// Densities of the samples of a tile, of which the first row of the trunk's `output` tells.
    #[inline(always)]
    fn densities<S: Simd>(&self, simd: S, output: &[f32], out: &mut [f32; TILE]) {
        let (raw, mut out) = (Column::new(simd, &output[..TILE]), ColumnMut::new(simd, out));
        for n in 0..TILE / S::F32_LANES {
            let limited = (raw.at(n) + self.density_bias).clamp(-RAW_SIGMA_LIMIT, RAW_SIGMA_LIMIT);
            out.set(n, limited.exp());
        }
    }

    /// Leaves the samples of `batch` of whose number in the chunk `keep` is true, with what [`Self::density`] has found
    /// out about them.
    #[inline(always)]
    pub fn retain(
        &self,
        w: &StreamWeights,
        batch: &mut StreamBatch,
        activations: &mut StreamActivations,
        keep: impl Fn(usize) -> bool,
    ) {
        // Networks that keep their tiles have read the encoding.
        batch.retain(keep, !w.trunk.keeps_tiles());
        if w.trunk.keeps_tiles() {
            self.trunk.retain(&mut activations.trunk, &batch.kept);
        }
    }

    /// The trunk on tile `tile` of a batch, as tile `n` of the activations: its first `outputs` outputs.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn trunk_forward<'c, S: Simd>(
        &self,
        simd: S,
        unit: &Unit,
        w: &StreamWeights,
        batch: &StreamBatch,
        tile: usize,
        trunk: &mut Activations,
        n: usize,
        code: &impl Fn(usize) -> &'c [f32],
        outputs: usize,
    ) {
        let (features, rest) = trunk.input(n).split_at_mut(self.encoding.width() * TILE);
        for (level, out) in batch.levels.iter().zip(features.chunks_exact_mut(FEATURES * TILE)) {
            level.read_tile(tile, out);
        }
        condition(rest, self.code, batch.rays(tile), code);
        self.trunk.forward_first(simd, unit, w.trunk, trunk, n, outputs);
    }

    /// Back-propagates through the evaluation that [`Self::forward`] left in `activations`.
    ///
    /// `values` are its outputs, `grad` the loss's gradient with respect to them. Keeps the parameter gradients of trunk
    /// and head for [`Self::finish`], and replaces the encoding in `batch` by the gradient with respect to it. Calls `code(ray, component,
    /// gradient)` for every run of lanes of a ray, with the gradients of four components from `component` on, and, if the batch has
    /// slopes, `position(ray, sample, gradient)` for every lane.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub fn backward<S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        batch: &mut StreamBatch,
        activations: &mut StreamActivations,
        values: &StreamSamples,
        grad: &StreamSamples,
        mut code: impl FnMut(usize, usize, Row),
        mut position: impl FnMut(usize, usize, Vec3),
    ) {
        let unit = Unit::detect();
        let StreamActivations { trunk, head } = activations;
        let StreamBatch { sample, ray, levels, slopes, .. } = batch;
        let tiles = sample.len().div_ceil(TILE);
        self.trunk.reserve_backward::<S>(tiles, trunk);
        self.head.reserve_backward::<S>(tiles, head);
        for (n, (lanes, rays)) in sample.chunks(TILE).zip(ray.chunks(TILE)).enumerate() {
            let mut raw = [[0.0; TILE]; 5];
            for (lane, &s) in lanes.iter().enumerate() {
                let s = s as usize;
                raw[0][lane] = grad.sigma[s] * values.sigma[s];
                for c in 0..3 {
                    let v = values.rgb[c][s];
                    raw[1 + c][lane] = grad.rgb[c][s] * v * (1.0 - v);
                }
                raw[4][lane] = grad.beta[s] * values.beta[s] * (1.0 - values.beta[s] / BETA_MAX);
            }
            for (out, raw) in head.output_grad().chunks_exact_mut(TILE).zip(&raw[1..]) {
                out.copy_from_slice(raw);
            }
            self.head.backward(simd, &unit, w.head, head, n);
            let out = trunk.output_grad();
            out.copy_from_slice(&head.input_grad()[..self.trunk.output() * TILE]);
            for (d, raw) in out.iter_mut().zip(&raw[0]) {
                *d += raw;
            }
            self.trunk.backward(simd, &unit, w.trunk, trunk, n);
            let (features, rest) = trunk.input_grad().split_at(self.encoding.width() * TILE);
            for (level, g) in levels.iter_mut().zip(features.chunks_exact(FEATURES * TILE)) {
                level.write_tile(n, g);
            }
            for (ray, run) in runs(rays) {
                for k in (0..self.code).step_by(FEATURES) {
                    code(ray, k, sum_lanes(&rest[k * TILE..], run.clone()));
                }
            }
            if *slopes {
                for (lane, s) in lanes.iter().enumerate() {
                    let mut sum = Vec3::ZERO;
                    for level in levels.iter() {
                        let (g, [x, y, z]) = (level.rows[n * TILE + lane], level.slopes[n * TILE + lane]);
                        sum += Vec3::new(g.dot(x), g.dot(y), g.dot(z));
                    }
                    position(rays[lane] as usize, *s as usize, sum);
                }
            }
        }
    }

    /// Adds the parameter gradients of trunk and head of all batches that have gone [`Self::backward`] to `trunk_grad` and
    /// `head_grad`.
    #[inline(always)]
    pub fn finish<S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        activations: &mut StreamActivations,
        [trunk_grad, head_grad]: [&mut [f32]; 2],
    ) {
        self.trunk.finish(simd, w.trunk, &mut activations.trunk, trunk_grad);
        self.head.finish(simd, w.head, &mut activations.head, head_grad);
    }
}

/// Fills the conditioning rows of a tile, ray by ray.
#[inline(always)]
fn condition<'c>(rows: &mut [f32], width: usize, rays: &[u32], of: impl Fn(usize) -> &'c [f32]) {
    if width == 0 {
        return;
    }
    let whole = width - width % FEATURES;
    for (n, rays) in rays.chunks(FEATURES).enumerate() {
        // Lanes behind the last are nobody's.
        let of: [_; FEATURES] = std::array::from_fn(|k| of(rays[k.min(rays.len() - 1)] as usize));
        let first = n * FEATURES;
        for k in (0..whole).step_by(FEATURES) {
            let at = |lane: usize| Row::from_slice(&of[lane][k..][..FEATURES]);
            let columns = transposed([at(0), at(1), at(2), at(3)]);
            for row in 0..FEATURES {
                rows[(k + row) * TILE + first..][..FEATURES].copy_from_slice(&columns[row].to_array());
            }
        }
        for k in whole..width {
            for lane in 0..FEATURES {
                rows[k * TILE + first + lane] = of[lane][k];
            }
        }
    }
}

/// Sums of some lanes of four rows of a tile.
#[inline(always)]
fn sum_lanes(rows: &[f32], lanes: Range<usize>) -> Row {
    let (mut sum, mut lane) = (Row::ZERO, lanes.start);
    let four = |k: usize, lane: usize| Row::from_slice(&rows[k * TILE + lane..][..FEATURES]);
    while lane + FEATURES <= lanes.end {
        let [a, b, c, d] = transposed([four(0, lane), four(1, lane), four(2, lane), four(3, lane)]);
        sum += (a + b) + (c + d);
        lane += FEATURES;
    }
    for lane in lane..lanes.end {
        sum += Row::new(rows[lane], rows[TILE + lane], rows[2 * TILE + lane], rows[3 * TILE + lane]);
    }
    sum
}

/// Rays of a tile, and the lanes that each has there.
#[inline(always)]
fn runs(rays: &[u32]) -> impl Iterator<Item = (usize, Range<usize>)> + '_ {
    let mut start = 0;
    rays.chunk_by(|a, b| a == b).map(move |run| {
        start += run.len();
        (run[0] as usize, start - run.len()..start)
    })
}

/// Where one stream's dense parameters are in the field's flat weight vector.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StreamRanges {
    /// Trunk.
    pub trunk: Range<usize>,
    /// Head.
    pub head: Range<usize>,
    /// Γ of the frame code; empty without one.
    pub code: Range<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::batch::tests::encoded;
    use crate::field::mlp::Arithmetic;
    use crate::field::{EncodingKind, Field, Stream};
    use crate::rng::Rng;
    use crate::train::testing;

    /// What a stream says of the samples `keep` of a batch, first asked for the density of all of them if their tiles are known.
    struct Said<'a> {
        field: &'a Field,
        arithmetic: Arithmetic,
        keep: fn(usize) -> bool,
        tiles: Tiles,
    }

    impl pulp::WithSimd for Said<'_> {
        type Output = StreamSamples;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> StreamSamples {
            let Self { field, arithmetic, keep, tiles } = self;
            let first = tiles == Tiles::Known;
            let (net, r) =
                (field.net(Stream::Dynamic).expect("all streams are on"), &field.layout.streams[1]);
            let [trunk, head] = [(&net.trunk, &r.trunk), (&net.head, &r.head)]
                .map(|(net, range)| net.pack_for(&field.weights[range.clone()], arithmetic));
            let w = StreamWeights { trunk: &trunk, head: &head };
            let (mut activations, mut out) = (StreamActivations::default(), StreamSamples::default());
            out.reset(COUNT);
            let (code, view) = (|_: usize| &[0.3; 64][..], |_: usize| &[0.2; 64][..]);
            let mut batch = encoded((0..COUNT).filter(|n| first || keep(*n)), false);
            if first {
                let mut sigma = vec![0.0; COUNT];
                net.density(simd, &w, &batch, &mut activations, Tiles::Kept, code, &mut sigma);
                net.retain(&w, &mut batch, &mut activations, keep);
            }
            net.forward(simd, &w, &batch, &mut activations, tiles, code, view, &mut out);
            out
        }
    }

    /// Samples of a batch.
    const COUNT: usize = 200;

    #[test]
    fn what_is_known_or_not_kept_says_the_same() {
        let mut field = Field::zeros(testing::shape(&testing::config_of(EncodingKind::Hash)));
        let mut rng = Rng::new(4, 0, 0);
        field.weights.iter_mut().for_each(|w| *w = rng.uniform() - 0.5);
        let keeps: [fn(usize) -> bool; 4] = [|_| false, |n| n % 90 == 7, |n| n % 3 > 0, |_| true];
        for arithmetic in [Arithmetic::Single, Arithmetic::Rounded, Arithmetic::Matrix] {
            for keep in keeps {
                let said = |tiles| {
                    let out = pulp::Arch::new().dispatch(Said { field: &field, arithmetic, keep, tiles });
                    let StreamSamples { sigma, rgb: [r, g, b], beta } = out;
                    [sigma, r, g, b, beta].map(|column| column.to_vec())
                };
                assert_eq!(said(Tiles::Known), said(Tiles::Kept));
                assert_eq!(said(Tiles::Passing), said(Tiles::Kept));
            }
        }
    }
}
