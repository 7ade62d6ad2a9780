//! Files that are either complete or not there: the one way in which anything is written.

mod disk;
#[cfg(test)]
pub(crate) mod faults;
mod stale;

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

pub use disk::TempFile;

use crate::error::{Error, Result};

/// What a writing closure gets: buffered, and seekable for formats that fill in tables afterwards.
pub type AtomicWriter = BufWriter<TempFile>;

/// Writers hand over whole columns or chunks of rows; this only gathers headers and other small pieces.
const BUFFER_BYTES: usize = 64 * 1024;

/// Removes the temporary file unless it was renamed, also when the closure panics.
struct Cleanup {
    path: PathBuf,
    armed: bool,
}

impl Drop for Cleanup {
    fn drop(&mut self) {
        if self.armed {
            // Nothing sensible can be done about a failure here; the write's own error is the one to report.
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Writes `path` so that a reader sees the old content or the whole new one, even after a power cut.
///
/// `write` fills a temporary file in the same folder; it is synced, renamed to `path`, and the folder is
/// synced.
///
/// # Errors
/// `Io` when the folder is missing or unwritable, the disk is full, or `write` fails. The temporary file is
/// then gone and an older `path` is untouched; only when nothing but syncing the folder failed, the whole new file
/// is there already.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut AtomicWriter) -> io::Result<()>) -> Result<()> {
    write_and_replace(path, write).map_err(|source| Error::io(path, source))
}

/// [`write_atomically`] for content that is already in memory.
///
/// # Errors
/// As for [`write_atomically`].
pub fn write_bytes_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    write_atomically(path, |file| file.write_all(bytes))
}

/// Checks that files can be made and written in `folder`.
///
/// # Errors
/// What the system says of it; nothing is left there either way, nor what a killed check has left.
pub fn check_writable(folder: &Path) -> io::Result<()> {
    let (mut file, _cleanup) = create_temp_beside(&folder.join("probe"))?;
    file.write_all(b"probe")
}

fn write_and_replace(path: &Path, write: impl FnOnce(&mut AtomicWriter) -> io::Result<()>) -> io::Result<()> {
    let (file, mut cleanup) = create_temp_beside(path)?;
    let mut writer = BufWriter::with_capacity(BUFFER_BYTES, file);
    write(&mut writer)?;
    let file = writer.into_inner().map_err(io::IntoInnerError::into_error)?;
    file.sync()?;
    disk::rename(&cleanup.path, path)?;
    cleanup.armed = false;
    // Its lock goes with it: from here on it has its name, and nobody takes it for a leftover.
    drop(file);
    disk::sync_folder(folder_of(path), path)
}

/// Creates `.<name>.<process>-<counter>.tmp`, and removes what killed writers of the same name left behind.
///
/// The process id and the counter keep apart the writers of one machine; `create_new` those of several
/// machines or containers that share the folder and happen to have the same process id.
fn create_temp_beside(path: &Path) -> io::Result<(TempFile, Cleanup)> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let Some(name) = path.file_name() else {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "the path does not name a file"));
    };
    if let Some(name) = name.to_str() {
        stale::remove(folder_of(path), name);
    }
    loop {
        let counter = COUNTER.fetch_add(1, Ordering::Relaxed);
        let mut temp_name = std::ffi::OsString::from(".");
        temp_name.push(name);
        temp_name.push(format!(".{}-{counter}.tmp", std::process::id()));
        let temp_path = folder_of(path).join(temp_name);
        match TempFile::create(&temp_path, path) {
            Ok(file) => return Ok((file, Cleanup { path: temp_path, armed: true })),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
            Err(error) => return Err(error),
        }
    }
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    fn names_in(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_folder_that_can_be_written_is_left_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        // Of a check that was killed.
        fs::write(folder.path().join(".probe.4000000000-0.tmp"), b"probe").unwrap();
        fs::write(folder.path().join("map.bin"), b"old").unwrap();
        check_writable(folder.path()).unwrap();
        assert_eq!(names_in(folder.path()), ["map.bin"]);
        let missing = check_writable(&folder.path().join("missing")).unwrap_err();
        assert_eq!(missing.kind(), io::ErrorKind::NotFound);
        assert!(check_writable(&folder.path().join("map.bin")).is_err(), "a file is no folder");
    }

    #[test]
    fn a_write_replaces_the_file_and_leaves_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.bin");
        write_bytes_atomically(&path, b"old").unwrap();
        write_bytes_atomically(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(names_in(folder.path()), ["map.bin"]);
    }

    #[test]
    fn a_failed_write_keeps_the_old_file_and_leaves_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.bin");
        write_bytes_atomically(&path, b"old").unwrap();
        let error = write_atomically(&path, |file| {
            file.write_all(&[7; 100_000])?;
            Err(io::Error::other("out of ideas"))
        })
        .unwrap_err();
        assert!(
            error.to_string().contains("map.bin") && error.to_string().contains("out of ideas"),
            "{error}"
        );
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(names_in(folder.path()), ["map.bin"]);
    }

    #[test]
    fn a_panic_in_the_closure_keeps_the_old_file_and_leaves_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.bin");
        write_bytes_atomically(&path, b"old").unwrap();
        let outcome =
            std::panic::catch_unwind(|| write_atomically(&path, |_| panic!("expected by the test")));
        assert!(outcome.is_err());
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(names_in(folder.path()), ["map.bin"]);
    }

    #[test]
    fn a_missing_folder_and_a_path_without_a_name_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("nowhere").join("map.bin");
        assert!(matches!(write_bytes_atomically(&missing, b"x"), Err(Error::Io { .. })));
        assert!(matches!(write_bytes_atomically(Path::new(".."), b"x"), Err(Error::Io { .. })));
    }

    /// A folder in the place of the file: the rename fails even for root, whom permissions do not stop.
    #[test]
    fn a_failed_rename_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.bin");
        fs::create_dir(&path).unwrap();
        assert!(write_bytes_atomically(&path, b"x").is_err());
        assert_eq!(names_in(folder.path()), ["map.bin"]);
    }

    #[cfg(unix)]
    #[test]
    fn an_unwritable_folder_is_an_error_that_names_the_file() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o555)).unwrap();
        let path = folder.path().join("map.bin");
        let outcome = write_bytes_atomically(&path, b"x");
        // Root may write anywhere; then there is nothing to see here.
        let is_root = File::create(folder.path().join("probe")).is_ok();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
        match outcome {
            Ok(()) => assert!(is_root),
            Err(error) => assert!(error.to_string().contains("map.bin"), "{error}"),
        }
    }

    #[test]
    fn a_taken_temporary_name_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.bin");
        let (_file, other) = create_temp_beside(&path).unwrap();
        write_bytes_atomically(&path, b"mine").unwrap();
        assert!(other.path.exists());
        assert_eq!(fs::read(&path).unwrap(), b"mine");
    }
}
