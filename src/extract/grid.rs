//! A density sampled on a sparse grid: only the blocks that can hold a surface are evaluated.

use glam::Vec3A;
use rayon::prelude::*;

use super::ExtractError;
use super::blocks::{BlockSet, CELLS, CORNERS, POINTS, point_index};
use crate::work::Work;

/// Memory that a grid may use unless told otherwise, bytes.
const DEFAULT_MAX_BYTES: usize = 4 << 30;
/// Blocks along the side of the cubes that the coarse-to-fine search starts with.
const COARSEST: u32 = 8;

/// A box of cubic cells in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridSpec {
    /// Corner 0 of the grid, world. All f32 positions are relative to it.
    pub origin: [f64; 3],
    /// Cells along x, y, z.
    pub dims: [u32; 3],
    /// Side of a cell, world units.
    pub voxel: f64,
    /// Memory that the grid may use, bytes.
    pub max_bytes: usize,
}

impl GridSpec {
    /// A grid of `dims` cells with its corner 0 at `origin`.
    pub fn new(origin: [f64; 3], dims: [u32; 3], voxel: f64) -> Self {
        Self { origin, dims, voxel, max_bytes: DEFAULT_MAX_BYTES }
    }

    /// The smallest grid with its corner 0 at `min` that covers the box from `min` to `max` (world).
    pub fn covering(min: [f64; 3], max: [f64; 3], voxel: f64) -> Self {
        // Saturating float-to-int conversion: a nonsensical box becomes a grid that `validate` refuses.
        let dims = std::array::from_fn(|a| ((max[a] - min[a]) / voxel).ceil().max(0.0) as u32);
        Self::new(min, dims, voxel)
    }

    /// Blocks along x, y, z.
    pub(crate) fn block_dims(&self) -> [u32; 3] {
        self.dims.map(|d| d.div_ceil(CELLS as u32))
    }

    /// # Errors
    /// `Invalid` for an empty or non-finite grid, `TooLarge` where even the table of blocks would not fit.
    pub(crate) fn validate(&self) -> Result<(), ExtractError> {
        let positive = self.voxel.is_finite() && self.voxel > 0.0;
        ExtractError::require(positive, "voxel", self.voxel, "a positive length")?;
        let finite = self.origin.iter().all(|v| v.is_finite());
        ExtractError::require(finite, "grid origin", self.origin, "finite")?;
        // 2^20 cells a side keeps f32 positions within a sixteenth of a cell and block products within 64
        // bits.
        let sane = self.dims.iter().all(|&d| (1..=1 << 20).contains(&d));
        ExtractError::require(sane, "grid dims", self.dims, "between 1 and 1048576 cells along each axis")?;
        let slots: u128 = self.block_dims().iter().map(|&d| u128::from(d)).product();
        self.check_bytes("the table of grid blocks", slots * 4)
    }

    pub(crate) fn check_bytes(&self, what: &'static str, needed: u128) -> Result<(), ExtractError> {
        if needed <= self.max_bytes as u128 {
            return Ok(());
        }
        let mb = |bytes: u128| (bytes / 1_000_000) as u64;
        Err(ExtractError::TooLarge { what, needed_mb: mb(needed), limit_mb: mb(self.max_bytes as u128) })
    }

    /// Corner `p` (cells from the origin) relative to the origin, world units.
    #[inline]
    pub(crate) fn corner(&self, p: [usize; 3]) -> Vec3A {
        // f64 product, one rounding: neighbouring blocks agree on every position.
        Vec3A::from_array(p.map(|c| (c as f64 * self.voxel) as f32))
    }

    /// Linear index of a corner over the whole (dense) grid, x fastest.
    fn linear(&self, p: [usize; 3]) -> usize {
        let [nx, ny, _] = self.dims.map(|d| d as usize + 1);
        (p[2] * ny + p[1]) * nx + p[0]
    }
}

/// What was evaluated and what it cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GridReport {
    /// Blocks (8³ cells) that were evaluated.
    pub evaluated_blocks: usize,
    /// Blocks that were skipped: their space stays unknown.
    pub skipped_blocks: usize,
    /// Points at which the density was evaluated.
    pub evaluated_points: usize,
    /// Memory that the grid holds, bytes.
    pub bytes: usize,
}

impl GridReport {
    /// What leaving out so many blocks saves.
    pub fn work(blocks: usize) -> Work {
        let (voxels, bytes) = ((blocks * CELLS.pow(3)) as u64, (blocks * POINTS * 4) as u64);
        Work { voxels, bytes, ..Work::default() }
    }
}

