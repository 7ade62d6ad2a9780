//! Finds out which format a path holds and reads it.

use std::path::{Path, PathBuf};

use super::error::{Place, SceneError};
use super::{Scene, assemble, colmap, draft::Draft, epic_diff, epic_fields, json, transforms};

impl Scene {
    /// Opens a scene.
    ///
    /// `path` is a folder with `transforms.json` (nerfstudio), `meta.json` (EPIC-Diff), a COLMAP model
    /// (`sparse/0` and the like) or one EPIC-Fields JSON, looked for in this order; or one of these JSON
    /// files itself.
    ///
    /// Only lists and image headers are read; pixels are decoded when [`super::Frame::load_rgb`] asks for
    /// them.
    ///
    /// # Errors
    /// [`SceneError`], naming the file, the frame and the key, line or byte at fault, and what to do.
    pub fn open(path: impl AsRef<Path>) -> Result<Scene, SceneError> {
        assemble::assemble(read(path.as_ref())?)
    }
}

/// What the file of a scene lists, before it is checked.
pub(super) fn read(path: &Path) -> Result<Draft, SceneError> {
    if path.is_file() {
        return read_json(path);
    }
    // The system's own word where the path does not exist or may not be entered.
    std::fs::read_dir(path).map_err(|e| SceneError::io(path, e))?;
    for name in ["transforms.json", "meta.json"] {
        let file = path.join(name);
        if file.is_file() {
            return read_json(&file);
        }
    }
    if let Some((folder, binary)) = colmap::find_model(path) {
        return colmap::read(path, &folder, binary);
    }
    match &json_files(path)?[..] {
        [only] => read_json(only),
        found => Err(SceneError::NotAScene {
            path: path.to_owned(),
            what: format!(
                "no transforms.json (nerfstudio), meta.json (EPIC-Diff) or COLMAP model (sparse/0), and {}",
                if found.is_empty() { "no JSON file (EPIC-Fields)" } else { "several JSON files" }
            ),
            remedy: "give the folder that holds one of them, or the JSON file itself".into(),
        }),
    }
}

/// JSON files directly in a folder, sorted.
fn json_files(folder: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| SceneError::io(folder, e))? {
        let path = entry.map_err(|e| SceneError::io(folder, e))?.path();
        if path.extension().is_some_and(|e| e == "json") && path.is_file() {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Reads a JSON file by what is in it, whatever it is called.
fn read_json(file: &Path) -> Result<Draft, SceneError> {
    let map = json::read_object(file)?;
    if epic_diff::recognises(&map) {
        epic_diff::read(file, &map)
    } else if epic_fields::recognises(&map) {
        epic_fields::read(file, &map)
    } else if map.contains_key("frames") || file.ends_with("transforms.json") {
        transforms::read(file, &map)
    } else {
        Err(SceneError::invalid(
            file,
            Place::File,
            "it is none of the known formats (no `frames`; no `poses`, `images` and `intrinsics`; no \
             `camera` and `images`)",
            "give a transforms.json, an EPIC-Diff meta.json or an EPIC-Fields file",
        ))
    }
}
