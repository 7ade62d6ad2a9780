//! 64 cells at a time: which are on the surface, which of their edges it cuts, and their triangles.

use std::sync::LazyLock;

use crate::extract::mc_table::{EDGES, TABLE};

/// Bit rows at (y, z), (y + 1, z), (y, z + 1) and (y + 1, z + 1).
pub(super) type Rows<'a> = [&'a [u64]; 4];

/// Edges that start at the low end of a cell: along x in the four rows, along y at z and z + 1, along z at y and
/// y + 1. The remaining four are those along y and z of the next cell.
const STARTS: usize = 8;

/// A word of cells.
pub(super) struct Word {
    /// Bit x of each: whether that corner of cell x is inside.
    corners: [u64; 8],
    /// Bit x of each: whether the surface cuts that edge of cell x.
    pub(super) cuts: [u64; STARTS],
    /// Cells with a cut edge. Edges of the last corner of a row belong to no cell.
    pub(super) active: u64,
}

impl Word {
    /// Places in `cuts` of the edges that start at corner (y, z).
    pub(super) const OWN: [usize; 3] = [0, 4, 6];

    /// Word `w` of rows with `cells` cells.
    #[inline(always)]
    pub(super) fn new(rows: &Rows, w: usize, cells: usize) -> Self {
        let mut corners = [0; 8];
        let mut cuts = [0; STARTS];
        // Bits past the end of a row are zero and no cells.
        let within = low_bits(cells.saturating_sub(w * 64));
        for r in 0..4 {
            let here = rows[r][w];
            let next = here >> 1 | rows[r].get(w + 1).map_or(0, |n| n << 63);
            (corners[2 * r], corners[2 * r + 1]) = (here, next);
            cuts[r] = (here ^ next) & within;
        }
        let [a, _, b, _, c, _, d, _] = corners;
        (cuts[4], cuts[5], cuts[6], cuts[7]) = (a ^ b, c ^ d, a ^ c, b ^ d);
        let any = cuts.iter().fold(0, |any, c| any | c);
        Self { corners, cuts, active: any & within }
    }

    /// The case of cell `x`: bit c = corner c is inside.
    #[inline(always)]
    fn case(&self, x: u32) -> usize {
        let mut case = 0;
        for (c, corner) in self.corners.iter().enumerate() {
            case |= (corner >> x & 1) << c;
        }
        case as usize
    }

    /// How many triangles its cells have.
    #[inline(always)]
    pub(super) fn count_triangles(&self, cases: &Cases) -> usize {
        let (mut count, mut active) = (0, self.active);
        while active != 0 {
            count += usize::from(cases.0[self.case(active.trailing_zeros()) & 255].count);
            active &= active - 1;
        }
        count
    }
}

/// The numbers of the next vertices along four rows of cells.
pub(super) struct Numbers(pub(super) [u32; STARTS]);

impl Numbers {
    /// Writes the triangles of a word's cells to the front of `out`, which is shortened by them.
    ///
    /// Words must come in order: a cell takes the numbers that the cells before it left.
    #[inline(always)]
    pub(super) fn write_triangles(&mut self, word: &Word, cases: &Cases, out: &mut &mut [[u32; 3]]) {
        let mut active = word.active;
        while active != 0 {
            let x = active.trailing_zeros();
            active &= active - 1;
            let mut numbers = [0; 2 * STARTS];
            let (before, after) = numbers.split_at_mut(STARTS);
            before.copy_from_slice(&self.0);
            for k in 0..STARTS {
                self.0[k] += (word.cuts[k] >> x) as u32 & 1;
            }
            after.copy_from_slice(&self.0);
            let case = &cases.0[word.case(x) & 255];
            let cell = out.split_off_mut(..usize::from(case.count)).unwrap_or_default();
            for (triangle, places) in cell.iter_mut().zip(&case.places) {
                *triangle = places.map(|p| numbers[usize::from(p) % (2 * STARTS)]);
            }
        }
    }
}

/// The triangles of a case.
#[derive(Clone, Copy, Default)]
struct Case {
    count: u8,
    /// Corners of the triangles, as places in the numbers before the cell and, from [`STARTS`], behind it.
    places: [[u8; 3]; 5],
}

/// All cases.
pub(super) struct Cases([Case; 256]);

/// The table of marching cubes with places of vertex numbers instead of edges.
pub(super) static CASES: LazyLock<Cases> = LazyLock::new(|| {
    Cases(std::array::from_fn(|case| {
        let mut found = Case::default();
        let triangles = TABLE.triangles(case as u8);
        found.count = triangles.len() as u8;
        for (places, edges) in found.places.iter_mut().zip(triangles) {
            *places = edges.map(place);
        }
        found
    }))
});

/// Where the number of edge `e`'s vertex is.
fn place(e: u8) -> u8 {
    let (axis, [dx, dy, dz]) = EDGES[usize::from(e)];
    let start = match axis {
        0 => dy + 2 * dz,
        1 => 4 + dz,
        _ => 6 + dy,
    };
    (start + STARTS * dx) as u8
}

/// A mask of the lowest `n` bits; all for n ≥ 64.
#[inline(always)]
fn low_bits(n: usize) -> u64 {
    if n >= 64 { u64::MAX } else { (1 << n) - 1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_case_has_more_triangles_than_there_is_room_for() {
        let most = (0..=255).map(|case| TABLE.triangles(case).len()).max();
        assert_eq!(most, Some(5));
    }
}
