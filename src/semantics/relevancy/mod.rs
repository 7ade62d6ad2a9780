//! How well a point answers a phrase (LERF, Kerr et al. 2023, as DIV-FF uses it).
//!
//! A feature f̂ = f/|f| is held against a phrase q and canonical phrases c_i ("object", "stuff", ...):
//!
//! ```text
//! score = min_i exp(τ f̂·q) / (exp(τ f̂·q) + exp(τ f̂·c_i)) = σ(τ (f̂·q − max_i f̂·c_i))
//! ```
//!
//! The right-hand side has one exponential, of the smallest margin, and so neither overflows nor divides by zero. 0.5
//! means: as close to the phrase as to the nearest canonical one. A point without evidence, f = 0, has score 0 and
//! coverage 0. In compressed space nothing is decompressed: see [`crate::semantics::compress::LinearMap`].

mod kernel;
#[cfg(test)]
mod tests;

use half::f16;
use rayon::prelude::*;

use crate::scene::features::{Space, normalise};
use crate::semantics::compress::{Compressor, LinearMap, Map, Projected};

/// Points that one task looks at; a multiple of what the kernel takes together.
const CHUNK: usize = 4096;
/// Points that an autoencoder decompresses together.
const DECODED: usize = 384;

/// Beyond it a margin of f32's last digit decides everything, and products with small features overflow.
const MAX_TEMPERATURE: f32 = 1e6;

/// τ of LERF's code. The paper's formula has none, which is τ = 1.
pub const LERF_TEMPERATURE: f32 = 10.0;

/// Why points cannot be held against phrases.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RelevancyError {
    /// There is nothing to compare a phrase with.
    #[error("no canonical phrases in the {} space; it needs at least one of {:?}", space.name(),
        space.canonical_phrases())]
    NoCanonical {
        /// The space.
        space: Space,
    },
    /// An embedding has not as many numbers as the features.
    #[error(
        "{what} has {found} numbers, the features {expected}; use embeddings of the model that made the features"
    )]
    Width {
        /// Which one.
        what: String,
        /// Numbers that it has.
        found: usize,
        /// Numbers that it should have.
        expected: usize,
    },
    /// An embedding is zero or not finite.
    #[error("{what} is zero or not finite; encode it again")]
    Embedding {
        /// Which one.
        what: String,
    },
    /// τ is out of range.
    #[error(
        "the relevancy's temperature is {value}; choose a number above 0 and up to a million, such as 10"
    )]
    Temperature {
        /// τ.
        value: f32,
    },
    /// A feature is not finite.
    #[error("the feature of point {point} is not finite")]
    NonFinite {
        /// Number of the point.
        point: usize,
    },
}

/// Features of points, row by row.
#[derive(Clone, Copy, Debug)]
pub enum Points<'a> {
    /// `[points, dim]`.
    F32(&'a [f32]),
    /// `[points, dim]`; half the memory, and the speed of memory is what counts.
    F16(&'a [f16]),
}

impl Points<'_> {
    fn len(&self) -> usize {
        match self {
            Self::F32(v) => v.len(),
            Self::F16(v) => v.len(),
        }
    }

    fn part(&self, start: usize, end: usize) -> Points<'_> {
        match self {
            Self::F32(v) => Points::F32(&v[start..end]),
            Self::F16(v) => Points::F16(&v[start..end]),
        }
    }
}

/// Phrases to be found, ready for points of one space.
#[derive(Clone, Debug)]
pub struct Queries {
    /// The phrases to be found, then the canonical ones: each `[dim]` and an offset.
    phrases: Vec<Projected>,
    /// How many of them are to be found.
    wanted: usize,
    temperature: f32,
    /// What the features' squared length is beside |z|².
    norm: Norm,
    /// Set where features must be decompressed first.
    decoder: Option<Compressor>,
}

/// |f|² = `constant` + 2 `linear` · z + |z|².
#[derive(Clone, Debug)]
struct Norm {
    constant: f32,
    linear: Vec<f32>,
}

