//! Rows of descriptors, and what a row may not be.

use std::fmt;
use std::path::{Path, PathBuf};

use divff_exporters::{NpyHeader, read_npy};

use super::error::FeatureError;

/// Why a descriptor cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unusable {
    /// All its numbers are zero: it points nowhere.
    Zero,
    /// It holds a NaN or an infinity.
    NonFinite,
}

impl fmt::Display for Unusable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Zero => "all zeros",
            Self::NonFinite => "not finite (NaN or infinity)",
        })
    }
}

/// Descriptors of one file, one a row.
///
/// Invariant: every number is finite. A row that was zero or not finite in the file is all zeros here and listed in
/// `left_out`: one bad mask must not cost the frame its other masks.
#[derive(Clone, Debug, PartialEq)]
pub struct Descriptors {
    /// Where they come from.
    pub path: PathBuf,
    /// Numbers per row, at least 1.
    pub dim: usize,
    /// `[rows, dim]`, as stored: not normalised.
    pub values: Vec<f32>,
    /// Rows that are left out, in order, and why.
    pub left_out: Vec<(usize, Unusable)>,
}

impl Descriptors {
    /// Reads an array whose last dimension is the descriptor; the shape's other dimensions are returned beside.
    ///
    /// `dimensions` is what the name of the file promises, `[rows, cols, D]` or so.
    ///
    /// # Errors
    /// Not readable, not of floats, or not of so many dimensions.
    pub(super) fn read(path: &Path, dimensions: &[&str]) -> Result<(Vec<usize>, Self), FeatureError> {
        let array = read_npy(path)?;
        check_floats(path, &array.header, dimensions)?;
        let (dim, lead) = array.header.shape.split_last().expect("at least one dimension was checked");
        let values = array.to_f32();
        Ok((lead.to_vec(), Self::new(path.to_owned(), *dim, values)))
    }

    /// Descriptors from memory; `values` is `[rows, dim]`.
    pub fn new(path: PathBuf, dim: usize, mut values: Vec<f32>) -> Self {
        let mut left_out = Vec::new();
        for (n, row) in values.chunks_exact_mut(dim.max(1)).enumerate() {
            if let Some(why) = unusable(row) {
                row.fill(0.0);
                left_out.push((n, why));
            }
        }
        Self { path, dim, values, left_out }
    }

    /// Number of rows, those left out included.
    pub fn rows(&self) -> usize {
        self.values.len() / self.dim.max(1)
    }

    /// One row.
    pub fn row(&self, n: usize) -> &[f32] {
        &self.values[n * self.dim..(n + 1) * self.dim]
    }

    /// Whether a row can be used.
    pub fn is_usable(&self, n: usize) -> bool {
        self.left_out.binary_search_by_key(&n, |(row, _)| *row).is_err()
    }

    /// What was left out, in words; `None` if nothing was.
    pub fn warning(&self) -> Option<String> {
        let (row, why) = self.left_out.first()?;
        let count = self.left_out.len();
        let of = self.rows();
        Some(format!(
            "{}: {count} of {of} descriptors are left out (first: row {row} is {why}); extract the frame again",
            self.path.display()
        ))
    }
}

/// Why a descriptor cannot be used; `None` if it can.
pub(crate) fn unusable(row: &[f32]) -> Option<Unusable> {
    if row.iter().any(|v| !v.is_finite()) {
        return Some(Unusable::NonFinite);
    }
    row.iter().all(|v| *v == 0.0).then_some(Unusable::Zero)
}

/// Checks type and number of dimensions of an array of descriptors, and that none of them is empty.
pub(super) fn check_floats(path: &Path, header: &NpyHeader, dimensions: &[&str]) -> Result<(), FeatureError> {
    let NpyHeader { dtype, shape } = header;
    let sound = shape.len() == dimensions.len() && shape.last() != Some(&0) && dtype.is_float();
    if sound {
        return Ok(());
    }
    Err(FeatureError::shape(
        path,
        format!("{} of shape {shape:?}", dtype.descr()),
        format!("floats of shape [{}]", dimensions.join(", ")),
        "save it as the layout of the scene folder says (docs/scenes.md)",
    ))
}
