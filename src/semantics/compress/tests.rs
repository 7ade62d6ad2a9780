//! Known answers, hard cases and stored compressors.

use super::*;
use crate::rng::Rng;

const FULL: usize = 24;

fn random(rng: &mut Rng) -> f32 {
    2.0 * rng.uniform() - 1.0
}

/// `count` unit vectors around a common mean, in `rank` directions.
fn clustered(count: usize, rank: usize, seed: u64) -> Vec<f32> {
    let mut rng = Rng::new(seed, 0, 0);
    let mean: Vec<f32> = (0..FULL).map(|_| random(&mut rng)).collect();
    let axes: Vec<f32> = (0..rank * FULL).map(|_| random(&mut rng)).collect();
    let mut rows = Vec::new();
    for _ in 0..count {
        let mut row = mean.clone();
        for axis in axes.chunks_exact(FULL) {
            let by = random(&mut rng);
            row.iter_mut().zip(axis).for_each(|(r, a)| *r += by * a);
        }
        normalise(&mut row);
        rows.extend(row);
    }
    rows
}

fn fit(rows: &[f32], config: &CompressConfig) -> Compressor {
    Compressor::fit_rows(rows, FULL, config, 7).unwrap()
}

fn with_dim(dim: usize) -> CompressConfig {
    CompressConfig { dim: Some(dim), ..CompressConfig::default() }
}

fn linear(c: &Compressor) -> &LinearMap {
    let Map::Linear(map) = &c.map else { panic!("not linear") };
    map
}

#[test]
fn descriptors_of_few_directions_come_back_exactly() {
    // Points around a mean in 5 directions span 6 dimensions after normalising; 5 + the curvature are not enough.
    let rows = clustered(300, 5, 1);
    let made = fit(&rows, &with_dim(6));
    assert!(made.error < 1e-6, "{}", made.error);
    assert!(made.error_on(&rows) < 1e-6, "{}", made.error_on(&rows));
}

#[test]
fn the_reported_error_is_the_error_made() {
    let rows = clustered(300, 12, 2);
    for dim in [1, 4, 8, 11] {
        let made = fit(&rows, &with_dim(dim));
        assert!((made.error - made.error_on(&rows)).abs() < 1e-6, "{dim}: {}", made.error);
    }
}

#[test]
fn the_dimension_is_the_smallest_that_is_good_enough() {
    let rows = clustered(300, 12, 3);
    let made = fit(&rows, &CompressConfig { feature_error: 0.02, ..CompressConfig::default() });
    assert!(
        made.error <= 0.02 && made.dim().is_multiple_of(4) && made.dim() < FULL,
        "{} at {}",
        made.error,
        made.dim()
    );
    assert!(fit(&rows, &with_dim(made.dim() - 4)).error > 0.02);
    let exact = fit(&rows, &CompressConfig { feature_error: 1e-12, ..CompressConfig::default() });
    assert_eq!(exact.dim(), 16, "12 directions, the mean and rounding to four");
}

#[test]
fn bases_are_orthonormal_for_few_rows_duplicates_and_one_row() {
    let one = clustered(1, 3, 4);
    let twice = [one.clone(), one.clone()].concat();
    for (name, rows) in [("few", clustered(5, 3, 4)), ("one", one), ("twice", twice)] {
        let made = fit(&rows, &with_dim(8));
        let basis = linear(&made).basis();
        for i in 0..8 {
            for j in 0..8 {
                let (a, b) = (&basis[i * FULL..(i + 1) * FULL], &basis[j * FULL..(j + 1) * FULL]);
                let product: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                assert!((product - f32::from(u8::from(i == j))).abs() < 1e-5, "{name} {i} {j}: {product}");
            }
        }
        assert!(made.error < 1e-6 && made.error_on(&rows) < 1e-6, "{name}: {}", made.error);
    }
}

#[test]
fn zeros_are_left_out_and_nothing_but_zeros_is_an_error() {
    let rows = clustered(50, 3, 5);
    let mut with_zeros = rows.clone();
    with_zeros.splice(FULL..FULL, vec![0.0; 3 * FULL]);
    assert_eq!(fit(&rows, &with_dim(4)), fit(&with_zeros, &with_dim(4)));
    let empty = Compressor::fit_rows(&[0.0; 4 * FULL], FULL, &with_dim(4), 0);
    assert_eq!(empty.unwrap_err(), CompressError::NoDescriptors);
    let empty = Compressor::fit_rows(&[], FULL, &with_dim(4), 0);
    assert_eq!(empty.unwrap_err(), CompressError::NoDescriptors);
}

#[test]
fn opposite_descriptors_have_no_mean_and_still_work() {
    let mut rows = clustered(40, 6, 6);
    let opposite: Vec<f32> = rows.iter().map(|v| -v).collect();
    rows.extend(opposite);
    let made = fit(&rows, &with_dim(8));
    assert!(linear(&made).mean().iter().all(|m| m.abs() < 1e-6));
    assert!(made.error < 1e-5, "{}", made.error);
}

