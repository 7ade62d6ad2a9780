//! The end of a step for one table: what all batches found out about its rows goes into them.

use pulp::{Simd, WithSimd};

use super::adam::{StepSize, TableState};
use crate::field::encoding::Level;
use crate::field::hashgrid::Row;
use crate::field::stream::StreamBatch;

/// Scatters one level's gradients, batch after batch, and updates its table.
pub struct TablePass<'a, B> {
    /// Batches that were encoded and gone back through.
    pub batches: B,
    /// Number of the level.
    pub number: usize,
    /// What it is.
    pub level: &'a Level,
    /// Its rows.
    pub table: &'a mut [Row],
    /// Gradients and moments of the rows.
    pub state: &'a mut TableState,
    /// How far a step goes.
    pub rate: StepSize,
}

impl<'a, B: Iterator<Item = &'a StreamBatch>> WithSimd for TablePass<'_, B> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self { batches, number, level, table, state, rate } = self;
        for batch in batches.filter(|b| !b.is_empty()) {
            level.scatter(&mut state.grad, batch.tiles(), &batch.levels[number].rows[..batch.len()]);
        }
        state.update(table, rate);
    }
}
