//! What a network sees of a position: level by level a row of four features.
//!
//! Levels are lattices with learned rows (`hashgrid`), or the sines and cosines of NeRF (Mildenhall et al. 2020, section
//! 5.1), which have nothing to learn. Batches, tiles and derivatives are the same for both.

use std::f32::consts::PI;

use super::hashgrid::{Around, FEATURES, HashGrid, Lattice, Points, Row, Slopes};
use crate::simd::{TILE, sin_cos_pi};

/// One row of features of a position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Level {
    /// Interpolated between the rows of a table.
    Lattice(Lattice),
    /// The position itself: x, y, z and a zero.
    Position,
    /// Sine and cosine of one coordinate at two neighbouring bands: ω x and 2 ω x with ω = π · `half_turns`.
    Waves {
        /// Which coordinate of space.
        axis: usize,
        /// Half turns per unit length, 2^k for band k.
        half_turns: f32,
    },
}

/// The levels of one stream.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoding {
    /// In the order in which networks see them.
    pub levels: Vec<Level>,
}

impl From<HashGrid> for Encoding {
    fn from(grid: HashGrid) -> Self {
        Self { levels: grid.levels.into_iter().map(Level::Lattice).collect() }
    }
}

impl Encoding {
    /// The position, and its sines and cosines at 2^k π for k from 0 to below `bands`, an even number.
    ///
    /// There is no time among them: what changes is told by the frame's code alone.
    pub fn frequency(bands: usize) -> Self {
        let waves = (0..bands as i32).step_by(2).flat_map(|band| {
            let half_turns = 2f32.powi(band);
            (0..3).map(move |axis| Level::Waves { axis, half_turns })
        });
        Self { levels: std::iter::once(Level::Position).chain(waves).collect() }
    }

    /// Number of features.
    pub fn width(&self) -> usize {
        self.levels.len() * FEATURES
    }
}

impl Level {
    /// Rows of its table; 0 where nothing is learned.
    pub fn rows(&self) -> usize {
        match self {
            Self::Lattice(lattice) => lattice.rows,
            Self::Position | Self::Waves { .. } => 0,
        }
    }

    /// Rows of its table between which a point is interpolated; 0 where nothing is learned.
    pub fn corners(&self) -> usize {
        match self {
            Self::Lattice(lattice) if lattice.has_time() => 16,
            Self::Lattice(_) => 8,
            Self::Position | Self::Waves { .. } => 0,
        }
    }

    /// Writes the features of tiles of points, a row a point, to what belongs to each: of the lanes of a tile as many as that has rows.
    #[inline(always)]
    pub fn encode<'a>(
        &self,
        table: &[Row],
        tiles: impl Iterator<Item = (&'a Points, &'a mut [Row])>,
        around: &mut Around,
    ) {
        if let Self::Lattice(lattice) = self {
            return lattice.encode(table, tiles, around);
        }
        tiles.for_each(|(pos, out)| self.write(pos, out));
    }

    /// As [`Self::encode`], and each point's derivatives of its features by x, y and z.
    #[inline(always)]
    pub fn encode_with_slopes<'a>(
        &self,
        table: &[Row],
        tiles: impl Iterator<Item = (&'a Points, (&'a mut [Row], &'a mut [Slopes]))>,
        around: &mut Around,
    ) {
        if let Self::Lattice(lattice) = self {
            return lattice.encode_with_slopes(table, tiles, around);
        }
        for (pos, (out, slopes)) in tiles {
            self.write(pos, out);
            for (row, slopes) in out.iter().zip(slopes) {
                *slopes = match *self {
                    Self::Waves { axis, half_turns } => {
                        let mut slopes = [Row::ZERO; 3];
                        slopes[axis] = PI * half_turns * Row::new(row.y, -row.x, 2.0 * row.w, -2.0 * row.z);
                        slopes
                    }
                    _ => [Row::X, Row::Y, Row::Z],
                };
            }
        }
    }

    /// Writes the features of a tile of points, where nothing is learned.
    #[inline(always)]
    fn write(&self, pos: &Points, out: &mut [Row]) {
        if let Self::Waves { axis, half_turns } = *self {
            return waves(&pos[axis], half_turns, out);
        }
        for (s, out) in out.iter_mut().enumerate() {
            *out = Row::new(pos[0][s], pos[1][s], pos[2][s], 0.0);
        }
    }

    /// Adds the gradients of the features of tiles of points, which belong to each, to the rows that they were read from; nothing where
    /// none were.
    #[inline(always)]
    pub fn scatter<'a>(
        &self,
        grads: &mut [Row],
        tiles: impl Iterator<Item = (&'a Points, &'a [Row])>,
        around: &mut Around,
    ) {
        if let Self::Lattice(lattice) = self {
            lattice.scatter(grads, tiles, around);
        }
    }
}

