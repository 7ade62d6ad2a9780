//! Training at the ends of its settings: nothing moves, or an error names stage, step and index.

use divff::config::Config;
use divff::scene::Scene;
use divff::train::{TrainError, Trained, Trainer};
use tempfile::TempDir;

use crate::scenes::{filmed, quick};

/// A trainer of the kitchen, and the folder that its pictures are in.
fn trainer(change: impl FnOnce(&mut Config)) -> (Trainer, TempDir) {
    let folder = filmed(|_| ());
    let scene = Scene::open(folder.path()).unwrap();
    let mut config = quick(&scene);
    change(&mut config);
    (Trainer::new(&scene, &config).unwrap(), folder)
}

/// Takes some steps; the mean loss of the last, or what went wrong.
fn steps(trainer: &mut Trainer, count: u64) -> Result<f64, TrainError> {
    let mut loss = f64::NAN;
    for n in 0..count {
        loss = trainer.step(n as f64 / count as f64, None)?.loss;
    }
    Ok(loss)
}

fn is_finite(trained: &Trained) -> bool {
    trained.field.weights.iter().all(|w| w.is_finite())
        && trained.field.tables.iter().flatten().flatten().all(|row| row.is_finite())
        && trained.grids.streams.iter().all(|g| g.sigma.iter().all(|s| s.is_finite()))
}

#[test]
fn frozen_rates_leave_every_number_as_it_was() {
    let (mut trainer, _folder) = trainer(|config| {
        let t = &mut config.train;
        for rate in
            [&mut t.table_rate, &mut t.network_rate, &mut t.exposure_rate, &mut t.pose_rate, &mut t.rig_rate]
        {
            *rate = 0.0;
        }
    });
    let before = trainer.trained().field.clone();
    steps(&mut trainer, 5).unwrap();
    assert_eq!(trainer.trained().field.weights, before.weights);
    assert_eq!(trainer.trained().field.tables, before.tables);
}

#[test]
fn exploding_rates_end_in_an_error_before_anything_is_stored() {
    type Change = fn(&mut Config);
    let rates: [(&str, Change); 5] = [
        ("tables", |c| c.train.table_rate = 1e30),
        ("networks", |c| c.train.network_rate = 1e20),
        ("exposures", |c| c.train.exposure_rate = 1e30),
        ("poses", |c| (c.train.pose_rate, c.train.refine_from) = (1e38, 0.0)),
        ("everything", |c| (c.train.table_rate, c.train.network_rate) = (f32::MAX, f32::MAX)),
    ];
    for (what, change) in rates {
        let (mut trainer, _folder) = trainer(change);
        let run = tempfile::tempdir().unwrap();
        let done = steps(&mut trainer, 60).and_then(|_| trainer.save(run.path()));
        match done {
            Err(TrainError::NonFinite { step, .. }) => {
                assert!((1..=60).contains(&step), "{what}: step {step}");
                assert!(!Trained::path(run.path()).exists(), "{what}");
            }
            Err(other) => panic!("{what}: {other}"),
            // Adam's steps are as long as the rate, whatever the gradient: large numbers may stay numbers.
            Ok(()) => assert!(is_finite(trainer.trained()), "{what}: NaN without an error"),
        }
    }
}

#[test]
fn uncertainty_down_to_nothing_trains_or_says_where_it_cannot() {
    for beta_min in [0.03, 1e-3, 1e-10, 1e-18, 1e-30, f32::MIN_POSITIVE] {
        let (mut trainer, _folder) = trainer(|config| config.loss.beta_min = beta_min);
        match steps(&mut trainer, 20) {
            Ok(loss) => assert!(loss.is_finite() && is_finite(trainer.trained()), "β_min {beta_min:e}"),
            Err(TrainError::NonFinite { step, .. }) => {
                assert!(beta_min < 1e-15 && step > 0, "β_min {beta_min:e}: step {step}");
            }
            Err(other) => panic!("β_min {beta_min:e}: {other}"),
        }
    }
}

#[test]
fn prices_as_high_as_they_go_train_or_say_where_they_cannot() {
    for price in [0.0, 1e6, 1e20, f32::MAX] {
        let (mut trainer, _folder) = trainer(|config| {
            let l = &mut config.loss;
            for p in [&mut l.transient, &mut l.distortion, &mut l.entropy, &mut l.depth, &mut l.flatness] {
                *p = price;
            }
        });
        match steps(&mut trainer, 20) {
            Ok(loss) => assert!(loss.is_finite() && is_finite(trainer.trained()), "price {price:e}"),
            Err(TrainError::NonFinite { step, .. }) => assert!(step > 0 && price > 1e10, "price {price:e}"),
            Err(other) => panic!("price {price:e}: {other}"),
        }
    }
}
