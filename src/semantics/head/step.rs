//! One training step of the fields of a space at frozen geometry.
//!
//! The loss of a ray is W |Σ w f − z|² over the descriptor and, with weights of its own, over the part feature. Where a
//! descriptor tells of many rays together, as that of a patch does, it is |mean (Σ w f) − z|² over rays of the bag. As in
//! the training of geometry, a fixed number of groups have a gradient each, and every table is updated by one task
//! that walks the groups in order: the result does not depend on the number of threads.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::cache::Sources;
use super::scale::Pyramid;
use super::{HeadModel, Heads};
use crate::field::batch::StreamBatch;
use crate::field::hashgrid::FEATURES;
use crate::field::mlp::{Activations, Precision};
use crate::rng::Rng;
use crate::scene::features::Space;
use crate::semantics::SemanticsError;
use crate::simd::TILE;
use crate::simd::matrix::Unit;
use crate::tasks::PerThread;
use crate::train::adam::{self, Moments, StepSize, TableState};
use crate::train::table_pass::{StreamTables, TableScratch, update_and_encode};

mod joint;

pub use self::joint::JointPlan;

/// Groups that a step is divided into; fixed, so that sums are taken in the same order on any machine.
const GROUPS: usize = 16;

/// What the rays of a cache should look like, for one space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RayTargets {
    /// Numbers per ray: descriptor, then part feature.
    pub width: usize,
    /// How many of them are the descriptor's.
    pub dim: usize,
    /// `[rays, width]`, or `[rays, knots, width]` if there is a pyramid.
    pub values: Vec<half::f16>,
    /// Weights of the two parts of the loss; 0: no target.
    pub weights: Vec<[f32; 2]>,
    /// Rays with a target.
    pub usable: Vec<u32>,
    /// Time of each ray.
    pub times: Vec<f32>,
    /// Rays that share a descriptor; if there are any, steps choose among them and not among `usable`.
    pub bags: Bags,
    /// Set if descriptors depend on scale; a step then draws one for every ray.
    pub pyramid: Option<Pyramid>,
}

/// Rays that one descriptor describes together: those of a patch, or of a hotspot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bags {
    /// Bag `n` has the rays `members[first[n]..first[n + 1]]`, at least one.
    pub first: Vec<u32>,
    /// Rays.
    pub members: Vec<u32>,
    /// `[bags, dim]`.
    pub values: Vec<half::f16>,
}

impl Bags {
    /// Adds a bag; one without rays is left out.
    pub fn push(&mut self, rays: impl IntoIterator<Item = u32>, value: &[f32]) {
        if self.first.is_empty() {
            self.first.push(0);
        }
        let before = self.members.len();
        self.members.extend(rays);
        if self.members.len() > before {
            self.first.push(self.members.len() as u32);
            self.values.extend(value.iter().map(|v| half::f16::from_f32(*v)));
        }
    }

    /// Number of bags.
    pub fn len(&self) -> usize {
        self.first.len().saturating_sub(1)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// These bags with the rays that `keep` says; `dim` numbers a descriptor.
    pub fn only(&self, dim: usize, keep: impl Fn(&u32) -> bool) -> Self {
        let mut kept = Self::default();
        for n in 0..self.len() {
            let value: Vec<f32> = self.values[n * dim..][..dim].iter().map(|v| v.to_f32()).collect();
            kept.push(self.of(n).iter().copied().filter(&keep), &value);
        }
        kept
    }

    /// Rays of bag `n`.
    pub fn of(&self, n: usize) -> &[u32] {
        &self.members[self.first[n] as usize..self.first[n + 1] as usize]
    }
}

/// What a step is told.
#[derive(Clone, Copy, Debug)]
pub struct HeadStep {
    /// Number of the step, from 1.
    pub step: u64,
    /// Rays; rounded up to whole groups.
    pub rays: usize,
    /// Rays of a bag that are rendered.
    pub bag: usize,
    /// Learning rate of the tables.
    pub table_rate: f32,
    /// Learning rate of the networks.
    pub network_rate: f32,
    /// What the networks are multiplied in.
    pub precision: Precision,
    /// Seed of everything random.
    pub seed: u64,
}

/// State of the training of one space.
pub struct HeadOptimiser {
    moments: [Moments; 3],
    tables: [Vec<TableState>; 3],
    groups: Vec<Group>,
    scratch: PerThread<TableScratch>,
}

/// Rays of one group and what they left.
#[derive(Default)]
pub(super) struct Group {
    rays: Vec<u32>,
    /// Bags that the rays are of, each with as many rays; empty if each ray is by itself.
    bags: Vec<u32>,
    /// Scale that was drawn for each ray, as a share of the image's height; empty without a pyramid.
    drawn: Vec<f32>,
    batches: [StreamBatch; 3],
    /// Share of each lane in its ray.
    shares: [Vec<f32>; 3],
    activations: [Activations; 3],
    /// `[rays, width]`: what is rendered, then the gradient with respect to it.
    rendered: Vec<f32>,
    /// Gradients of the networks.
    pub(super) gradient: [Vec<f32>; 3],
    /// Sum over the rays.
    pub(super) loss: f64,
}

impl HeadOptimiser {
    /// Fresh state.
    pub fn new(heads: &Heads) -> Self {
        Self {
            moments: heads.weights.each_ref().map(|w| Moments::new(w.len())),
            tables: heads.tables.each_ref().map(|t| t.iter().map(|t| TableState::new(t.len())).collect()),
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            scratch: PerThread::default(),
        }
    }

