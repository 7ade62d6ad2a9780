//! What an atomic write asks of the file system: the one place where tests make it fail.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

#[cfg(test)]
use super::faults::check;

/// The disk's own faults are enough outside tests.
#[cfg(not(test))]
fn check(_target: &Path) -> io::Result<()> {
    Ok(())
}

/// A new file that will take the place of another one.
#[derive(Debug)]
pub struct TempFile {
    file: File,
    target: PathBuf,
}

impl TempFile {
    /// Creates `path`, which must not exist, and locks it as long as it is open.
    ///
    /// # Errors
    /// `AlreadyExists` also where somebody who clears up was faster than the lock.
    pub(super) fn create(path: &Path, target: &Path) -> io::Result<Self> {
        check(target)?;
        let file = OpenOptions::new().write(true).create_new(true).open(path)?;
        // Not every file system has locks; where there are none, nobody clears up.
        if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) || !path.exists() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        Ok(Self { file, target: target.to_owned() })
    }

    pub(super) fn sync(&self) -> io::Result<()> {
        check(&self.target)?;
        self.file.sync_all()
    }
}

impl Write for TempFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        check(&self.target)?;
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for TempFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

pub(super) fn rename(path: &Path, target: &Path) -> io::Result<()> {
    check(target)?;
    fs::rename(path, target)
}

/// Makes the rename durable. Only Unix lets a folder be opened and synced.
pub(super) fn sync_folder(folder: &Path, target: &Path) -> io::Result<()> {
    check(target)?;
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}
