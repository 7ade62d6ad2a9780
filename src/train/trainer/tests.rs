//! Whole trainings of a wall seen by three cameras.

use std::ops::ControlFlow;

use super::*;
use crate::field::{EncodingKind, FrequencyConfig};
use crate::rng::Rng;
use crate::synth::{SynthOptions, generate};
use crate::train::step::CHUNK_RAYS;
use crate::train::testing;

/// Steps of the tests' schedules: two reports.
const STEPS: u64 = 2 * REPORT_EVERY;

const ENCODINGS: [EncodingKind; 3] = [EncodingKind::Hash, EncodingKind::Dense, EncodingKind::Frequency];

fn config(static_until: f64) -> Config {
    config_of(EncodingKind::Hash, static_until)
}

fn config_of(encoding: EncodingKind, static_until: f64) -> Config {
    let mut config = testing::config_of(encoding);
    config.train.steps = STEPS;
    config.train.streams = StreamChoice::All;
    config.train.static_until = static_until;
    // Frames are aligned and their depth is looked for, before and after the interruption of the tests below.
    config.train.stereo_at = 0.1;
    config.train.align_at = vec![0.3, 0.8];
    config.train.align_after = 0;
    config
}

/// The checkpoint as bytes, without the one thing in it that no two trainings share.
fn bytes(trainer: &mut Trainer) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    trainer.trained.progress.seconds = 0.0;
    trainer.save(folder.path()).expect("the temporary folder can be written");
    std::fs::read(Trained::path(folder.path())).expect("it was just written")
}

fn train(scene: &Scene, config: &Config, threads: usize) -> (Vec<u8>, Vec<Progress>) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started");
    pool.install(|| {
        let run = tempfile::tempdir().expect("a temporary folder");
        let mut trainer = Trainer::new(scene, config).expect("the test's scene is valid");
        let mut reports = Vec::new();
        let mut watch = |p: &Progress| {
            reports.push(*p);
            ControlFlow::Continue(())
        };
        trainer.run(run.path(), None, &mut watch).expect("training goes through");
        (bytes(&mut trainer), reports)
    })
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    for config in ENCODINGS.map(|e| config_of(e, 0.3)) {
        let (one, _) = train(&scene, &config, 1);
        let (two, _) = train(&scene, &config, 2);
        assert!(one == two, "{:?}: two threads give other bytes than one", config.field.encoding);
    }
    let config = config(0.3);
    let (one, _) = train(&scene, &config, 1);
    let (other, _) = train(&scene, &Config { seed: config.seed + 1, ..config }, 2);
    assert!(one != other, "the seed must matter");
}

#[test]
fn the_wall_is_learned() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut scene = testing::scene(folder.path());
    // Looked at as a held-out frame, too, so that rendering is measured.
    let mut held_out = scene.frames[0].clone();
    held_out.split = Split::Test;
    scene.frames.push(held_out);
    let mut config = config(1.0);
    config.train.steps = 4 * REPORT_EVERY;
    let (_, reports) = train(&scene, &config, 2);
    let (first, last) = (&reports[0], &reports[reports.len() - 1]);
    assert!(last.loss < first.loss, "the loss went from {} to {}", first.loss, last.loss);
    assert!(last.psnr > first.psnr + 3.0, "the rays' PSNR went from {} to {}", first.psnr, last.psnr);
    let seen = last.test_psnr.expect("there is a held-out frame");
    assert!(seen > 18.0, "a frame that was trained on has {seen} dB");
}

#[test]
fn samples_are_placed_more_sharply_only_where_nothing_moves() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    // The streams are settled in the first of two reports, never, and settled but with all of them there.
    let cases = [
        (StreamChoice::Static, 0.3, true),
        (StreamChoice::Static, 1.0, false),
        (StreamChoice::All, 0.3, false),
    ];
    for (streams, static_until, differs) in cases {
        let mut soft = config(static_until);
        soft.train.streams = streams;
        let mut sharp = soft.clone();
        sharp.train.still_sharpness *= 4.0;
        let [soft, sharp] = [soft, sharp].map(|config| train(&scene, &config, 2).0);
        assert_eq!(soft != sharp, differs, "{streams:?}, settled after {static_until} of the schedule");
    }
}

