//! Rays traced once: where the light of a pixel comes from, at frozen geometry.

use glam::Vec3;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use crate::render::forward::{Chunk, Model, RayInput, Tracer};
use crate::render::rays::View;
use crate::render::sampler::Sampling;

/// Rays traced together.
const CHUNK_RAYS: usize = 32;
/// Chunks of one task.
const TASK_CHUNKS: usize = 16;
/// Samples that give less than this share of a ray's light are not kept.
const NEGLIGIBLE: f32 = 0.005;

/// A place that a pixel's light comes from: 9 bytes of content.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Source {
    /// Position in the coordinates of the stream, as fractions of 65535.
    place: [u16; 3],
    /// Share of the light of the sources that were kept, in 65535ths.
    share: u16,
    /// Which stream.
    pub stream: u8,
}

impl Source {
    /// Position in the coordinates of the stream: units, or the actor's frustum.
    pub fn position(&self) -> Vec3 {
        Vec3::from_array(self.place.map(|v| f32::from(v) / 65535.0))
    }

    /// Share of the light; those of a ray sum to 1 up to rounding.
    pub fn share(&self) -> f32 {
        f32::from(self.share) / 65535.0
    }
}

/// A sample that a pixel owes light to, before it is known whether it is kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    /// w^s.
    pub weight: f32,
    pub stream: u8,
    /// Number in its chunk.
    pub sample: u32,
    /// Position in the coordinates of the stream.
    pub place: Vec3,
}

/// All samples of a traced chunk that give light, ray by ray.
pub(super) fn find(chunk: &Chunk, found: &mut Vec<Vec<Found>>) {
    found.resize_with(chunk.rays.len(), Vec::new);
    found.iter_mut().for_each(Vec::clear);
    for (s, batch) in chunk.batches.iter().enumerate() {
        for (k, place) in batch.points() {
            let weight = chunk.weights.weight[s][k];
            if weight > 0.0 {
                found[chunk.intervals.layout.ray(k)].push(Found {
                    weight,
                    stream: s as u8,
                    sample: k as u32,
                    place,
                });
            }
        }
    }
}

/// Leaves those of a ray's samples that it owes most of its light to, at most `keep` of them; the sum of their weights.
pub(super) fn select(found: &mut Vec<Found>, keep: usize) -> f32 {
    let total: f32 = found.iter().map(|f| f.weight).sum();
    found.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    found.truncate(keep);
    found.retain(|f| f.weight >= NEGLIGIBLE * total);
    found.iter().map(|f| f.weight).sum()
}

/// The sources of many rays.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sources {
    /// Ray `n` has the sources `first[n]..first[n + 1]`.
    first: Vec<u32>,
    sources: Vec<Source>,
    /// Opacity of each ray.
    pub opacity: Vec<f32>,
    /// Mean z-depth of each ray's sources, units; 0 without any.
    pub depth: Vec<f32>,
}

impl Sources {
    /// Traces `inputs`, rays of `views`, and keeps of each at most `keep` samples.
    ///
    /// The result does not depend on the number of threads.
    pub fn trace(
        model: &Model,
        views: &[View],
        inputs: &[RayInput],
        sampling: &Sampling,
        keep: usize,
    ) -> Self {
        let arch = pulp::Arch::new();
        let parts: Vec<Self> = inputs
            .par_chunks(CHUNK_RAYS * TASK_CHUNKS)
            .map(|inputs| arch.dispatch(TracePass { model, views, inputs, sampling, keep }))
            .collect();
        let mut all = Self { first: vec![0], ..Self::default() };
        for part in parts {
            let start = all.sources.len() as u32;
            all.first.extend(part.first[1..].iter().map(|f| f + start));
            all.sources.extend(part.sources);
            all.opacity.extend(part.opacity);
            all.depth.extend(part.depth);
        }
        all
    }

    /// Rays whose samples have the given weights, streams and positions; all at depth 1.
    #[cfg(test)]
    pub(super) fn of_rays(rays: Vec<Vec<(f32, u8, Vec3)>>) -> Self {
        let mut all = Self { first: vec![0], ..Self::default() };
        for of_ray in rays {
            let found = |(weight, stream, place)| Found { weight, stream, sample: 0, place };
            all.add(1.0, &mut of_ray.into_iter().map(found).collect(), usize::MAX);
            all.depth.push(1.0);
        }
        all
    }

    /// Number of rays.
    pub fn len(&self) -> usize {
        self.opacity.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.opacity.is_empty()
    }

    /// Sources of ray `n`, those with the largest share first.
    pub fn of(&self, n: usize) -> &[Source] {
        &self.sources[self.first[n] as usize..self.first[n + 1] as usize]
    }

    /// Number of sources of all rays.
    pub fn count(&self) -> usize {
        self.sources.len()
    }
}

struct TracePass<'a> {
    model: &'a Model<'a>,
    views: &'a [View],
    inputs: &'a [RayInput],
    sampling: &'a Sampling,
    keep: usize,
}

impl WithSimd for TracePass<'_> {
    type Output = Sources;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Sources {
        let Self { model, views, inputs, sampling, keep } = self;
        let (mut chunk, mut tracer) = (Chunk::default(), Tracer::default());
        let mut out = Sources { first: vec![0], ..Sources::default() };
        let mut found = Vec::new();
        for inputs in inputs.chunks(CHUNK_RAYS) {
            chunk.densities(simd, &mut tracer, model, views, inputs, sampling);
            find(&chunk, &mut found);
            for (r, (ray, found)) in chunk.rays.iter().zip(&mut found).enumerate() {
                out.add(1.0 - chunk.weights.left[r], found, keep);
                let light: f32 = found.iter().map(|f| f.weight).sum();
                let t: f32 = found.iter().map(|f| f.weight * chunk.intervals.t[f.sample as usize]).sum();
                out.depth.push(if light > 0.0 { t / light * ray.ray.refined_cam.z } else { 0.0 });
            }
        }
        out
    }
}

impl Sources {
    /// Adds a ray whose samples have the given weights.
    fn add(&mut self, opacity: f32, found: &mut Vec<Found>, keep: usize) {
        let kept = select(found, keep);
        let fraction = |v: f32| (v.clamp(0.0, 1.0) * 65535.0 + 0.5) as u16;
        self.sources.extend(found.iter().map(|f| Source {
            place: f.place.to_array().map(fraction),
            share: fraction(f.weight / kept),
            stream: f.stream,
        }));
        self.first.push(self.sources.len() as u32);
        self.opacity.push(opacity.clamp(0.0, 1.0));
    }
}
