//! Samples that leave tiles in which others stay.

use super::{TILE, machine};

/// Where tiles are in a slice: `[tile * stride + row * TILE + lane]`.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Rows of a tile.
    pub rows: usize,
    /// Floats from one tile to the next.
    pub stride: usize,
}

impl Layout {
    /// Place of a lane's number in the first row; lanes are counted through all tiles.
    #[inline(always)]
    pub(super) fn place(self, lane: usize) -> usize {
        lane / TILE * self.stride + lane % TILE
    }
}

/// Moves the lanes `kept`, in increasing order, to the front, and fills the rest of the last tile that they take with zeros.
pub fn keep(values: &mut [f32], layout: Layout, kept: &[u32]) {
    let moved = kept.iter().enumerate().find(|(to, from)| *to != **from as usize);
    if let Some((first, _)) = moved
        && !machine::keep_lanes(values, layout, kept, first)
    {
        keep_one_by_one(values, layout, kept, first);
    }
    let ends = kept.len() % TILE;
    if ends > 0 {
        let tile = &mut values[kept.len() / TILE * layout.stride..][..layout.rows * TILE];
        tile.chunks_exact_mut(TILE).for_each(|row| row[ends..].fill(0.0));
    }
}

/// Moves the lanes from the `first` that is not at its place.
fn keep_one_by_one(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) {
    // No lane moves towards the end: its new place has been read before.
    for (to, from) in kept.iter().enumerate().skip(first) {
        let (to, from) = (layout.place(to), layout.place(*from as usize));
        for row in 0..layout.rows {
            values[to + row * TILE] = values[from + row * TILE];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;
    use crate::simd::add_sums;

    #[test]
    fn every_row_has_its_sum() {
        for lanes in [16, 8, 4, 1] {
            // Whole numbers, which no order of summing rounds.
            let value = |n: usize, j: usize, k: usize| (100 * n + j * j + 3 * k) as f32;
            let rows: Vec<f32> =
                (0..12 * lanes).map(|at| value(at / lanes / 4, at / lanes % 4, at % lanes)).collect();
            let mut out = [[1.0; 4]; 3];
            add_sums(&rows, lanes, &mut out);
            for (n, out) in out.iter().enumerate() {
                for (j, sum) in out.iter().enumerate() {
                    let truth: f32 = (0..lanes).map(|k| value(n, j, k)).sum();
                    assert_eq!(*sum, 1.0 + truth, "{lanes} lanes");
                }
            }
        }
    }

    #[test]
    fn kept_lanes_follow_one_another_and_zeros_end_the_last_tile() {
        let mut rng = Rng::new(3, 0, 0);
        for case in 0..300 {
            let (tiles, rows) = (1 + rng.below(5), 1 + rng.below(9));
            let layout = Layout { rows, stride: (rows + rng.below(3)) * TILE };
            let values: Vec<f32> = (0..tiles * layout.stride).map(|n| 1.0 + n as f32).collect();
            // None, some, most and all of them.
            let share = [0.0, 0.1, 0.5, 0.95, 1.0][case % 5];
            let kept: Vec<u32> = (0..(tiles * TILE) as u32).filter(|_| rng.uniform() < share).collect();
            let (mut fast, mut slow) = (values.clone(), values.clone());
            keep(&mut fast, layout, &kept);
            keep_one_by_one(&mut slow, layout, &kept, 0);
            for row in 0..rows {
                let at = |lane: usize| layout.place(lane) + row * TILE;
                for (to, from) in kept.iter().enumerate() {
                    assert_eq!(fast[at(to)], values[at(*from as usize)], "case {case}");
                    assert_eq!(slow[at(to)], fast[at(to)], "case {case}");
                }
                assert!((kept.len()..kept.len().next_multiple_of(TILE)).all(|n| fast[at(n)] == 0.0));
            }
        }
    }
}
