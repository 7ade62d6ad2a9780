//! Readers take paths; fuzzers have bytes.
//!
//! `cargo +nightly fuzz run ply`, with `TMPDIR` in memory. Nothing may panic, and what is read must be valid.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Reads the bytes as a file of this name.
pub fn with_file<T>(name: &str, bytes: &[u8], read: impl FnOnce(&Path) -> T) -> T {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        // Several fuzzers may run side by side; each overwrites its one file.
        let folder = std::env::temp_dir().join(format!("divff-fuzz-{}", std::process::id()));
        fs::create_dir_all(&folder).expect("the temporary folder is writable");
        folder
    });
    let path = folder.join(name);
    fs::write(&path, bytes).expect("the temporary folder is writable");
    read(&path)
}
