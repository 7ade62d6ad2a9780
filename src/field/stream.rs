//! One stream of the field: encoding → trunk → (density, geometry features) → head → (colour, uncertainty).
//!
//! All three streams are this network; they differ in what it is conditioned on. The persistent stream's head sees
//! the viewing direction; the trunks of the dynamic and the actor stream see the frame's code (DESIGN: z^d_t, z^a_t).

use std::ops::Range;

use glam::Vec3;
use pulp::Simd;

use super::hashgrid::{FEATURES, HashGrid, Row};
use super::mlp::{Mlp, Packed, TileView};
use crate::simd::{self, AlignedVec, TILE};

/// Width of the trunk's output: raw density, then geometry features for the head.
const GEOMETRY: usize = 16;

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
    pub grid: HashGrid,
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

/// A stream's parameters as the kernels read them during one step.
pub struct StreamWeights<'a> {
    /// One table a level.
    pub tables: &'a [Vec<Row>],
    /// Packed trunk.
    pub trunk: &'a Packed,
    /// Packed head.
    pub head: &'a Packed,
}

/// What a stream says about each of a chunk's samples, and on the way back the loss's gradient with respect to it.
#[derive(Clone, Default)]
pub struct StreamSamples {
    /// σ, 1/unit.
    pub sigma: Vec<f32>,
    /// Colour, 0–1.
    pub rgb: Vec<[f32; 3]>,
    /// Uncertainty β ≥ 0.
    pub beta: Vec<f32>,
}

impl StreamSamples {
    /// Zeros for `n` samples.
    pub fn reset(&mut self, n: usize) {
        self.sigma.clear();
        self.sigma.resize(n, 0.0);
        self.rgb.clear();
        self.rgb.resize(n, [0.0; 3]);
        self.beta.clear();
        self.beta.resize(n, 0.0);
    }
}

/// The samples of a chunk at which one stream is evaluated, and the buffers to do so.
#[derive(Default)]
pub struct StreamBatch {
    /// Which sample of the chunk each lane is.
    pub sample: Vec<u32>,
    /// Positions, tile by tile.
    pos: Vec<[[f32; TILE]; 3]>,
    tiles: AlignedVec,
    grads: AlignedVec,
}

impl StreamBatch {
    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.sample.clear();
        self.pos.clear();
    }

    /// Adds sample number `sample` of the chunk at `p`.
    #[inline(always)]
    pub fn push(&mut self, sample: usize, p: Vec3) {
        let lane = self.sample.len() % TILE;
        if lane == 0 {
            self.pos.push([[0.5; TILE]; 3]);
        }
        let tile = self.pos.len() - 1;
        for axis in 0..3 {
            self.pos[tile][axis][lane] = p[axis];
        }
        self.sample.push(sample as u32);
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.sample.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.sample.is_empty()
    }

    /// Positions tile by tile, `[axis][lane]`.
    pub fn tiles(&self) -> &[[[f32; TILE]; 3]] {
        &self.pos
    }
}

impl StreamNet {
    /// Assembles the network around an encoding.
    pub fn new(grid: HashGrid, hidden: usize, layers: usize, code: usize, view: usize, bias: f32) -> Self {
        let mut trunk = vec![grid.width() + code];
        trunk.extend(std::iter::repeat_n(hidden, layers));
        trunk.push(GEOMETRY);
        let trunk = Mlp::new(&trunk);
        let head = Mlp::new(&[GEOMETRY + view, hidden, 4]);
        Self { grid, trunk, head, code, view, density_bias: bias }
    }

    /// Floats of one tile's activations.
    fn stride(&self) -> usize {
        (self.trunk.rows() + self.head.rows()) * TILE
    }

