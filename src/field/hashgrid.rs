//! Multi-resolution hash grid (Müller et al. 2022, instant-ngp, section 3): a point's features, forward and backward.
//!
//! Each level is one table of rows of four floats, at most 2 MiB, so that it stays in a core's L2 while a batch is
//! gathered from it or scattered into it. A level whose lattice fits its table is stored densely; only finer levels
//! hash. Levels are separate so that gradients can be scattered by one task a level, without atomics and in a fixed
//! order.

use glam::{Vec3, Vec4};

use crate::simd::TILE;

/// Features per level: one 16-byte row.
pub const FEATURES: usize = 4;

/// One table row; a `Vec4` rather than an array because the compiler keeps it in one vector register.
pub type Row = Vec4;

/// The lattice of one level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Cells per unit length.
    pub scale: Vec3,
    /// Largest cell index along each axis.
    last_cell: [u32; 3],
    /// Row strides of a dense level; the multipliers of a hashed one.
    stride: [u32; 3],
    /// Rows in the table.
    pub rows: usize,
    /// Whether lattice points map to rows one to one.
    pub dense: bool,
}

/// The eight rows around each point of a tile and the points' places between them.
struct Corners {
    /// `[corner][lane]`, x fastest.
    rows: [[u32; TILE]; 8],
    /// `[axis][lane]`, 0–1.
    frac: [[f32; TILE]; 3],
}

/// Shape of a grid over the box `[0, extent]`.
#[derive(Clone, Debug, PartialEq)]
pub struct HashGrid {
    /// Coarse to fine.
    pub levels: Vec<Level>,
}

impl HashGrid {
    /// `levels` lattices from `coarsest` to `finest` cells per unit length in geometric progression over the box
    /// `[0, extent]`, each with at most `2^log2_rows` rows.
    pub fn new(extent: Vec3, levels: usize, coarsest: Vec3, finest: Vec3, log2_rows: u32) -> Self {
        let growth = |n: usize| if levels > 1 { n as f32 / (levels - 1) as f32 } else { 0.0 };
        let levels = (0..levels)
            .map(|n| {
                let scale = coarsest * (finest / coarsest).powf(growth(n));
                Level::new(extent, scale, 1usize << log2_rows)
            })
            .collect();
        Self { levels }
    }

    /// Width of the encoding.
    pub fn width(&self) -> usize {
        self.levels.len() * FEATURES
    }

    /// Writes the features of one tile of points (`pos`: x, y, z rows) to `out` `[width][TILE]`.
    #[inline(always)]
    pub fn encode(&self, tables: &[Vec<Row>], pos: &[[f32; TILE]; 3], out: &mut [f32]) {
        for ((level, table), out) in self.levels.iter().zip(tables).zip(out.chunks_exact_mut(FEATURES * TILE))
        {
            let (o0, rest) = out.split_at_mut(TILE);
            let (o1, rest) = rest.split_at_mut(TILE);
            let (o2, o3) = rest.split_at_mut(TILE);
            let corners = level.corners(pos);
            for s in 0..TILE {
                let row = corners.interpolate(table, s);
                o0[s] = row.x;
                o1[s] = row.y;
                o2[s] = row.z;
                o3[s] = row.w;
            }
        }
    }

    /// Gradient with respect to the positions of a tile, of a loss whose gradient with respect to the encoding is
    /// `grad` `[width][TILE]`.
    #[inline(always)]
    pub fn position_gradient(
        &self,
        tables: &[Vec<Row>],
        pos: &[[f32; TILE]; 3],
        grad: &[f32],
    ) -> [[f32; TILE]; 3] {
        let mut out = [[0.0; TILE]; 3];
        for ((level, table), g) in self.levels.iter().zip(tables).zip(grad.chunks_exact(FEATURES * TILE)) {
            let corners = level.corners(pos);
            for s in 0..TILE {
                let g = Row::new(g[s], g[TILE + s], g[2 * TILE + s], g[3 * TILE + s]);
                let d = corners.position_gradient(table, g, s) * level.scale;
                out[0][s] += d.x;
                out[1][s] += d.y;
                out[2][s] += d.z;
            }
        }
        out
    }
}

impl Level {
    fn new(extent: Vec3, scale: Vec3, max_rows: usize) -> Self {
        let cells = (extent * scale).ceil().max(Vec3::ONE).as_uvec3();
        let points = [cells.x + 1, cells.y + 1, cells.z + 1];
        let lattice = points.iter().map(|&p| p as usize).product::<usize>();
        let dense = lattice <= max_rows;
        let (stride, rows) = if dense {
            ([1, points[0], points[0] * points[1]], lattice)
        } else {
            // Instant-ngp's primes; 1 for x keeps neighbours in x on one cache line.
            ([1, 2_654_435_761, 805_459_861], max_rows)
        };
        Self { scale, last_cell: [cells.x - 1, cells.y - 1, cells.z - 1], stride, rows, dense }
    }

