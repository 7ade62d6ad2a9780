//! Fields of features: for each stream a small encoding and a network, position (and time) → compressed feature.
//!
//! They are apart from the field of geometry: features vary slowly within an object, so few and coarse lattices do, and
//! geometry does not change by adding them. One [`Heads`] is one space (image-language or video-language); its outputs
//! are the compressed descriptor and then, where part features regularise it, those.

pub mod cache;
mod render;
pub mod scale;
mod step;
#[cfg(test)]
mod tests;
mod told;
pub mod train;

use glam::Vec3;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use self::render::{FeatureImage, render_features, trace_frame, trace_pixels};
use super::config::{HeadStreamConfig, SemanticsConfig};
use crate::field::batch::StreamBatch;
use crate::field::encoding::Encoding;
use crate::field::hashgrid::{FEATURES, HashGrid, Row};
use crate::field::mlp::{Activations, Mlp, Packed, Precision};
use crate::field::{FieldShape, Stream};
use crate::rng::Rng;
use crate::simd::TILE;
use crate::simd::matrix::Unit;

/// Stream of random numbers that weights start from.
const INIT_STREAM: u64 = 0x6865_6164;

/// Points that one task evaluates; fixed, so that results do not depend on the number of threads.
const BATCH: usize = 48 * 64;

/// Everything that determines the fields of one space but their learned numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadShape {
    /// Numbers per compressed descriptor.
    pub dim: usize,
    /// Numbers per compressed part feature; 0: none.
    pub parts: usize,
    /// Encodings: persistent, dynamic, actor.
    pub encodings: [HeadStreamConfig; 3],
    /// Width of the hidden layers.
    pub hidden: usize,
    /// Hidden layers.
    pub layers: usize,
    /// The box, units.
    pub extent: Vec3,
    /// Frames that features are known of: sets how fine time is resolved.
    pub frames: usize,
    /// The streams that there are.
    pub streams: [bool; 3],
    /// Smallest and largest size, units, that the networks tell apart, if what a point looks like depends on that of
    /// the patch around it: see [`scale`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scales: Option<[f32; 2]>,
}

/// The network of one stream.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadNet {
    /// Encoding of the position.
    pub grid: Encoding,
    /// Encoding → feature.
    pub mlp: Mlp,
}

/// The fields of one space.
#[derive(Clone, Debug)]
pub struct Heads {
    /// What they were built from.
    pub shape: HeadShape,
    /// One network per stream.
    pub nets: [Option<HeadNet>; 3],
    /// Hash tables `[stream][level][row]`.
    pub tables: [Vec<Vec<Row>>; 3],
    /// Weights of each network.
    pub weights: [Vec<f32>; 3],
}

impl HeadShape {
    /// For the field of a scene with `frames` frames that have features.
    pub fn new(
        config: &SemanticsConfig,
        field: &FieldShape,
        frames: usize,
        dim: usize,
        parts: usize,
    ) -> Self {
        Self {
            dim,
            parts,
            encodings: Stream::ALL.map(|s| config.stream(s).clone()),
            hidden: config.hidden,
            layers: config.layers,
            extent: field.normalisation.extent,
            frames,
            streams: field.streams,
            scales: None,
        }
    }

    /// Numbers that the networks give for a point: descriptor and part feature.
    pub fn width(&self) -> usize {
        self.dim + self.parts
    }

    /// The lattices of a stream: over the box, or over the camera's frustum for the actor.
    pub fn grid(&self, stream: Stream) -> Encoding {
        let c = &self.encodings[stream as usize];
        let actor = stream == Stream::Actor;
        let extent = if actor { Vec3::ONE } else { self.extent };
        // A lattice point between two frames that are farther apart than a cell would never be trained.
        let frames = (0.5 * self.frames as f32).max(1.0);
        let (coarsest, finest) = ([c.coarsest, 0.25 * frames], [c.time_finest, frames]);
        HashGrid::new(extent, c.levels, Vec3::splat(c.coarsest), Vec3::splat(c.finest), c.log2_rows)
            .with_time(extent, c.time_levels, coarsest, finest, c.log2_rows)
            .into()
    }

    fn net(&self, stream: Stream) -> HeadNet {
        let grid = self.grid(stream);
        let scale = if self.scales.is_some() { FEATURES } else { 0 };
        let mut widths = vec![grid.width() + scale];
        widths.extend(std::iter::repeat_n(self.hidden, self.layers));
        widths.push(self.width());
        HeadNet { mlp: Mlp::new(&widths).with_given(scale), grid }
    }
}

