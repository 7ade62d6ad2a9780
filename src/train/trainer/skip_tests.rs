//! What is skipped changes nothing that shows: trainings and pictures with and without.

use super::*;
use crate::render::image::RenderedFrame;
use crate::render::sampler::Sampling;
use crate::train::testing;

/// Settings of a short training in which streams are skipped.
fn settings() -> Config {
    let mut config = testing::config();
    config.train.steps = 200;
    config.train.streams = StreamChoice::All;
    config.train.static_until = 0.2;
    config.train.stereo_at = 1.0;
    config.train.skip_from = 0.3;
    config
}

/// A field that learned the wall, with cells in which a stream is skipped.
fn trained(folder: &Path) -> (Scene, Trainer) {
    let scene = testing::scene(folder);
    let mut trainer = Trainer::new(&scene, &settings()).expect("the test's scene is valid");
    let run = tempfile::tempdir().expect("a temporary folder");
    trainer.run(run.path(), None, &mut |_| ControlFlow::Continue(())).expect("training goes through");
    (scene, trainer)
}

fn picture(field: &Field, grids: &Grids, streams: [bool; 3], frame: &Frame) -> RenderedFrame {
    let sampling = Sampling { count: 32, step: 0.01, explore: 0.2, sharpness: 1.0 };
    render(&Model::new(field, grids, streams), frame, &sampling, 1)
}

#[test]
fn a_training_of_few_steps_skips_nothing_while_all_is_fog() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    for (steps, skip_after, skips) in [(60, 100, false), (60, 10, true), (120, 100, true)] {
        let mut config = settings();
        (config.train.steps, config.train.skip_after) = (steps, skip_after);
        let mut trainer = Trainer::new(&scene, &config).expect("the test's scene is valid");
        let run = tempfile::tempdir().expect("a temporary folder");
        trainer.run(run.path(), None, &mut |_| ControlFlow::Continue(())).expect("training goes through");
        assert_eq!(trainer.trained().grids.threshold != [0.0; 3], skips, "{steps} steps");
    }
}

#[test]
fn a_stream_that_is_nowhere_and_one_that_is_absent_look_the_same() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (scene, trainer) = trained(folder.path());
    let mut trained = trainer.into_trained();
    for grid in &mut trained.grids.streams[1..] {
        grid.sigma.fill(0.0);
    }
    let draw = |trained: &Trained, streams| -> Vec<RenderedFrame> {
        scene.frames.iter().map(|f| picture(&trained.field, &trained.grids, streams, f)).collect()
    };
    let all = draw(&trained, [true; 3]);
    assert_eq!(draw(&trained, [true, false, false]), all, "streams that are not asked for");
    trained.keep_streams([true, false, false]);
    assert_eq!(draw(&trained, [true; 3]), all, "streams that the field does not have");
    assert!(all.iter().flat_map(|i| &i.opacity).any(|o| o[0] > 0.5), "there is something to see");
}

#[test]
fn a_training_without_the_moving_streams_counts_what_they_would_have_taken() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    let mut config = testing::config();
    config.train.streams = StreamChoice::Static;
    let mut trainer = Trainer::new(&scene, &config).expect("the test's scene is valid");
    let report = trainer.step(0.5, None).expect("the numbers stay finite");
    assert_eq!(report.absent, 2 * report.rays * trainer.config.train.samples);
    assert_eq!(report.candidates * 2, report.absent);
}

#[test]
fn skipped_cells_do_not_show() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (scene, trainer) = trained(folder.path());
    let Trained { field, grids, progress } = trainer.trained();
    assert!(progress.evaluations < progress.candidates, "{progress:?}");
    let everywhere = Grids { threshold: [0.0; 3], ..grids.clone() };
    let (mut squared, mut count) = (0.0, 0);
    for frame in &scene.frames {
        let [with, without] = [grids, &everywhere].map(|grids| picture(field, grids, [true; 3], frame));
        for (a, b) in with.rgb.as_flattened().iter().zip(without.rgb.as_flattened()) {
            squared += f64::from(a - b).powi(2);
            count += 1;
        }
    }
    let same = psnr(squared / f64::from(count));
    assert!(same > 40.0, "pictures with and without agree to {same} dB");
}

#[test]
fn poses_that_are_exact_cost_nothing_and_change_nothing_else() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    let step = |trusts: bool| {
        let mut config = testing::config();
        // Refined, but not so far that a float of a camera moves.
        (config.train.pose_rate, config.train.rig_rate) = (1e-20, 0.0);
        let mut trainer = Trainer::new(&scene, &config).expect("the test's scene is valid");
        trainer.trained.progress.trusts_poses = trusts;
        for _ in 0..6 {
            let report = trainer.step(0.5, None).expect("the numbers stay finite");
            assert_eq!(report.unrefined > 0, trusts);
            trainer.count(&report);
        }
        assert_eq!(trainer.trained.progress.unrefined > 0, trusts);
        let field = &mut trainer.trained.field;
        let refinement = field.layout.refinement();
        assert_eq!(field.weights[refinement.clone()].iter().all(|w| *w == 0.0), trusts);
        field.weights[refinement].fill(0.0);
        (field.weights.clone(), field.tables.clone())
    };
    assert!(step(true) == step(false), "the way back to the poses changed the field");
}

#[test]
fn a_training_without_faint_samples_learns_the_same() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut scene = testing::scene(folder.path());
    // How well it shows what it was trained on is all that these cameras, which have nothing in common, can tell.
    let test = scene.frames.iter().map(|frame| Frame { split: Split::Test, ..frame.clone() });
    scene.frames.extend(test.collect::<Vec<_>>());
    let learn = |faint: f32| {
        let mut config = settings();
        (config.train.faint, config.train.steps) = (faint, 300);
        let mut trainer = Trainer::new(&scene, &config).expect("the test's scene is valid");
        let run = tempfile::tempdir().expect("a temporary folder");
        trainer.run(run.path(), None, &mut |_| ControlFlow::Continue(())).expect("training goes through");
        (trainer.test_psnr().expect("there are frames to look at"), trainer.into_trained().progress)
    };
    let ((all, everything), (bright, progress)) = (learn(0.0), learn(1e-4));
    assert_eq!(everything.faint, 0);
    assert!(progress.faint > progress.evaluations / 100, "{progress:?}");
    assert!(bright > all - 0.5, "{all} dB with faint samples, {bright} dB without");
}