/// A kitchen in 24 small pictures: what each encoding says of them after some hundred steps must be far better than the
/// best single colour.
#[test]
fn every_encoding_learns_a_kitchen() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = SynthOptions { frames: 24, width: 48, height: 27, seed: 1 };
    generate(&options, folder.path()).expect("the temporary folder can be written");
    let scene = Scene::open(folder.path()).expect("it was just made");
    // Networks on frequencies have hardly begun after so few steps.
    for (encoding, margin) in ENCODINGS.into_iter().zip([5.0, 5.0, 1.0]) {
        let mut config = Config::default();
        config.field.encoding = encoding;
        config.field.frequency = FrequencyConfig { hidden: 32, head: 16, ..FrequencyConfig::default() };
        // So narrow networks take larger steps.
        config.train.frequency_rate *= 10.0;
        for stream in [&mut config.field.persistent, &mut config.field.dynamic, &mut config.field.actor] {
            stream.log2_rows = 13;
        }
        config.train.streams = StreamChoice::Static;
        config.train.stereo_at = 1.0;
        config.train.align_at = Vec::new();
        (config.train.steps, config.train.rays, config.train.samples) = (300, 512, 8);
        (config.train.render_samples, config.train.grid_cells) = (16, 32.0);
        let (_, reports) = train(&scene, &config, 2);
        let learned = reports[reports.len() - 1].psnr;
        let plain = psnr_of_mean_colour(&Trainer::new(&scene, &config).expect("the scene is valid").pixels);
        assert!(learned > plain + margin, "{encoding:?}: {learned} dB; the mean colour has {plain} dB");
    }
}

/// PSNR, dB, of pictures that show nothing but their own mean colour.
fn psnr_of_mean_colour(pixels: &PixelSet) -> f64 {
    let mean = pixels.mean_colour();
    let all = || pixels.images.iter().flatten();
    let squared =
        |rgb: &[u8; 3]| (0..3).map(|c| (f64::from(rgb[c]) / 255.0 - f64::from(mean[c])).powi(2)).sum::<f64>();
    -10.0 * (all().map(squared).sum::<f64>() / (3 * all().count()) as f64).log10()
}

#[test]
fn resuming_gives_the_bytes_of_an_uninterrupted_training() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    // Interrupted half-way: once after the streams are settled, once before.
    let cases = [0.2, 0.7].map(config).into_iter();
    for config in cases.chain(ENCODINGS[1..].iter().map(|e| config_of(*e, 0.2))) {
        let (straight, _) = train(&scene, &config, 2);
        let run = tempfile::tempdir().expect("a temporary folder");
        let mut first = Trainer::new(&scene, &config).expect("the test's scene is valid");
        first.run(run.path(), None, &mut |_| ControlFlow::Break(())).expect("training goes through");
        assert_eq!(first.trained().progress.step, REPORT_EVERY);
        drop(first);
        let mut second = Trainer::resume(&scene, &config, run.path()).expect("the checkpoint is whole");
        second.run(run.path(), None, &mut |_| ControlFlow::Continue(())).expect("training goes through");
        assert_eq!(second.trained().progress.step, STEPS);
        let (encoding, until) = (config.field.encoding, config.train.static_until);
        assert!(bytes(&mut second) == straight, "{encoding:?}, static until {until}: resumed to other bytes");
    }
}

#[test]
fn a_refinement_from_which_stereo_finds_less_is_undone() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = SynthOptions { frames: 24, width: 96, height: 54, seed: 1 };
    generate(&options, folder.path()).expect("the temporary folder can be written");
    let scene = Scene::open(folder.path()).expect("it was just made");
    let mut trainer = Trainer::new(&scene, &Config::default()).expect("the scene is valid");
    let refinement = trainer.trained.field.layout.refinement();
    let all: Vec<usize> = (0..trainer.pixels.frames.len()).collect();
    // A few frames say yes; they say no, and all of them that nothing is lost; all of them say no.
    for (given, moved, kept) in [(0.0, 0.05, true), (2.0, 1e-9, true), (2.0, 0.05, false)] {
        let weights = testing::noise(&mut Rng::new(7, 0, 0), refinement.len(), moved);
        trainer.trained.field.weights[refinement.clone()].copy_from_slice(&weights);
        trainer.trained.progress.given_coverage = Some(given);
        let search = trainer.settle_poses().expect("the poses have been refined");
        assert_eq!(trainer.trained.progress.trusts_poses, !kept, "{given} {moved}");
        let left = &trainer.trained.field.weights[refinement.clone()];
        assert!(if kept { *left == weights } else { left.iter().all(|w| *w == 0.0) });
        let goes_on = trainer.pixels.stereo_search(&trainer.trained.field, &trainer.config.stereo);
        assert_eq!(search.coverage(&all), goes_on.coverage(&all), "another search goes on");
    }
}

