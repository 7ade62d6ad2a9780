//! Everything that can embed phrases in one space, asked in order.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use super::folder::{self, EncoderFile};
use super::{TextEncoder, TextError, spelling};
use crate::scene::features::{FeatureStore, Space, TextTable, read_embeddings};

/// Known phrases that an error lists.
const LISTED: usize = 5;

/// Everything that can embed phrases in one space.
///
/// A phrase is looked for in what was given first ([`Self::add_file`]), then in what comes with the scene, and made by
/// the encoder only then: nothing of the encoder but its `encoder.json` is read before it is needed.
#[derive(Debug)]
pub struct TextSource {
    space: Space,
    dim: Option<usize>,
    given: Vec<TextTable>,
    scene: Option<TextTable>,
    encoder: Option<LazyEncoder>,
}

#[derive(Debug)]
struct LazyEncoder {
    folder: PathBuf,
    loaded: OnceLock<TextEncoder>,
}

impl TextSource {
    /// A source that knows nothing yet, for features of `dim` numbers; `None` accepts embeddings of any width.
    pub fn new(space: Space, dim: Option<usize>) -> Self {
        Self { space, dim, given: Vec::new(), scene: None, encoder: None }
    }

    /// The embeddings that come with a scene, if it has any for this space; they must fit the scene's features.
    ///
    /// # Errors
    /// [`TextError::Features`]: they are damaged, or do not fit the scene's features.
    pub fn of_scene(store: &FeatureStore, space: Space) -> Result<Self, TextError> {
        let dim = if space == Space::Clip { store.language_dim() } else { store.video_dim() };
        Ok(Self { scene: store.text(space)?, ..Self::new(space, dim) })
    }

    /// The embeddings that lie in `text/` of a folder, which need not be a scene.
    ///
    /// # Errors
    /// [`TextError::Features`]: they are damaged.
    pub fn of_folder(root: &Path, space: Space) -> Result<Self, TextError> {
        Ok(Self { scene: TextTable::read(root, space)?, ..Self::new(space, None) })
    }

    /// Adds embeddings of `phrases` from a file, one row for each, in order.
    ///
    /// # Errors
    /// [`TextError::Count`], [`TextError::Width`], or the file cannot be read.
    pub fn add_file(&mut self, phrases: &[String], path: &Path) -> Result<(), TextError> {
        let embeddings = read_embeddings(path)?;
        if embeddings.rows() != phrases.len() {
            let (path, rows) = (path.to_owned(), embeddings.rows());
            return Err(TextError::Count { path, rows, phrases: phrases.len() });
        }
        self.check_width(path, embeddings.dim)?;
        self.given.push(TextTable { space: self.space, phrases: phrases.to_vec(), embeddings });
        Ok(())
    }

    /// Finds the encoder for phrases that have no embedding: in `given` or in its folder `clip` or `egovideo`, else
    /// where `$DIVFF_TEXT_CLIP` or `$DIVFF_TEXT_EGOVIDEO` says. Where nothing names one there is none.
    ///
    /// # Errors
    /// [`TextError::NoEncoder`] if a folder that is named has none, [`TextError::Width`] if its embeddings do not
    /// fit, [`TextError::Encoder`] if its `encoder.json` is damaged.
    pub fn find_encoder(&mut self, given: Option<&Path>) -> Result<(), TextError> {
        let fallback = std::env::var_os(folder::variable(self.space)).filter(|v| !v.is_empty());
        self.use_encoder(given, fallback.as_deref().map(Path::new))
    }

    /// [`Self::find_encoder`] with the variable's value said.
    pub(super) fn use_encoder(
        &mut self,
        given: Option<&Path>,
        fallback: Option<&Path>,
    ) -> Result<(), TextError> {
        self.encoder = match folder::find(self.space, given, fallback)? {
            None => None,
            Some((folder, EncoderFile { dim, .. })) => {
                self.check_width(&folder, dim)?;
                Some(LazyEncoder { folder, loaded: OnceLock::new() })
            }
        };
        Ok(())
    }

    /// The space of the embeddings.
    pub fn space(&self) -> Space {
        self.space
    }

    /// Phrases that have an embedding without an encoder, what was given first.
    pub fn phrases(&self) -> impl Iterator<Item = &str> {
        self.tables().flat_map(|t| &t.phrases).map(String::as_str)
    }

    /// The embedding of a phrase, of unit length.
    ///
    /// # Errors
    /// [`TextError::Phrase`] if nothing knows it; [`TextError::Encoder`] if the encoder cannot be loaded or fails.
    pub fn embed(&self, phrase: &str) -> Result<Vec<f32>, TextError> {
        if let Some(found) = self.tables().find_map(|t| t.find(phrase)) {
            return Ok(found.to_vec());
        }
        match &self.encoder {
            Some(encoder) => encoder.get()?.embed(phrase),
            None => Err(self.unknown(phrase)),
        }
    }

    /// Embeddings of the canonical phrases of the space.
    ///
    /// # Errors
    /// As [`Self::embed`], for the first that is missing.
    pub fn canonical(&self) -> Result<Vec<Vec<f32>>, TextError> {
        self.space.canonical_phrases().iter().map(|phrase| self.embed(phrase)).collect()
    }

    fn tables(&self) -> impl Iterator<Item = &TextTable> {
        self.given.iter().chain(&self.scene)
    }

    fn unknown(&self, phrase: &str) -> TextError {
        TextError::Phrase {
            phrase: phrase.to_owned(),
            space: self.space,
            known: self.phrases().count(),
            nearest: spelling::nearest(phrase, self.phrases(), LISTED),
            variable: folder::variable(self.space),
        }
    }

    fn check_width(&self, path: &Path, found: usize) -> Result<(), TextError> {
        match self.dim {
            Some(expected) if expected != found => {
                Err(TextError::Width { path: path.to_owned(), space: self.space, found, expected })
            }
            _ => Ok(()),
        }
    }
}

impl LazyEncoder {
    fn get(&self) -> Result<&TextEncoder, TextError> {
        if let Some(encoder) = self.loaded.get() {
            return Ok(encoder);
        }
        let encoder = TextEncoder::open(&self.folder)?;
        Ok(self.loaded.get_or_init(|| encoder))
    }
}