impl Heads {
    /// Untrained fields with all numbers zero; see [`Self::init`].
    pub fn zeros(shape: HeadShape) -> Self {
        let nets = Stream::ALL.map(|s| shape.streams[s as usize].then(|| shape.net(s)));
        let tables = |n: &HeadNet| n.grid.levels.iter().map(|l| vec![Row::ZERO; l.rows()]).collect();
        Self {
            tables: nets.each_ref().map(|n| n.as_ref().map_or(Vec::new(), tables)),
            weights: nets
                .each_ref()
                .map(|n| n.as_ref().map_or(Vec::new(), |n| vec![0.0; n.mlp.parameters()])),
            nets,
            shape,
        }
    }

    /// Gives all numbers their random start.
    pub fn init(&mut self, seed: u64) {
        let mut rng = Rng::new(seed, INIT_STREAM, 0);
        for s in 0..3 {
            let Some(net) = &self.nets[s] else { continue };
            self.weights[s] = net.mlp.init(|| rng.uniform());
            for row in self.tables[s].iter_mut().flatten() {
                *row = Row::from_array(std::array::from_fn(|_| 1e-2 * (2.0 * rng.uniform() - 1.0)));
            }
        }
    }
}

/// Fields ready to be evaluated.
pub struct HeadModel<'a> {
    /// Shape and tables.
    pub heads: &'a Heads,
    packed: [Option<Packed>; 3],
}

impl<'a> HeadModel<'a> {
    /// Packs the weights.
    pub fn new(heads: &'a Heads, precision: Precision) -> Self {
        let packed = std::array::from_fn(|s| {
            let net = heads.nets[s].as_ref()?;
            Some(net.mlp.pack(&heads.weights[s], precision))
        });
        Self { heads, packed }
    }

    fn net(&self, s: usize) -> Option<(&HeadNet, &Packed)> {
        self.heads.nets[s].as_ref().zip(self.packed[s].as_ref())
    }

    /// Features of stream `stream` at `points` (units; [`crate::render::forward::Model::actor_point`] for the actor)
    /// at `time`, to `out` `[points, shape.dim]`; zeros where the scene has no such stream. `size`, units, matters to
    /// fields with scales alone.
    pub fn features(&self, stream: Stream, points: &[Vec3], time: f32, size: f32, out: &mut [f32]) {
        let dim = self.heads.shape.dim;
        out.par_chunks_mut(BATCH * dim).zip(points.par_chunks(BATCH)).for_each(|(out, points)| {
            let mut batch = StreamBatch::default();
            points.iter().enumerate().for_each(|(n, p)| batch.push(n, n, *p, time));
            let stream = stream as usize;
            pulp::Arch::new().dispatch(PointPass { model: self, stream, batch, size: |_| size, out });
        });
    }

    /// Encodes `batch` and evaluates stream `s`; `out(tile, rows)` gets the outputs, a row of lanes a number.
    ///
    /// `size` of a sample, by its number, is asked for fields with scales alone.
    #[inline(always)]
    fn forward<S: Simd>(
        &self,
        simd: S,
        s: usize,
        batch: &mut StreamBatch,
        activations: &mut Activations,
        size: impl Fn(usize) -> f32,
        mut out: impl FnMut(usize, &[f32]),
    ) {
        let Some((net, packed)) = self.net(s) else { return };
        let unit = Unit::detect();
        batch.encode(&net.grid, &self.heads.tables[s]);
        let tiles = batch.len().div_ceil(TILE);
        net.mlp.reserve(packed, tiles, activations);
        for n in 0..tiles {
            let input = activations.input(n);
            input.fill(0.0);
            for (level, out) in batch.levels.iter().zip(input.chunks_exact_mut(FEATURES * TILE)) {
                level.read_tile(n, out);
            }
            if let Some(range) = self.heads.shape.scales {
                let samples = &batch.sample[n * TILE..];
                let size = |lane: usize| size(samples[lane] as usize);
                scale::write_tile(
                    range,
                    size,
                    TILE.min(samples.len()),
                    &mut input[net.grid.width() * TILE..],
                );
            }
            net.mlp.forward(simd, &unit, packed, activations, n);
            out(n, activations.output(n));
        }
    }
}

/// Features at the samples of a batch, whose numbers are those of the rows of `out`.
struct PointPass<'a, F> {
    model: &'a HeadModel<'a>,
    stream: usize,
    batch: StreamBatch,
    /// Of a sample.
    size: F,
    out: &'a mut [f32],
}

impl<F: Fn(usize) -> f32> WithSimd for PointPass<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { model, stream, mut batch, size, out } = self;
        let dim = model.heads.shape.dim;
        if model.net(stream).is_none() {
            return out.fill(0.0);
        }
        let count = batch.len();
        model.forward(simd, stream, &mut batch, &mut Activations::default(), size, |tile, rows| {
            for lane in 0..TILE.min(count - tile * TILE) {
                let out = &mut out[(tile * TILE + lane) * dim..][..dim];
                for (k, o) in out.iter_mut().enumerate() {
                    *o = rows[k * TILE + lane];
                }
            }
        });
    }
}
