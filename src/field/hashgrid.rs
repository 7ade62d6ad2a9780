//! Multi-resolution hash grid (Müller et al. 2022, instant-ngp, section 3): a point's features, forward and backward.
//!
//! Each level is one table of rows of four floats, at most 2 MiB, so that it stays in a core's L2 while a batch is
//! gathered from it or scattered into it. A level whose lattice fits its table is stored densely; only finer levels
//! hash. Levels are separate so that gradients can be scattered by one task a level, without atomics and in a fixed
//! order.

use glam::Vec3;

use crate::simd::TILE;

/// Features per level: one 16-byte row.
pub const FEATURES: usize = 4;

/// One table row.
pub type Row = [f32; FEATURES];

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

/// The eight rows around a point and the point's place between them.
struct Corners {
    rows: [u32; 8],
    frac: Vec3,
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
        for ((level, table), out) in self.levels.iter().zip(tables).zip(out.chunks_exact_mut(FEATURES * TILE)) {
            let (o0, rest) = out.split_at_mut(TILE);
            let (o1, rest) = rest.split_at_mut(TILE);
            let (o2, o3) = rest.split_at_mut(TILE);
            for s in 0..TILE {
                let row = level.interpolate(table, Vec3::new(pos[0][s], pos[1][s], pos[2][s]));
                o0[s] = row[0];
                o1[s] = row[1];
                o2[s] = row[2];
                o3[s] = row[3];
            }
        }
    }

    /// Gradient with respect to the position of a loss whose gradient with respect to the encoding of lane `s` is
    /// the column `s` of `grad` `[width][TILE]`.
    pub fn position_gradient(&self, tables: &[Vec<Row>], pos: Vec3, grad: &[f32], s: usize) -> Vec3 {
        let mut out = Vec3::ZERO;
        for (n, (level, table)) in self.levels.iter().zip(tables).enumerate() {
            let g: Row = std::array::from_fn(|f| grad[(n * FEATURES + f) * TILE + s]);
            out += level.position_gradient(table, pos, g);
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
    fn corners(&self, p: Vec3) -> Corners {
        let q = p * self.scale;
        // `as u32` saturates: a point below the box (or NaN) lands in cell 0, one above in the last cell.
        let cell = [
            (q.x as u32).min(self.last_cell[0]),
            (q.y as u32).min(self.last_cell[1]),
            (q.z as u32).min(self.last_cell[2]),
        ];
        let frac = (q - Vec3::new(cell[0] as f32, cell[1] as f32, cell[2] as f32)).clamp(Vec3::ZERO, Vec3::ONE);
        let y0 = cell[1].wrapping_mul(self.stride[1]);
        let y1 = y0.wrapping_add(self.stride[1]);
        let z0 = cell[2].wrapping_mul(self.stride[2]);
        let z1 = z0.wrapping_add(self.stride[2]);
        let (x0, x1) = (cell[0], cell[0] + 1);
        let rows = if self.dense {
            let (a, b, c, d) = (y0 + z0, y1 + z0, y0 + z1, y1 + z1);
            [x0 + a, x1 + a, x0 + b, x1 + b, x0 + c, x1 + c, x0 + d, x1 + d]
        } else {
            let mask = self.rows as u32 - 1;
            let (a, b, c, d) = (y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1);
            [x0 ^ a, x1 ^ a, x0 ^ b, x1 ^ b, x0 ^ c, x1 ^ c, x0 ^ d, x1 ^ d].map(|r| r & mask)
        };
        Corners { rows, frac }
    }

    #[inline(always)]
    fn interpolate(&self, table: &[Row], p: Vec3) -> Row {
        let c = self.corners(p);
        let v = c.rows.map(|r| table[r as usize]);
        let x00 = lerp(v[0], v[1], c.frac.x);
        let x10 = lerp(v[2], v[3], c.frac.x);
        let x01 = lerp(v[4], v[5], c.frac.x);
        let x11 = lerp(v[6], v[7], c.frac.x);
        lerp(lerp(x00, x10, c.frac.y), lerp(x01, x11, c.frac.y), c.frac.z)
    }

    /// Adds `g` to the gradient rows around `p`, by the weights with which [`Self::interpolate`] read them.
    #[inline(always)]
    pub fn scatter(&self, grads: &mut [Row], p: Vec3, g: Row) {
        let c = self.corners(p);
        let (fx, fy, fz) = (c.frac.x, c.frac.y, c.frac.z);
        let (y0z0, y1z0) = ((1.0 - fy) * (1.0 - fz), fy * (1.0 - fz));
        let (y0z1, y1z1) = ((1.0 - fy) * fz, fy * fz);
        for (n, yz) in [y0z0, y1z0, y0z1, y1z1].into_iter().enumerate() {
            for (row, w) in [(c.rows[2 * n], (1.0 - fx) * yz), (c.rows[2 * n + 1], fx * yz)] {
                let row = &mut grads[row as usize];
                for f in 0..FEATURES {
                    row[f] += w * g[f];
                }
            }
        }
    }

    fn position_gradient(&self, table: &[Row], p: Vec3, g: Row) -> Vec3 {
        let c = self.corners(p);
        let v = c.rows.map(|r| {
            let row = table[r as usize];
            row[0] * g[0] + row[1] * g[1] + row[2] * g[2] + row[3] * g[3]
        });
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let (x, y, z) = (c.frac.x, c.frac.y, c.frac.z);
        let dx = mix(mix(v[1] - v[0], v[3] - v[2], y), mix(v[5] - v[4], v[7] - v[6], y), z);
        let dy = mix(mix(v[2] - v[0], v[3] - v[1], x), mix(v[6] - v[4], v[7] - v[5], x), z);
        let dz = mix(mix(v[4] - v[0], v[5] - v[1], x), mix(v[6] - v[2], v[7] - v[3], x), y);
        Vec3::new(dx, dy, dz) * self.scale
    }
}

#[inline(always)]
fn lerp(a: Row, b: Row, t: f32) -> Row {
    std::array::from_fn(|f| a[f] + (b[f] - a[f]) * t)
}
