//! What can go wrong between a trained field and the files of a map.

use crate::config::ConfigError;
use crate::error::FileError;
use crate::extract::ExtractError;
use crate::scene::SceneError;

/// Why a map cannot be built or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MapError {
    /// A setting cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A frame's image or mask cannot be read.
    #[error(transparent)]
    Scene(Box<SceneError>),
    /// The surface cannot be extracted.
    #[error("extracting the {what} surface: {source}")]
    Extract {
        /// Which one.
        what: String,
        /// Why.
        source: ExtractError,
    },
    /// A time that no frame has.
    #[error("there is no frame with index {index}; the scene has frames {first} to {last}")]
    NoSuchFrame {
        /// What was asked for.
        index: u32,
        /// Smallest index of the scene.
        first: u32,
        /// Largest index of the scene.
        last: u32,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] divff_exporters::Error),
    /// The folder cannot be made or cleared.
    #[error(transparent)]
    Io(#[from] FileError),
}

impl From<SceneError> for MapError {
    fn from(error: SceneError) -> Self {
        Self::Scene(Box::new(error))
    }
}

impl MapError {
    pub(crate) fn extract(what: &str) -> impl FnOnce(ExtractError) -> Self {
        let what = what.to_owned();
        move |source| Self::Extract { what, source }
    }
}
