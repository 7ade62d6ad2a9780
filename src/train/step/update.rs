//! The end of a step: density grids and dense weights take what the groups have found, tables when the next one begins.

use std::ops::Range;

use super::{Optimiser, StepPlan};
use crate::field::Field;
use crate::field::hashgrid::FEATURES;
use crate::render::forward::Grids;
use crate::tasks::Tasks;
use crate::train::adam::{self, Moments, StepSize};

/// Updates dense weights and density grids.
pub fn update(optimiser: &mut Optimiser, field: &mut Field, grids: &mut Grids, plan: &StepPlan) {
    let Optimiser { dense, groups, gradient, .. } = optimiser;
    let groups = &groups[..];
    let mut tasks = Tasks::default();
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
