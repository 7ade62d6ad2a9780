//! Which known phrases are spelt most like one that is not.

/// At most `count` of `known`, the nearest in spelling first; letter case does not matter.
pub(super) fn nearest<'a>(phrase: &str, known: impl Iterator<Item = &'a str>, count: usize) -> Vec<String> {
    let wanted: Vec<char> = phrase.to_lowercase().chars().collect();
    let mut ranked: Vec<(usize, &str)> =
        known.map(|k| (edits(&wanted, &k.to_lowercase().chars().collect::<Vec<_>>()), k)).collect();
    // By the phrase itself among equals, so that the order does not depend on where phrases come from.
    ranked.sort();
    ranked.dedup();
    ranked.into_iter().take(count).map(|(_, k)| k.to_owned()).collect()
}

/// Letters to insert, remove or change to make `a` of `b` (Levenshtein's distance), a row of the table at a time.
fn edits(a: &[char], b: &[char]) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let changed = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edits_are_counted() {
        let count = |a: &str, b: &str| edits(&a.chars().collect::<Vec<_>>(), &b.chars().collect::<Vec<_>>());
        assert_eq!(
            [count("kitten", "sitting"), count("", "abc"), count("abc", ""), count("é", "e")],
            [3, 3, 3, 1]
        );
    }

    #[test]
    fn the_nearest_come_first_each_once() {
        let known = ["plate", "tea pot", "teapots", "TEA POT"];
        assert_eq!(
            nearest("Teapot", known.into_iter().chain(["tea pot"]), 3),
            ["TEA POT", "tea pot", "teapots"]
        );
    }
}
