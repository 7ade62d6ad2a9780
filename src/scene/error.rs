//! What can be wrong with a scene, where, and what to do about it.

use std::fmt;
use std::path::{Path, PathBuf};

/// Where in a file something is wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// The file as a whole.
    File,
    /// A key of the file, as a path such as `aabb` or `camera.params`.
    Key(String),
    /// A frame, by the name that the file gives it.
    Frame(String),
    /// A key of one frame.
    FrameKey {
        /// The frame, by the name that the file gives it.
        frame: String,
        /// The key inside the frame.
        key: String,
    },
    /// A line of a text file, counted from 1.
    Line(usize),
    /// A byte offset in a binary file.
    Byte(u64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::File => Ok(()),
            Place::Key(key) => write!(f, ", key `{key}`"),
            Place::Frame(frame) => write!(f, ", frame {frame}"),
            Place::FrameKey { frame, key } => write!(f, ", frame {frame}, key `{key}`"),
            Place::Line(line) => write!(f, ", line {line}"),
            Place::Byte(offset) => write!(f, ", byte {offset}"),
        }
    }
}

/// Why a scene could not be opened or one of its files not be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// The operating system refused to read a file.
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A point cloud cannot be read.
    #[error(transparent)]
    Points(divff_exporters::Error),
    /// The path holds none of the known formats.
    #[error("{}: no scene found: {what}; {remedy}", path.display())]
    NotAScene {
        /// What was to be opened.
        path: PathBuf,
        /// What was looked for.
        what: String,
        /// What to do.
        remedy: String,
    },
    /// The file contradicts itself, its format or the other files.
    #[error("{}{at}: {what}; {remedy}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Where in it.
        at: Place,
        /// What is wrong.
        what: String,
        /// What to do.
        remedy: String,
    },
    /// The file is valid, but asks for something that `divff` does not do.
    #[error("{}{at}: {what} is not supported; {remedy}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// Where in it.
        at: Place,
        /// What is not supported.
        what: String,
        /// What to do.
        remedy: String,
    },
    /// A file that a frame names is not there.
    #[error(
        "{}, frame {frame}: its {kind} {} does not exist; {remedy}",
        listed_in.display(), path.display()
    )]
    MissingFile {
        /// The file that lists the frame.
        listed_in: PathBuf,
        /// The frame, by the name that the file gives it.
        frame: String,
        /// What the missing file is: image, depth or mask.
        kind: &'static str,
        /// The file that is missing.
        path: PathBuf,
        /// What to do.
        remedy: String,
    },
    /// An image, depth or mask file cannot be decoded or has the wrong shape.
    #[error("{}, frame {frame}: {what}; {remedy}", path.display())]
    Image {
        /// The image file.
        path: PathBuf,
        /// Stem of the frame's image.
        frame: String,
        /// What is wrong.
        what: String,
        /// What to do.
        remedy: String,
    },
}

impl SceneError {
    pub(crate) fn io(path: &Path, source: std::io::Error) -> Self {
        SceneError::Io { path: path.to_owned(), source }
    }

    pub(crate) fn invalid(
        path: &Path,
        at: Place,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        SceneError::Invalid { path: path.to_owned(), at, what: what.into(), remedy: remedy.into() }
    }

    pub(crate) fn unsupported(
        path: &Path,
        at: Place,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        SceneError::Unsupported { path: path.to_owned(), at, what: what.into(), remedy: remedy.into() }
    }

    pub(crate) fn image(
        path: &Path,
        frame: &str,
        what: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        SceneError::Image {
            path: path.to_owned(),
            frame: frame.to_owned(),
            what: what.into(),
            remedy: remedy.into(),
        }
    }
}
