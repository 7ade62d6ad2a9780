//! From a phrase to its embedding: where embeddings come from.

use std::path::Path;

use super::compress::Compressor;
use super::error::SemanticsError;
use super::relevancy::{Queries, RelevancyError};
use super::text::{TextError, TextSource};
use crate::scene::Scene;
use crate::scene::features::{FeatureStore, Space};

/// What can embed phrases in either space: what is given, what comes with a scene, and encoders.
#[derive(Debug)]
pub struct TextSources {
    spaces: [TextSource; 2],
}

impl TextSources {
    /// The encoders that the environment names, and nothing else.
    ///
    /// # Errors
    /// An encoder that is not where it should be.
    pub fn encoders() -> Result<Self, SemanticsError> {
        Self::new(Space::ALL.map(|space| Ok(TextSource::new(space, None))))
    }

    /// What `text/` in a folder holds, and the encoders that the environment names.
    ///
    /// # Errors
    /// A file of embeddings that is damaged, or an encoder that is not where it should be.
    pub fn of_folder(root: &Path) -> Result<Self, SemanticsError> {
        Self::new(Space::ALL.map(|space| TextSource::of_folder(root, space)))
    }

    /// As [`Self::of_folder`], checked against the scene's features.
    ///
    /// # Errors
    /// Also embeddings that do not fit the features.
    pub fn of_scene(scene: &Scene) -> Result<Self, SemanticsError> {
        let store = FeatureStore::open(scene)?;
        Self::new(Space::ALL.map(|space| TextSource::of_scene(&store, space)))
    }

    fn new([clip, egovideo]: [Result<TextSource, TextError>; 2]) -> Result<Self, SemanticsError> {
        let mut spaces = [clip?, egovideo?];
        for source in &mut spaces {
            source.find_encoder(None)?;
        }
        Ok(Self { spaces })
    }

    /// Adds a file with one embedding for each of `phrases`, in order; they win over the scene's.
    ///
    /// # Errors
    /// A file that cannot be used, or with another number of rows.
    pub fn give(&mut self, space: Space, phrases: &[String], path: &Path) -> Result<(), SemanticsError> {
        Ok(self.spaces[space as usize].add_file(phrases, path)?)
    }

    /// Takes the text encoder in `folder` (or in its `clip` or `egovideo`) for phrases that nothing else knows.
    ///
    /// # Errors
    /// There is none, or its embeddings do not fit the scene's features.
    pub fn encode_with(&mut self, space: Space, folder: &Path) -> Result<(), SemanticsError> {
        Ok(self.spaces[space as usize].find_encoder(Some(folder))?)
    }

    /// The embedding of a phrase, from the first source that knows it.
    ///
    /// # Errors
    /// [`TextError::Phrase`] if none does.
    pub fn embedding(&self, space: Space, phrase: &str) -> Result<Vec<f32>, SemanticsError> {
        Ok(self.spaces[space as usize].embed(phrase)?)
    }

    /// Phrases ready to be held against features that `compressor` made short.
    ///
    /// # Errors
    /// [`TextError::Phrase`] where no source knows a phrase, [`SemanticsError::Relevancy`] for embeddings that do
    /// not fit, or if no canonical phrase is known.
    pub fn queries(
        &self,
        space: Space,
        compressor: &Compressor,
        phrases: &[String],
        temperature: f32,
    ) -> Result<Queries, SemanticsError> {
        self.with_embeddings(space, phrases, |wanted, canonical| {
            Queries::compressed(space, compressor, wanted, canonical, temperature)
        })
    }

    /// Phrases ready to be held against descriptors as they are.
    ///
    /// # Errors
    /// As [`Self::queries`].
    pub fn plain_queries(
        &self,
        space: Space,
        phrases: &[String],
        temperature: f32,
    ) -> Result<Queries, SemanticsError> {
        self.with_embeddings(space, phrases, |wanted, canonical| {
            Queries::new(space, wanted, canonical, temperature)
        })
    }

    fn with_embeddings(
        &self,
        space: Space,
        phrases: &[String],
        queries: impl FnOnce(&[&[f32]], &[&[f32]]) -> Result<Queries, RelevancyError>,
    ) -> Result<Queries, SemanticsError> {
        let wanted: Vec<Vec<f32>> =
            phrases.iter().map(|p| self.embedding(space, p)).collect::<Result<_, _>>()?;
        let missing = self.missing_canonical(space);
        let canonical = self.canonical(space);
        if !missing.is_empty() && !canonical.is_empty() {
            tracing::warn!(
                "no {} embedding of the canonical {missing:?}: scores are held against the other canonical phrases, and \
                 are higher than they should be; add the missing ones to the scene's text/{0}.txt and .npy",
                space.name()
            );
        }
        let wanted: Vec<&[f32]> = wanted.iter().map(Vec::as_slice).collect();
        let canonical: Vec<&[f32]> = canonical.iter().map(Vec::as_slice).collect();
        Ok(queries(&wanted, &canonical)?)
    }

    /// Canonical phrases that no source knows.
    fn missing_canonical(&self, space: Space) -> Vec<&'static str> {
        let phrases = space.canonical_phrases().iter().copied();
        phrases.filter(|p| self.embedding(space, p).is_err()).collect()
    }

    /// Embeddings of the canonical phrases that are known.
    pub fn canonical(&self, space: Space) -> Vec<Vec<f32>> {
        space.canonical_phrases().iter().filter_map(|p| self.embedding(space, p).ok()).collect()
    }

    /// The first `most` phrases that have an embedding without an encoder, canonical ones aside.
    pub fn phrases(&self, space: Space, most: usize) -> Vec<String> {
        let canonical = space.canonical_phrases();
        let asked = self.spaces[space as usize].phrases().filter(|p| !canonical.contains(p) && !p.is_empty());
        asked.take(most).map(str::to_owned).collect()
    }
}

/// A phrase as it stands in the names of columns and channels: lower case, every run of other characters than a–z and
/// 0–9 one underscore, none at the ends.
pub fn slug(phrase: &str) -> String {
    let lower = phrase.to_lowercase();
    let parts = lower.split(|c: char| !c.is_ascii_lowercase() && !c.is_ascii_digit());
    parts.filter(|p| !p.is_empty()).collect::<Vec<_>>().join("_")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_those_of_the_scorer() {
        for (phrase, expected) in [
            ("wash a kitchen utensil", "wash_a_kitchen_utensil"),
            ("  Chopping-Board (wood)! ", "chopping_board_wood"),
            ("caf\u{e9} 2", "caf_2"),
            ("\u{1f600}", ""),
        ] {
            assert_eq!(slug(phrase), expected);
        }
    }
}
