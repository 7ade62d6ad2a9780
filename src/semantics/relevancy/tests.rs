//! Against the formula in f64, and the inputs that break formulas.

use half::slice::HalfFloatSliceExt;

use super::*;
use crate::rng::Rng;
use crate::semantics::compress::{AutoencoderConfig, CompressConfig, CompressorKind};

fn random(count: usize, seed: u64) -> Vec<f32> {
    let mut rng = Rng::new(seed, 0, 0);
    (0..count).map(|_| 2.0 * rng.uniform() - 1.0).collect()
}

fn slices(values: &[f32], dim: usize) -> Vec<&[f32]> {
    values.chunks_exact(dim).collect()
}

/// The formula as it stands in the paper, with τ, in f64.
fn formula(feature: &[f32], wanted: &[f32], canonical: &[&[f32]], temperature: f64) -> f64 {
    let dot =
        |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let cosine = |a: &[f32]| dot(a, feature) / (dot(a, a) * dot(feature, feature)).sqrt();
    let q = (temperature * cosine(wanted)).exp();
    canonical.iter().map(|c| q / (q + (temperature * cosine(c)).exp())).fold(1.0, f64::min)
}

/// `dim`, phrases, canonical phrases, points: blocks of 64 and what is left of them, one vector of columns and two.
const SHAPES: [(usize, usize, usize, usize); 7] = [
    (3, 1, 1, 1),
    (8, 1, 5, 64),
    (32, 1, 5, 1000),
    (33, 9, 7, 130),
    (32, 20, 5, 77),
    (144, 3, 4, 97),
    (512, 2, 4, 4200),
];

#[test]
fn scores_are_those_of_the_formula() {
    for (dim, wanted, canonical, points) in SHAPES {
        let (q, c, f) = (random(wanted * dim, 1), random(canonical * dim, 2), random(points * dim, 3));
        let (q, c) = (slices(&q, dim), slices(&c, dim));
        for temperature in [1.0, 10.0] {
            let queries = Queries::new(Space::Clip, &q, &c, temperature).unwrap();
            let found = queries.score(Points::F32(&f)).unwrap();
            for (n, feature) in f.chunks_exact(dim).enumerate() {
                for (scores, q) in found.scores.iter().zip(&q) {
                    let truth = formula(feature, q, &c, temperature.into());
                    // f32 sums of `dim` products, times τ/4 at the steepest.
                    assert!((f64::from(scores[n]) - truth).abs() < 4e-6, "{dim} {n}: {} {truth}", scores[n]);
                }
                assert_eq!(found.coverage[n], 1.0);
            }
        }
    }
}

#[test]
fn half_precision_points_give_the_same_as_their_values() {
    for (dim, wanted, canonical, points) in SHAPES {
        let (q, c, f) = (random(wanted * dim, 1), random(canonical * dim, 2), random(points * dim, 3));
        let queries = Queries::new(Space::Clip, &slices(&q, dim), &slices(&c, dim), 10.0).unwrap();
        let stored: Vec<f16> = f.iter().map(|v| f16::from_f32(*v)).collect();
        let found = queries.score(Points::F16(&stored)).unwrap();
        assert_eq!(found, queries.score(Points::F32(&stored.to_f32_vec())).unwrap());
    }
}

#[test]
fn compressed_points_score_as_if_decompressed() {
    let full = 24;
    let rows = random(300 * full, 4);
    let (q, c) = (random(3 * full, 5), random(4 * full, 6));
    let (q, c) = (slices(&q, full), slices(&c, full));
    let linear = CompressConfig { dim: Some(8), ..CompressConfig::default() };
    let autoencoder = CompressConfig {
        kind: CompressorKind::Autoencoder,
        autoencoder: AutoencoderConfig { hidden: vec![12], steps: 5, rate: 1e-3 },
        ..linear.clone()
    };
    for config in [linear, autoencoder] {
        let compressor = Compressor::fit_rows(&rows, full, &config, 0).unwrap();
        let mut codes = vec![0.0; 300 * compressor.dim()];
        compressor.encode(&rows, &mut codes);
        let queries = Queries::compressed(Space::Clip, &compressor, &q, &c, 10.0).unwrap();
        let found = queries.score(Points::F32(&codes)).unwrap();
        let mut back = vec![0.0; rows.len()];
        compressor.decode(&codes, &mut back);
        for (n, feature) in back.chunks_exact(full).enumerate() {
            for (scores, q) in found.scores.iter().zip(&q) {
                let truth = formula(feature, q, &c, 10.0);
                assert!((f64::from(scores[n]) - truth).abs() < 2e-5, "{:?} {n}", config.kind);
            }
        }
        // No evidence, whatever the mean descriptor would score.
        let nothing = queries.score(Points::F32(&vec![0.0; 2 * compressor.dim()])).unwrap();
        assert_eq!((&nothing.scores[0][..], &nothing.coverage[..]), (&[0.0; 2][..], &[0.0; 2][..]));
    }
}

#[test]
fn any_finite_feature_scores_between_zero_and_one() {
    let dim = 16;
    let (q, c) = (random(dim, 7), random(5 * dim, 8));
    let (q, c) = (slices(&q, dim), slices(&c, dim));
    let base = random(dim, 9);
    for temperature in [1e-3, 10.0, 1e6] {
        let queries = Queries::new(Space::Clip, &q, &c, temperature).unwrap();
        for scale in [f32::MAX, 1e38, 1e20, 1.0, 1e-20, 1e-38, 1e-44] {
            let f: Vec<f32> = base.iter().map(|v| v * scale).collect();
            let found = queries.score(Points::F32(&f)).unwrap();
            let score = f64::from(found.scores[0][0]);
            assert!((0.0..=1.0).contains(&score), "{score} at {scale:e}, {temperature:e}");
            if f.iter().any(|v| *v != 0.0) {
                assert_eq!(found.coverage[0], 1.0);
                let truth = formula(&f, q[0], &c, f64::from(temperature).min(10.0));
                assert!(
                    temperature > 10.0 || (score - truth).abs() < 1e-5,
                    "{score} at {scale:e}, not {truth}"
                );
            }
        }
    }
}

