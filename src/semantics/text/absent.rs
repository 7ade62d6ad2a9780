//! In place of the encoder, in a build without the feature `text`: there is none, and opening one says so.

use std::convert::Infallible;
use std::path::Path;

use super::TextError;
use crate::scene::features::Space;

/// A text tower and its tokenizer; this build has none.
#[derive(Debug)]
pub struct TextEncoder(Infallible);

impl TextEncoder {
    /// Fails.
    ///
    /// # Errors
    /// [`TextError::Encoder`], always.
    pub fn open(folder: &Path) -> Result<Self, TextError> {
        Err(TextError::Encoder {
            path: folder.to_owned(),
            what: "this program was built without text encoders".to_owned(),
            remedy: "build it with the feature `text`",
        })
    }

    /// The space of its embeddings.
    pub fn space(&self) -> Space {
        match self.0 {}
    }

    /// Numbers per embedding.
    pub fn dim(&self) -> usize {
        match self.0 {}
    }

    /// The embedding of a text.
    ///
    /// # Errors
    /// None: there is no encoder to call this on.
    pub fn embed(&self, _text: &str) -> Result<Vec<f32>, TextError> {
        match self.0 {}
    }
}
