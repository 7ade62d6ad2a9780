//! The linear map: x ≈ μ + Bᵀ z with z = B (x − μ), B of orthonormal rows.
//!
//! Chosen by principal components, so no other map of d numbers has a smaller squared error. A phrase q is held
//! against a compressed point without decompressing it:
//!
//! ```text
//! q · x̂ = q·μ + (B q) · z          |x̂|² = |μ|² + 2 (B μ) · z + |z|²
//! ```

use rayon::prelude::*;

use super::eigen::symmetric_eigen;
use super::error::CompressError;

/// Rows that go into the covariance together: the matrix is read once for all of them.
const BLOCK: usize = 8;

/// A linear compression.
#[derive(Clone, Debug, PartialEq)]
pub struct LinearMap {
    /// `[full]`.
    pub(super) mean: Vec<f32>,
    /// `[dim, full]`, orthonormal rows, largest variance first.
    pub(super) basis: Vec<f32>,
    /// B μ, `[dim]`.
    basis_mean: Vec<f32>,
    /// |μ|².
    mean_norm2: f32,
}

/// A phrase in compressed space: its product with a decompressed point is `offset + direction · z`.
#[derive(Clone, Debug, PartialEq)]
pub struct Projected {
    /// B q, `[dim]`.
    pub direction: Vec<f32>,
    /// q · μ.
    pub offset: f32,
}

/// What principal components say about some descriptors.
pub(super) struct Components {
    mean: Vec<f64>,
    /// `[full, full]`, one component a row, largest variance first.
    vectors: Vec<f64>,
    full: usize,
}

impl Components {
    /// `rows` is `[n, full]`, finite and not all zero.
    pub fn new(rows: &[f32], full: usize) -> Self {
        let count = (rows.len() / full) as f64;
        let mut mean = vec![0.0; full];
        for row in rows.chunks_exact(full) {
            mean.iter_mut().zip(row).for_each(|(m, v)| *m += f64::from(*v));
        }
        mean.iter_mut().for_each(|m| *m /= count);
        let covariance = covariance(rows, &mean, full);
        let (_, vectors) = symmetric_eigen(&covariance, full);
        Self { mean, vectors, full }
    }

    /// 1 − mean cosine between descriptors and what d components make of them, for d = 0 ..= full.
    pub fn error_curve(&self, rows: &[f32]) -> Vec<f64> {
        let full = self.full;
        let mean_norm2: f64 = self.mean.iter().map(|m| m * m).sum();
        let basis_mean: Vec<f64> = self.vectors.chunks_exact(full).map(|b| dot(b, &self.mean)).collect();
        let curve_of = |row: &[f32]| {
            let row: Vec<f64> = row.iter().map(|v| f64::from(*v)).collect();
            let norm = dot(&row, &row).sqrt();
            // Of x̂: product with x, and squared length.
            let (mut product, mut norm2) = (dot(&row, &self.mean), mean_norm2);
            let mut cosines = Vec::with_capacity(full + 1);
            let mut push = |product: f64, norm2: f64| {
                // Below this, what is left of x̂ is rounding: it points nowhere.
                let cosine = if norm2 > 1e-20 * norm * norm { product / (norm * norm2.sqrt()) } else { 0.0 };
                cosines.push(cosine);
            };
            push(product, norm2);
            for (b, b_mean) in self.vectors.chunks_exact(full).zip(&basis_mean) {
                let b_row = dot(b, &row);
                let z = b_row - b_mean;
                product += z * b_row;
                norm2 += 2.0 * z * b_mean + z * z;
                push(product, norm2);
            }
            cosines
        };
        // Groups in a fixed order: the sum does not depend on the number of threads.
        let groups: Vec<Vec<f64>> = rows
            .par_chunks(64 * full)
            .map(|rows| {
                let mut sum = vec![0.0; full + 1];
                for row in rows.chunks_exact(full) {
                    sum.iter_mut().zip(curve_of(row)).for_each(|(s, c)| *s += c);
                }
                sum
            })
            .collect();
        let count = (rows.len() / full) as f64;
        (0..=full).map(|d| 1.0 - groups.iter().map(|g| g[d]).sum::<f64>() / count).collect()
    }

    /// The map with the first `dim` components.
    pub fn map(&self, dim: usize) -> LinearMap {
        let single = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<_>>();
        LinearMap::from_parts(single(&self.mean), single(&self.vectors[..dim * self.full]))
    }
}

