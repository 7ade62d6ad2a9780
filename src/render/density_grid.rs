//! A coarse running picture of where the density is: decides where samples go and where a stream is evaluated at all.

use glam::{UVec3, Vec3};

use crate::simd::{floor_within, prefetch};

/// Points that are looked up together.
pub const STRIDE: usize = 16;

/// Running mean of recent densities on a lattice of cells over `[0, extent]`, in one or more slices of time.
#[derive(Clone, Debug)]
pub struct DensityGrid {
    dims: UVec3,
    per_unit: Vec3,
    slices: usize,
    /// σ of each cell, 1/unit; x fastest, time slowest.
    pub sigma: Vec<f32>,
}

impl DensityGrid {
    /// Cells of `cell` units in `slices` slices of time; every cell starts at `sigma`.
    pub fn new(extent: Vec3, cell: Vec3, slices: usize, sigma: f32) -> Self {
        let dims = Self::dims_of(extent, cell);
        let cells = Self::cells(extent, cell, slices);
        Self { dims, per_unit: dims.as_vec3() / extent, slices, sigma: vec![sigma; cells] }
    }

    /// Numbers that a grid of [`Self::new`] holds.
    pub fn cells(extent: Vec3, cell: Vec3, slices: usize) -> usize {
        Self::dims_of(extent, cell).as_usizevec3().element_product() * slices
    }

    fn dims_of(extent: Vec3, cell: Vec3) -> UVec3 {
        (extent / cell).ceil().max(Vec3::ONE).as_uvec3()
    }

    /// Edge lengths of a cell, units.
    pub fn cell(&self) -> Vec3 {
        1.0 / self.per_unit
    }

    /// Number of cells along each axis.
    pub fn dims(&self) -> UVec3 {
        self.dims
    }

    /// The slice that a time in [0, 1] falls into.
    pub fn slice(&self, time: f32) -> usize {
        ((time * self.slices as f32) as usize).min(self.slices - 1)
    }

    /// Index of the cell that holds `p`; points outside belong to the nearest cell.
    #[inline(always)]
    pub fn index(&self, p: Vec3, slice: usize) -> usize {
        let q = p * self.per_unit;
        let cell = |x: f32, dim: u32| floor_within(x, (dim - 1) as f32).0;
        let (x, y, z) = (cell(q.x, self.dims.x), cell(q.y, self.dims.y), cell(q.z, self.dims.z));
        ((slice as u32 * self.dims.z + z) * self.dims.y + y) as usize * self.dims.x as usize + x as usize
    }

    /// As [`Self::index`], of many `points` (x, y, z rows) in a slice each.
    #[inline(always)]
    pub fn indices(&self, points: &[[f32; STRIDE]; 3], slices: &[u32; STRIDE]) -> [u32; STRIDE] {
        let mut index = [0; STRIDE];
        let (dims, per_unit) = (self.dims, self.per_unit);
        for n in 0..STRIDE {
            let (x, _) = floor_within(points[0][n] * per_unit.x, (dims.x - 1) as f32);
            let (y, _) = floor_within(points[1][n] * per_unit.y, (dims.y - 1) as f32);
            let (z, _) = floor_within(points[2][n] * per_unit.z, (dims.z - 1) as f32);
            index[n] = ((slices[n] * dims.z + z) * dims.y + y) * dims.x + x;
        }
        index
    }

    /// Asks for `cells` before they are needed.
    #[inline(always)]
    pub fn fetch(&self, cells: &[u32]) {
        for cell in cells {
            prefetch(&self.sigma[0], *cell as usize * size_of::<f32>());
        }
    }

    /// σ of `cells`.
    #[inline(always)]
    pub fn of(&self, cells: &[u32; STRIDE]) -> [f32; STRIDE] {
        let mut sigma = [0.0; STRIDE];
        for n in 0..STRIDE {
            sigma[n] = self.sigma[cells[n] as usize];
        }
        sigma
    }

    /// σ of the cell that holds `p`.
    #[inline(always)]
    pub fn at(&self, p: Vec3, slice: usize) -> f32 {
        self.sigma[self.index(p, slice)]
    }

    /// Whether σ is at least `threshold` in any cell, of any slice, that the box from `min` to `max` (units) touches.
    pub fn any_at_least(&self, min: Vec3, max: Vec3, threshold: f32) -> bool {
        let cell = |p: Vec3| (p * self.per_unit).max(Vec3::ZERO).as_uvec3().min(self.dims - UVec3::ONE);
        let (a, b) = (cell(min).as_usizevec3(), cell(max).as_usizevec3());
        let [w, h, d] = self.dims.to_array().map(|n| n as usize);
        let mut rows = (0..self.slices)
            .flat_map(|s| (a.z..=b.z).flat_map(move |z| (a.y..=b.y).map(move |y| ((s * d + z) * h + y) * w)));
        rows.any(|row| self.sigma[row + a.x..=row + b.x].iter().any(|&s| s >= threshold))
    }

    /// The point at fraction `u` of cell number `index`, and a time in its slice (at fraction `v`).
    pub fn point(&self, index: usize, u: Vec3, v: f32) -> (Vec3, f32) {
        let [w, h, d] = self.dims.to_array().map(|n| n as usize);
        let cell = Vec3::new((index % w) as f32, (index / w % h) as f32, (index / (w * h) % d) as f32);
        let time = ((index / (w * h * d)) as f32 + v) / self.slices as f32;
        ((cell + u) / self.per_unit, time)
    }

    /// Moves cell number `cell` towards `sigma` by the fraction `rate`.
    ///
    /// A mean, not a maximum: an envelope makes fog look opaque, so that what is behind it is never sampled again.
    #[inline(always)]
    pub fn observe(&mut self, cell: usize, sigma: f32, rate: f32) {
        let old = &mut self.sigma[cell];
        *old += rate * (sigma - *old);
    }
}
