//! Rows of a table at the corners of the cells that points are in: read between, and added to.
//!
//! The rows of two corners that differ in x stand side by side in a vector, so that a cell has four of those; where lattices have a
//! row for each of their points, two such rows follow one another in the table as well.

use glam::Vec4;

use super::{TILE, machine, prefetch};

/// Derivatives of a row by x, y and z.
pub type Slopes = [Vec4; 3];

/// A table of no more rows stays so near to a core (256 KiB) that asking for its rows takes longer than waiting for them.
const NEAR: usize = 16_384;

/// The eight rows around each point of a tile, x fastest, then y, then z.
#[derive(Clone)]
pub struct Corners {
    /// Numbers of the rows, `[corner][lane]`; with `edges` of the first corner alone.
    pub rows: [[u32; TILE]; 8],
    /// Where the rows of all cells stand alike: how far from the first corner's those of the four corners with the smaller x are; those
    /// of the other four are one behind each.
    pub edges: Option<[u32; 4]>,
    /// Where the points are between the corners, `[axis][lane]`, 0–1.
    pub frac: [[f32; TILE]; 3],
}

impl Default for Corners {
    fn default() -> Self {
        Self { rows: [[0; TILE]; 8], edges: None, frac: [[0.0; TILE]; 3] }
    }
}

impl Corners {
    /// Number of the row at corner `corner` of lane `lane`.
    #[inline(always)]
    fn row(&self, corner: usize, lane: usize) -> usize {
        let number = match self.edges {
            Some(edges) => self.rows[0][lane] + edges[corner / 2] + (corner % 2) as u32,
            None => self.rows[corner][lane],
        };
        number as usize
    }

    /// Whether a table of `rows` rows has all of those around the first points.
    #[inline(always)]
    pub(super) fn are_within(&self, points: usize, rows: usize) -> bool {
        let largest = |corner: usize| self.rows[corner][..points].iter().fold(0, |most, row| *row.max(&most));
        let last = match self.edges {
            Some(edges) => largest(0) as usize + edges.into_iter().fold(0, u32::max) as usize + 1,
            None => (0..8).map(largest).fold(0, u32::max) as usize,
        };
        points == 0 || last < rows
    }

    /// Asks for the rows around the point of lane `lane` before they are needed.
    #[inline(always)]
    pub fn fetch(&self, table: &[Vec4], lane: usize) {
        if let Some(first) = table.first() {
            for corner in 0..8 {
                prefetch(first, self.row(corner, lane) * size_of::<Vec4>());
            }
        }
    }

    /// What is between the rows around the point of lane `lane`, and its derivatives by the three fractions.
    #[inline(always)]
    pub fn interpolate(&self, table: &[Vec4], lane: usize) -> (Vec4, Slopes) {
        let [fx, fy, fz] = self.frac.each_ref().map(|frac| frac[lane]);
        // By y along four edges, by z across two faces, by x through the cell.
        let [low, high] = [0, 1].map(|x| {
            let [a, b, c, d] = [0, 2, 4, 6].map(|corner| table[self.row(corner + x, lane)]);
            let (e, f) = (a + (b - a) * fy, c + (d - c) * fy);
            [e + (f - e) * fz, (b - a) + ((d - c) - (b - a)) * fz, f - e]
        });
        let between = |n: usize| low[n] + (high[n] - low[n]) * fx;
        (between(0), [high[0] - low[0], between(1), between(2)])
    }

    /// Adds `g` to the rows around the point of lane `lane`, by the weights with which they are read.
    #[inline(always)]
    fn scatter(&self, table: &mut [Vec4], lane: usize, g: Vec4) {
        let [fx, fy, fz] = self.frac.each_ref().map(|frac| frac[lane]);
        let [low, high] = [g * (1.0 - fx), g * fx].map(|g| {
            let (near, far) = (g * (1.0 - fz), g * fz);
            [near * (1.0 - fy), near * fy, far * (1.0 - fy), far * fy]
        });
        for edge in 0..4 {
            table[self.row(2 * edge, lane)] += low[edge];
            table[self.row(2 * edge + 1, lane)] += high[edge];
        }
    }
}

