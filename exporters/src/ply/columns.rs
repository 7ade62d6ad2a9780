//! Columns of 32-bit values → neighbouring bytes of rows, four columns and four rows at a time.

const TILE: usize = 4;

/// Puts the values of `columns` from `first_row` on at byte `at` of each `stride`-byte row of `rows`, side by side.
pub(super) fn pack_columns<T: Copy>(
    rows: &mut [u8],
    stride: usize,
    at: usize,
    first_row: usize,
    columns: &[&[T]],
    bytes: impl Fn(T) -> [u8; 4] + Copy,
) {
    let (tiles, rest) = columns.as_chunks::<TILE>();
    for (n, columns) in tiles.iter().enumerate() {
        pack_tiles(rows, stride, at + 4 * TILE * n, first_row, columns, bytes);
    }
    match columns.last_chunk::<TILE>() {
        // Columns that are there already once more, which is faster than the rest by itself.
        Some(last) if !rest.is_empty() => {
            pack_tiles(rows, stride, at + 4 * (columns.len() - TILE), first_row, last, bytes);
        }
        _ => {
            for (n, column) in rest.iter().enumerate() {
                pack_items(rows, stride, at + 4 * n, &column[first_row..], bytes);
            }
        }
    }
}

fn pack_tiles<T: Copy>(
    rows: &mut [u8],
    stride: usize,
    at: usize,
    first_row: usize,
    columns: &[&[T]; TILE],
    bytes: impl Fn(T) -> [u8; 4] + Copy,
) {
    let count = rows.len() / stride;
    let mut cut: [&[T]; TILE] = [&[]; TILE];
    for (cut, column) in cut.iter_mut().zip(columns) {
        *cut = &column[first_row..first_row + count];
    }
    let [(a, _), (b, _), (c, _), (d, _)] = [cut[0], cut[1], cut[2], cut[3]].map(<[T]>::as_chunks::<TILE>);
    for (tile, rows) in rows.chunks_exact_mut(TILE * stride).enumerate() {
        // All are loaded before the first is stored, and each is stored by itself: sixteen bytes put together in memory
        // would be loaded before they are there.
        let [a, b, c, d] = [a[tile], b[tile], c[tile], d[tile]];
        for r in 0..TILE {
            let row = rows[r * stride + at..][..4 * TILE].as_chunks_mut::<4>().0;
            row[0] = bytes(a[r]);
            row[1] = bytes(b[r]);
            row[2] = bytes(c[r]);
            row[3] = bytes(d[r]);
        }
    }
    let whole = count - count % TILE;
    for (n, column) in cut.iter().enumerate() {
        pack_items(&mut rows[whole * stride..], stride, at + 4 * n, &column[whole..], bytes);
    }
}

/// Puts the bytes of an item at byte `at` of each `stride`-byte row of `rows`.
///
/// Rows are counted, not iterated over: `zip` with chunks calls a function for each of them where the standard library is
/// not optimised together with this crate.
pub(super) fn pack_items<T: Copy, const N: usize>(
    rows: &mut [u8],
    stride: usize,
    at: usize,
    items: &[T],
    bytes: impl Fn(T) -> [u8; N],
) {
    let count = rows.len() / stride;
    for (r, &item) in items[..count].iter().enumerate() {
        rows[r * stride + at..][..N].copy_from_slice(&bytes(item));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every number of columns and rows about a tile, at an odd place in the row.
    #[test]
    fn every_value_comes_to_its_place_and_nothing_else_changes() {
        const ROWS: usize = 11;
        let columns: Vec<Vec<f32>> =
            (0..10).map(|c| (0..ROWS + 5).map(|r| (100 * c + r) as f32).collect()).collect();
        let columns: Vec<&[f32]> = columns.iter().map(Vec::as_slice).collect();
        for count in 0..=columns.len() {
            for (rows, first_row) in (0..=ROWS).zip([0, 1, 5].into_iter().cycle()) {
                let (at, stride) = (3, 3 + 4 * count + 2);
                let mut packed = vec![7; rows * stride];
                pack_columns(&mut packed, stride, at, first_row, &columns[..count], f32::to_le_bytes);
                let mut expected = Vec::new();
                for r in 0..rows {
                    expected.extend([7; 3]);
                    expected
                        .extend((0..count).flat_map(|c| ((100 * c + first_row + r) as f32).to_le_bytes()));
                    expected.extend([7; 2]);
                }
                assert_eq!(packed, expected, "{count} columns, {rows} rows from {first_row}");
            }
        }
    }
}