    /// Runs one step; the mean loss of its rays.
    pub fn step(
        &mut self,
        heads: &mut Heads,
        sources: &Sources,
        targets: &RayTargets,
        plan: &HeadStep,
    ) -> f64 {
        self.groups.resize_with(GROUPS, Group::default);
        let bags =
            if targets.bags.is_empty() { 0 } else { (plan.rays / plan.bag.max(1)).div_ceil(GROUPS).max(1) };
        let per_group = if bags > 0 { bags * plan.bag.max(1) } else { plan.rays.div_ceil(GROUPS) };
        let count = (per_group * GROUPS) as f32;
        let model = HeadModel::new(heads, plan.precision);
        let arch = pulp::Arch::new();
        // One by one, so that no thread waits for several of the other's at the end.
        self.groups.par_iter_mut().enumerate().with_max_len(1).for_each(|(n, group)| {
            let mut rng = Rng::new(plan.seed, plan.step, n as u64);
            group.choose(&mut rng, targets, per_group, bags);
            arch.dispatch(GroupPass { group, model: &model, sources, targets, count });
        });
        drop(model);
        self.update(heads, plan);
        self.groups.iter().map(|g| g.loss).sum::<f64>() / f64::from(count)
    }

    /// Checks what the last step has left; `whole`: the tables, too, whose rows show in the loss when they are read
    /// next, which may be never.
    ///
    /// # Errors
    /// [`SemanticsError::NonFinite`].
    pub fn check(&self, heads: &Heads, space: Space, step: u64, whole: bool) -> Result<(), SemanticsError> {
        let loss = self.groups.iter().position(|g| !g.loss.is_finite());
        let weight = || heads.weights.iter().flatten().position(|w| !w.is_finite());
        let row = || heads.tables.iter().flatten().flatten().position(|r| !r.is_finite()).filter(|_| whole);
        let found = (loss.map(|n| ("the loss of a group of rays", n)))
            .or_else(|| Some(("a network weight", weight()?)))
            .or_else(|| Some(("a row of the tables", row()?)));
        match found {
            Some((stage, index)) => Err(SemanticsError::NonFinite { stage, space, step, index }),
            None => Ok(()),
        }
    }

    fn update(&mut self, heads: &mut Heads, plan: &HeadStep) {
        let Self { moments, tables, groups, scratch } = self;
        let rate = Some(StepSize::new(plan.table_rate, plan.step));
        let streams = heads.nets.iter().zip(&mut heads.tables).zip(tables).map(|((net, tables), states)| {
            Some(StreamTables { encoding: &net.as_ref()?.grid, tables, states, rate })
        });
        groups.iter_mut().flat_map(|g| &mut g.batches).for_each(StreamBatch::put_off);
        let batches = groups.iter_mut().flat_map(|g| g.batches.iter_mut().enumerate());
        update_and_encode(streams, batches, scratch);
        let rate = StepSize::new(plan.network_rate, plan.step);
        for (s, (weights, moments)) in heads.weights.iter_mut().zip(moments).enumerate() {
            let mut gradient = vec![0.0; weights.len()];
            for group in &*groups {
                gradient.iter_mut().zip(&group.gradient[s]).for_each(|(g, d)| *g += d);
            }
            adam::update(weights, &gradient, &mut moments.first, &mut moments.second, rate);
        }
    }
}

pub(super) struct GroupPass<'a> {
    pub(super) group: &'a mut Group,
    pub(super) model: &'a HeadModel<'a>,
    pub(super) sources: &'a Sources,
    pub(super) targets: &'a RayTargets,
    /// Rays of the whole step.
    pub(super) count: f32,
}

