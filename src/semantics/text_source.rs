//! From a phrase to its embedding: where embeddings come from.

use std::path::Path;

use super::compress::Compressor;
use super::error::SemanticsError;
use super::relevancy::Queries;
use crate::scene::Scene;
use crate::scene::features::{FeatureStore, Space, TextTable, read_embeddings};

/// Embeddings of phrases: those that come with a scene, and those given for single phrases.
#[derive(Clone, Debug, Default)]
pub struct TextSource {
    tables: [Option<TextTable>; 2],
    given: Vec<(Space, String, Vec<f32>)>,
}

impl TextSource {
    /// What `text/` in a folder holds.
    ///
    /// # Errors
    /// A file of embeddings that is damaged.
    pub fn of_folder(root: &Path) -> Result<Self, SemanticsError> {
        let [clip, egovideo] = Space::ALL.map(|space| TextTable::read(root, space));
        Ok(Self { tables: [clip?, egovideo?], given: Vec::new() })
    }

    /// As [`Self::of_folder`], checked against the scene's features.
    ///
    /// # Errors
    /// A file of embeddings that is damaged or does not fit the features.
    pub fn of_scene(scene: &Scene) -> Result<Self, SemanticsError> {
        let store = FeatureStore::open(scene)?;
        let [clip, egovideo] = Space::ALL.map(|space| store.text(space));
        Ok(Self { tables: [clip?, egovideo?], given: Vec::new() })
    }

    /// Adds a file with one embedding for each of `phrases`, in order; they win over the scene's.
    ///
    /// # Errors
    /// A file that cannot be used, or with another number of rows.
    pub fn give(&mut self, space: Space, phrases: &[String], path: &Path) -> Result<(), SemanticsError> {
        let rows = read_embeddings(path)?;
        if rows.rows() != phrases.len() {
            let (path, phrases) = (path.to_owned(), phrases.len());
            return Err(SemanticsError::EmbeddingCount { path, rows: rows.rows(), phrases });
        }
        let given = phrases.iter().enumerate().map(|(n, p)| (space, p.clone(), rows.row(n).to_vec()));
        self.given.extend(given);
        Ok(())
    }

    /// The embedding of a phrase, from the first source that knows it.
    ///
    /// # Errors
    /// [`SemanticsError::Phrase`] if none does.
    pub fn embedding(&self, space: Space, phrase: &str) -> Result<Vec<f32>, SemanticsError> {
        self.known(space, phrase).ok_or_else(|| SemanticsError::Phrase { phrase: phrase.to_owned(), space })
    }

    /// Phrases ready to be held against features that `compressor` made short.
    ///
    /// # Errors
    /// [`SemanticsError::Phrase`] where no source knows a phrase, [`SemanticsError::Relevancy`] for embeddings that do
    /// not fit, or if no canonical phrase is known.
    pub fn queries(
        &self,
        space: Space,
        compressor: &Compressor,
        phrases: &[String],
        temperature: f32,
    ) -> Result<Queries, SemanticsError> {
        let wanted: Vec<Vec<f32>> =
            phrases.iter().map(|p| self.embedding(space, p)).collect::<Result<_, _>>()?;
        let canonical = self.canonical(space);
        let wanted: Vec<&[f32]> = wanted.iter().map(Vec::as_slice).collect();
        let canonical: Vec<&[f32]> = canonical.iter().map(Vec::as_slice).collect();
        Ok(Queries::compressed(space, compressor, &wanted, &canonical, temperature)?)
    }

    /// Embeddings of the canonical phrases that are known.
    pub fn canonical(&self, space: Space) -> Vec<Vec<f32>> {
        space.canonical_phrases().iter().filter_map(|p| self.known(space, p)).collect()
    }

    /// The first `most` phrases that come with the scene, canonical ones aside.
    pub fn phrases(&self, space: Space, most: usize) -> Vec<String> {
        let all = self.tables[space as usize].iter().flat_map(|t| &t.phrases);
        let canonical = space.canonical_phrases();
        let asked = all.filter(|p| !canonical.contains(&p.as_str()) && !p.is_empty());
        asked.take(most).cloned().collect()
    }

    fn known(&self, space: Space, phrase: &str) -> Option<Vec<f32>> {
        let given = self.given.iter().find(|(s, p, _)| *s == space && p == phrase).map(|g| g.2.clone());
        given.or_else(|| Some(self.tables[space as usize].as_ref()?.find(phrase)?.to_vec()))
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
