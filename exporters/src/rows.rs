//! Rows of a fixed number of bytes, packed on all cores and written in order.

use std::io::{self, Write};

use rayon::prelude::*;

/// Bytes of rows that a column is spread over at a time. They stay in the first-level cache while one column after the
/// other passes over them; from the second level, forty columns take four times as long.
pub(crate) const CHUNK_BYTES: usize = 16 * 1024;

/// Chunks but for the last have a multiple of so many rows, for packers that take some at once.
const ROWS_AT_ONCE: usize = 4;

/// Bytes handed to the system at a time, for each thread that packs them.
const BATCH_BYTES: usize = 1 << 20;

/// Packs chunks of rows in parallel while the batch before is written.
///
/// `pack` gets the index of a chunk's first row and its bytes, `stride` a row.
///
/// # Errors
/// Those of `file`.
pub(crate) fn write_rows(
    file: &mut (impl Write + Send),
    rows: usize,
    stride: usize,
    pack: impl Fn(usize, &mut [u8]) + Sync,
) -> io::Result<()> {
    let rows_per_chunk = (CHUNK_BYTES / stride).next_multiple_of(ROWS_AT_ONCE).max(ROWS_AT_ONCE);
    let chunks_per_batch = (BATCH_BYTES / CHUNK_BYTES) * rayon::current_num_threads();
    let rows_per_batch = rows_per_chunk * chunks_per_batch;
    let pack_batch = |first_row: usize, batch: &mut Vec<u8>| {
        batch.resize(rows_per_batch.min(rows.saturating_sub(first_row)) * stride, 0);
        batch
            .par_chunks_mut(rows_per_chunk * stride)
            .enumerate()
            .for_each(|(chunk, bytes)| pack(first_row + chunk * rows_per_chunk, bytes));
    };
    let (mut packed, mut next) = (Vec::new(), Vec::new());
    // On one of the pool's threads: from outside, both sides of each `join` would wait for one to wake up.
    rayon::scope(|_| {
        pack_batch(0, &mut packed);
        for first_row in (0..rows).step_by(rows_per_batch) {
            let (written, ()) =
                rayon::join(|| file.write_all(&packed), || pack_batch(first_row + rows_per_batch, &mut next));
            written?;
            std::mem::swap(&mut packed, &mut next);
        }
        Ok(())
    })
}

/// [`write_rows`] with one item a row.
///
/// # Errors
/// Those of `file`.
pub(crate) fn write_items<T: Sync, const N: usize>(
    file: &mut (impl Write + Send),
    items: &[T],
    bytes: impl Fn(&T) -> [u8; N] + Sync,
) -> io::Result<()> {
    write_rows(file, items.len(), N, |first, rows| {
        for (to, item) in rows.as_chunks_mut::<N>().0.iter_mut().zip(&items[first..]) {
            *to = bytes(item);
        }
    })
}

/// Words in little endian; as they lie in memory, on most machines.
///
/// # Errors
/// Those of `file`.
pub(crate) fn write_words(file: &mut (impl Write + Send), words: &[u32]) -> io::Result<()> {
    if cfg!(target_endian = "little") {
        file.write_all(bytemuck::cast_slice(words))
    } else {
        write_items(file, words, |word| word.to_le_bytes())
    }
}

/// Three words in little endian. Spelt out: `array::map` with a closure was a call for each of them.
pub(crate) fn triple_bytes([a, b, c]: [u32; 3]) -> [u8; 12] {
    bytemuck::cast([a.to_le(), b.to_le(), c.to_le()])
}