#[test]
fn not_finite_descriptors_are_named() {
    let mut rows = clustered(4, 2, 7);
    rows[2 * FULL + 3] = f32::NAN;
    let error = Compressor::fit_rows(&rows, FULL, &with_dim(4), 0).unwrap_err();
    assert_eq!(error, CompressError::NonFinite { row: 2 });
}

#[test]
fn a_projected_phrase_scores_as_if_decompressed() {
    let rows = clustered(200, 12, 8);
    let made = fit(&rows, &with_dim(8));
    let map = linear(&made);
    let mut rng = Rng::new(9, 0, 0);
    for row in rows.chunks_exact(FULL).take(50) {
        let phrase: Vec<f32> = (0..FULL).map(|_| random(&mut rng)).collect();
        let (mut code, mut back) = ([0.0; 8], [0.0; FULL]);
        map.encode(row, &mut code);
        map.decode(&code, &mut back);
        let projected = map.project(&phrase);
        let product = f64::from(projected.offset)
            + projected.direction.iter().zip(code).map(|(d, z)| f64::from(*d) * f64::from(z)).sum::<f64>();
        let score = product / map.norm2(&code).sqrt();
        let truth = cosine(&phrase, &back) * phrase.iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt();
        // The map is stored in f32: products of 24 numbers below 1, each right to 6e-8.
        assert!((score - truth).abs() < 2e-6, "{score} is not {truth}");
    }
}

#[test]
fn blending_codes_is_compressing_the_blend() {
    let rows = clustered(20, 12, 10);
    let made = fit(&rows, &with_dim(8));
    let (a, b) = (&rows[..FULL], &rows[FULL..2 * FULL]);
    let mixed: Vec<f32> = a.iter().zip(b).map(|(a, b)| 0.3 * a + 0.7 * b).collect();
    let mut codes = [0.0; 24];
    made.encode(&[a, b, &mixed].concat(), &mut codes);
    for i in 0..8 {
        assert!((0.3 * codes[i] + 0.7 * codes[8 + i] - codes[16 + i]).abs() < 1e-6);
    }
}

#[test]
fn an_autoencoder_learns_what_there_is() {
    let rows = clustered(200, 3, 11);
    let config = CompressConfig {
        kind: CompressorKind::Autoencoder,
        dim: Some(4),
        autoencoder: AutoencoderConfig { hidden: vec![32, 16], steps: 300, rate: 5e-3 },
        ..CompressConfig::default()
    };
    let made = fit(&rows, &config);
    assert!(made.error < 0.02, "{}", made.error);
    assert!((made.error - made.error_on(&rows)).abs() < 1e-5);
    assert_eq!(made, fit(&rows, &config), "the same rows and seed give the same networks");
}

#[test]
fn stored_compressors_come_back() {
    let rows = clustered(60, 6, 12);
    let autoencoder = CompressConfig {
        kind: CompressorKind::Autoencoder,
        dim: Some(6),
        autoencoder: AutoencoderConfig { hidden: vec![10], steps: 3, rate: 1e-3 },
        ..CompressConfig::default()
    };
    for config in [with_dim(5), autoencoder] {
        let made = fit(&rows, &config);
        let mut arrays = std::collections::BTreeMap::new();
        made.visit(|name, shape, values| {
            assert_eq!(shape.iter().product::<usize>(), values.len());
            arrays.insert(name, values.to_vec());
        });
        let json = serde_json::to_string(&made.header()).unwrap();
        let header: CompressorHeader = serde_json::from_str(&json).unwrap();
        let lost = |name: &str| CompressError::Stored { name: name.into(), what: "is missing".into() };
        let back =
            Compressor::from_stored(&header, |name| arrays.get(name).cloned().ok_or_else(|| lost(name)));
        assert_eq!(back.unwrap(), made);
        for (name, values) in &arrays {
            for damage in [vec![], values[1..].to_vec(), vec![f32::NAN; values.len()]] {
                let fetch = |n: &'static str| Ok(if n == *name { damage.clone() } else { arrays[n].clone() });
                let back = Compressor::from_stored::<CompressError>(&header, fetch);
                assert!(back.is_err(), "{name} of {} numbers was taken", damage.len());
            }
        }
    }
}

#[test]
fn settings_out_of_range_are_refused() {
    let bad = |edit: fn(&mut CompressConfig)| {
        let mut config = CompressConfig::default();
        edit(&mut config);
        assert!(matches!(config.validate(), Err(CompressError::Setting { .. })), "{config:?}");
    };
    bad(|c| c.dim = Some(0));
    bad(|c| c.feature_error = 0.0);
    bad(|c| c.feature_error = f64::NAN);
    bad(|c| c.autoencoder.hidden = vec![0]);
    bad(|c| c.autoencoder.rate = f32::NAN);
}