/// Values at the corners of the cells of some blocks of a box; everything else is unknown.
///
/// An unknown corner is stored as NaN; a cell is marched only when its 8 corners are known.
#[derive(Clone, Debug)]
pub struct SparseGrid {
    pub(crate) spec: GridSpec,
    pub(crate) blocks: BlockSet,
    /// `[blocks * POINTS]`.
    pub(crate) values: Vec<f32>,
    report: GridReport,
}

impl SparseGrid {
    /// Samples `sigma` on every block that `may_hold_surface`.
    ///
    /// `may_hold_surface(center, half_extent)` is asked for cubes of 64, 32, 16 and 8 cells; it must hold for
    /// a cube if it holds for any part of it. `sigma(points, out)` writes one value per point and must not
    /// depend on the other points of the batch. Each point is evaluated once. Positions are relative to
    /// `spec.origin`, world units.
    ///
    /// # Errors
    /// `NonFinite` ("density grid") with the linear index of the corner over the whole grid, x fastest;
    /// `Invalid` and `TooLarge` for a bad `spec`.
    pub fn sample(
        spec: &GridSpec,
        may_hold_surface: &(dyn Fn(Vec3A, f32) -> bool + Sync),
        sigma: &(dyn Fn(&[Vec3A], &mut [f32]) + Sync),
    ) -> Result<Self, ExtractError> {
        spec.validate()?;
        let blocks = BlockSet::new(spec.block_dims(), find_blocks(spec, may_hold_surface));
        let mut grid = Self::unknown(spec, blocks)?;
        let (blocks, spec) = (&grid.blocks, &grid.spec);
        let results: Vec<(usize, Option<usize>)> = grid
            .values
            .par_chunks_mut(POINTS)
            .enumerate()
            .map_init(Batch::default, |batch, (b, values)| batch.evaluate(spec, blocks, b, values, sigma))
            .collect();
        if let Some(index) = results.iter().filter_map(|r| r.1).min() {
            return Err(ExtractError::NonFinite { stage: "density grid", index });
        }
        grid.report.evaluated_points = results.iter().map(|r| r.0).sum();
        grid.blocks.share_borders(&mut grid.values);
        Ok(grid)
    }

    /// A grid whose blocks exist and whose values are all unknown.
    pub(crate) fn unknown(spec: &GridSpec, blocks: BlockSet) -> Result<Self, ExtractError> {
        let bytes = blocks.len() * POINTS * 4 + blocks.bytes();
        spec.check_bytes("the sampled grid", bytes as u128)?;
        let report = GridReport {
            evaluated_blocks: blocks.len(),
            skipped_blocks: BlockSet::slot_count(spec.block_dims()) - blocks.len(),
            evaluated_points: 0,
            bytes,
        };
        Ok(Self { spec: *spec, values: vec![f32::NAN; blocks.len() * POINTS], blocks, report })
    }

    /// This grid, with `value` of what `other` (of the same `spec`) knows where this one knows nothing.
    ///
    /// # Errors
    /// `TooLarge` where the union does not fit.
    pub fn or(&self, other: &Self, value: impl Fn(f32) -> f32 + Sync) -> Result<Self, ExtractError> {
        let coords = self.blocks.coords().iter().chain(other.blocks.coords()).copied().collect();
        let mut union = Self::unknown(&self.spec, BlockSet::new(self.spec.block_dims(), coords))?;
        let blocks = &union.blocks;
        union.values.par_chunks_mut(POINTS).enumerate().for_each(|(b, values)| {
            let at = blocks.coords()[b].map(i64::from);
            let of = |grid: &'_ Self| grid.blocks.find(at).map(|b| b * POINTS);
            let (first, second) = (of(self), of(other));
            for (k, out) in values.iter_mut().enumerate() {
                let known = first.map_or(f32::NAN, |start| self.values[start + k]);
                *out = match (known.is_nan(), second) {
                    (true, Some(start)) => value(other.values[start + k]),
                    _ => known,
                };
            }
        });
        union.blocks.share_borders(&mut union.values);
        Ok(union)
    }

    /// Where the grid lies.
    pub fn spec(&self) -> &GridSpec {
        &self.spec
    }

    /// What was evaluated and what it cost.
    pub fn report(&self) -> GridReport {
        self.report
    }

    /// The corner values of each block in order, x fastest; NaN where unknown.
    pub fn blocks_of_values(&self) -> impl Iterator<Item = &[f32]> {
        self.values.chunks_exact(POINTS)
    }

