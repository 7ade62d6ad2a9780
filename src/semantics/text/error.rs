//! Why a phrase has no embedding.

use std::path::PathBuf;

use crate::scene::features::{FeatureError, Space};

/// Why a phrase has no embedding.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TextError {
    /// The scene's embeddings or a given file cannot be used.
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
        "{}: its embeddings have {found} numbers, the {} features {expected}; use the text encoder that belongs to \
         the features' model",
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
    /// Nothing knows a phrase, and there is no encoder.
    #[error(
        "no {} embedding of \"{phrase}\": {}; ask for a known phrase, or give its embedding (--text-embedding \
         FILE.npy) or a text encoder (--text-encoder DIR or ${variable}; scripts/export_text_encoders.py makes one)",
        space.name(), known_phrases(known, nearest)
    )]
    Phrase {
        /// The phrase.
        phrase: String,
        /// The space.
        space: Space,
        /// How many phrases have an embedding.
        known: usize,
        /// Those that are spelt most like it, the nearest first.
        nearest: Vec<String>,
        /// The variable of the environment that can name an encoder.
        variable: &'static str,
    },
    /// A folder that was named holds no encoder of the space.
    #[error(
        "{}: no encoder.json of the space {name} in it or in {name}/; export the encoder with \
         scripts/export_text_encoders.py",
        path.display(), name = space.name()
    )]
    NoEncoder {
        /// The folder.
        path: PathBuf,
        /// The space.
        space: Space,
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

fn known_phrases(known: &usize, nearest: &[String]) -> String {
    let listed: Vec<String> = nearest.iter().map(|p| format!("\"{p}\"")).collect();
    match *known {
        0 => "no phrase has one".to_owned(),
        n if n == nearest.len() => format!("known are {}", listed.join(", ")),
        n => format!("of {n} known phrases the nearest are {}", listed.join(", ")),
    }
}
