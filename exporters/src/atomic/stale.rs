//! Temporary files of writers that were killed.

use std::collections::HashMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Temporary files that were in a folder when it was first written to, by the name that they were to take.
type Leftovers = HashMap<String, Vec<PathBuf>>;

/// Removes the temporary files of `name` in `folder` whose writers are gone.
///
/// A living writer, in whichever process, holds a lock on its file, which the system gives up when it dies. A folder is
/// looked through once; where there are no locks, nothing is removed. Failures are nobody's concern: what is left over
/// is in nobody's way.
pub(super) fn remove(folder: &Path, name: &str) {
    static FOUND: Mutex<Option<HashMap<PathBuf, Leftovers>>> = Mutex::new(None);
    let mut found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
    let leftovers = found.get_or_insert_default().entry(folder.to_owned()).or_insert_with(|| look(folder));
    for path in leftovers.remove(name).unwrap_or_default() {
        if let Ok(file) = File::open(&path)
            && file.try_lock().is_ok()
        {
            // Under the lock, so that a writer that has only just made it notices: see TempFile::create().
            let _ = fs::remove_file(&path);
        }
    }
}

fn look(folder: &Path) -> Leftovers {
    let mut found = Leftovers::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let temp_name = entry.file_name();
        if let Some(name) = temp_name.to_str().and_then(target) {
            found.entry(name.to_owned()).or_default().push(entry.path());
        }
    }
    found
}

/// The name that a temporary file was to take: `map.ply` of `.map.ply.1234-0.tmp`.
fn target(temp_name: &str) -> Option<&str> {
    let (name, id) = temp_name.strip_prefix('.')?.strip_suffix(".tmp")?.rsplit_once('.')?;
    let (process, counter) = id.split_once('-')?;
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    (is_number(process) && is_number(counter) && !name.is_empty()).then_some(name)
}

#[cfg(test)]
mod tests {
    use super::super::write_bytes_atomically;
    use super::*;

    #[test]
    fn only_names_that_we_make_are_ours() {
        assert_eq!(target(".map.ply.1234-0.tmp"), Some("map.ply"));
        assert_eq!(target(".a.1-22.tmp"), Some("a"));
        for other in
            ["map.ply.1234-0.tmp", ".map.ply.1234.tmp", ".map.ply.x-0.tmp", ".map.ply.1-.tmp", "..1-0.tmp"]
        {
            assert_eq!(target(other), None, "{other}");
        }
    }

    #[test]
    fn what_killed_writers_left_goes_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in [".map.bin.4000000000-0.tmp", ".map.bin.1-7.tmp", ".other.bin.1-0.tmp", "map.bin.tmp"] {
            fs::write(at(name), b"half").unwrap();
        }
        // Another process that is still writing.
        let alive = File::options().write(true).open(at(".map.bin.1-7.tmp")).unwrap();
        alive.try_lock().unwrap();
        write_bytes_atomically(&at("map.bin"), b"whole").unwrap();
        assert!(!at(".map.bin.4000000000-0.tmp").exists(), "its writer is dead");
        assert!(at(".map.bin.1-7.tmp").exists(), "its writer is alive");
        assert!(at(".other.bin.1-0.tmp").exists(), "nobody wrote other.bin");
        assert!(at("map.bin.tmp").exists(), "somebody else's");
        write_bytes_atomically(&at("other.bin"), b"whole").unwrap();
        assert!(!at(".other.bin.1-0.tmp").exists());
    }

    #[test]
    fn a_file_is_locked_until_it_has_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.bin");
        super::super::write_atomically(&path, |_| {
            let temp = fs::read_dir(folder.path())?.next().expect("the temporary file")?.path();
            assert!(File::open(temp)?.try_lock().is_err(), "somebody could take it for a leftover");
            Ok(())
        })
        .unwrap();
        assert!(File::open(path).unwrap().try_lock().is_ok());
    }
}
