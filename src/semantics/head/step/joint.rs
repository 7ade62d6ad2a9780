//! A step of the fields of a space together with one of geometry: features pull at where the light comes from.
//!
//! With f̂ = Σ w f / Σ w over the samples that are kept of a ray, and g the gradient of the loss with respect to f̂, the
//! gradient with respect to w_i is g · (f_i − f̂) / Σ w. It joins that of the colours before compositing goes backward.

use std::sync::{Mutex, MutexGuard, PoisonError};

use pulp::{Simd, WithSimd};

use super::{Group, HeadOptimiser, HeadStep, RayTargets};
use crate::field::batch::StreamBatch;
use crate::render::forward::Chunk;
use crate::rng::Rng;
use crate::semantics::head::cache::{find, select};
use crate::semantics::head::{HeadModel, Heads};
use crate::simd::TILE;
use crate::train::step::{CHUNK_RAYS, Companion};

#[cfg(test)]
mod tests;

/// Light of a ray below which its features tell nothing about where it ends.
const DIM: f32 = 0.1;

/// What a joint step is told beside [`HeadStep`].
#[derive(Clone, Copy, Debug)]
pub struct JointPlan {
    /// Chunks of rays that geometry traces.
    pub chunks: usize,
    /// Samples that are kept of a ray.
    pub samples: usize,
    /// Weight of the features' loss where it pulls at geometry.
    pub weight: f32,
}

/// The side of the features while geometry takes its step.
struct JointStep<'a, P> {
    model: HeadModel<'a>,
    /// One per chunk.
    groups: &'a [Mutex<Group>],
    targets: &'a RayTargets,
    /// Frame and pixel of a ray.
    pixel: P,
    plan: JointPlan,
}

impl HeadOptimiser {
    /// Runs one step on rays that `geometry` traces, and lets the features pull at their samples; the mean loss of the
    /// features. `pixel` tells frame and pixel of a ray.
    ///
    /// # Errors
    /// What `geometry` says; the fields are then as they were.
    pub fn joint_step<E>(
        &mut self,
        heads: &mut Heads,
        targets: &RayTargets,
        pixel: impl Fn(u32) -> (usize, usize) + Sync,
        (plan, joint): (&HeadStep, JointPlan),
        geometry: impl FnOnce(&dyn Companion) -> Result<(), E>,
    ) -> Result<f64, E> {
        self.groups.resize_with(joint.chunks, Group::default);
        for (n, group) in self.groups.iter_mut().enumerate() {
            let mut rng = Rng::new(plan.seed, plan.step, n as u64);
            // A chunk is one bag of rays, or as many rays by themselves.
            group.choose(&mut rng, targets, CHUNK_RAYS, usize::from(!targets.bags.is_empty()));
        }
        let groups: Vec<Mutex<Group>> = self.groups.drain(..).map(Mutex::new).collect();
        let model = HeadModel::new(heads, plan.precision);
        let done = geometry(&JointStep { model, groups: &groups, targets, pixel, plan: joint });
        self.groups
            .extend(groups.into_iter().map(|g| g.into_inner().unwrap_or_else(PoisonError::into_inner)));
        done?;
        self.update(heads, plan);
        let rays = (joint.chunks * CHUNK_RAYS) as f64;
        Ok(self.groups.iter().map(|g| g.loss).sum::<f64>() / rays)
    }
}

/// A chunk's group is asked for by one thread; what a panic may have left in it is never read.
fn lock(group: &Mutex<Group>) -> MutexGuard<'_, Group> {
    group.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<P: Fn(u32) -> (usize, usize) + Sync> Companion for JointStep<'_, P> {
    fn rays(&self, chunk: usize) -> Vec<(usize, usize)> {
        lock(&self.groups[chunk]).rays.iter().map(|ray| (self.pixel)(*ray)).collect()
    }

    fn ask(&self, chunk: usize, traced: &Chunk, weight: &mut [[f32; 3]]) {
        let Self { model, targets, plan, .. } = self;
        let group = &mut *lock(&self.groups[chunk]);
        pulp::Arch::new().dispatch(AskPass { group, model, targets, plan, traced, weight });
    }
}

struct AskPass<'a> {
    group: &'a mut Group,
    model: &'a HeadModel<'a>,
    targets: &'a RayTargets,
    plan: &'a JointPlan,
    traced: &'a Chunk,
    weight: &'a mut [[f32; 3]],
}

impl WithSimd for AskPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { group, model, targets, plan, traced, weight } = self;
        let width = targets.width;
        let kept = group.place_traced(traced, targets, plan.samples);
        let mut outputs: [Vec<f32>; 3] = Default::default();
        for (out, batch) in outputs.iter_mut().zip(&group.batches) {
            out.resize(batch.tiles().len() * TILE * width, 0.0);
        }
        group.render(simd, model, targets, |s, tile, rows| {
            outputs[s][tile * TILE * width..][..TILE * width].copy_from_slice(&rows[..TILE * width]);
        });
        let rendered = group.rendered.clone();
        group.compare(targets, (plan.chunks * CHUNK_RAYS) as f32);
        for (s, lanes) in kept.iter().enumerate() {
            for (n, lane) in lanes.iter().enumerate() {
                let rows = &outputs[s][n / TILE * TILE * width..];
                let ray = lane.ray * width..(lane.ray + 1) * width;
                let (g, mean) = (&group.rendered[ray.clone()], &rendered[ray]);
                let f = (0..width).map(|k| rows[k * TILE + n % TILE]);
                let pull: f32 = f.zip(g).zip(mean).map(|((f, g), mean)| g * (f - mean)).sum();
                weight[lane.sample][s] += plan.weight * pull / lane.light;
            }
        }
        group.back(simd, model, width);
    }
}

/// Where a lane of a batch comes from.
struct Lane {
    ray: usize,
    sample: usize,
    /// Σ w of the samples that were kept of the ray.
    light: f32,
}

impl Group {
    /// The samples of a traced chunk that its rays owe most of their light to; of each stream's lanes, which they are.
    fn place_traced(&mut self, traced: &Chunk, targets: &RayTargets, keep: usize) -> [Vec<Lane>; 3] {
        let Self { rays, batches, shares, .. } = self;
        batches.iter_mut().for_each(StreamBatch::clear);
        shares.iter_mut().for_each(Vec::clear);
        let (mut found, mut lanes): (_, [Vec<Lane>; 3]) = (Vec::new(), Default::default());
        find(traced, &mut found);
        for (n, (ray, found)) in rays.iter().zip(&mut found).enumerate() {
            let light = select(found, keep);
            if light < DIM {
                continue;
            }
            for f in found.iter() {
                let s = usize::from(f.stream);
                batches[s].push(n, n, f.place, targets.times[*ray as usize]);
                shares[s].push(f.weight / light);
                lanes[s].push(Lane { ray: n, sample: f.sample as usize, light });
            }
        }
        lanes
    }
}
