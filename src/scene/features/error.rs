//! What can be wrong with a feature file, where, and what to do about it.

use std::path::{Path, PathBuf};

use crate::scene::SceneError;

/// Why a feature file cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FeatureError {
    /// A `.npy` file cannot be read, is damaged or of a type that is not supported.
    #[error("{0}; make the file again")]
    Array(Box<divff_exporters::Error>),
    /// A `meta.json` or a picture cannot be read or makes no sense.
    #[error(transparent)]
    Scene(Box<SceneError>),
    /// A text file cannot be read.
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// An array has another shape or kind than its name asks for.
    #[error("{}: it is {found}, expected {expected}; {remedy}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Shape and type that it has.
        found: String,
        /// What it should have.
        expected: String,
        /// What to do.
        remedy: &'static str,
    },
    /// Descriptors of two lengths in one space.
    #[error(
        "{}: its descriptors have {found} numbers, those of {} have {expected}; make all features of a folder \
         with the same model",
        path.display(), set_by.display()
    )]
    Width {
        /// The file.
        path: PathBuf,
        /// Numbers per descriptor in it.
        found: usize,
        /// Numbers per descriptor elsewhere.
        expected: usize,
        /// The file that set the width.
        set_by: PathBuf,
    },
    /// A mask index without a descriptor.
    #[error(
        "{}: index {index} at level {level}, row {y}, column {x}, but {} holds {masks} descriptors; indices go \
         from 0 to one less than that, and -1 is no mask: extract both files again",
        path.display(), descriptors.display()
    )]
    MaskIndex {
        /// The index map.
        path: PathBuf,
        /// Level of the map.
        level: usize,
        /// Row of the map.
        y: usize,
        /// Column of the map.
        x: usize,
        /// The index found.
        index: i64,
        /// The file of descriptors.
        descriptors: PathBuf,
        /// How many it holds.
        masks: usize,
    },
    /// A file that another one cannot be used without.
    #[error("{}: it needs {} beside it, which is not there; extract the frame's features again", path.display(),
        missing.display())]
    Companion {
        /// The file that is there.
        path: PathBuf,
        /// The file that is not.
        missing: PathBuf,
    },
    /// A descriptor that must be usable holds only zeros, or NaN or an infinity.
    #[error("{}: row {row} is {why}; {remedy}", path.display())]
    Descriptor {
        /// The file.
        path: PathBuf,
        /// Row of the array, from 0.
        row: usize,
        /// What it is.
        why: super::Unusable,
        /// What to do.
        remedy: &'static str,
    },
    /// Phrases and embeddings are not equally many.
    #[error("{}: {phrases} phrases, but {} holds {rows} embeddings; one line for each row", path.display(),
        embeddings.display())]
    PhraseCount {
        /// The list of phrases.
        path: PathBuf,
        /// Phrases in it.
        phrases: usize,
        /// The file of embeddings.
        embeddings: PathBuf,
        /// Rows of it.
        rows: usize,
    },
}

impl FeatureError {
    pub(crate) fn shape(
        path: &Path,
        found: impl Into<String>,
        expected: impl Into<String>,
        remedy: &'static str,
    ) -> Self {
        Self::Shape { path: path.to_owned(), found: found.into(), expected: expected.into(), remedy }
    }
}

// Boxed: both are large, and every result here would carry their size.
impl From<SceneError> for FeatureError {
    fn from(error: SceneError) -> Self {
        Self::Scene(Box::new(error))
    }
}

impl From<divff_exporters::Error> for FeatureError {
    fn from(error: divff_exporters::Error) -> Self {
        Self::Array(Box::new(error))
    }
}
