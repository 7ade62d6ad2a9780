//! Where text embeddings come from: a file given by the user, the scene's own `text/<space>.npy`, or an encoder that
//! runs inside the tool.

#[cfg(feature = "text-encoder")]
mod encoder;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

#[cfg(feature = "text-encoder")]
pub use encoder::{EncoderFile, TextEncoder};

use crate::scene::features::{FeatureError, FeatureStore, Space, TextTable, read_embeddings};

/// Why a phrase has no embedding.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TextError {
    /// The scene's embeddings or a given file cannot be used, or hold no such phrase.
    #[error(transparent)]
    Features(#[from] FeatureError),
    /// A given file holds another number of embeddings than there are phrases.
    #[error("{}: {rows} embeddings for {phrases} phrases; give one row for each --text, in order", path.display())]
    Count {
        /// The file.
        path: PathBuf,
        /// Rows of it.
        rows: usize,
        /// Phrases asked for.
        phrases: usize,
    },
    /// An embedding has not as many numbers as the features of its space.
    #[error(
        "{}: its embeddings have {found} numbers, the scene's {} features {expected}; use the text encoder that \
         belongs to the features' model",
        path.display(), space.name()
    )]
    Width {
        /// Where the embedding comes from.
        path: PathBuf,
        /// The space.
        space: Space,
        /// Numbers of the embedding.
        found: usize,
        /// Numbers of a feature.
        expected: usize,
    },
    /// A text encoder cannot be loaded or run.
    #[error("{}: {what}; {remedy}", path.display())]
    Encoder {
        /// File or folder.
        path: PathBuf,
        /// What is wrong.
        what: String,
        /// What to do.
        remedy: &'static str,
    },
}

/// Everything that can embed phrases in one space, asked in this order: what was given, the scene's, the encoder.
#[derive(Default)]
pub struct TextSources {
    given: Vec<TextTable>,
    scene: Option<TextTable>,
    #[cfg(feature = "text-encoder")]
    encoder: Option<TextEncoder>,
    dim: Option<usize>,
}

impl TextSources {
    /// The embeddings that come with a scene, if it has any for this space.
    ///
    /// # Errors
    /// [`TextError::Features`]: they are damaged, or do not fit the scene's features.
    pub fn of_scene(store: &FeatureStore, space: Space) -> Result<Self, TextError> {
        let dim = if space == Space::Clip { store.language_dim() } else { store.video_dim() };
        Ok(Self { scene: store.text(space)?, dim, ..Self::default() })
    }

    /// Adds embeddings of `phrases` from a file, one row for each, in order.
    ///
    /// # Errors
    /// [`TextError::Count`], [`TextError::Width`], or the file cannot be read.
    pub fn add_file(&mut self, space: Space, phrases: &[String], path: &Path) -> Result<(), TextError> {
        let embeddings = read_embeddings(path)?;
        if embeddings.rows() != phrases.len() {
            let (path, rows) = (path.to_owned(), embeddings.rows());
            return Err(TextError::Count { path, rows, phrases: phrases.len() });
        }
        self.check_width(space, path, embeddings.dim)?;
        self.given.push(TextTable { space, phrases: phrases.to_vec(), embeddings });
        Ok(())
    }

    /// Adds an encoder for phrases that have no embedding.
    ///
    /// # Errors
    /// [`TextError::Width`] if it does not fit the scene's features.
    #[cfg(feature = "text-encoder")]
    pub fn add_encoder(&mut self, encoder: TextEncoder) -> Result<(), TextError> {
        self.check_width(encoder.space(), encoder.folder(), encoder.dim())?;
        self.encoder = Some(encoder);
        Ok(())
    }

    /// The embedding of a phrase, of unit length.
    ///
    /// # Errors
    /// [`FeatureError::Phrase`] if nothing knows it; [`TextError::Encoder`] if the encoder fails.
    pub fn embed(&self, space: Space, phrase: &str) -> Result<Vec<f32>, TextError> {
        let tables = self.given.iter().chain(&self.scene).filter(|t| t.space == space);
        if let Some(found) = tables.into_iter().find_map(|t| t.find(phrase)) {
            return Ok(found.to_vec());
        }
        #[cfg(feature = "text-encoder")]
        if let Some(encoder) = self.encoder.as_ref().filter(|e| e.space() == space) {
            return encoder.embed(phrase);
        }
        let searched = match &self.scene {
            Some(t) => format!("{} holds {} others", t.embeddings.path.display(), t.phrases.len()),
            None => "the scene comes with no text embeddings".to_owned(),
        };
        let phrase = phrase.to_owned();
        Err(FeatureError::Phrase { phrase, space: space.name(), searched }.into())
    }

    /// Embeddings of the canonical phrases of a space.
    ///
    /// # Errors
    /// As [`Self::embed`], for the first that is missing.
    pub fn canonical(&self, space: Space) -> Result<Vec<Vec<f32>>, TextError> {
        space.canonical_phrases().iter().map(|phrase| self.embed(space, phrase)).collect()
    }

    fn check_width(&self, space: Space, path: &Path, found: usize) -> Result<(), TextError> {
        match self.dim {
            Some(expected) if expected != found => {
                Err(TextError::Width { path: path.to_owned(), space, found, expected })
            }
            _ => Ok(()),
        }
    }
}