    /// The value at corner `p` (cells from the origin); `None` where it is unknown.
    pub fn value(&self, p: [u32; 3]) -> Option<f32> {
        // Up to eight blocks store a corner; any of them that exists has it.
        let cells = CELLS as u32;
        let candidates = (0..8u32).filter_map(|i| {
            let lower = [i & 1, i >> 1 & 1, i >> 2].map(|l| l == 1);
            if (0..3).any(|a| lower[a] && !p[a].is_multiple_of(cells)) {
                return None;
            }
            let block = std::array::from_fn(|a| i64::from(p[a] / cells) - i64::from(lower[a]));
            let b = self.blocks.find(block)?;
            let local = std::array::from_fn(|a| (i64::from(p[a]) - block[a] * CELLS as i64) as usize);
            Some(self.values[b * POINTS + point_index(local)])
        });
        candidates.into_iter().find(|v| !v.is_nan())
    }
}

/// Buffers of one worker.
#[derive(Default)]
struct Batch {
    points: Vec<Vec3A>,
    at: Vec<[usize; 3]>,
    out: Vec<f32>,
}

impl Batch {
    /// Evaluates the corners that block `b` owns; returns their number and the first that is not finite.
    fn evaluate(
        &mut self,
        spec: &GridSpec,
        blocks: &BlockSet,
        b: usize,
        values: &mut [f32],
        sigma: &(dyn Fn(&[Vec3A], &mut [f32]) + Sync),
    ) -> (usize, Option<usize>) {
        self.at.clear();
        let first = blocks.coords()[b].map(|c| c as usize * CELLS);
        let inside = |p: [usize; 3]| (0..3).all(|a| first[a] + p[a] <= spec.dims[a] as usize);
        for z in 0..CORNERS {
            for y in 0..CORNERS {
                let owned = blocks.owned_points(b, y, z);
                self.at.extend(
                    (0..CORNERS).filter(|x| owned >> x & 1 == 1).map(|x| [x, y, z]).filter(|&p| inside(p)),
                );
            }
        }
        let world = |p: [usize; 3]| -> [usize; 3] { std::array::from_fn(|a| first[a] + p[a]) };
        self.points.clear();
        self.points.extend(self.at.iter().map(|&p| spec.corner(world(p))));
        self.out.clear();
        self.out.resize(self.at.len(), f32::NAN);
        sigma(&self.points, &mut self.out);
        for (&p, &v) in self.at.iter().zip(&self.out) {
            values[point_index(p)] = v;
        }
        let bad = self.at.iter().zip(&self.out).filter(|(_, v)| !v.is_finite());
        (self.at.len(), bad.map(|(&p, _)| spec.linear(world(p))).min())
    }
}

/// Coordinates of the blocks for which the predicate holds, found by descending from cubes of 8³ blocks.
fn find_blocks(spec: &GridSpec, may_hold: &(dyn Fn(Vec3A, f32) -> bool + Sync)) -> Vec<[u32; 3]> {
    let dims = spec.block_dims();
    let [nx, ny, nz] = dims.map(|d| d.div_ceil(COARSEST));
    let top = (0..u64::from(nx) * u64::from(ny) * u64::from(nz)).into_par_iter();
    top.flat_map_iter(|i| {
        let c = [i % u64::from(nx), i / u64::from(nx) % u64::from(ny), i / (u64::from(nx) * u64::from(ny))];
        let mut found = Vec::new();
        descend(spec, dims, c.map(|v| v as u32 * COARSEST), COARSEST, may_hold, &mut found);
        found
    })
    .collect()
}

fn descend(
    spec: &GridSpec,
    dims: [u32; 3],
    at: [u32; 3],
    size: u32,
    may_hold: &(dyn Fn(Vec3A, f32) -> bool + Sync),
    found: &mut Vec<[u32; 3]>,
) {
    let half = f64::from(size) * CELLS as f64 * spec.voxel / 2.0;
    let center = at.map(|c| (f64::from(c) * CELLS as f64 * spec.voxel + half) as f32);
    if (0..3).any(|a| at[a] >= dims[a]) || !may_hold(Vec3A::from_array(center), half as f32) {
        return;
    }
    if size == 1 {
        found.push(at);
        return;
    }
    let h = size / 2;
    for i in 0..8 {
        let child = [at[0] + (i & 1) * h, at[1] + (i >> 1 & 1) * h, at[2] + (i >> 2) * h];
        descend(spec, dims, child, h, may_hold, found);
    }
}