/// Covariance of the rows, `[full, full]`. Every row of it is summed by one task in a fixed order.
fn covariance(rows: &[f32], mean: &[f64], full: usize) -> Vec<f64> {
    let centred: Vec<f64> =
        rows.chunks_exact(full).flat_map(|r| r.iter().zip(mean).map(|(v, m)| f64::from(*v) - m)).collect();
    let mut matrix = vec![0.0; full * full];
    matrix.par_chunks_mut(full).enumerate().for_each(|(i, out)| {
        for block in centred.chunks(BLOCK * full) {
            for row in block.chunks_exact(full) {
                let x = row[i];
                for (out, v) in out[i..].iter_mut().zip(&row[i..]) {
                    *out += x * v;
                }
            }
        }
    });
    let count = (rows.len() / full) as f64;
    for i in 0..full {
        for j in i..full {
            let v = matrix[i * full + j] / count;
            matrix[i * full + j] = v;
            matrix[j * full + i] = v;
        }
    }
    matrix
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn dot_single(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>() as f32
}

impl LinearMap {
    /// A map from its mean `[full]` and basis `[dim, full]`, whose rows must be orthonormal.
    fn from_parts(mean: Vec<f32>, basis: Vec<f32>) -> Self {
        let basis_mean = basis.chunks_exact(mean.len()).map(|b| dot_single(b, &mean)).collect();
        let mean_norm2 = dot_single(&mean, &mean);
        Self { mean, basis, basis_mean, mean_norm2 }
    }

    /// [`Self::from_parts`] of numbers that come from a file.
    ///
    /// # Errors
    /// [`CompressError::Stored`] if lengths do not fit or the basis is not orthonormal (to 1e-3).
    pub(super) fn checked(mean: Vec<f32>, basis: Vec<f32>, dim: usize) -> Result<Self, CompressError> {
        let stored = |what: &str| CompressError::Stored { name: "basis".into(), what: what.into() };
        if mean.is_empty() || dim == 0 || Some(basis.len()) != dim.checked_mul(mean.len()) {
            return Err(stored("has the wrong length"));
        }
        if mean.iter().any(|v| !v.is_finite()) {
            return Err(CompressError::Stored { name: "mean".into(), what: "is not finite".into() });
        }
        let rows: Vec<&[f32]> = basis.chunks_exact(mean.len()).collect();
        for (i, a) in rows.iter().enumerate() {
            for (j, b) in rows[..=i].iter().enumerate() {
                let expected = if i == j { 1.0 } else { 0.0 };
                // Also false for NaN.
                let sound = (dot_single(a, b) - expected).abs() < 1e-3;
                if !sound {
                    return Err(stored("is not orthonormal"));
                }
            }
        }
        Ok(Self::from_parts(mean, basis))
    }

    /// Numbers per descriptor before compression.
    pub fn full(&self) -> usize {
        self.mean.len()
    }

    /// Numbers per descriptor after it.
    pub fn dim(&self) -> usize {
        self.basis_mean.len()
    }

    /// The mean descriptor, `[full]`.
    pub fn mean(&self) -> &[f32] {
        &self.mean
    }

    /// The basis, `[dim, full]`.
    pub fn basis(&self) -> &[f32] {
        &self.basis
    }

    /// B μ, `[dim]`.
    pub fn basis_mean(&self) -> &[f32] {
        &self.basis_mean
    }

    /// |μ|².
    pub fn mean_norm2(&self) -> f32 {
        self.mean_norm2
    }

    /// z = B (x − μ) for each row of `rows` `[n, full]`, to `out` `[n, dim]`.
    pub fn encode(&self, rows: &[f32], out: &mut [f32]) {
        let full = self.full();
        let mut centred = vec![0.0; full];
        for (row, out) in rows.chunks_exact(full).zip(out.chunks_exact_mut(self.dim())) {
            centred.iter_mut().zip(row).zip(&self.mean).for_each(|((c, x), m)| *c = x - m);
            for (z, b) in out.iter_mut().zip(self.basis.chunks_exact(full)) {
                *z = lanes_dot(b, &centred);
            }
        }
    }

    /// x̂ = μ + Bᵀ z for each row of `codes` `[n, dim]`, to `out` `[n, full]`. Not normalised.
    pub fn decode(&self, codes: &[f32], out: &mut [f32]) {
        let full = self.full();
        for (code, out) in codes.chunks_exact(self.dim()).zip(out.chunks_exact_mut(full)) {
            out.copy_from_slice(&self.mean);
            for (z, b) in code.iter().zip(self.basis.chunks_exact(full)) {
                out.iter_mut().zip(b).for_each(|(o, b)| *o += z * b);
            }
        }
    }

    /// A phrase `[full]` in compressed space.
    pub fn project(&self, phrase: &[f32]) -> Projected {
        let direction = self.basis.chunks_exact(self.full()).map(|b| dot_single(b, phrase)).collect();
        Projected { direction, offset: dot_single(&self.mean, phrase) }
    }

    /// |x̂|² of a compressed point, in f64: exact to rounding also where the mean and z nearly cancel.
    pub fn norm2(&self, code: &[f32]) -> f64 {
        let cross: f64 = self.basis_mean.iter().zip(code).map(|(m, z)| f64::from(*m) * f64::from(*z)).sum();
        let own: f64 = code.iter().map(|z| f64::from(*z).powi(2)).sum();
        (f64::from(self.mean_norm2) + 2.0 * cross + own).max(0.0)
    }
}

/// Sum of products in sixteen lanes, so that it vectorises; always the same order.
fn lanes_dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0; 16];
    let (a16, a_rest) = a.as_chunks::<16>();
    let (b16, b_rest) = b.as_chunks::<16>();
    for (a, b) in a16.iter().zip(b16) {
        for i in 0..16 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}