#[test]
fn poses_that_are_clearly_bad_are_judged_by_few_frames() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    let mut trainer = Trainer::new(&scene, &config(0.3)).expect("the test's scene is valid");
    // Of pictures without any texture, stereo finds nothing.
    trainer.pixels.images.iter_mut().flatten().for_each(|rgb| *rgb = [90; 3]);
    trainer.judge_poses();
    let progress = &trainer.trained.progress;
    assert_eq!(
        (progress.given_coverage, progress.judged, progress.trusts_poses),
        (Some(0.0), Some(4), false)
    );
}

#[test]
fn trusted_poses_are_not_refined() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    for trusts in [true, false] {
        let mut trainer = Trainer::new(&scene, &config(0.3)).expect("the test's scene is valid");
        trainer.trained.progress.trusts_poses = trusts;
        for _ in 0..4 {
            trainer.step(0.5, None).expect("the numbers stay finite");
        }
        let refinement = &trainer.trained.field.weights[trainer.trained.field.layout.refinement()];
        assert_eq!(refinement.iter().all(|w| *w == 0.0), trusts);
    }
}

/// Otherwise what moves is let in, and empty space skipped, before anything is known.
#[test]
fn a_schedule_by_the_clock_begins_with_the_first_step() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut trainer = Trainer::new(&testing::scene(folder.path()), &config(0.3)).expect("the scene is valid");
    let budget = Some(Duration::from_secs(60));
    // Looking for depth took a third of the time.
    (trainer.trained.progress.prepared, trainer.trained.progress.seconds) = (20.0, 20.0);
    assert_eq!(trainer.fraction(budget), 0.0);
    trainer.trained.progress.seconds = 40.0;
    assert_eq!(trainer.fraction(budget), 0.5);
    trainer.trained.progress.seconds = 61.0;
    assert_eq!(trainer.fraction(budget), 1.0);
}

#[test]
fn stereo_is_left_out_where_a_time_budget_is_too_short_for_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    let minute = Some(Duration::from_secs(60));
    for (budget, cost, moves, left_out) in [
        (minute, 20.0, false, true),
        (minute, 1.0, false, false),
        (minute, 20.0, true, false),
        (None, 20.0, false, false),
    ] {
        let mut trainer = Trainer::new(&scene, &config(0.3)).expect("the scene is valid");
        if !moves {
            trainer.trained.keep_streams([true, false, false]);
        }
        trainer.stereo_cost = Some(cost);
        assert_eq!(trainer.stereo_waits(budget), cost == 20.0 && budget.is_some(), "nothing is known yet");
        trainer.trained.progress.streams_settled = true;
        trainer.leave_out_stereo(budget);
        assert!(!trainer.stereo_waits(budget));
        trainer.look_at_depth();
        let found = !trainer.pixels.stereo.is_empty();
        assert_eq!(found, !left_out, "{budget:?}, {cost} s, {moves}");
        assert_eq!(trainer.trained.progress.stereo_left_out, left_out.then_some(cost));
    }
}

#[test]
fn tables_that_wait_for_the_next_step_learn_the_same() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = testing::scene(folder.path());
    let learn = |take: fn(&mut Trainer, usize) -> Vec<StepReport>| {
        let mut trainer = Trainer::new(&scene, &testing::config()).expect("the test's scene is valid");
        trainer.streams = [true; 3];
        let mut reports = take(&mut trainer, 5);
        // Other groups of rays, which cannot tell what these have found.
        trainer.config.train.rays += 20 * CHUNK_RAYS;
        reports.extend(take(&mut trainer, 3));
        trainer.settle();
        let rows = reports.iter().map(|report| (report.loss, report.rows)).collect::<Vec<_>>();
        (rows, trainer.trained.field.weights, trainer.trained.field.tables)
    };
    let at_once = |trainer: &mut Trainer, count| {
        let one = |_| trainer.step(0.5, None).expect("the numbers stay finite");
        (0..count).map(one).collect()
    };
    let waiting = |trainer: &mut Trainer, count| trainer.steps(0.5, count).expect("the numbers stay finite");
    let never_settled = |trainer: &mut Trainer, count| {
        let one = |_| trainer.begin_step(0.5, None).expect("the numbers stay finite");
        (0..count).map(one).collect()
    };
    let (rows, weights, tables) = learn(at_once);
    assert!(rows.iter().all(|(_, rows)| rows.updated > 0 && rows.unseen > 0), "{rows:?}");
    assert!(learn(waiting) == (rows.clone(), weights.clone(), tables.clone()));
    let (late, late_weights, late_tables) = learn(never_settled);
    assert!((late_weights, late_tables) == (weights, tables));
    // A step tells what became of the tables after the one before.
    assert!(late[1..].iter().map(|(_, rows)| rows).eq(rows[..7].iter().map(|(_, rows)| rows)));
}
