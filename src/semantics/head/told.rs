//! Who hears how far training has come, and when.

use std::ops::ControlFlow;

use super::train::HeadProgress;

/// Steps between two reports.
const REPORT_EVERY: u64 = 50;

/// Whether to go on is asked after every report.
pub(super) type Report<'a> = dyn FnMut(&HeadProgress) -> ControlFlow<()> + 'a;

/// Reports now and then.
pub(super) struct Told<'a, 'b> {
    pub(super) report: &'a mut Report<'b>,
    /// Steps of earlier phases.
    pub(super) done: u64,
    /// Steps of all.
    pub(super) steps: u64,
}

impl Told<'_, '_> {
    /// Tells of step number `step` of a phase; `last`: the phase is over.
    pub(super) fn add(&mut self, what: &'static str, step: u64, last: bool, loss: f64) -> ControlFlow<()> {
        if !step.is_multiple_of(REPORT_EVERY) && !last {
            return ControlFlow::Continue(());
        }
        let fraction = (self.done + step) as f64 / self.steps.max(1) as f64;
        if last {
            self.done += step;
        }
        (self.report)(&HeadProgress { what, step, fraction, loss })
    }
}
