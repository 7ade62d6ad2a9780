//! The end of a step: tables, density grids and dense weights take what the groups have found.

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::{Optimiser, StepPlan};
use crate::field::Field;
use crate::field::hashgrid::FEATURES;
use crate::render::forward::Grids;
use crate::tasks::Tasks;
use crate::train::adam::{self, Moments, StepSize};
use crate::train::table_pass::TablePass;

/// Updates everything that is learned, and the density grids; returns the rows of tables that were updated.
pub fn update(optimiser: &mut Optimiser, field: &mut Field, grids: &mut Grids, plan: &StepPlan) -> usize {
    let Optimiser { dense, tables, groups, gradient, table_scratch: scratch, .. } = optimiser;
    let (groups, scratch) = (&groups[..], &*scratch);
    let arch = pulp::Arch::new();
    let rate = StepSize::new(plan.table_rate, plan.step);
    let (mut tasks, updated) = (Tasks::default(), &AtomicUsize::new(0));
    for (s, (tables, states)) in field.tables.iter_mut().zip(tables).enumerate() {
        let (true, Some(net)) = (plan.streams[s], &field.nets[s]) else { continue };
        let levels = net.encoding.levels.iter().enumerate();
        for ((number, level), (table, state)) in levels.zip(tables.iter_mut().zip(states)) {
            let chunks = groups.iter().flat_map(|g| &g.chunks);
            let batches = chunks.map(move |chunk| &chunk.traced.batches[s]);
            let pass = TablePass { batches, number, level, table, state, rate, scratch };
            tasks.add(pass.cost(), move || {
                updated.fetch_add(arch.dispatch(pass), Ordering::Relaxed);
            });
        }
    }
    for (s, grid) in grids.streams.iter_mut().enumerate().filter(|(s, _)| plan.streams[*s]) {
        let cells = groups.iter().map(|group| group.evaluations[s]).sum();
        tasks.add(cells, move || {
            groups.iter().for_each(|group| group.tell(s, grid, plan.grid_rate));
            groups.iter().for_each(|group| group.tell_refreshed(s, grid));
        });
    }
    let sum = &mut gradient[..];
    tasks.add(groups.len() * sum.len() / FEATURES, move || {
        sum.fill(0.0);
        for group in groups {
            sum.iter_mut().zip(&group.dense).for_each(|(g, d)| *g += d);
        }
    });
    tasks.run();
    update_dense(field, dense, gradient, plan);
    updated.load(Ordering::Relaxed)
}

fn update_dense(field: &mut Field, moments: &mut Moments, gradient: &[f32], plan: &StepPlan) {
    let Field { layout, weights, .. } = field;
    let mut apply = |range: Range<usize>, rate: f32| {
        if rate == 0.0 || range.is_empty() {
            return;
        }
        let Moments { first, second } = &mut *moments;
        let (first, second) = (&mut first[range.clone()], &mut second[range.clone()]);
        adam::update(
            &mut weights[range.clone()],
            &gradient[range],
            first,
            second,
            StepSize::new(rate, plan.step),
        );
    };
    for (s, r) in layout.streams.iter().enumerate() {
        if plan.streams[s] {
            apply(r.trunk.clone(), plan.network_rate);
            apply(r.head.clone(), plan.network_rate);
            apply(r.code.clone(), plan.network_rate);
        }
    }
    apply(layout.exposure.clone(), plan.exposure_rate);
    apply(layout.pose.clone(), plan.pose_rate);
    apply(layout.rig.clone(), plan.rig_rate);
}