/// Sine and cosine at one band and, by doubling the angle, at the next.
#[inline(always)]
fn waves(x: &[f32; TILE], half_turns: f32, out: &mut [Row]) {
    let (mut sin, mut cos) = ([0.0; TILE], [0.0; TILE]);
    for s in 0..TILE {
        // A product with a power of two is exact, whatever the band.
        (sin[s], cos[s]) = sin_cos_pi(half_turns * x[s]);
    }
    for (s, out) in out.iter_mut().enumerate() {
        let (sin, cos) = (sin[s], cos[s]);
        *out = Row::new(sin, cos, 2.0 * sin * cos, (cos - sin) * (cos + sin));
    }
}

#[cfg(test)]
mod tests {
    use std::iter::once;

    use glam::Vec3;

    use super::*;
    use crate::field::hashgrid::AXES;
    use crate::rng::Rng;

    /// The paper's number of bands.
    const BANDS: usize = 10;

    /// Random points in the box and a little around it.
    fn tile(seed: u64) -> Points {
        let mut rng = Rng::new(seed, 0, 0);
        [[0.0; TILE]; AXES].map(|axis: [f32; TILE]| axis.map(|_| 1.2 * rng.uniform() - 0.1))
    }

    /// Features of one point by their definition, in f64, in the order of the levels.
    fn defined(p: [f64; 3]) -> Vec<f64> {
        let mut out = vec![p[0], p[1], p[2], 0.0];
        for pair in 0..BANDS as i32 / 2 {
            for x in p {
                for band in [2 * pair, 2 * pair + 1] {
                    let angle = 2f64.powi(band) * std::f64::consts::PI * x;
                    out.extend([angle.sin(), angle.cos()]);
                }
            }
        }
        out
    }

    fn at(pos: &Points, lane: usize) -> [f64; 3] {
        [0, 1, 2].map(|axis| f64::from(pos[axis][lane]))
    }

    #[test]
    fn frequencies_are_sines_and_cosines_of_the_position() {
        let encoding = Encoding::frequency(BANDS);
        // NeRF's 63 numbers and a zero.
        assert_eq!(encoding.width(), 3 + 3 * 2 * BANDS + 1);
        for seed in 0..20 {
            let pos = tile(seed);
            for (n, level) in encoding.levels.iter().enumerate() {
                let mut rows = [Row::ZERO; TILE];
                level.encode(&[], once((&pos, &mut rows[..])), &mut Around::default());
                for (lane, row) in rows.iter().enumerate() {
                    let truth = &defined(at(&pos, lane))[n * FEATURES..];
                    for (a, b) in row.to_array().iter().zip(truth) {
                        // Two roundings of numbers of order 1, and what doubling makes of them.
                        assert!((f64::from(*a) - b).abs() < 5e-7, "level {n}: {a} is not {b}");
                    }
                }
            }
        }
    }

    #[test]
    fn slopes_of_frequencies_are_their_derivatives() {
        let encoding = Encoding::frequency(BANDS);
        let pos = tile(100);
        for (n, level) in encoding.levels.iter().enumerate() {
            let (mut rows, mut slopes) = ([Row::ZERO; TILE], [[Row::ZERO; 3]; TILE]);
            level.encode_with_slopes(
                &[],
                once((&pos, (&mut rows[..], &mut slopes[..]))),
                &mut Around::default(),
            );
            let mut plain = [Row::ZERO; TILE];
            level.encode(&[], once((&pos, &mut plain[..])), &mut Around::default());
            assert_eq!(rows, plain);
            for (lane, slopes) in slopes.iter().enumerate() {
                for (axis, slope) in slopes.iter().enumerate() {
                    let moved = |h: f64| {
                        let mut p = at(&pos, lane);
                        p[axis] += h;
                        defined(p)
                    };
                    let (above, below) = (moved(1e-6), moved(-1e-6));
                    for (k, slope) in slope.to_array().iter().enumerate() {
                        let difference = (above[n * FEATURES + k] - below[n * FEATURES + k]) / 2e-6;
                        // The finest band turns by 2^9 π a unit; h² of the third derivative is a millionth of it.
                        let error = (f64::from(*slope) - difference).abs();
                        assert!(error < 1e-5 * 1600.0, "level {n}, axis {axis}: {slope}, not {difference}");
                    }
                }
            }
        }
    }

    #[test]
    fn frequencies_far_from_the_box_stay_bounded() {
        for x in [1e3, -1e3, 1e9, f32::MAX, f32::MIN, f32::INFINITY, f32::NAN] {
            for level in &Encoding::frequency(BANDS).levels[1..] {
                let mut rows = [Row::ZERO; TILE];
                let pos = [[x; TILE]; AXES];
                level.encode(&[], once((&pos, &mut rows[..])), &mut Around::default());
                assert!(x.is_nan() || rows[0].abs().max_element() < 1.001, "{x}: {}", rows[0]);
            }
        }
    }

    #[test]
    fn the_levels_of_an_encoding_know_what_is_learned() {
        let grid = HashGrid::new(Vec3::ONE, 2, Vec3::splat(4.0), Vec3::splat(40.0), 9);
        let rows: Vec<usize> = grid.levels.iter().map(|l| l.rows).collect();
        let encoding = Encoding::from(grid);
        assert_eq!(encoding.levels.iter().map(Level::rows).collect::<Vec<_>>(), rows);
        assert!(Encoding::frequency(BANDS).levels.iter().all(|l| l.rows() == 0));
    }
}
