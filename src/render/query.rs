//! Questions to one stream at points of one's own choice: density and colour.

use glam::Vec3;
use pulp::{Simd, WithSimd};

use super::forward::Model;
use crate::field::batch::StreamBatch;
use crate::field::stream::{StreamActivations, StreamNet, StreamSamples, StreamWeights, Tiles};
use crate::field::{Stream, view_encoding};

/// One stream of a model at one time.
///
/// Points are in the stream's own coordinates: units for persistent and dynamic, [`Model::actor_point`] for the actor.
pub struct Query<'a> {
    model: &'a Model<'a>,
    stream: Stream,
    net: &'a StreamNet,
    code: Vec<f32>,
    time: f32,
    /// Slice of the density grid.
    slice: usize,
}

impl<'a> Query<'a> {
    /// `None` where the field has no such stream. `time` is scene time and only matters to streams that change.
    pub fn new(model: &'a Model, stream: Stream, time: f32) -> Option<Self> {
        let field = model.field;
        let net = field.net(stream)?;
        let mut code = vec![0.0; net.code];
        if let Some(trajectory) = &field.codes[stream as usize] {
            let gamma = &field.weights[field.layout.streams[stream as usize].code.clone()];
            trajectory.evaluate(gamma, trajectory.locate(time), &mut code);
        }
        let slice = model.grids.streams[stream as usize].slice(time);
        Some(Self { model, stream, net, code, time, slice })
    }

    /// Which stream is asked.
    pub fn stream(&self) -> Stream {
        self.stream
    }

    /// σ (1/unit) at each point, 0 where the density grid says that the stream has nothing.
    pub fn density(&self, points: &[Vec3], out: &mut [f32]) {
        let s = self.stream as usize;
        let (grid, threshold) = (&self.model.grids.streams[s], self.model.grids.threshold[s]);
        out.fill(0.0);
        let mut batch = StreamBatch::default();
        for (n, p) in points.iter().enumerate().filter(|(_, p)| grid.at(**p, self.slice) >= threshold) {
            batch.push(n, 0, *p, self.time);
        }
        let Some(weights) = self.model.weights(s) else { return };
        if batch.is_empty() {
            return;
        }
        let mut sigma = vec![0.0; batch.len()];
        let pass = DensityPass { query: self, weights, batch: &mut batch, out: &mut sigma };
        pulp::Arch::new().dispatch(pass);
        for (&n, sigma) in batch.sample.iter().zip(sigma) {
            out[n as usize] = sigma;
        }
    }

    /// Display-referred colour (sRGB, 0–1) at each point as seen along `directions` (unit vectors, in world axes; only
    /// the persistent stream's colour depends on them), before any frame's exposure.
    pub fn colours(&self, points: &[Vec3], directions: &[Vec3]) -> Vec<[f32; 3]> {
        let Some(weights) = self.model.weights(self.stream as usize) else { return Vec::new() };
        let mut batch = StreamBatch::default();
        points.iter().enumerate().for_each(|(n, p)| batch.push(n, n, *p, self.time));
        let views: Vec<_> = directions.iter().map(|d| view_encoding(*d)).collect();
        let mut out = StreamSamples::default();
        out.reset(points.len());
        if !points.is_empty() {
            let pass = ColourPass { query: self, weights, batch: &mut batch, views: &views, out: &mut out };
            pulp::Arch::new().dispatch(pass);
        }
        (0..points.len()).map(|n| [0, 1, 2].map(|c| out.rgb[c][n])).collect()
    }

    #[inline(always)]
    fn encode(&self, batch: &mut StreamBatch) {
        batch.encode(&self.net.encoding, &self.model.field.tables[self.stream as usize]);
    }
}

struct DensityPass<'a> {
    query: &'a Query<'a>,
    weights: StreamWeights<'a>,
    batch: &'a mut StreamBatch,
    out: &'a mut [f32],
}

impl WithSimd for DensityPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { query, weights, batch, out } = self;
        let code = |_: usize| &query.code[..];
        let mut activations = StreamActivations::default();
        query.encode(batch);
        query.net.density(simd, &weights, batch, &mut activations, Tiles::Passing, code, out);
    }
}

struct ColourPass<'a> {
    query: &'a Query<'a>,
    weights: StreamWeights<'a>,
    batch: &'a mut StreamBatch,
    views: &'a [[f32; crate::field::VIEW]],
    out: &'a mut StreamSamples,
}

impl WithSimd for ColourPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { query, weights, batch, views, out } = self;
        let code = |_: usize| &query.code[..];
        let view = |n: usize| &views[n][..];
        let mut activations = StreamActivations::default();
        query.encode(batch);
        query.net.forward(simd, &weights, batch, &mut activations, Tiles::Passing, code, view, out);
    }
}
