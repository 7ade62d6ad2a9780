//! The end of a step for one table: what all batches found out about its rows goes into them.

use pulp::{Simd, WithSimd};

use super::adam::{StepSize, TableState};
use crate::field::batch::StreamBatch;
use crate::field::encoding::Level;
use crate::field::hashgrid::{Around, Row};
use crate::tasks::PerThread;

/// Buffers of one thread, used for one table after the other.
#[derive(Default)]
pub struct TableScratch {
    /// Gradients of the rows of the table that the thread is at; zeros between tables.
    gradient: Vec<Row>,
    around: Around,
}

/// Scatters one level's gradients, batch after batch, and updates its table; gives the rows that it has updated.
pub struct TablePass<'a, B> {
    /// Batches that were encoded and gone back through.
    pub batches: B,
    /// Number of the level.
    pub number: usize,
    /// What it is.
    pub level: &'a Level,
    /// Its rows.
    pub table: &'a mut [Row],
    /// Moments of the rows.
    pub state: &'a mut TableState,
    /// How far a step goes.
    pub rate: StepSize,
    /// Buffers of the threads, of which the pass takes its own thread's.
    pub scratch: &'a PerThread<TableScratch>,
}

impl<'a, B: Iterator<Item = &'a StreamBatch> + Clone> TablePass<'a, B> {
    /// Rows that it adds to, and rows that it updates, which take about as long.
    pub fn cost(&self) -> usize {
        let points: usize = self.batches.clone().map(StreamBatch::len).sum();
        points * self.level.corners() + self.table.len()
    }
}

impl<'a, B: Iterator<Item = &'a StreamBatch>> WithSimd for TablePass<'_, B> {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> usize {
        let Self { batches, number, level, table, state, rate, scratch } = self;
        let TableScratch { gradient, around } = &mut *scratch.mine();
        if gradient.len() < table.len() {
            gradient.resize(table.len(), Row::ZERO);
        }
        let gradient = &mut gradient[..table.len()];
        let tiles = batches.filter(|b| !b.is_empty()).flat_map(|b| b.encoded(number));
        level.scatter(gradient, tiles, around);
        state.update(simd, table, gradient, rate)
    }
}
