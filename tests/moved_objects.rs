//! Pick and place: that something moves is found out, and what is moved where it is at that time, and not where it was.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use divff::config::{Config, Preset};
use divff::pipeline::{self, Cost, Event, Observer, RunFolder};
use divff::scene::{Scene, Split};
use divff::synth::{SynthOptions, generate};
use divff::train::{Progress, StreamChoice, Trainer};

/// Nobody listens.
struct Quiet;

impl Observer for Quiet {
    fn event(&mut self, _: &Event) {}

    fn stop(&self) -> bool {
        false
    }
}

/// Shares of the views in which moved objects are found: at the time that a frame shows, and at the mirrored time, when
/// most of them are somewhere else; and how many views count.
fn found(path: &Path, config: &Config) -> ([f64; 2], usize) {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::new(folder.path().join("run"));
    let scene = Scene::open(path).unwrap();
    let session = pipeline::train(&scene, config, &run, false, &mut Quiet).unwrap();
    let trained = pipeline::train_features(&scene, session, config, &run, &mut Quiet).unwrap();
    let (fields, trained) = trained.expect("nobody says stop");
    let mut mirrored = scene.clone();
    for frame in mirrored.frames.iter_mut().filter(|f| f.split == Split::Test) {
        frame.time = 1.0 - frame.time;
    }
    let mut views = 0;
    let shares = [&scene, &mirrored].map(|scene| {
        let metrics =
            pipeline::evaluate(scene, &trained, Some(&fields), config, &run, Cost::default(), &mut Quiet);
        let quality = metrics.unwrap().expect("nobody says stop").quality;
        views = quality.moved_objects_scored.expect("the scene has objects that move");
        quality.moved_objects_found.expect("the scene has objects that move")
    });
    println!(
        "{}: found in {:.2} of {views} views, at mirrored times {:.2}",
        path.display(),
        shares[0],
        shares[1]
    );
    (shares, views)
}

fn settings(steps: u64) -> Config {
    let mut config = Config::preset(Preset::Standard);
    config.train.streams = StreamChoice::All;
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
    let ([right, mirrored], views) = found(&path, &settings(1400));
    assert!(views >= 20, "{views} views are too few to tell");
    assert!(right >= 0.6, "moved objects are found in {right:.2} of {views} views only");
    assert!(mirrored <= right - 0.2, "at another time as well ({mirrored:.2}): time does not count");
}

/// A folder of the real and rendered scenes; says so where it is not there.
fn data(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("DIVFF_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let path = root.join(name);
    if !path.is_dir() {
        eprintln!("SKIPPED: no {name} in {}; set DIVFF_DATA to run this test", root.display());
        return None;
    }
    Some(path)
}

#[test]
fn on_the_rendered_kitchen() {
    let Some(path) = data("kitchen-a") else { return };
    let ([right, mirrored], views) = found(&path, &settings(2000));
    assert!(right >= 0.6, "moved objects are found in {right:.2} of {views} views only");
    assert!(mirrored <= right - 0.2, "at another time as well ({mirrored:.2}): time does not count");
}

/// Which streams a draft of a scene keeps, and the share of wrong blocks by which that is decided.
fn kept_streams(path: &Path) -> ([bool; 3], f64) {
    let run = tempfile::tempdir().unwrap();
    let scene = Scene::open(path).unwrap();
    let mut trainer = Trainer::new(&scene, &Config::preset(Preset::Draft)).unwrap();
    let mut until_settled = |p: &Progress| match p.step {
        ..500 => ControlFlow::Continue(()),
        _ => ControlFlow::Break(()),
    };
    trainer.run(run.path(), None, &mut until_settled).unwrap();
    let trained = trainer.trained();
    let unexplained = trained.progress.unexplained.expect("a draft has settled its streams by now");
    println!("{}: {:.1} % of the blocks are wrong", path.display(), 100.0 * unexplained);
    (trained.field.shape.streams, unexplained)
}

#[test]
fn streams_that_a_scene_needs_are_trained_and_no_others() {
    let folder = tempfile::tempdir().unwrap();
    let synthetic = folder.path().join("scene");
    generate(&SynthOptions::default(), &synthetic).unwrap();
    // The border is at 4 %; nothing here may be near it.
    let (streams, unexplained) = kept_streams(&synthetic);
    assert!(streams == [true; 3] && unexplained > 0.06, "{streams:?} {unexplained}");
    if let Some(rendered) = data("kitchen-a") {
        let (streams, unexplained) = kept_streams(&rendered);
        assert!(streams == [true; 3] && unexplained > 0.06, "{streams:?} {unexplained}");
    }
    if let Some(still) = data("redkitchen") {
        let (streams, unexplained) = kept_streams(&still);
        assert!(streams == [true, false, false] && unexplained < 0.03, "{streams:?} {unexplained}");
    }
}
