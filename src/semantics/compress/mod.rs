//! Making descriptors short, per scene: 512 numbers to a few dozen.
//!
//! [`Compressor::fit`] learns from a [`TargetTable`]. The linear map (the default) can be queried in compressed space;
//! the autoencoder is LangSplat's, for comparison. Both know the error they make: 1 − mean cosine between descriptors
//! and what comes back.
//!
//! A compressor is stored as a [`CompressorHeader`] (serde) and the arrays that [`Compressor::visit`] names.

mod autoencoder;
mod eigen;
mod error;
mod linear;
#[cfg(test)]
mod tests;

pub use autoencoder::{Autoencoder, AutoencoderConfig};
pub use error::CompressError;
use linear::Components;
pub use linear::{LinearMap, Projected};
use serde::{Deserialize, Serialize};

use crate::scene::features::normalise;
use crate::semantics::targets::TargetTable;

/// Descriptors that are learned from: enough for 512 dimensions, and no more than 32 MB.
const MAX_ROWS: usize = 16_384;
/// Networks that read the codes compute four numbers together.
const MULTIPLE: usize = 4;

/// Which kind of compressor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CompressorKind {
    /// Mean and orthonormal basis.
    #[default]
    Linear,
    /// Two small networks.
    Autoencoder,
}

/// How descriptors are compressed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CompressConfig {
    /// Which kind.
    pub kind: CompressorKind,
    /// Numbers per compressed descriptor; chosen by `feature_error` if not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dim: Option<usize>,
    /// 1 − mean cosine that compression may cost.
    pub feature_error: f64,
    /// Of the autoencoder.
    pub autoencoder: AutoencoderConfig,
}

impl Default for CompressConfig {
    fn default() -> Self {
        let (kind, autoencoder) = (CompressorKind::default(), AutoencoderConfig::default());
        Self { kind, dim: None, feature_error: 0.02, autoencoder }
    }
}

impl CompressConfig {
    /// # Errors
    /// [`CompressError::Setting`] for a number out of range.
    pub fn validate(&self) -> Result<(), CompressError> {
        let wrong = |name, value: String, remedy| Err(CompressError::Setting { name, value, remedy });
        if self.dim == Some(0) {
            return wrong("dim", "0".into(), "choose at least 1, or leave it out");
        }
        if !(self.feature_error > 0.0 && self.feature_error < 1.0) {
            return wrong(
                "feature_error",
                self.feature_error.to_string(),
                "choose between 0 and 1, such as 0.02",
            );
        }
        let a = &self.autoencoder;
        if a.hidden.len() > 16 || a.hidden.iter().any(|w| *w == 0 || *w > 4096) {
            return wrong(
                "autoencoder.hidden",
                format!("{:?}", a.hidden),
                "choose up to 16 widths of 1 to 4096",
            );
        }
        if a.steps == 0 || !(a.rate > 0.0 && a.rate <= 1.0) {
            let value = format!("{}, with {} steps", a.rate, a.steps);
            return wrong("autoencoder.rate", value, "choose between 0 and 1, and at least one step");
        }
        Ok(())
    }
}

/// A way to make the descriptors of one scene and space short.
#[derive(Clone, Debug, PartialEq)]
pub struct Compressor {
    /// What it does.
    pub map: Map,
    /// 1 − mean cosine between the descriptors it was made from and what comes back.
    pub error: f64,
}

/// The two ways.
#[derive(Clone, Debug, PartialEq)]
pub enum Map {
    /// Can be queried in compressed space.
    Linear(LinearMap),
    /// Must be decompressed for a query.
    Autoencoder(Autoencoder),
}

/// What a stored compressor is, beside its arrays.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CompressorHeader {
    kind: CompressorKind,
    full: usize,
    dim: usize,
    error: f64,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    hidden: Vec<usize>,
}

impl Compressor {
    /// Learns to compress the descriptors of a table.
    ///
    /// Without `config.dim`, the smallest multiple of four whose error is at most `feature_error` is taken; if none is
    /// good enough, all dimensions of the linear map, or the autoencoder with the largest code that was tried.
    ///
    /// # Errors
    /// [`CompressError`]: settings out of range, no usable descriptor, or one that is not finite.
    pub fn fit(table: &TargetTable, config: &CompressConfig, seed: u64) -> Result<Self, CompressError> {
        config.validate()?;
        Self::fit_rows(&table.sample(MAX_ROWS), table.dim(), config, seed)
    }

