//! Folders of exported text encoders: where they are looked for, and what their `encoder.json` says.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::TextError;
use crate::scene::features::Space;

/// A model takes no more tokens than this; it guards against a damaged `encoder.json`.
const MAX_CONTEXT: usize = 4096;
/// What to do about a folder that cannot be used.
pub(super) const EXPORT_AGAIN: &str = "export the encoder again with scripts/export_text_encoders.py";

/// `encoder.json`: what the model and the tokenizer beside it do not say.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EncoderFile {
    /// The space of the embeddings.
    pub(super) space: Space,
    /// Name of the model, for people.
    pub(super) model: String,
    /// Tokens that the model takes: longer texts are cut, shorter ones padded.
    pub(super) context: usize,
    /// The token to pad with.
    pub(super) pad: u32,
    /// Numbers per embedding.
    pub(super) dim: usize,
}

impl EncoderFile {
    /// Reads the file in a folder.
    pub(super) fn read(folder: &Path) -> Result<Self, TextError> {
        let path = folder.join("encoder.json");
        let bad = |what| TextError::Encoder { path: path.clone(), what, remedy: EXPORT_AGAIN };
        let text = std::fs::read(&path).map_err(|e| bad(format!("cannot be read: {e}")))?;
        let about: Self = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
        if !(2..=MAX_CONTEXT).contains(&about.context) || about.dim == 0 {
            return Err(bad(format!("a context of {} tokens, {} numbers", about.context, about.dim)));
        }
        Ok(about)
    }
}

/// The variable of the environment that names a space's encoder where nothing else does.
pub(super) fn variable(space: Space) -> &'static str {
    ["DIVFF_TEXT_CLIP", "DIVFF_TEXT_EGOVIDEO"][space as usize]
}

/// The encoder of a space: in `given` or its subfolder named after the space, else in the folder `fallback`.
///
/// `given` may hold an encoder of another space alone: that is for somebody else, and `fallback` decides.
pub(super) fn find(
    space: Space,
    given: Option<&Path>,
    fallback: Option<&Path>,
) -> Result<Option<(PathBuf, EncoderFile)>, TextError> {
    for folder in [given, fallback].into_iter().flatten() {
        if let Some(found) = look_in(folder, space)? {
            return Ok(Some(found));
        }
    }
    let empty = fallback.or(given.filter(|folder| !holds_any(folder)));
    empty.map_or(Ok(None), |path| Err(TextError::NoEncoder { path: path.to_owned(), space }))
}

fn look_in(folder: &Path, space: Space) -> Result<Option<(PathBuf, EncoderFile)>, TextError> {
    for folder in [folder.to_owned(), folder.join(space.name())] {
        if folder.join("encoder.json").is_file() {
            let about = EncoderFile::read(&folder)?;
            if about.space == space {
                return Ok(Some((folder, about)));
            }
        }
    }
    Ok(None)
}

fn holds_any(folder: &Path) -> bool {
    let mut folders = vec![folder.to_owned()];
    folders.extend(Space::ALL.map(|s| folder.join(s.name())));
    folders.iter().any(|f| f.join("encoder.json").is_file())
}
