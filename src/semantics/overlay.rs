//! Scores as colours, over what they belong to.

use crate::report::turbo;

/// Score from which on the overlay is seen; below it a point is closer to a canonical phrase than to the one asked for.
pub const FROM: f32 = 0.5;

/// Share of the scale's colour where the score is highest.
const STRENGTH: f32 = 0.85;

/// Colours with the scores from 0.5 to their maximum mapped to the colour scale, as the figures of the paper are; what
/// is not found turns grey.
pub fn overlay(colours: &[[u8; 3]], scores: &[f32]) -> Vec<[u8; 3]> {
    let max = scores.iter().copied().fold(FROM, f32::max);
    let scale = 1.0 / (max - FROM).max(1e-6);
    let one = |(colour, score): (&[u8; 3], &f32)| {
        let grey = colour.iter().map(|c| f32::from(*c)).sum::<f32>() / 3.0;
        let x = ((score - FROM) * scale).clamp(0.0, 1.0);
        let share = if *score > FROM { STRENGTH } else { 0.0 };
        let mark = turbo(0.35 + 0.6 * x);
        std::array::from_fn(|c| ((1.0 - share) * grey + share * f32::from(mark[c]) + 0.5) as u8)
    };
    colours.iter().zip(scores).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_found_is_coloured_and_the_best_is_red() {
        let colours = [[90, 60, 30]; 3];
        let [not, little, best] = overlay(&colours, &[0.5, 0.51, 0.8])[..] else { panic!() };
        assert_eq!(not, [60; 3]);
        assert!(best[0] > best[2] && little != not && little[0] < best[0], "{little:?} {best:?}");
        assert_eq!(overlay(&colours[..1], &[0.2]), [[60; 3]], "nothing found, nothing coloured");
    }
}
