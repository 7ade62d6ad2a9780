//! What can go wrong while training.

use crate::config::ConfigError;
use crate::error::{BadFile, FileError};
use crate::scene::SceneError;
use crate::scene::features::FeatureError;

/// Why training cannot start, continue or be stored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A frame cannot be read.
    #[error(transparent)]
    Scene(Box<SceneError>),
    /// The masks that tell what moves cannot be read.
    #[error(transparent)]
    Features(Box<FeatureError>),
    /// A setting cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// No training frame has a usable pixel.
    #[error("no training frame has a usable pixel: every mask is empty")]
    NoPixels,
    /// The numbers have left the range of f32: the learning rate is too high, or the input is not an image.
    #[error(
        "{stage} is not finite at step {step} (index {index}); lower train.table_rate and train.network_rate (or train.frequency_rate)"
    )]
    NonFinite {
        /// What was being computed.
        stage: &'static str,
        /// Training step.
        step: u64,
        /// Index within the stage.
        index: usize,
    },
    /// A checkpoint that is damaged or of another field.
    #[error(transparent)]
    Checkpoint(BadFile),
    /// A file cannot be read or written.
    #[error(transparent)]
    Io(#[from] FileError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] divff_exporters::Error),
}

// Boxed: a scene error is large, and every result here would carry its size.
impl From<SceneError> for TrainError {
    fn from(error: SceneError) -> Self {
        Self::Scene(Box::new(error))
    }
}

impl From<FeatureError> for TrainError {
    fn from(error: FeatureError) -> Self {
        Self::Features(Box::new(error))
    }
}
