//! The attributes of the vertices, in units of their tolerances.

use crate::extract::ExtractError;

/// An attribute whose rows a simplified mesh must still interpolate.
#[derive(Clone, Copy, Debug)]
pub struct Column<'a> {
    /// `[vertices * dim]`, row-major.
    pub values: &'a [f32],
    /// Numbers per vertex, at least 1.
    pub dim: usize,
    /// Largest length of the difference between a row and what is interpolated in its place; above 0.
    pub tolerance: f32,
}

/// All columns side by side, divided by their tolerances, so that one pass tells the worst of them.
pub(super) struct Rows {
    /// Width of each column.
    dims: Vec<usize>,
    tolerances: Vec<f32>,
    width: usize,
    values: Vec<f32>,
}

impl Rows {
    pub(super) fn new(columns: &[Column], vertices: usize) -> Result<Self, ExtractError> {
        for (n, column) in columns.iter().enumerate() {
            let fits = column.dim > 0 && column.tolerance > 0.0 && column.tolerance.is_finite();
            let given = (column.dim, column.tolerance);
            ExtractError::require(fits, "column (dim, tolerance)", given, "at least 1 and above 0")?;
            let found = column.values.len();
            ExtractError::same_length(|| format!("column {n}"), vertices * column.dim, found)?;
            if let Some(index) = column.values.iter().position(|v| !v.is_finite()) {
                return Err(ExtractError::NonFinite { stage: "simplify (attributes)", index });
            }
        }
        let dims: Vec<usize> = columns.iter().map(|c| c.dim).collect();
        let width = dims.iter().sum();
        let mut values = Vec::with_capacity(width * vertices);
        for v in 0..vertices {
            for c in columns {
                values.extend(c.values[v * c.dim..(v + 1) * c.dim].iter().map(|x| x / c.tolerance));
            }
        }
        Ok(Self { dims, tolerances: columns.iter().map(|c| c.tolerance).collect(), width, values })
    }

    fn row(&self, v: u32) -> &[f32] {
        &self.values[v as usize * self.width..(v as usize + 1) * self.width]
    }

    /// Calls `each` with the number of every column and how far, in tolerances, its row at `v` is from the weighted
    /// mean of the rows at `corners`.
    fn compare<const N: usize>(
        &self,
        v: u32,
        corners: [u32; N],
        weights: [f32; N],
        mut each: impl FnMut(usize, f32),
    ) {
        let (row, rows) = (self.row(v), corners.map(|c| self.row(c)));
        let mut start = 0;
        for (n, dim) in self.dims.iter().enumerate() {
            let mut squares = 0.0f32;
            for i in start..start + dim {
                let mean: f32 = (0..N).map(|k| weights[k] * rows[k][i]).sum();
                squares += (row[i] - mean) * (row[i] - mean);
            }
            each(n, squares.sqrt());
            start += dim;
        }
    }

    /// The worst of the columns' deviations, in tolerances.
    pub(super) fn deviation<const N: usize>(&self, v: u32, corners: [u32; N], weights: [f32; N]) -> f32 {
        let mut worst = 0.0f32;
        self.compare(v, corners, weights, |_, d| worst = worst.max(d));
        worst
    }

    /// Raises `largest` (one number per column, in the column's own units) to the deviations at `v`.
    pub(super) fn record<const N: usize>(
        &self,
        v: u32,
        corners: [u32; N],
        weights: [f32; N],
        largest: &mut [f32],
    ) {
        self.compare(v, corners, weights, |n, d| largest[n] = largest[n].max(d * self.tolerances[n]));
    }

    pub(super) fn columns(&self) -> usize {
        self.dims.len()
    }
}
