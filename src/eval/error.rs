//! What can go wrong while a result is compared with the truth.

use std::path::PathBuf;

use super::surface::SurfaceError;
use crate::error::FileError;
use crate::scene::SceneError;

/// Why an evaluation stopped. A measure without truth is not an error: it is left out.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// The scene's own images or depths cannot be read.
    #[error(transparent)]
    Scene(Box<SceneError>),
    /// A ground-truth image cannot be read.
    #[error("{}: {source}; restore the file, or take the ground truth out of the scene", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// The decoder's complaint.
        source: image::ImageError,
    },
    /// A list of what phrases should find is not what it should be.
    #[error("{}: is not {expected}; restore the file, or take it out of the scene", path.display())]
    Labels {
        /// The file.
        path: PathBuf,
        /// What it should be.
        expected: &'static str,
    },
    /// A ground-truth label image is not stored as it should be.
    #[error("{path}: is {got}; store the labels as 8-bit grey", path = path.display())]
    PixelType {
        /// The file.
        path: PathBuf,
        /// What it is.
        got: String,
    },
    /// An image does not have the size that the frame's camera says.
    #[error("{what} of frame {frame} has {got} pixels, its camera {width} x {height}; make the sizes agree")]
    Size {
        /// Which image.
        what: &'static str,
        /// The frame's stem.
        frame: String,
        /// Number of pixels found.
        got: usize,
        /// Camera width, px.
        width: u32,
        /// Camera height, px.
        height: u32,
    },
    /// A rendering holds NaN or infinity.
    #[error("rendered {what} of frame {frame} is not finite at pixel {pixel}; the run is damaged")]
    NonFinite {
        /// Which layer.
        what: &'static str,
        /// The frame's stem.
        frame: String,
        /// Row-major pixel index.
        pixel: usize,
    },
    /// The caller could not render a frame.
    #[error("cannot render frame {frame}: {source}")]
    Render {
        /// The frame's stem.
        frame: String,
        /// The renderer's own error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A folder or file cannot be read.
    #[error(transparent)]
    Io(#[from] FileError),
    /// A mesh cannot be read.
    #[error("{source}")]
    Ply {
        /// The reader's own error, which names the file.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A mesh cannot be measured.
    #[error("{path}: {source}", path = path.display())]
    Surface {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: SurfaceError,
    },
}

// Boxed: the reader's errors are large, and every result here would carry their size.
impl From<SceneError> for EvalError {
    fn from(error: SceneError) -> Self {
        Self::Scene(Box::new(error))
    }
}