/// Writes what is between the rows of `table` around the first points of a tile to `out`, and asks for the rows around `next` ones.
#[inline(always)]
pub fn interpolate(table: &[Vec4], corners: &Corners, next: &Corners, out: &mut [Vec4]) {
    if !machine::interpolate(table, corners, ahead(table, next), out) {
        for (lane, out) in out.iter_mut().enumerate() {
            *out = corners.interpolate(table, lane).0;
        }
    }
}

/// Adds gradients `g` of the first points of a tile to the rows of `table` around them, by the weights with which they are read, and
/// asks for the rows around `next` ones.
#[inline(always)]
pub fn scatter(table: &mut [Vec4], corners: &Corners, next: &Corners, g: &[Vec4]) {
    let ahead = ahead(table, next);
    if !machine::scatter(table, corners, ahead, g) {
        for (lane, g) in g.iter().enumerate() {
            corners.scatter(table, lane, *g);
        }
    }
}

/// What is worth asking for.
#[inline(always)]
fn ahead<'a>(table: &[Vec4], next: &'a Corners) -> Option<&'a Corners> {
    (table.len() > NEAR).then_some(next)
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;
    use crate::rng::Rng;

    /// Corners of random cells of a table of `rows` rows.
    fn corners(rng: &mut Rng, rows: usize, alike: bool) -> Corners {
        let mut corners = Corners { edges: alike.then_some([0, 7, 60, 67]), ..Corners::default() };
        let below = if alike { rows - 68 } else { rows };
        corners.rows.iter_mut().flatten().for_each(|row| *row = rng.below(below) as u32);
        corners.frac.iter_mut().flatten().for_each(|frac| *frac = rng.uniform());
        corners
    }

    /// A near table and a far one, cells that are alike and others, some and all points of a tile.
    fn cases() -> impl Iterator<Item = (usize, bool, usize)> {
        [100, NEAR + 100].into_iter().flat_map(|rows| {
            [false, true].into_iter().flat_map(move |alike| [0, 5, TILE].map(|points| (rows, alike, points)))
        })
    }

    fn random_rows(rng: &mut Rng, rows: usize) -> Vec<Vec4> {
        (0..rows).map(|_| Vec4::from_array([(); 4].map(|()| rng.uniform() - 0.5))).collect()
    }

    #[test]
    fn a_tile_is_read_as_its_points_are() {
        for (rows, alike, points) in cases() {
            let mut rng = Rng::new(5, rows as u64, points as u64);
            let (table, [now, next]) =
                (random_rows(&mut rng, rows), [(); 2].map(|()| corners(&mut rng, rows, alike)));
            let mut out = vec![Vec4::ONE; points];
            interpolate(&table, &now, &next, &mut out);
            assert!(out.iter().enumerate().all(|(lane, out)| *out == now.interpolate(&table, lane).0));
        }
    }

    #[test]
    fn a_tile_is_added_as_its_points_are() {
        for (rows, alike, points) in cases() {
            let mut rng = Rng::new(6, rows as u64, points as u64);
            let [now, next] = [(); 2].map(|()| corners(&mut rng, rows, alike));
            let (mut fast, g) = (random_rows(&mut rng, rows), random_rows(&mut rng, points));
            let mut slow = fast.clone();
            scatter(&mut fast, &now, &next, &g);
            g.iter().enumerate().for_each(|(lane, g)| now.scatter(&mut slow, lane, *g));
            assert!(fast == slow);
        }
    }

    #[test]
    fn rows_that_a_table_does_not_have_are_not_touched() {
        for alike in [false, true] {
            let (mut rng, next) = (Rng::new(7, 0, 0), Corners::default());
            let mut beyond = corners(&mut rng, 100, alike);
            beyond.rows[0][3] = if alike { 32 } else { 100 };
            let (mut table, mut out) = (vec![Vec4::ONE; 100], [Vec4::ONE; TILE]);
            // Nobody asks for the point of lane 3.
            interpolate(&table, &beyond, &next, &mut out[..3]);
            let read = catch_unwind(AssertUnwindSafe(|| interpolate(&table, &beyond, &next, &mut out)));
            let added =
                catch_unwind(AssertUnwindSafe(|| scatter(&mut table, &beyond, &next, &[Vec4::ONE; TILE])));
            assert!(read.is_err() && added.is_err());
        }
    }
}
