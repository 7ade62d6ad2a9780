//! Multi-resolution hash grid (Müller et al. 2022, instant-ngp, section 3): a point's features, forward and backward.
//!
//! Each level is one table of rows of four floats, at most 2 MiB, so that it stays in a core's L2 while a batch is
//! gathered from it or scattered into it. A level whose lattice fits its table is stored densely; only finer levels
//! hash. Levels are separate so that gradients can be scattered by one task a level, without atomics and in a fixed
//! order.

use std::mem::swap;

use glam::{Vec3, Vec4};

pub use crate::simd::rows::Slopes;
use crate::simd::rows::{self, Corners};
use crate::simd::{TILE, floor_within};

/// Features per level: one 16-byte row.
pub const FEATURES: usize = 4;

/// One table row; a `Vec4` rather than an array because the compiler keeps it in one vector register.
pub type Row = Vec4;

/// Axes that lattices can span: three of space, and time.
pub const AXES: usize = 4;

/// The axis of time.
pub const TIME: usize = 3;

/// Points of one tile, `[axis][lane]`.
pub type Points = [[f32; TILE]; AXES];

/// One level: a lattice whose points have rows of a table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Cells per unit length.
    pub scale: Vec3,
    /// Cells over the whole of time; 0 for a lattice of space alone.
    pub time_scale: f32,
    /// Largest cell index along each axis.
    last_cell: [u32; AXES],
    /// Row strides of a dense level; the multipliers of a hashed one.
    stride: [u32; AXES],
    /// Rows in the table.
    pub rows: usize,
    /// Whether lattice points map to rows one to one.
    pub dense: bool,
}

/// The corners around each point of a tile; for a lattice with time those before it and those after it.
#[derive(Clone)]
struct Cells {
    before: Corners,
    after: Corners,
    /// Share of the latter.
    fraction: [f32; TILE],
}

/// The cells around the points of two tiles that follow each other: a buffer, which what encodes or scatters overwrites.
pub struct Around([Cells; 2]);

impl Default for Around {
    fn default() -> Self {
        let none = Cells { before: Corners::default(), after: Corners::default(), fraction: [0.0; TILE] };
        Self([none.clone(), none])
    }
}

/// Tiles of points and what belongs to each, with the cells around the points.
///
/// Those of a tile are found before the one before it is dealt with, so that its rows can be asked for meanwhile: they are too far
/// apart for the processor to foresee, and a tile takes longer than the way to the farthest cache.
struct Walk<'a, I, T> {
    lattice: &'a Lattice,
    tiles: I,
    /// Around the points of the tile that [`Self::advance`] has given.
    now: &'a mut Cells,
    /// Around those of the tile behind it; behind the last, of one that was before.
    next: &'a mut Cells,
    /// What belongs to the latter.
    waiting: Option<T>,
}

