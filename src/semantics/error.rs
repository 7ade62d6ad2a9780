//! What can go wrong with features.

use super::compress::CompressError;
use super::relevancy::RelevancyError;
use super::text::TextError;
use crate::error::{BadFile, FileError};
use crate::scene::SceneError;
use crate::scene::features::{FeatureError, Space};
use crate::train::TrainError;

/// Why features cannot be trained, stored or asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SemanticsError {
    /// A feature file cannot be used.
    #[error(transparent)]
    Feature(Box<FeatureError>),
    /// A frame cannot be read.
    #[error(transparent)]
    Scene(Box<SceneError>),
    /// Geometry cannot be trained with the features.
    #[error(transparent)]
    Train(Box<TrainError>),
    /// Descriptors cannot be compressed.
    #[error("descriptors cannot be compressed: {0}")]
    Compress(#[from] CompressError),
    /// The numbers have left the range of f32: the learning rate is too high.
    #[error(
        "{stage} of the {} features is not finite at step {step} (index {index}); lower semantics.table_rate and \
         semantics.network_rate",
        space.name()
    )]
    NonFinite {
        /// What was being computed.
        stage: &'static str,
        /// Whose features.
        space: Space,
        /// Training step.
        step: u64,
        /// Index within the stage.
        index: usize,
    },
    /// Points cannot be held against phrases.
    #[error(transparent)]
    Relevancy(#[from] RelevancyError),
    /// A phrase cannot be embedded.
    #[error(transparent)]
    Text(Box<TextError>),
    /// The run has no features of a space.
    #[error("{} features: {why}; train the run on a scene that has them", space.name())]
    NoFeatures {
        /// The space.
        space: Space,
        /// Why there are none.
        why: String,
    },
    /// A file of trained features is damaged, or of another version.
    #[error(transparent)]
    Stored(BadFile),
    /// A file cannot be read or written.
    #[error(transparent)]
    Io(#[from] FileError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] divff_exporters::Error),
}

// Boxed: these errors are large, and every result here would carry their size.
impl From<FeatureError> for SemanticsError {
    fn from(error: FeatureError) -> Self {
        Self::Feature(Box::new(error))
    }
}

impl From<TextError> for SemanticsError {
    fn from(error: TextError) -> Self {
        Self::Text(Box::new(error))
    }
}

impl From<SceneError> for SemanticsError {
    fn from(error: SceneError) -> Self {
        Self::Scene(Box::new(error))
    }
}

impl From<TrainError> for SemanticsError {
    fn from(error: TrainError) -> Self {
        Self::Train(Box::new(error))
    }
}
