//! The tables' part of a step: each takes what the last samples have found out about its rows, and then says what it is at
//! the next ones, while it is near a core.

use std::sync::atomic::{AtomicUsize, Ordering};

use pulp::{Simd, WithSimd};

use super::adam::{StepSize, TableState};
use crate::field::batch::{LevelTask, StreamBatch};
use crate::field::encoding::Encoding;
use crate::field::hashgrid::{Around, Row};
use crate::tasks::{PerThread, Tasks};

/// Buffers of one thread, used for one table after the other.
#[derive(Default)]
pub struct TableScratch {
    /// Gradients of the rows of the table that the thread is at; zeros between tables.
    gradient: Vec<Row>,
    /// For the numbers of cache lines of those that are not zeros.
    lines: Vec<u32>,
    around: Around,
}

/// The tables of one stream.
pub struct StreamTables<'a> {
    /// What the levels are.
    pub encoding: &'a Encoding,
    /// Their rows.
    pub tables: &'a mut [Vec<Row>],
    /// Moments of the rows.
    pub states: &'a mut [TableState],
    /// How far a step goes; `None` where no gradients were put off.
    pub rate: Option<StepSize>,
}

/// Updates tables by the gradients that batches have [put off](StreamBatch::put_off), and encodes the batches' samples, level by
/// level; batches come with the number of their stream, of those that are there. Gives the rows that were updated, with those beside
/// them on a cache line.
pub fn update_and_encode<'a>(
    streams: impl Iterator<Item = Option<StreamTables<'a>>>,
    batches: impl Iterator<Item = (usize, &'a mut StreamBatch)>,
    scratch: &PerThread<TableScratch>,
) -> usize {
    let mut streams: Vec<_> =
        streams.map(|stream| stream.map(|stream| (stream, Vec::<LevelTask>::new()))).collect();
    for (s, batch) in batches {
        let Some((StreamTables { encoding, .. }, levels)) = &mut streams[s] else { continue };
        let of_batch = batch.tasks(encoding);
        if levels.is_empty() {
            *levels = of_batch;
        } else {
            levels.iter_mut().zip(of_batch).for_each(|(task, of_batch)| task.append(of_batch));
        }
    }
    let arch = pulp::Arch::new();
    let (mut tasks, updated) = (Tasks::default(), &AtomicUsize::new(0));
    for (StreamTables { tables, states, rate, .. }, levels) in streams.into_iter().flatten() {
        for ((task, table), state) in levels.into_iter().zip(tables).zip(states) {
            let pass = TablePass { task, table, state, rate, scratch };
            tasks.add(pass.cost(), move || {
                updated.fetch_add(arch.dispatch(pass), Ordering::Relaxed);
            });
        }
    }
    tasks.run();
    updated.load(Ordering::Relaxed)
}

/// Scatters one level's gradients, batch after batch, updates its table, and encodes on that level.
struct TablePass<'a> {
    task: LevelTask<'a>,
    table: &'a mut [Row],
    state: &'a mut TableState,
    rate: Option<StepSize>,
    scratch: &'a PerThread<TableScratch>,
}

impl TablePass<'_> {
    /// Rows that it adds to and looks up, and rows that it updates, which take about as long.
    fn cost(&self) -> usize {
        self.task.cost() + self.rate.map_or(0, |_| self.table.len())
    }
}

impl WithSimd for TablePass<'_> {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> usize {
        let Self { task, table, state, rate, scratch } = self;
        let TableScratch { gradient, lines, around } = &mut *scratch.mine();
        let mut updated = 0;
        if let Some(rate) = rate {
            if gradient.len() < table.len() {
                gradient.resize(table.len(), Row::ZERO);
            }
            let gradient = &mut gradient[..table.len()];
            task.scatter(gradient, around);
            updated = state.update(simd, table, gradient, rate, lines);
        }
        task.encode(table, around);
        updated
    }
}
