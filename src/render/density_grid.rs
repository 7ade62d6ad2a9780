//! A coarse running picture of where the density is: decides where samples go and where a stream is evaluated at all.

use glam::{UVec3, Vec3};

/// Running mean of recent densities on a lattice of cells over `[0, extent]`.
#[derive(Clone, Debug)]
pub struct DensityGrid {
    dims: UVec3,
    per_unit: Vec3,
    /// σ of each cell, 1/unit; x fastest.
    pub sigma: Vec<f32>,
}

impl DensityGrid {
    /// Cells of `cell` units; every cell starts at `sigma`.
    pub fn new(extent: Vec3, cell: Vec3, sigma: f32) -> Self {
        let dims = (extent / cell).ceil().max(Vec3::ONE).as_uvec3();
        Self { dims, per_unit: dims.as_vec3() / extent, sigma: vec![sigma; dims.element_product() as usize] }
    }

    /// Edge lengths of a cell, units.
    pub fn cell(&self) -> Vec3 {
        1.0 / self.per_unit
    }

    /// Number of cells along each axis.
    pub fn dims(&self) -> UVec3 {
        self.dims
    }

    /// Index of the cell that holds `p`; points outside belong to the nearest cell.
    #[inline(always)]
    pub fn index(&self, p: Vec3) -> usize {
        let q = p * self.per_unit;
        // `as u32` saturates at 0 for negative numbers and NaN.
        let x = (q.x as u32).min(self.dims.x - 1);
        let y = (q.y as u32).min(self.dims.y - 1);
        let z = (q.z as u32).min(self.dims.z - 1);
        ((z * self.dims.y + y) * self.dims.x + x) as usize
    }

    /// σ of the cell that holds `p`.
    #[inline(always)]
    pub fn at(&self, p: Vec3) -> f32 {
        self.sigma[self.index(p)]
    }

    /// The point at fraction `u` of cell number `index`.
    pub fn point(&self, index: usize, u: Vec3) -> Vec3 {
        let n = index as u32;
        let cell =
            UVec3::new(n % self.dims.x, n / self.dims.x % self.dims.y, n / (self.dims.x * self.dims.y));
        (cell.as_vec3() + u) / self.per_unit
    }

    /// Moves the cell of `p` towards `sigma` by the fraction `rate`.
    ///
    /// A mean, not a maximum: an envelope makes fog look opaque, so that what is behind it is never sampled again.
    #[inline(always)]
    pub fn observe(&mut self, p: Vec3, sigma: f32, rate: f32) {
        let n = self.index(p);
        self.sigma[n] += rate * (sigma - self.sigma[n]);
    }
}
