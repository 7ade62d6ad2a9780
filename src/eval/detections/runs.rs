//! Masks as run lengths, as COCO's tools write them.

use serde::Deserialize;

/// Lengths of runs outside and inside by turns, starting outside.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub enum Counts {
    /// As they are.
    Plain(Vec<u64>),
    /// As characters: five bits each from the lowest on, the sixth says that more follow; from the fourth run on the
    /// difference to the run before the last (`rleToString` of COCO's `maskApi.c`).
    Packed(String),
}

/// A mask over numbered pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Runs(Vec<u64>);

impl Runs {
    /// Run lengths that cover `pixels` pixels exactly.
    ///
    /// # Errors
    /// What is wrong with them.
    pub fn new(counts: &Counts, pixels: u64) -> Result<Self, String> {
        let runs = match counts {
            Counts::Plain(runs) => runs.clone(),
            Counts::Packed(text) => unpacked(text)?,
        };
        let total = runs.iter().try_fold(0u64, |sum, run| sum.checked_add(*run));
        match total == Some(pixels) {
            true => Ok(Self(runs)),
            false => Err(format!("its runs cover {} pixels and not {pixels}", total.unwrap_or(u64::MAX))),
        }
    }

    /// Numbers of the pixels inside, rising.
    pub fn inside(&self) -> impl Iterator<Item = usize> + '_ {
        let mut end = 0;
        let ranges = self.0.iter().map(move |run| {
            let start = end;
            end += *run as usize;
            start..end
        });
        ranges.skip(1).step_by(2).flatten()
    }
}

fn unpacked(text: &str) -> Result<Vec<u64>, String> {
    let mut runs: Vec<i64> = Vec::new();
    let mut characters = text.bytes().enumerate();
    while let Some(mut next) = characters.next() {
        let (mut value, mut shift) = (0i64, 0u32);
        loop {
            let (place, byte) = next;
            // Longer numbers than 2^40 are no runs.
            let bits = byte.checked_sub(48).filter(|b| *b < 64 && shift < 40);
            let Some(bits) = bits else {
                return Err(format!("its counts cannot be read at character {place}"));
            };
            value |= i64::from(bits & 0x1f) << shift;
            shift += 5;
            if bits & 0x20 == 0 {
                if bits & 0x10 != 0 {
                    value |= -1 << shift;
                }
                break;
            }
            let Some(more) = characters.next() else { return Err("its counts are cut off".into()) };
            next = more;
        }
        if runs.len() > 2 {
            value = value.saturating_add(runs[runs.len() - 2]);
        }
        runs.push(value);
    }
    let sound = |run: &i64| u64::try_from(*run).map_err(|_| "its counts hold a negative run".to_owned());
    runs.iter().map(sound).collect()
}