    /// Evaluates all samples of `batch`; `code` and `view` give the conditioning of a sample of the chunk.
    #[inline(always)]
    pub fn forward<'c, S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        batch: &mut StreamBatch,
        code: impl Fn(u32) -> &'c [f32],
        view: impl Fn(u32) -> &'c [f32],
        out: &mut StreamSamples,
    ) {
        let stride = self.stride();
        batch.tiles.reserve_len(batch.pos.len() * stride);
        for (n, pos) in batch.pos.iter().enumerate() {
            let lanes = &batch.sample[n * TILE..batch.sample.len().min((n + 1) * TILE)];
            let tile = &mut batch.tiles[n * stride..][..stride];
            let (trunk, head) = tile.split_at_mut(self.trunk.rows() * TILE);
            self.grid.encode(w.tables, pos, &mut trunk[..self.grid.width() * TILE]);
            condition(&mut trunk[self.grid.width() * TILE..], self.code, lanes, &code);
            self.trunk.forward(simd, w.trunk, trunk);
            let geometry = &trunk[self.trunk.output_row() * TILE..];
            head[..GEOMETRY * TILE].copy_from_slice(geometry);
            condition(&mut head[GEOMETRY * TILE..], self.view, lanes, &view);
            self.head.forward(simd, w.head, head);
            let mut raw = [[0.0; TILE]; 5];
            raw[0].copy_from_slice(&geometry[..TILE]);
            for (k, raw) in raw[1..].iter_mut().enumerate() {
                raw.copy_from_slice(&head[(self.head.output_row() + k) * TILE..][..TILE]);
            }
            for v in &mut raw[0] {
                *v = simd::exp((*v + self.density_bias).clamp(-RAW_SIGMA_LIMIT, RAW_SIGMA_LIMIT));
            }
            for row in &mut raw[1..] {
                for v in row {
                    *v = simd::sigmoid(*v);
                }
            }
            for (lane, &s) in lanes.iter().enumerate() {
                let s = s as usize;
                out.sigma[s] = raw[0][lane];
                out.rgb[s] = [raw[1][lane], raw[2][lane], raw[3][lane]];
                out.beta[s] = BETA_MAX * raw[4][lane];
            }
        }
    }

    /// Densities alone of all samples of `batch`, in lane order; colours and uncertainty are not computed.
    #[inline(always)]
    pub fn density<'c, S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        batch: &mut StreamBatch,
        code: impl Fn(u32) -> &'c [f32],
        out: &mut [f32],
    ) {
        batch.tiles.reserve_len(self.stride());
        for (n, pos) in batch.pos.iter().enumerate() {
            let lanes = &batch.sample[n * TILE..batch.sample.len().min((n + 1) * TILE)];
            let trunk = &mut batch.tiles[..self.trunk.rows() * TILE];
            self.grid.encode(w.tables, pos, &mut trunk[..self.grid.width() * TILE]);
            condition(&mut trunk[self.grid.width() * TILE..], self.code, lanes, &code);
            self.trunk.forward(simd, w.trunk, trunk);
            let raw = &trunk[self.trunk.output_row() * TILE..];
            for (o, r) in out[n * TILE..].iter_mut().zip(&raw[..lanes.len()]) {
                *o = simd::exp((*r + self.density_bias).clamp(-RAW_SIGMA_LIMIT, RAW_SIGMA_LIMIT));
            }
        }
    }

    /// Back-propagates through the evaluation that [`Self::forward`] left in `batch`.
    ///
    /// `values` are its outputs, `grad` the loss's gradient with respect to them. Adds the parameter gradients of trunk
    /// and head to `trunk_grad` and `head_grad`. The gradients of encoding, code and position stay in the batch:
    /// see [`Self::encoding_gradient`], [`Self::code_gradient`] and [`Self::position_gradient`].
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub fn backward<S: Simd>(
        &self,
        simd: S,
        w: &StreamWeights,
        batch: &mut StreamBatch,
        values: &StreamSamples,
        grad: &StreamSamples,
        trunk_grad: &mut [f32],
        head_grad: &mut [f32],
    ) {
        let stride = self.stride();
        let count = batch.pos.len();
        batch.grads.reserve_len(count * stride);
        for n in 0..count {
            let lanes = &batch.sample[n * TILE..batch.sample.len().min((n + 1) * TILE)];
            let (trunk, head) = batch.tiles[n * stride..][..stride].split_at(self.trunk.rows() * TILE);
            let (dtrunk, dhead) = batch.grads[n * stride..][..stride].split_at_mut(self.trunk.rows() * TILE);
            let mut raw = [[0.0; TILE]; 5];
            for (lane, &s) in lanes.iter().enumerate() {
                let s = s as usize;
                raw[0][lane] = grad.sigma[s] * values.sigma[s];
                for c in 0..3 {
                    let v = values.rgb[s][c];
                    raw[1 + c][lane] = grad.rgb[s][c] * v * (1.0 - v);
                }
                raw[4][lane] = grad.beta[s] * values.beta[s] * (1.0 - values.beta[s] / BETA_MAX);
            }
            let out = self.head.output_row() * TILE;
            for (k, raw) in raw[1..].iter().enumerate() {
                dhead[out + k * TILE..][..TILE].copy_from_slice(raw);
            }
            self.head.backward(simd, w.head, head, dhead, true);
            let out = self.trunk.output_row() * TILE;
            dtrunk[out..].copy_from_slice(&dhead[..GEOMETRY * TILE]);
            for (d, raw) in dtrunk[out..][..TILE].iter_mut().zip(&raw[0]) {
                *d += raw;
            }
            self.trunk.backward(simd, w.trunk, trunk, dtrunk, true);
        }
        let view = |data, row: usize| TileView { data, stride, offset: row * TILE };
        let rows = self.trunk.rows();
        self.trunk.accumulate(simd, view(&batch.tiles, 0), view(&batch.grads, 0), count, trunk_grad);
        self.head.accumulate(simd, view(&batch.tiles, rows), view(&batch.grads, rows), count, head_grad);
    }

    /// The gradient of the encoding, level-major `out[level * capacity + lane]`.
    #[inline(always)]
    pub fn encoding_gradient(&self, batch: &StreamBatch, capacity: usize, out: &mut [Row]) {
        let stride = self.stride();
        for (level, out) in out.chunks_exact_mut(capacity).take(self.grid.levels.len()).enumerate() {
            for (n, out) in out[..batch.len()].chunks_mut(TILE).enumerate() {
                let g = &batch.grads[n * stride + level * FEATURES * TILE..][..FEATURES * TILE];
                for (lane, row) in out.iter_mut().enumerate() {
                    *row = Row::new(g[lane], g[TILE + lane], g[2 * TILE + lane], g[3 * TILE + lane]);
                }
            }
        }
    }

    /// Calls `add(sample, component, gradient)` for the gradient of every lane's code.
    #[inline(always)]
    pub fn code_gradient(&self, batch: &StreamBatch, mut add: impl FnMut(u32, usize, f32)) {
        let stride = self.stride();
        for (n, lanes) in batch.sample.chunks(TILE).enumerate() {
            for k in 0..self.code {
                let row = &batch.grads[n * stride + (self.grid.width() + k) * TILE..][..TILE];
                for (s, g) in lanes.iter().zip(row) {
                    add(*s, k, *g);
                }
            }
        }
    }

    /// Calls `add(sample, gradient)` for the gradient of every lane's position.
    #[inline(always)]
    pub fn position_gradient(&self, w: &StreamWeights, batch: &StreamBatch, mut add: impl FnMut(u32, Vec3)) {
        let stride = self.stride();
        for (n, (lanes, pos)) in batch.sample.chunks(TILE).zip(&batch.pos).enumerate() {
            let grad = &batch.grads[n * stride..][..self.grid.width() * TILE];
            let d = self.grid.position_gradient(w.tables, pos, grad);
            for (lane, s) in lanes.iter().enumerate() {
                add(*s, Vec3::new(d[0][lane], d[1][lane], d[2][lane]));
            }
        }
    }
}

/// Fills the conditioning rows of a tile lane by lane.
#[inline(always)]
fn condition<'c>(rows: &mut [f32], width: usize, lanes: &[u32], of: impl Fn(u32) -> &'c [f32]) {
    if width == 0 {
        return;
    }
    for (lane, &s) in lanes.iter().enumerate() {
        for (k, v) in of(s)[..width].iter().enumerate() {
            rows[k * TILE + lane] = *v;
        }
    }
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
