//! All distinct descriptors of one space in one array.

use half::f16;
use rayon::prelude::*;

use crate::scene::features::{Blend, Descriptors, normalise};
use crate::semantics::compress::Compressor;

/// Rows that are decoded or compressed at a time.
const BLOCK: usize = 384;

/// Descriptors of unit length, one a row, in half precision: files hold no more, and a long video has 10⁵ of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TargetTable {
    dim: usize,
    values: Vec<f16>,
}

impl TargetTable {
    /// An empty table of descriptors with `dim` numbers.
    pub fn new(dim: usize) -> Self {
        Self { dim, values: Vec::new() }
    }

    /// Numbers per row.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.values.len() / self.dim.max(1)
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Appends all rows of an array, each scaled to unit length, and returns the number of the first.
    ///
    /// Rows that were left out stay in as zeros, so that numbers keep their order; no target refers to them.
    pub fn append(&mut self, rows: &Descriptors) -> u32 {
        debug_assert_eq!(rows.dim, self.dim);
        let first = self.len() as u32;
        let mut row = vec![0.0; self.dim];
        for values in rows.values.chunks_exact(self.dim) {
            row.copy_from_slice(values);
            normalise(&mut row);
            self.values.extend(row.iter().map(|v| f16::from_f32(*v)));
        }
        first
    }

    /// Copies one row to `out` `[dim]`.
    pub fn row(&self, n: usize, out: &mut [f32]) {
        for (out, v) in out.iter_mut().zip(&self.values[n * self.dim..(n + 1) * self.dim]) {
            *out = v.to_f32();
        }
    }

    /// The blended descriptor, scaled to unit length, in `out` `[dim]`.
    pub fn blend(&self, blend: &Blend, out: &mut [f32]) {
        out.fill(0.0);
        for (row, weight) in blend.iter() {
            let row = &self.values[row as usize * self.dim..][..self.dim];
            for (out, v) in out.iter_mut().zip(row) {
                *out += weight * v.to_f32();
            }
        }
        normalise(out);
    }

    /// At most `most` rows spread evenly over the table, `[rows, dim]`, those left out aside.
    pub fn sample(&self, most: usize) -> Vec<f32> {
        let usable: Vec<usize> = (0..self.len())
            .filter(|n| self.values[n * self.dim..(n + 1) * self.dim].iter().any(|v| *v != f16::ZERO))
            .collect();
        let count = usable.len().min(most);
        let mut out = vec![0.0; count * self.dim];
        for (i, row) in out.chunks_exact_mut(self.dim.max(1)).enumerate() {
            self.row(usable[i * usable.len() / count], row);
        }
        out
    }

    /// The whole table compressed: what a trainer keeps.
    ///
    /// Under a linear map, blending compressed rows is the same as compressing the blend, because weights sum to 1.
    pub fn encode(&self, compressor: &Compressor) -> EncodedTable {
        let dim = compressor.dim();
        let mut values = vec![0.0; self.len() * dim];
        values.par_chunks_mut(BLOCK * dim).zip(self.values.par_chunks(BLOCK * self.dim.max(1))).for_each(
            |(out, stored)| {
                let rows: Vec<f32> = stored.iter().map(|v| v.to_f32()).collect();
                compressor.encode(&rows, out);
            },
        );
        EncodedTable { dim, values }
    }
}

/// A [`TargetTable`] after compression; the same row numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedTable {
    /// Numbers per row.
    pub dim: usize,
    /// `[rows, dim]`.
    pub values: Vec<f32>,
}

impl EncodedTable {
    /// One row.
    pub fn row(&self, n: u32) -> &[f32] {
        &self.values[n as usize * self.dim..][..self.dim]
    }

    /// The weighted sum of a blend's rows, in `out` `[dim]`.
    pub fn blend(&self, blend: &Blend, out: &mut [f32]) {
        out.fill(0.0);
        for (row, weight) in blend.iter() {
            for (out, v) in out.iter_mut().zip(self.row(row)) {
                *out += weight * v;
            }
        }
    }
}
