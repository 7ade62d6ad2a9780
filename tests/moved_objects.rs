//! Pick and place: that something moves is found out, and what is moved where it is at that time, and not where it was.

use std::ops::ControlFlow;
use std::path::Path;

use divff::config::{Config, Preset};
use divff::pipeline::{self, Cost, Event, Observer, RunFolder};
use divff::scene::{Scene, Split};
use divff::synth::{SynthOptions, generate};
use divff::train::{Progress, Trainer};

#[path = "support/data.rs"]
mod data;

/// Nobody listens.
struct Quiet;

impl Observer for Quiet {
    fn event(&mut self, _: &Event) {}

    fn stop(&self) -> bool {
        false
    }
}

/// What a training has found out about a scene in which things move.
struct Found {
    /// Streams that it keeps.
    streams: [bool; 3],
    /// Share of wrong blocks by which that is decided.
    unexplained: f64,
    /// Views with an object that has moved.
    views: usize,
    /// In what share of them it is found, at the time that a frame shows.
    right: f64,
    /// Likewise at the mirrored time, when most of them are somewhere else.
    mirrored: f64,
}

fn found(path: &Path, config: &Config) -> Found {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::new(folder.path().join("run"));
    let scene = Scene::open(path).unwrap();
    let session = pipeline::train(&scene, config, &run, false, &mut Quiet).unwrap();
    let trained = pipeline::train_features(&scene, session, config, &run, &mut Quiet).unwrap();
    let (fields, trained) = trained.expect("nobody says stop");
    let mut at_mirrored_times = scene.clone();
    for frame in at_mirrored_times.frames.iter_mut().filter(|f| f.split == Split::Test) {
        frame.time = 1.0 - frame.time;
    }
    let mut views = 0;
    let [right, mirrored] = [&scene, &at_mirrored_times].map(|scene| {
        let metrics =
            pipeline::evaluate(scene, &trained, Some(&fields), config, &run, Cost::default(), &mut Quiet);
        let quality = metrics.unwrap().expect("nobody says stop").quality;
        views = quality.moved_objects_scored.expect("the scene has objects that move");
        quality.moved_objects_found.expect("the scene has objects that move")
    });
    let unexplained = trained.progress.unexplained.expect("its streams are settled");
    println!(
        "{}: {:.1} % of the blocks are wrong; found in {right:.2} of {views} views, at mirrored times {mirrored:.2}",
        path.display(),
        100.0 * unexplained
    );
    Found { streams: trained.field.shape.streams, unexplained, views, right, mirrored }
}

impl Found {
    /// That things move is seen, and where they are at their time.
    fn check(&self) {
        let Self { streams, unexplained, views, right, mirrored } = self;
        // The border is at 4 %; nothing here may be near it.
        assert!(*streams == [true; 3] && *unexplained > 0.06, "{streams:?} {unexplained}");
        assert!(*views >= 20, "{views} views are too few to tell");
        assert!(*right >= 0.6, "moved objects are found in {right:.2} of {views} views only");
        assert!(*mirrored <= right - 0.2, "at another time as well ({mirrored:.2}): time does not count");
    }
}

fn settings(steps: u64) -> Config {
    let mut config = Config::preset(Preset::Standard);
    config.train.steps = steps;
    // As in drafts: what moves waits for steps more than for rays.
    config.train.rays = 2048;
    config.semantics.steps = 500;
    config.semantics.joint_steps = 0;
    config
}

#[test]
fn on_the_synthetic_kitchen() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene");
    generate(&SynthOptions { frames: 200, ..SynthOptions::default() }, &path).unwrap();
    found(&path, &settings(1400)).check();
}

#[test]
fn on_the_rendered_kitchen() {
    let Some(path) = data::scene("kitchen-a") else { return };
    found(&path, &settings(2500)).check();
}

#[test]
fn where_nothing_moves_there_are_no_streams_for_it() {
    let Some(path) = data::scene("redkitchen") else { return };
    let run = tempfile::tempdir().unwrap();
    let scene = Scene::open(&path).unwrap();
    let mut trainer = Trainer::new(&scene, &Config::preset(Preset::Draft)).unwrap();
    let mut until_settled = |p: &Progress| match p.step {
        ..450 => ControlFlow::Continue(()),
        _ => ControlFlow::Break(()),
    };
    trainer.run(run.path(), None, &mut until_settled).unwrap();
    let trained = trainer.trained();
    let unexplained = trained.progress.unexplained.expect("its streams are settled");
    println!("{}: {:.1} % of the blocks are wrong", path.display(), 100.0 * unexplained);
    let streams = trained.field.shape.streams;
    assert!(streams == [true, false, false] && unexplained < 0.03, "{streams:?} {unexplained}");
}
