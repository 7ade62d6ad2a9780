//! Features of any length, of none, and pointing the other way, held against phrases.

use divff::scene::features::Space;
use divff::semantics::relevancy::{Points, Queries, RelevancyError};

use crate::rng::Rng;
use crate::{NOT_FINITE, SIZES};

const DIM: usize = 32;

fn random(count: usize, seed: u64) -> Vec<f32> {
    let mut rng = Rng::new(seed, 0, 0);
    (0..count).map(|_| 2.0 * rng.uniform() - 1.0).collect()
}

fn queries() -> Queries {
    let (wanted, canonical) = (random(DIM, 1), random(4 * DIM, 2));
    let canonical: Vec<&[f32]> = canonical.chunks_exact(DIM).collect();
    Queries::new(Space::Clip, &[&wanted], &canonical, 10.0).unwrap()
}

#[test]
fn scores_do_not_depend_on_the_length_of_a_feature() {
    let points = random(300 * DIM, 3);
    let truth = queries().score(Points::F32(&points)).unwrap();
    // Below 1e-38 the numbers themselves lose digits.
    for size in SIZES.into_iter().filter(|s| *s >= f32::MIN_POSITIVE) {
        let scaled: Vec<f32> = points.iter().map(|v| v * size).collect();
        let found = queries().score(Points::F32(&scaled)).unwrap();
        for (n, (a, b)) in found.scores[0].iter().zip(&truth.scores[0]).enumerate() {
            assert!((a - b).abs() < 1e-4, "×{size:e}, point {n}: {a} is not {b}");
        }
        assert!(found.coverage.iter().all(|c| *c == 1.0), "×{size:e}");
    }
}

#[test]
fn no_feature_has_no_score_and_a_trace_of_one_has_a_finite_one() {
    for size in [0.0, 1e-45, 1e-42] {
        let points = vec![size; 70 * DIM];
        let found = queries().score(Points::F32(&points)).unwrap();
        assert!(found.scores[0].iter().all(|s| (0.0..=1.0).contains(s)), "{size:e}");
        let covered = f32::from(u8::from(size > 0.0));
        assert!(found.coverage.iter().all(|c| *c == covered), "{size:e}");
        assert!(size > 0.0 || found.scores[0].iter().all(|s| *s == 0.0));
    }
}

#[test]
fn opposite_and_equal_features_score_at_the_ends() {
    let (wanted, canonical) = (random(DIM, 1), random(DIM, 2));
    let queries = Queries::new(Space::Clip, &[&wanted], &[&canonical], 1e6).unwrap();
    let opposite: Vec<f32> = wanted.iter().map(|v| -v).collect();
    let found = queries.score(Points::F32(&[&wanted[..], &opposite[..]].concat())).unwrap();
    assert!(found.scores[0][0] > 0.999 && found.scores[0][1] < 0.001, "{:?}", found.scores);
    // A phrase against itself and against its opposite.
    for canonical in [&wanted, &opposite] {
        let queries = Queries::new(Space::Clip, &[&wanted], &[canonical], 1e6).unwrap();
        let found = queries.score(Points::F32(&random(50 * DIM, 9))).unwrap();
        assert!(found.scores[0].iter().all(|s| (0.0..=1.0).contains(s)));
    }
}

#[test]
fn a_feature_that_is_not_finite_is_named_by_its_point() {
    for bad in NOT_FINITE {
        for point in [0, 1, 63, 64, 4097] {
            let mut points = random(5000 * DIM, 4);
            points[point * DIM + 5] = bad;
            let error = queries().score(Points::F32(&points)).unwrap_err();
            assert_eq!(error, RelevancyError::NonFinite { point });
        }
        let mut phrase = random(DIM, 1);
        phrase[3] = bad;
        let canonical = random(DIM, 2);
        let error = Queries::new(Space::Clip, &[&phrase], &[&canonical], 10.0).unwrap_err();
        assert!(matches!(error, RelevancyError::Embedding { .. }));
    }
}
