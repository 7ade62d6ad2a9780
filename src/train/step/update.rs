//! The end of a step: tables, density grids and dense weights take what the groups have found.

use std::ops::Range;

use super::{Optimiser, StepPlan};
use crate::field::Field;
use crate::render::forward::Grids;
use crate::train::adam::{self, Moments, StepSize};
use crate::train::table_pass::TablePass;

/// Updates everything that is learned, and the density grids.
pub fn update(optimiser: &mut Optimiser, field: &mut Field, grids: &mut Grids, plan: &StepPlan) {
    let Optimiser { dense, tables, groups, gradient, .. } = optimiser;
    let groups = &groups[..];
    let arch = pulp::Arch::new();
    let rate = StepSize::new(plan.table_rate, plan.step);
    rayon::scope(|scope| {
        // Finest levels first: they take longest.
        for (s, (tables, states)) in field.tables.iter_mut().zip(tables).enumerate() {
            let (true, Some(net)) = (plan.streams[s], &field.nets[s]) else { continue };
            let levels = net.encoding.levels.iter().enumerate();
            for ((number, level), (table, state)) in levels.zip(tables.iter_mut().zip(states)).rev() {
                let chunks = groups.iter().flat_map(|g| &g.chunks);
                let batches = chunks.map(move |chunk| &chunk.traced.batches[s]);
                let pass = TablePass { batches, number, level, table, state, rate };
                scope.spawn(move |_| arch.dispatch(pass));
            }
        }
        for (s, grid) in grids.streams.iter_mut().enumerate().filter(|(s, _)| plan.streams[*s]) {
            scope.spawn(move |_| {
                groups.iter().for_each(|group| group.tell(s, grid, plan.grid_rate));
                groups.iter().for_each(|group| group.tell_refreshed(s, grid));
            });
        }
        gradient.fill(0.0);
        for group in groups {
            for (g, d) in gradient.iter_mut().zip(&group.dense) {
                *g += d;
            }
        }
    });
    update_dense(field, dense, gradient, plan);
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