    #[inline(always)]
    fn corners(&self, pos: &[[f32; TILE]; 3]) -> Corners {
        let mut cell = [[0u32; TILE]; 3];
        let mut frac = [[0.0f32; TILE]; 3];
        for axis in 0..3 {
            let (scale, last) = (self.scale[axis], self.last_cell[axis] as i32);
            for s in 0..TILE {
                let q = pos[axis][s] * scale;
                // `as i32` saturates: a point outside the box (or NaN) lands in the nearest cell (or the first).
                let c = (q as i32).clamp(0, last);
                cell[axis][s] = c as u32;
                frac[axis][s] = (q - c as f32).clamp(0.0, 1.0);
            }
        }
        let mut rows = [[0u32; TILE]; 8];
        let mask = self.rows as u32 - 1;
        for s in 0..TILE {
            let (x0, x1) = (cell[0][s], cell[0][s] + 1);
            let y0 = cell[1][s].wrapping_mul(self.stride[1]);
            let y1 = y0.wrapping_add(self.stride[1]);
            let z0 = cell[2][s].wrapping_mul(self.stride[2]);
            let z1 = z0.wrapping_add(self.stride[2]);
            for (n, (y, z)) in [(y0, z0), (y1, z0), (y0, z1), (y1, z1)].into_iter().enumerate() {
                if self.dense {
                    rows[2 * n][s] = x0 + y + z;
                    rows[2 * n + 1][s] = x1 + y + z;
                } else {
                    rows[2 * n][s] = (x0 ^ y ^ z) & mask;
                    rows[2 * n + 1][s] = (x1 ^ y ^ z) & mask;
                }
            }
        }
        Corners { rows, frac }
    }

    /// Adds the gradients `g` of a tile's features to the rows around its points `pos`, by the weights with which
    /// they were read.
    #[inline(always)]
    pub fn scatter(&self, grads: &mut [Row], pos: &[[f32; TILE]; 3], g: &[Row]) {
        let c = self.corners(pos);
        for (s, g) in g.iter().enumerate() {
            let (fx, fy, fz) = (c.frac[0][s], c.frac[1][s], c.frac[2][s]);
            let (g1, g0) = (*g * fz, *g * (1.0 - fz));
            let (g11, g10, g01, g00) = (g1 * fy, g0 * fy, g1 * (1.0 - fy), g0 * (1.0 - fy));
            for (n, g) in [g00, g10, g01, g11].into_iter().enumerate() {
                grads[c.rows[2 * n][s] as usize] += g * (1.0 - fx);
                grads[c.rows[2 * n + 1][s] as usize] += g * fx;
            }
        }
    }
}

impl Corners {
    #[inline(always)]
    fn interpolate(&self, table: &[Row], s: usize) -> Row {
        let row = |n: usize| table[self.rows[n][s] as usize];
        let [fx, fy, fz] = [self.frac[0][s], self.frac[1][s], self.frac[2][s]];
        let along_x = |n: usize| {
            let (a, b) = (row(n), row(n + 1));
            a + (b - a) * fx
        };
        let (a, b) = (along_x(0), along_x(2));
        let (c, d) = (along_x(4), along_x(6));
        let (e, f) = (a + (b - a) * fy, c + (d - c) * fy);
        e + (f - e) * fz
    }

    /// Gradient with respect to the fractions of lane `s`.
    #[inline(always)]
    fn position_gradient(&self, table: &[Row], g: Row, s: usize) -> Vec3 {
        let v = |n: usize| table[self.rows[n][s] as usize].dot(g);
        let v = [v(0), v(1), v(2), v(3), v(4), v(5), v(6), v(7)];
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let [x, y, z] = [self.frac[0][s], self.frac[1][s], self.frac[2][s]];
        let dx = mix(mix(v[1] - v[0], v[3] - v[2], y), mix(v[5] - v[4], v[7] - v[6], y), z);
        let dy = mix(mix(v[2] - v[0], v[3] - v[1], x), mix(v[6] - v[4], v[7] - v[5], x), z);
        let dz = mix(mix(v[4] - v[0], v[5] - v[1], x), mix(v[6] - v[2], v[7] - v[3], x), y);
        Vec3::new(dx, dy, dz)
    }
}
