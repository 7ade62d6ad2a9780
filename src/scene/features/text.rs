//! Text embeddings that come with a scene: `text/<space>.npy` and `text/<space>.txt`.

use std::path::{Path, PathBuf};

use super::error::FeatureError;
use super::table::Descriptors;

/// The two spaces that features and text share.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Space {
    /// Image-language: what things are.
    Clip,
    /// Video-language: what can be done with them.
    Egovideo,
}

impl Space {
    /// Both, in the order of every `[_; 2]`.
    pub const ALL: [Self; 2] = [Self::Clip, Self::Egovideo];

    /// Lower-case name as used in files and on the command line.
    pub fn name(self) -> &'static str {
        ["clip", "egovideo"][self as usize]
    }

    /// The phrases that a query is held against (the paper's, after LERF).
    pub fn canonical_phrases(self) -> &'static [&'static str] {
        match self {
            Self::Clip => &["object", "thing", "stuff", "texture", "hands"],
            Self::Egovideo => &["general task", "indistinct movement", "unclear action", "background"],
        }
    }
}

/// Phrases and their embeddings, normalised to unit length.
#[derive(Clone, Debug, PartialEq)]
pub struct TextTable {
    /// Which space the embeddings are in.
    pub space: Space,
    /// One phrase a row.
    pub phrases: Vec<String>,
    /// `[phrases, dim]`, every row usable and of unit length.
    pub embeddings: Descriptors,
}

impl TextTable {
    /// Paths of the embeddings and of the phrases of a space.
    pub fn paths(root: &Path, space: Space) -> [PathBuf; 2] {
        ["npy", "txt"].map(|extension| root.join("text").join(format!("{}.{extension}", space.name())))
    }

    /// Reads the embeddings that come with a scene; `None` if it has none for this space.
    ///
    /// # Errors
    /// [`FeatureError`]: one of the two files is missing or damaged, they do not fit each other, or an embedding is
    /// zero or not finite.
    pub fn read(root: &Path, space: Space) -> Result<Option<Self>, FeatureError> {
        let [npy, txt] = Self::paths(root, space);
        match (npy.is_file(), txt.is_file()) {
            (false, false) => return Ok(None),
            (true, false) => return Err(FeatureError::Companion { path: npy, missing: txt }),
            (false, true) => return Err(FeatureError::Companion { path: txt, missing: npy }),
            (true, true) => {}
        }
        let text =
            std::fs::read_to_string(&txt).map_err(|source| FeatureError::Io { path: txt.clone(), source })?;
        let phrases: Vec<String> =
            text.strip_prefix('\u{feff}').unwrap_or(&text).lines().map(|l| l.trim().to_owned()).collect();
        let embeddings = read_embeddings(&npy)?;
        if phrases.len() != embeddings.rows() {
            return Err(FeatureError::PhraseCount {
                path: txt,
                phrases: phrases.len(),
                rows: embeddings.rows(),
                embeddings: npy,
            });
        }
        Ok(Some(Self { space, phrases, embeddings }))
    }

    /// The embedding of a phrase; letter case and white space do not matter.
    pub fn find(&self, phrase: &str) -> Option<&[f32]> {
        let wanted = folded(phrase);
        let row = self.phrases.iter().position(|p| folded(p) == wanted)?;
        Some(self.embeddings.row(row))
    }
}

/// Reads embeddings `[Q, D]` or a single `[D]`, and normalises each to unit length.
///
/// # Errors
/// Not readable, of another shape, or with a row that is zero or not finite.
pub fn read_embeddings(path: &Path) -> Result<Descriptors, FeatureError> {
    let header = divff_exporters::read_npy_header(path)?;
    let dimensions: &[&str] = if header.shape.len() == 1 { &["D"] } else { &["Q", "D"] };
    let (_, mut embeddings) = Descriptors::read(path, dimensions)?;
    if let Some(&(row, why)) = embeddings.left_out.first() {
        let remedy = "every phrase needs a usable embedding: encode it again";
        return Err(FeatureError::Descriptor { path: path.to_owned(), row, why, remedy });
    }
    embeddings.values.chunks_exact_mut(embeddings.dim).for_each(normalise);
    Ok(embeddings)
}

/// Scales a finite vector to unit length; zeros stay zeros.
///
/// In f64, so that neither overflow nor underflow of the squares can spoil it.
pub(crate) fn normalise(row: &mut [f32]) {
    let norm = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    if norm > 0.0 {
        row.iter_mut().for_each(|v| *v = (f64::from(*v) / norm) as f32);
    }
}

fn folded(phrase: &str) -> String {
    phrase.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase()
}