    /// [`Self::fit`] for rows `[n, full]` in memory; each counts alike, whatever its length. Zeros are left out.
    ///
    /// # Errors
    /// As [`Self::fit`].
    pub fn fit_rows(
        rows: &[f32],
        full: usize,
        config: &CompressConfig,
        seed: u64,
    ) -> Result<Self, CompressError> {
        config.validate()?;
        let mut kept = Vec::with_capacity(rows.len());
        for (n, row) in rows.chunks_exact(full.max(1)).enumerate() {
            if row.iter().any(|v| !v.is_finite()) {
                return Err(CompressError::NonFinite { row: n });
            }
            if row.iter().any(|v| *v != 0.0) {
                kept.extend_from_slice(row);
            }
        }
        if kept.is_empty() {
            return Err(CompressError::NoDescriptors);
        }
        kept.chunks_exact_mut(full).for_each(normalise);
        match config.kind {
            CompressorKind::Linear => Ok(fit_linear(&kept, full, config)),
            CompressorKind::Autoencoder => fit_autoencoder(&kept, full, config, seed),
        }
    }

    /// Numbers per descriptor before compression.
    pub fn full(&self) -> usize {
        match &self.map {
            Map::Linear(map) => map.full(),
            Map::Autoencoder(map) => map.full(),
        }
    }

    /// Numbers per descriptor after it.
    pub fn dim(&self) -> usize {
        match &self.map {
            Map::Linear(map) => map.dim(),
            Map::Autoencoder(map) => map.dim(),
        }
    }

    /// Which kind it is.
    pub fn kind(&self) -> CompressorKind {
        match &self.map {
            Map::Linear(_) => CompressorKind::Linear,
            Map::Autoencoder(_) => CompressorKind::Autoencoder,
        }
    }

    /// Compresses `rows` `[n, full]` to `out` `[n, dim]`.
    pub fn encode(&self, rows: &[f32], out: &mut [f32]) {
        match &self.map {
            Map::Linear(map) => map.encode(rows, out),
            Map::Autoencoder(map) => map.encode(rows, out),
        }
    }

    /// Decompresses `codes` `[n, dim]` to `out` `[n, full]`. Not normalised.
    pub fn decode(&self, codes: &[f32], out: &mut [f32]) {
        match &self.map {
            Map::Linear(map) => map.decode(codes, out),
            Map::Autoencoder(map) => map.decode(codes, out),
        }
    }

    /// 1 − mean cosine between rows `[n, full]` and what comes back; rows of zeros do not count.
    pub fn error_on(&self, rows: &[f32]) -> f64 {
        let (mut codes, mut back) = (vec![0.0; self.dim()], vec![0.0; self.full()]);
        let (mut sum, mut count) = (0.0, 0usize);
        for row in rows.chunks_exact(self.full()).filter(|r| r.iter().any(|v| *v != 0.0)) {
            self.encode(row, &mut codes);
            self.decode(&codes, &mut back);
            sum += cosine(row, &back);
            count += 1;
        }
        if count == 0 { 0.0 } else { 1.0 - sum / count as f64 }
    }

    /// What is stored beside the arrays.
    pub fn header(&self) -> CompressorHeader {
        let hidden = match &self.map {
            Map::Linear(_) => Vec::new(),
            Map::Autoencoder(map) => map.hidden().to_vec(),
        };
        CompressorHeader { kind: self.kind(), full: self.full(), dim: self.dim(), error: self.error, hidden }
    }

