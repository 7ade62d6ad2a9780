//! Principal components of data that have none.

use divff::semantics::compress::{CompressConfig, CompressError, Compressor};

use crate::rng::Rng;
use crate::{NOT_FINITE, SIZES};

const FULL: usize = 24;

fn random(count: usize, seed: u64) -> Vec<f32> {
    let mut rng = Rng::new(seed, 0, 0);
    (0..count).map(|_| 2.0 * rng.uniform() - 1.0).collect()
}

/// Fits 8 numbers to some rows and checks that all of them come back finite, and how well.
fn fit(rows: &[f32], most: f64, what: &str) {
    let config = CompressConfig { dim: Some(8), ..CompressConfig::default() };
    let made = Compressor::fit_rows(rows, FULL, &config, 1).unwrap_or_else(|e| panic!("{what}: {e}"));
    let count = rows.len() / FULL;
    let (mut codes, mut back) = (vec![f32::NAN; count * made.dim()], vec![f32::NAN; rows.len()]);
    let norm = |row: &[f32]| row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    let unit = |row: &[f32]| row.iter().map(|v| (f64::from(*v) / norm(row).max(1e-300)) as f32).collect();
    let units: Vec<Vec<f32>> = rows.chunks_exact(FULL).map(unit).collect();
    made.encode(&units.concat(), &mut codes);
    made.decode(&codes, &mut back);
    assert!(codes.iter().chain(&back).all(|v| v.is_finite()), "{what}");
    assert!(made.error.is_finite() && made.error <= most, "{what}: error {}", made.error);
}

#[test]
fn one_row_equal_rows_opposite_rows_and_rows_of_one_direction() {
    let row = random(FULL, 1);
    let opposite: Vec<f32> = row.iter().map(|v| -v).collect();
    fit(&row, 1e-5, "one row");
    fit(&row.repeat(500), 1e-5, "equal rows");
    fit(&[&row[..], &opposite].concat(), 1e-5, "opposite rows");
    let line: Vec<f32> = (1..200).flat_map(|n| row.iter().map(move |v| v * n as f32)).collect();
    fit(&line, 1e-5, "one direction");
    let mut with_zeros = vec![0.0; 10 * FULL];
    with_zeros.extend(&row);
    fit(&with_zeros, 1e-5, "zeros beside one row");
    // As many directions as numbers: there is nothing to leave out without loss.
    let axes: Vec<f32> = (0..FULL * FULL).map(|n| f32::from(u8::from(n % (FULL + 1) == 0))).collect();
    fit(&axes, 1.0, "all axes");
}

#[test]
fn rows_of_any_length_count_alike() {
    for size in SIZES.into_iter().filter(|s| *s > 0.0) {
        let rows: Vec<f32> = random(3 * FULL, 2).iter().map(|v| v * size).collect();
        fit(&rows, 1e-3, &format!("rows of size {size:e}"));
    }
}

#[test]
fn what_cannot_be_compressed_is_named() {
    let config = CompressConfig::default();
    for bad in NOT_FINITE {
        let mut rows = random(40 * FULL, 3);
        rows[17 * FULL + 2] = bad;
        let error = Compressor::fit_rows(&rows, FULL, &config, 1).unwrap_err();
        assert_eq!(error, CompressError::NonFinite { row: 17 });
    }
    for rows in [vec![], vec![0.0; 9 * FULL]] {
        let error = Compressor::fit_rows(&rows, FULL, &config, 1).unwrap_err();
        assert_eq!(error, CompressError::NoDescriptors);
    }
}
