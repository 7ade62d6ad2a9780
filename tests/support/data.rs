//! Scenes with ground truth that are not part of the project, where they are there.

use std::path::{Path, PathBuf};

/// The folder of a scene in `$DIVFF_DATA`, else in `../shared/data`; says so where there is none.
pub fn scene(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("DIVFF_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let folder = root.join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("SKIPPED: no {name} in {}; set DIVFF_DATA", root.display());
    None
}