#[test]
fn zeros_score_zero_without_coverage_and_do_not_touch_their_neighbours() {
    let dim = 8;
    let (q, c) = (random(dim, 7), random(2 * dim, 8));
    let queries = Queries::new(Space::Egovideo, &[&q], &slices(&c, dim), 10.0).unwrap();
    let mut f = random(100 * dim, 10);
    let before = queries.score(Points::F32(&f)).unwrap();
    f[17 * dim..18 * dim].fill(0.0);
    f[99 * dim..].fill(-0.0);
    let after = queries.score(Points::F32(&f)).unwrap();
    for n in 0..100 {
        let empty = n == 17 || n == 99;
        assert_eq!(after.coverage[n], f32::from(u8::from(!empty)));
        assert_eq!(after.scores[0][n], if empty { 0.0 } else { before.scores[0][n] }, "{n}");
    }
}

#[test]
fn a_decompressed_feature_that_nearly_vanishes_is_still_exact() {
    let full = 6;
    let rows: Vec<f32> = random(50 * full, 11).iter().map(|v| v * 0.2 + 1.0).collect();
    let config = CompressConfig { dim: Some(6), ..CompressConfig::default() };
    let compressor = Compressor::fit_rows(&rows, full, &config, 0).unwrap();
    let mut code = [0.0; 6];
    let tiny = [1e-3, -2e-3, 0.5e-3, 0.0, 1e-3, 2e-3];
    compressor.encode(&tiny, &mut code);
    let (q, c) = (random(full, 12), random(3 * full, 13));
    let c = slices(&c, full);
    let queries = Queries::compressed(Space::Clip, &compressor, &[&q], &c, 10.0).unwrap();
    let found = queries.score(Points::F32(&code)).unwrap();
    // What is left is 1e-3 of numbers near 1, stored as f32: right to 1e-4 before τ.
    assert!((f64::from(found.scores[0][0]) - formula(&tiny, &q, &c, 10.0)).abs() < 1e-3);
}

#[test]
fn the_first_point_that_is_not_finite_is_named() {
    let dim = 8;
    let (q, c) = (random(dim, 7), random(2 * dim, 8));
    let queries = Queries::new(Space::Clip, &[&q], &slices(&c, dim), 10.0).unwrap();
    let mut f = random(9000 * dim, 10);
    f[8999 * dim] = f32::INFINITY;
    assert_eq!(queries.score(Points::F32(&f)).unwrap_err(), RelevancyError::NonFinite { point: 8999 });
    f[5000 * dim + 7] = f32::NAN;
    assert_eq!(queries.score(Points::F32(&f)).unwrap_err(), RelevancyError::NonFinite { point: 5000 });
}

#[test]
fn what_cannot_be_asked_is_an_error() {
    let e = [1.0, 0.0];
    let ask = |wanted: &[&[f32]], canonical: &[&[f32]], t| Queries::new(Space::Clip, wanted, canonical, t);
    assert!(matches!(ask(&[&e], &[], 1.0), Err(RelevancyError::NoCanonical { .. })));
    assert!(matches!(ask(&[&e], &[&[1.0]], 1.0), Err(RelevancyError::Width { found: 1, expected: 2, .. })));
    assert!(matches!(ask(&[&[0.0, 0.0]], &[&e], 1.0), Err(RelevancyError::Embedding { .. })));
    assert!(matches!(ask(&[&e], &[&[f32::NAN, 0.0]], 1.0), Err(RelevancyError::Embedding { .. })));
    for t in [0.0, -1.0, 1e7, f32::NAN, f32::INFINITY] {
        assert!(matches!(ask(&[&e], &[&e], t), Err(RelevancyError::Temperature { .. })));
    }
    let queries = ask(&[&e], &[&e], 1.0).unwrap();
    assert!(matches!(queries.score(Points::F32(&[1.0; 3])), Err(RelevancyError::Width { .. })));
    assert_eq!(queries.score(Points::F32(&[])).unwrap().coverage.len(), 0);
}

#[test]
fn each_phrase_has_the_scores_of_its_best_size() {
    let axis = |n: usize| -> Vec<f32> { (0..4).map(|k| f32::from(u8::from(k == n))).collect() };
    let (cup, table, stuff) = (axis(0), axis(1), axis(2));
    let queries = Queries::new(Space::Clip, &[&cup, &table], &[&stuff], 10.0).unwrap();
    // Two points: stuff at the middle size; small patches at the second show the cup, large ones the table everywhere.
    let middle = [&stuff[..], &stuff].concat();
    let at = |size: f32| if size < 1.0 { [&stuff[..], &cup].concat() } else { [&table[..], &table].concat() };
    let best = queries.best_scores(&middle, &[0.5, 2.0], at).unwrap();
    assert!(best[0][0] < 0.01 && best[0][1] > 0.99, "{best:?}");
    assert!(best[1][0] > 0.99 && best[1][1] > 0.99, "{best:?}");
    let alone = queries.best_scores(&middle, &[], |_| panic!("no other size")).unwrap();
    assert_eq!(alone, queries.score(Points::F32(&middle)).unwrap().scores);
}