/// What holding points against phrases gives.
#[derive(Clone, Debug, PartialEq)]
pub struct Relevancy {
    /// One list per phrase, in the order asked: for each point 0 to 1.
    pub scores: Vec<Vec<f32>>,
    /// For each point 1 where there is a feature, 0 where there is none.
    pub coverage: Vec<f32>,
}

/// First point, and where its chunk's scores (one list per phrase) and coverage go.
type Task<'a> = (usize, Vec<&'a mut [f32]>, &'a mut [f32]);

impl Queries {
    /// Phrases for features that are as long as the embeddings.
    ///
    /// Embeddings are scaled to unit length. `temperature` is τ.
    ///
    /// # Errors
    /// [`RelevancyError`] for an embedding or a temperature that cannot be used, or no canonical phrase.
    pub fn new(
        space: Space,
        wanted: &[&[f32]],
        canonical: &[&[f32]],
        temperature: f32,
    ) -> Result<Self, RelevancyError> {
        let dim = wanted.first().or(canonical.first()).map_or(0, |e| e.len());
        let phrases = checked(space, wanted, canonical, temperature, dim)?;
        let phrases = phrases.into_iter().map(|direction| Projected { direction, offset: 0.0 }).collect();
        let norm = Norm { constant: 0.0, linear: vec![0.0; dim] };
        Ok(Self { phrases, wanted: wanted.len(), temperature, norm, decoder: None })
    }

    /// Phrases for compressed features.
    ///
    /// A linear map is applied to the phrases, an autoencoder is undone for every point.
    ///
    /// # Errors
    /// As [`Self::new`]; [`RelevancyError::Width`] also where embeddings do not fit what was compressed.
    pub fn compressed(
        space: Space,
        compressor: &Compressor,
        wanted: &[&[f32]],
        canonical: &[&[f32]],
        temperature: f32,
    ) -> Result<Self, RelevancyError> {
        let phrases = checked(space, wanted, canonical, temperature, compressor.full())?;
        match &compressor.map {
            Map::Linear(map) => Ok(Self {
                phrases: phrases.iter().map(|p| map.project(p)).collect(),
                wanted: wanted.len(),
                temperature,
                norm: Norm::of(map),
                decoder: None,
            }),
            Map::Autoencoder(_) => {
                let plain = Self::new(space, wanted, canonical, temperature)?;
                Ok(Self { decoder: Some(compressor.clone()), ..plain })
            }
        }
    }

    /// Numbers per feature that the points must have.
    pub fn dim(&self) -> usize {
        self.decoder.as_ref().map_or(self.norm.linear.len(), Compressor::dim)
    }

    /// Holds all points against all phrases.
    ///
    /// The same result on any number of threads. A feature of zeros means that nothing is known: score and coverage
    /// are 0. So it is where a decompressed feature vanishes.
    ///
    /// # Errors
    /// [`RelevancyError::NonFinite`] for the first point with a NaN or an infinity, [`RelevancyError::Width`] if the
    /// number of values is no multiple of [`Self::dim`].
    pub fn score(&self, points: Points) -> Result<Relevancy, RelevancyError> {
        let dim = self.dim();
        if dim == 0 || !points.len().is_multiple_of(dim) {
            let what = "the list of points".to_owned();
            return Err(RelevancyError::Width { what, found: points.len(), expected: dim });
        }
        let count = points.len() / dim;
        let mut scores = vec![vec![0.0; count]; self.wanted];
        let mut coverage = vec![0.0; count];
        let packed = kernel::Packed::new(self);
        let mut tasks: Vec<Task> = coverage
            .chunks_mut(CHUNK)
            .enumerate()
            .map(|(n, coverage)| (n * CHUNK, Vec::with_capacity(self.wanted), coverage))
            .collect();
        for scores in &mut scores {
            for (task, part) in tasks.iter_mut().zip(scores.chunks_mut(CHUNK)) {
                task.1.push(part);
            }
        }
        let bad: Vec<Option<usize>> = tasks
            .into_par_iter()
            .map(|(start, mut scores, coverage)| {
                let part = points.part(start * dim, (start + coverage.len()) * dim);
                let bad = match &self.decoder {
                    None => kernel::run(self, &packed, part, &mut scores, coverage),
                    Some(decoder) => self.decode_and_score(decoder, &packed, part, &mut scores, coverage),
                };
                bad.map(|n| start + n)
            })
            .collect();
        match bad.into_iter().flatten().next() {
            Some(point) => Err(RelevancyError::NonFinite { point }),
            None => Ok(Relevancy { scores, coverage }),
        }
    }