    /// The arrays that have to be stored: name, shape and values.
    pub fn visit<'a>(&'a self, mut f: impl FnMut(&'static str, Vec<usize>, &'a [f32])) {
        match &self.map {
            Map::Linear(map) => {
                f("mean", vec![map.full()], &map.mean);
                f("basis", vec![map.dim(), map.full()], &map.basis);
            }
            Map::Autoencoder(map) => {
                f("mean", vec![map.full()], &map.mean);
                f("weights", vec![map.weights.len()], &map.weights);
            }
        }
    }

    /// A linear map that is known: mean `[full]` and basis `[dim, full]` of orthonormal rows.
    ///
    /// # Errors
    /// [`CompressError::Stored`] for lengths that do not fit, or a basis that is none.
    pub fn from_linear(mean: Vec<f32>, basis: Vec<f32>) -> Result<Self, CompressError> {
        let dim = basis.len() / mean.len().max(1);
        Ok(Self { map: Map::Linear(LinearMap::checked(mean, basis, dim)?), error: 0.0 })
    }

    /// A stored compressor; `fetch` gives an array by its name.
    ///
    /// # Errors
    /// [`CompressError::Stored`] for an array that is missing, has the wrong length or makes no sense, or whatever
    /// `fetch` says.
    pub fn from_stored<E: From<CompressError>>(
        header: &CompressorHeader,
        mut fetch: impl FnMut(&'static str) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        let mean = fetch("mean")?;
        let sound = header.full > 0 && header.dim > 0 && header.dim <= MAX_ROWS && header.error.is_finite();
        if !sound || mean.len() != header.full || header.hidden.iter().any(|w| *w > 4096) {
            let what = "does not fit its header".to_owned();
            return Err(CompressError::Stored { name: "mean".into(), what }.into());
        }
        let map = match header.kind {
            CompressorKind::Linear => Map::Linear(LinearMap::checked(mean, fetch("basis")?, header.dim)?),
            CompressorKind::Autoencoder => {
                let weights = fetch("weights")?;
                let CompressorHeader { full, dim, hidden, .. } = header;
                Map::Autoencoder(Autoencoder::checked(*full, *dim, hidden, mean, weights)?)
            }
        };
        Ok(Self { map, error: header.error })
    }
}

fn fit_linear(rows: &[f32], full: usize, config: &CompressConfig) -> Compressor {
    let components = Components::new(rows, full);
    let curve = components.error_curve(rows);
    let good_enough = || {
        let candidates = (MULTIPLE..=full).step_by(MULTIPLE);
        candidates.into_iter().find(|d| curve[*d] <= config.feature_error).unwrap_or(full)
    };
    let dim = config.dim.map_or_else(good_enough, |d| d.min(full));
    Compressor { map: Map::Linear(components.map(dim)), error: curve[dim].max(0.0) }
}

/// Codes that are tried when none is asked for.
const CODES: [usize; 4] = [8, 16, 32, 64];

fn fit_autoencoder(
    rows: &[f32],
    full: usize,
    config: &CompressConfig,
    seed: u64,
) -> Result<Compressor, CompressError> {
    let tried: Vec<usize> = match config.dim {
        // The networks' widths are multiples of four; a part of a code would not come back.
        Some(dim) => vec![dim.min(full).next_multiple_of(MULTIPLE)],
        None => CODES.to_vec(),
    };
    let mut best: Option<Compressor> = None;
    for dim in tried {
        let map = Map::Autoencoder(Autoencoder::train(rows, full, dim, &config.autoencoder, seed)?);
        let mut made = Compressor { map, error: 0.0 };
        made.error = error_of(&made, rows);
        let good = made.error <= config.feature_error;
        if best.as_ref().is_none_or(|b| made.error < b.error) {
            best = Some(made);
        }
        if good {
            break;
        }
    }
    best.ok_or(CompressError::NoDescriptors)
}

/// [`Compressor::error_on`] in blocks, for networks that run on 48 rows together.
fn error_of(made: &Compressor, rows: &[f32]) -> f64 {
    let full = made.full();
    let count = rows.len() / full;
    let (mut codes, mut back) = (vec![0.0; count * made.dim()], vec![0.0; rows.len()]);
    made.encode(rows, &mut codes);
    made.decode(&codes, &mut back);
    let sum: f64 = rows.chunks_exact(full).zip(back.chunks_exact(full)).map(|(x, y)| cosine(x, y)).sum();
    1.0 - sum / count as f64
}

/// Cosine of two vectors; 0 where one is zero.
fn cosine(a: &[f32], b: &[f32]) -> f64 {
    let dot =
        |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let norms = (dot(a, a) * dot(b, b)).sqrt();
    if norms > 0.0 { dot(a, b) / norms } else { 0.0 }
}