impl WithSimd for GroupPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { group, model, sources, targets, count } = self;
        group.place(sources, targets);
        group.render(simd, model, targets, |_, _, _| ());
        group.compare(targets, count);
        group.back(simd, model, targets.width);
    }
}

impl Group {
    /// A group of the given rays, or bags of rays.
    #[cfg(test)]
    pub(super) fn of(rays: Vec<u32>, bags: Vec<u32>) -> Self {
        Self { rays, bags, ..Self::default() }
    }

    /// Chooses `count` rays, or as many of `bags` bags, and their scales.
    fn choose(&mut self, rng: &mut Rng, targets: &RayTargets, count: usize, bags: usize) {
        let Self { rays, bags: chosen, .. } = self;
        rays.clear();
        chosen.clear();
        if bags == 0 {
            rays.extend((0..count).map(|_| targets.usable[rng.below(targets.usable.len())]));
            // Neighbours in the cache are neighbours in a picture, and share table rows.
            rays.sort_unstable();
            return self.draw(rng, targets);
        }
        for _ in 0..bags {
            let bag = rng.below(targets.bags.len());
            let members = targets.bags.of(bag);
            chosen.push(bag as u32);
            rays.extend((0..count / bags).map(|_| members[rng.below(members.len())]));
        }
        self.draw(rng, targets);
    }

    /// Draws the scales of the chosen rays.
    pub(super) fn draw(&mut self, rng: &mut Rng, targets: &RayTargets) {
        self.drawn.clear();
        let Some(pyramid) = &targets.pyramid else { return };
        self.drawn.extend(self.rays.iter().map(|ray| pyramid.draw(*ray as usize, rng)));
    }

    /// Scales as they were drawn.
    #[cfg(test)]
    pub(super) fn drawn(&self) -> &[f32] {
        &self.drawn
    }

    /// Gradient of lane by lane encodings, after [`GroupPass`]: positions and rows of stream `s`.
    #[cfg(test)]
    pub(super) fn batch(&self, s: usize) -> &StreamBatch {
        &self.batches[s]
    }

    /// The samples of all rays.
    fn place(&mut self, sources: &Sources, targets: &RayTargets) {
        let Self { rays, batches, shares, .. } = self;
        batches.iter_mut().for_each(StreamBatch::clear);
        shares.iter_mut().for_each(Vec::clear);
        for (n, ray) in rays.iter().enumerate() {
            let time = targets.times[*ray as usize];
            for source in sources.of(*ray as usize) {
                let s = usize::from(source.stream);
                batches[s].push(n, n, source.position(), time);
                shares[s].push(source.share());
            }
        }
    }

    /// Σ w f of every ray; `outputs(stream, tile, rows)` hears what the networks give for the samples.
    #[inline(always)]
    fn render<S: Simd>(
        &mut self,
        simd: S,
        model: &HeadModel,
        targets: &RayTargets,
        mut outputs: impl FnMut(usize, usize, &[f32]),
    ) {
        let Self { rays, drawn, batches, shares, activations, rendered, .. } = self;
        let width = targets.width;
        let heights = targets.pyramid.as_ref().map_or(&[][..], |p| &p.heights);
        let size = |n: usize| drawn[n] * heights[rays[n] as usize];
        rendered.clear();
        rendered.resize(rays.len() * width, 0.0);
        for (s, batch) in batches.iter_mut().enumerate().filter(|(_, b)| !b.is_empty()) {
            let rays: Vec<u32> = batch.sample.clone();
            model.forward(simd, s, batch, &mut activations[s], size, |tile, rows| {
                outputs(s, tile, rows);
                let lanes = rays[tile * TILE..].iter().zip(&shares[s][tile * TILE..]).take(TILE);
                for (lane, (ray, share)) in lanes.enumerate() {
                    let out = &mut rendered[*ray as usize * width..][..width];
                    for (k, o) in out.iter_mut().enumerate() {
                        *o += share * rows[k * TILE + lane];
                    }
                }
            });
        }
    }