impl<'a, 'p, T, I: Iterator<Item = (&'p Points, T)>> Walk<'a, I, T> {
    #[inline(always)]
    fn new(lattice: &'a Lattice, table: &[Row], tiles: I, around: &'a mut Around) -> Self {
        let Around([now, next]) = around;
        let mut walk = Self { lattice, tiles, now, next, waiting: None };
        walk.look();
        if walk.waiting.is_some() {
            (0..TILE).for_each(|s| walk.fetch(table, s));
        }
        walk
    }

    /// Goes on to the next tile: what belongs to it.
    #[inline(always)]
    fn advance(&mut self) -> Option<T> {
        let current = self.waiting.take()?;
        swap(&mut self.now, &mut self.next);
        self.look();
        Some(current)
    }

    /// Finds what is around the points of the tile behind all that were found.
    #[inline(always)]
    fn look(&mut self) {
        if let Some((pos, waiting)) = self.tiles.next() {
            self.lattice.find(pos, self.next);
            self.waiting = Some(waiting);
        }
    }

    /// Asks for the rows around the point of lane `s` of the next tile.
    #[inline(always)]
    fn fetch(&self, table: &[Row], s: usize) {
        self.next.before.fetch(table, s);
        if self.lattice.has_time() {
            self.next.after.fetch(table, s);
        }
    }
}

/// Shape of a grid over the box `[0, extent]`.
#[derive(Clone, Debug, PartialEq)]
pub struct HashGrid {
    /// Coarse to fine.
    pub levels: Vec<Lattice>,
}

impl HashGrid {
    /// `levels` lattices from `coarsest` to `finest` cells per unit length in geometric progression over the box
    /// `[0, extent]`, each with at most `2^log2_rows` rows.
    pub fn new(extent: Vec3, levels: usize, coarsest: Vec3, finest: Vec3, log2_rows: u32) -> Self {
        let growth = |n: usize| if levels > 1 { n as f32 / (levels - 1) as f32 } else { 0.0 };
        let levels = (0..levels)
            .map(|n| {
                let scale = coarsest * (finest / coarsest).powf(growth(n));
                Lattice::new(extent, scale, 0.0, 1usize << log2_rows)
            })
            .collect();
        Self { levels }
    }

    /// Adds `levels` lattices over space and time, from `coarsest` to `finest` cells per unit of space and of time.
    ///
    /// A frame's code can only modulate what space alone tells; here things can be at one place now and at another
    /// one then.
    pub fn with_time(
        mut self,
        extent: Vec3,
        levels: usize,
        coarsest: [f32; 2],
        finest: [f32; 2],
        log2_rows: u32,
    ) -> Self {
        self.levels.extend((0..levels).map(|n| {
            let growth = if levels > 1 { n as f32 / (levels - 1) as f32 } else { 1.0 };
            let [space, time] = std::array::from_fn(|k| coarsest[k] * (finest[k] / coarsest[k]).powf(growth));
            Lattice::new(extent, Vec3::splat(space), time, 1usize << log2_rows)
        }));
        self
    }
}

/// The coarsest and the finest cells per unit of space and of time that are asked for, made so large that every lattice
/// between them fits `2^log2_rows` rows (4 or more) without hashing.
///
/// The finest lattice shrinks alike along all axes; levels are then spread up to it, so that no two are the same.
pub fn without_hashing(
    extent: Vec3,
    coarsest: [f32; 2],
    finest: [f32; 2],
    log2_rows: u32,
) -> ([f32; 2], [f32; 2]) {
    let fits = |share: f32| {
        let [space, time] = finest.map(|scale| share * scale);
        let points = points(extent, Vec3::splat(space), time);
        points.iter().map(|&p| p as usize).product::<usize>() <= 1 << log2_rows
    };
    // Bisection to the last bits of the share, which leaves the side that fits.
    let (mut share, mut beyond) = if fits(1.0) { (1.0, 1.0) } else { (0.0, 1.0) };
    while beyond - share > f32::EPSILON {
        let middle = 0.5 * (share + beyond);
        *(if fits(middle) { &mut share } else { &mut beyond }) = middle;
    }
    let finest = finest.map(|scale| share * scale);
    (std::array::from_fn(|k| coarsest[k].min(finest[k])), finest)
}

/// Lattice points along each axis.
fn points(extent: Vec3, scale: Vec3, time_scale: f32) -> [u32; AXES] {
    let cells = (extent * scale).ceil().max(Vec3::ONE).as_uvec3();
    [cells.x + 1, cells.y + 1, cells.z + 1, time_scale.ceil() as u32 + 1]
}

impl Lattice {
    fn new(extent: Vec3, scale: Vec3, time_scale: f32, max_rows: usize) -> Self {
        let points = points(extent, scale, time_scale);
        let lattice = points.iter().map(|&p| p as usize).product::<usize>();
        let dense = lattice <= max_rows;
        let (stride, rows) = if dense {
            ([1, points[0], points[0] * points[1], points[0] * points[1] * points[2]], lattice)
        } else {
            // Instant-ngp's primes and one more; 1 for x keeps neighbours in x on one cache line.
            ([1, 2_654_435_761, 805_459_861, 3_674_653_429], max_rows)
        };
        let last_cell = points.map(|p| p.saturating_sub(2));
        Self { scale, time_scale, last_cell, stride, rows, dense }
    }

    /// Writes the features of tiles of points, a row a point, to what belongs to each: of the lanes of a tile as many as that has rows.
    #[inline(always)]
    pub fn encode<'a>(
        &self,
        table: &[Row],
        tiles: impl Iterator<Item = (&'a Points, &'a mut [Row])>,
        around: &mut Around,
    ) {
        let mut walk = Walk::new(self, table, tiles, around);
        while let Some(out) = walk.advance() {
            let Walk { now, next, .. } = &walk;
            rows::interpolate(table, &now.before, &next.before, out);
            if self.has_time() {
                let mut after = [Row::ZERO; TILE];
                let after = &mut after[..out.len()];
                rows::interpolate(table, &now.after, &next.after, after);
                for ((out, after), fraction) in out.iter_mut().zip(after).zip(&now.fraction) {
                    *out += (*after - *out) * *fraction;
                }
            }
        }
    }

    /// As [`Self::encode`], and each point's derivatives of its features by x, y and z.
    #[inline(always)]
    pub fn encode_with_slopes<'a>(
        &self,
        table: &[Row],
        tiles: impl Iterator<Item = (&'a Points, (&'a mut [Row], &'a mut [Slopes]))>,
        around: &mut Around,
    ) {
        let mut walk = Walk::new(self, table, tiles, around);
        while let Some((out, slopes)) = walk.advance() {
            let Cells { before, after, fraction } = &*walk.now;
            for (s, (out, slopes)) in out.iter_mut().zip(slopes).enumerate() {
                walk.fetch(table, s);
                let (mut value, mut by) = before.interpolate(table, s);
                if self.has_time() {
                    let (then, by_then) = after.interpolate(table, s);
                    value += (then - value) * fraction[s];
                    (0..3).for_each(|k| by[k] += (by_then[k] - by[k]) * fraction[s]);
                }
                *out = value;
                *slopes = std::array::from_fn(|k| by[k] * self.scale[k]);
            }
        }
    }

    /// Whether it spans time, too.
    pub fn has_time(&self) -> bool {
        self.time_scale != 0.0
    }

    /// Finds what is around each point of a tile.
    #[inline(always)]
    fn find(&self, pos: &Points, cells: &mut Cells) {
        let Cells { before, after, fraction } = cells;
        if !self.has_time() {
            return self.corners(pos, &[0; TILE], before);
        }
        let mut layers = [[0; TILE]; 2];
        for s in 0..TILE {
            let q = pos[TIME][s] * self.time_scale;
            let (index, cell) = floor_within(q, self.last_cell[TIME] as f32);
            layers[0][s] = index.wrapping_mul(self.stride[TIME]);
            layers[1][s] = (index + 1).wrapping_mul(self.stride[TIME]);
            fraction[s] = (q - cell).clamp(0.0, 1.0);
        }
        self.corners(pos, &layers[0], before);
        self.corners(pos, &layers[1], after);
    }

    /// The corners in space around each point, in the layer of time that begins at `layer` (times its stride).
    #[inline(always)]
    fn corners(&self, pos: &Points, layer: &[u32; TILE], out: &mut Corners) {
        let mut cell = [[0u32; TILE]; 3];
        let Corners { rows, edges, frac } = out;
        for axis in 0..3 {
            let (scale, last) = (self.scale[axis], self.last_cell[axis] as f32);
            for s in 0..TILE {
                let q = pos[axis][s] * scale;
                // A point outside the box (or NaN) lands in the nearest cell (or the first).
                let (index, c) = floor_within(q, last);
                cell[axis][s] = index;
                frac[axis][s] = (q - c).clamp(0.0, 1.0);
            }
        }
        // Which of the two is asked here and not for each point: what a vector does or not by a mask is slow on many processors.
        let [_, y, z, _] = self.stride;
        *edges = self.dense.then(|| [0, y, z, y + z]);
        if self.dense {
            self.first_rows(&cell, layer, &mut rows[0]);
        } else {
            self.hashed_rows(&cell, layer, rows);
        }
    }

    /// Rows of the first corners of cells of a lattice that has one for each of its points.
    #[inline(always)]
    fn first_rows(&self, cell: &[[u32; TILE]; 3], layer: &[u32; TILE], rows: &mut [u32; TILE]) {
        let [_, stride_y, stride_z, _] = self.stride;
        for s in 0..TILE {
            let [y, z] = [cell[1][s].wrapping_mul(stride_y), cell[2][s].wrapping_mul(stride_z)];
            rows[s] = cell[0][s].wrapping_add(y).wrapping_add(z).wrapping_add(layer[s]);
        }
    }

    /// Rows around cells of a lattice whose points share them by chance.
    #[inline(always)]
    fn hashed_rows(&self, cell: &[[u32; TILE]; 3], layer: &[u32; TILE], rows: &mut [[u32; TILE]; 8]) {
        let mask = self.rows as u32 - 1;
        let [_, stride_y, stride_z, _] = self.stride;
        for s in 0..TILE {
            let (x, y) = (cell[0][s], cell[1][s].wrapping_mul(stride_y));
            let (z, t) = (cell[2][s].wrapping_mul(stride_z), layer[s]);
            let (y, z) = ([y, y.wrapping_add(stride_y)], [z, z.wrapping_add(stride_z)]);
            for dz in 0..2 {
                for dy in 0..2 {
                    let (n, rest) = (4 * dz + 2 * dy, y[dy] ^ z[dz] ^ t);
                    (rows[n][s], rows[n + 1][s]) = ((x ^ rest) & mask, ((x + 1) ^ rest) & mask);
                }
            }
        }
    }

    /// Adds the gradients of the features of tiles of points, which belong to each, to the rows around the points, by the weights with
    /// which they were read.
    #[inline(always)]
    pub fn scatter<'a>(
        &self,
        grads: &mut [Row],
        tiles: impl Iterator<Item = (&'a Points, &'a [Row])>,
        around: &mut Around,
    ) {
        let mut walk = Walk::new(self, grads, tiles, around);
        while let Some(g) = walk.advance() {
            let Walk { now: Cells { before, after, fraction }, next, .. } = &walk;
            if self.has_time() {
                let mut shares = [[0.0; TILE]; 2];
                for s in 0..TILE {
                    (shares[0][s], shares[1][s]) = (1.0 - fraction[s], fraction[s]);
                }
                let mut parts = [Row::ZERO; TILE];
                let parts = &mut parts[..g.len()];
                for (share, corners, next) in
                    [(&shares[0], before, &next.before), (&shares[1], after, &next.after)]
                {
                    parts.iter_mut().zip(g).zip(share).for_each(|((part, g), share)| *part = *g * *share);
                    rows::scatter(grads, corners, next, parts);
                }
            } else {
                rows::scatter(grads, before, &next.before, g);
            }
        }
    }
}
