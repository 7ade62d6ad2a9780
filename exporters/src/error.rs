//! What can go wrong, by whose fault it is: the disk's, the file's, or the caller's.

use std::io;
use std::path::{Path, PathBuf};

/// Shorthand for this crate's results.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a file was not written or not read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused. After a failed write nothing is left behind and an older file is
    /// untouched.
    #[error("{}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The file contradicts itself or its format, or ends too early.
    #[error("{}: {reason}{}", path.display(), at_byte(offset))]
    Invalid {
        /// File.
        path: PathBuf,
        /// Byte offset where this was noticed, where it is known.
        offset: Option<u64>,
        /// What is wrong.
        reason: String,
    },
    /// The file is valid but uses something that this crate does not read.
    #[error("{}: {what} is not supported; {remedy}", path.display())]
    Unsupported {
        /// File.
        path: PathBuf,
        /// The feature.
        what: String,
        /// What to do about it.
        remedy: &'static str,
    },
    /// What was passed to a writer breaks an invariant of its type.
    #[error("{object}: {reason}")]
    Inconsistent {
        /// Name of the geometry, image or manifest.
        object: String,
        /// The broken invariant.
        reason: String,
    },
    /// What was passed to a writer, or read from a file, holds a NaN or an infinity.
    #[error("{object}: `{column}` is {value} in row {row}; every value must be finite")]
    NonFinite {
        /// Name of the geometry or image.
        object: String,
        /// Column: `positions`, `normals`, or the name of an attribute, feature or channel.
        column: String,
        /// Vertex, or pixel in row-major order.
        row: usize,
        /// The value.
        value: f64,
    },
}

fn at_byte(offset: &Option<u64>) -> String {
    offset.map_or(String::new(), |offset| format!(" (at byte {offset})"))
}

impl Error {
    pub(crate) fn io(path: &Path, source: io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    pub(crate) fn invalid(path: &Path, reason: impl Into<String>) -> Self {
        Self::Invalid { path: path.to_owned(), offset: None, reason: reason.into() }
    }

    pub(crate) fn invalid_at(path: &Path, offset: usize, reason: impl Into<String>) -> Self {
        Self::Invalid { path: path.to_owned(), offset: Some(offset as u64), reason: reason.into() }
    }

    pub(crate) fn inconsistent(object: &str, reason: impl Into<String>) -> Self {
        Self::Inconsistent { object: object.to_owned(), reason: reason.into() }
    }
}