    /// Replaces what was rendered by the gradient of the loss with respect to it.
    fn compare(&mut self, targets: &RayTargets, count: f32) {
        let (width, dim) = (targets.width, targets.dim);
        self.loss = 0.0;
        let off = self.off_bags(targets);
        let mut target = Vec::with_capacity(width);
        for (n, rendered) in self.rendered.chunks_exact_mut(width).enumerate() {
            let ray = self.rays[n] as usize;
            targets.value(ray, self.drawn.get(n).copied().unwrap_or(0.0), &mut target);
            let mut loss = 0.0;
            for (k, (r, t)) in rendered.iter_mut().zip(&target).enumerate() {
                let weight = targets.weights[ray][usize::from(k >= dim)];
                let off = *r - t;
                loss += weight * off * off;
                *r = 2.0 * weight * off / count;
            }
            self.loss += f64::from(loss);
        }
        let Some(per_bag) = self.rays.len().checked_div(self.bags.len()) else { return };
        for (off, rays) in off.chunks_exact(dim).zip(self.rendered.chunks_exact_mut(per_bag * width)) {
            self.loss += per_bag as f64 * off.iter().map(|v| f64::from(v * v)).sum::<f64>();
            for rendered in rays.chunks_exact_mut(width) {
                rendered.iter_mut().zip(off).for_each(|(r, off)| *r += 2.0 * off / count);
            }
        }
    }

    /// Mean of what was rendered for the rays of each bag, minus what it should be: `[bags, dim]`.
    fn off_bags(&self, targets: &RayTargets) -> Vec<f32> {
        let (width, dim) = (targets.width, targets.dim);
        let Some(per_bag) = self.rays.len().checked_div(self.bags.len()) else { return Vec::new() };
        let mut off = vec![0.0; self.bags.len() * dim];
        let rays = self.rendered.chunks_exact(per_bag * width);
        for ((off, bag), rays) in off.chunks_exact_mut(dim).zip(&self.bags).zip(rays) {
            for rendered in rays.chunks_exact(width) {
                off.iter_mut().zip(rendered).for_each(|(o, r)| *o += r / per_bag as f32);
            }
            let wanted = &targets.bags.values[*bag as usize * dim..][..dim];
            off.iter_mut().zip(wanted).for_each(|(o, w)| *o -= w.to_f32());
        }
        off
    }

    #[inline(always)]
    fn back<S: Simd>(&mut self, simd: S, model: &HeadModel, width: usize) {
        let unit = Unit::detect();
        let Self { batches, shares, activations, rendered, gradient, .. } = self;
        for (s, batch) in batches.iter_mut().enumerate() {
            gradient[s].clear();
            gradient[s].resize(model.heads.weights[s].len(), 0.0);
            let Some((net, packed)) = model.net(s).filter(|_| !batch.is_empty()) else { continue };
            let StreamBatch { sample, levels, .. } = batch;
            let activations = &mut activations[s];
            net.mlp.reserve_backward::<S>(sample.len().div_ceil(TILE), activations);
            for (n, (rays, shares)) in sample.chunks(TILE).zip(shares[s].chunks(TILE)).enumerate() {
                let out = activations.output_grad();
                out.fill(0.0);
                for (lane, (ray, share)) in rays.iter().zip(shares).enumerate() {
                    let g = &rendered[*ray as usize * width..][..width];
                    for (k, g) in g.iter().enumerate() {
                        out[k * TILE + lane] = share * g;
                    }
                }
                net.mlp.backward(simd, &unit, packed, activations, n);
                let input = activations.input_grad();
                for (level, g) in levels.iter_mut().zip(input.chunks_exact(FEATURES * TILE)) {
                    level.write_tile(n, g);
                }
            }
            net.mlp.finish(simd, packed, activations, &mut gradient[s]);
        }
    }
}
