//! A coarse running picture of where the density is: decides where samples go and where a stream is evaluated at all.

use glam::{UVec3, Vec3};

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
        let dims = (extent / cell).ceil().max(Vec3::ONE).as_uvec3();
        let cells = dims.as_usizevec3().element_product() * slices;
        Self { dims, per_unit: dims.as_vec3() / extent, slices, sigma: vec![sigma; cells] }
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
        // `as u32` saturates at 0 for negative numbers and NaN.
        let x = (q.x as u32).min(self.dims.x - 1) as usize;
        let y = (q.y as u32).min(self.dims.y - 1) as usize;
        let z = (q.z as u32).min(self.dims.z - 1) as usize;
        ((slice * self.dims.z as usize + z) * self.dims.y as usize + y) * self.dims.x as usize + x
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

    /// Moves the cell of `p` towards `sigma` by the fraction `rate`.
    ///
    /// A mean, not a maximum: an envelope makes fog look opaque, so that what is behind it is never sampled again.
    #[inline(always)]
    pub fn observe(&mut self, p: Vec3, slice: usize, sigma: f32, rate: f32) {
        let n = self.index(p, slice);
        self.sigma[n] += rate * (sigma - self.sigma[n]);
    }
}