    /// Scores of points whose features depend on a size: for each phrase those at the size where it is highest at any
    /// point (LERF, 3.3). `points` are the features at one size, `at` gives those at each of `others`.
    ///
    /// # Errors
    /// As [`Self::score`].
    pub fn best_scores(
        &self,
        points: &[f32],
        others: &[f32],
        at: impl Fn(f32) -> Vec<f32>,
    ) -> Result<Vec<Vec<f32>>, RelevancyError> {
        let top = |scores: &[f32]| scores.iter().copied().fold(0.0, f32::max);
        let mut best = self.score(Points::F32(points))?.scores;
        for size in others {
            let found = self.score(Points::F32(&at(*size)))?.scores;
            for (best, found) in best.iter_mut().zip(found) {
                if top(&found) > top(best) {
                    *best = found;
                }
            }
        }
        Ok(best)
    }

    /// For compressors that phrases cannot be projected into.
    fn decode_and_score(
        &self,
        decoder: &Compressor,
        packed: &kernel::Packed,
        points: Points,
        scores: &mut [&mut [f32]],
        coverage: &mut [f32],
    ) -> Option<usize> {
        let (dim, full) = (decoder.dim(), decoder.full());
        let mut wide = vec![0.0; DECODED * full];
        let mut codes = vec![0.0; DECODED * dim];
        for start in (0..coverage.len()).step_by(DECODED) {
            let end = (start + DECODED).min(coverage.len());
            let (codes, wide) = (&mut codes[..(end - start) * dim], &mut wide[..(end - start) * full]);
            kernel::widen(points.part(start * dim, end * dim), codes);
            decoder.decode(codes, wide);
            for (code, wide) in codes.chunks_exact(dim).zip(wide.chunks_exact_mut(full)) {
                if code.iter().all(|v| *v == 0.0) {
                    wide.fill(0.0);
                }
            }
            let mut parts: Vec<&mut [f32]> = scores.iter_mut().map(|s| &mut s[start..end]).collect();
            let bad = kernel::run(self, packed, Points::F32(wide), &mut parts, &mut coverage[start..end]);
            if let Some(n) = bad {
                return Some(start + n);
            }
        }
        None
    }
}

impl Norm {
    fn of(map: &LinearMap) -> Self {
        Self { constant: map.mean_norm2(), linear: map.basis_mean().to_vec() }
    }
}

/// All embeddings, scaled to unit length: the wanted ones, then the canonical ones.
fn checked(
    space: Space,
    wanted: &[&[f32]],
    canonical: &[&[f32]],
    temperature: f32,
    dim: usize,
) -> Result<Vec<Vec<f32>>, RelevancyError> {
    if canonical.is_empty() {
        return Err(RelevancyError::NoCanonical { space });
    }
    if !(temperature > 0.0 && temperature <= MAX_TEMPERATURE) {
        return Err(RelevancyError::Temperature { value: temperature });
    }
    let named = (wanted.iter().enumerate().map(|(n, e)| (format!("the embedding of phrase {n}"), e))).chain(
        canonical.iter().enumerate().map(|(n, e)| (format!("the embedding of canonical phrase {n}"), e)),
    );
    named
        .map(|(what, embedding)| {
            if embedding.len() != dim {
                return Err(RelevancyError::Width { what, found: embedding.len(), expected: dim });
            }
            if embedding.iter().any(|v| !v.is_finite()) || embedding.iter().all(|v| *v == 0.0) {
                return Err(RelevancyError::Embedding { what });
            }
            let mut embedding = embedding.to_vec();
            normalise(&mut embedding);
            Ok(embedding)
        })
        .collect()
}
