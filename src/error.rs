//! What all stages say about files, so that each says it alike.

use std::path::{Path, PathBuf};

/// A file or folder that the system does not let be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FileError {
    /// Which one.
    pub path: PathBuf,
    /// What the system says.
    pub source: std::io::Error,
}

/// A file or folder that is not what it should be.
#[derive(Debug, thiserror::Error)]
#[error("{}: {what}; {remedy}", path.display())]
pub struct BadFile {
    /// Which one.
    pub path: PathBuf,
    /// What is wrong.
    pub what: String,
    /// What to do.
    pub remedy: &'static str,
}

impl FileError {
    /// Names the path in what the system says: `fs::read(path).map_err(FileError::at(path))`.
    pub fn at(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        move |source| Self { path: path.to_owned(), source }
    }
}
