//! What is picked up and put down is found where it is at that time, and not where it was: at novel views and times.

use std::path::{Path, PathBuf};

use divff::config::Config;
use divff::pipeline::{self, Outcome, RunOptions};
use divff::scene::Scene;
use divff::synth::{SynthOptions, generate};

/// Settings under which a run takes half a minute.
const SHORT: &str = "
[train]
steps = 700
rays = 2048
[map]
voxel_size = 0.1
points = 1000
times = \"frame:4\"
[semantics]
steps = 400
rays = 2048
cached_rays = 200000
joint_steps = 20
";

/// Share of the views of things that move in which they are found where they are, and how many views there are.
fn found(scene: &Scene, out: &Path) -> (f64, usize) {
    let config = Config::default().overlaid(SHORT, "SHORT").expect("settings that there are");
    let options = RunOptions { fresh: true };
    match pipeline::run(scene, &config, out, &options, &mut ()).expect("the scene is sound") {
        Outcome::Finished(metrics) => {
            let (share, views) = (metrics.quality.moved_objects_found, metrics.quality.moved_objects_scored);
            (share.unwrap_or(0.0), views.unwrap_or(0))
        }
        Outcome::Stopped { step } => panic!("nobody said stop at step {step}"),
    }
}

fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("pick_and_place").join(name);
    if folder.exists() {
        std::fs::remove_dir_all(&folder).expect("what an earlier test left can be removed");
    }
    folder
}

#[test]
fn a_synthetic_mug_is_found_where_it_was_put() {
    let root = folder("scene");
    let options = SynthOptions { frames: 96, width: 120, height: 68, ..SynthOptions::default() };
    generate(&options, &root).expect("a scene");
    let (share, views) = found(&Scene::open(&root).expect("what was just written"), &folder("run"));
    eprintln!("synth: found in {:.0} % of {views} views", 100.0 * share);
    assert!(views >= 10 && share >= 0.5, "found in {share} of {views} views");
}

#[test]
fn things_of_the_shipped_kitchen_are_found_where_they_were_put() {
    let root = std::env::var_os("DIVFF_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let root = root.join("kitchen-a");
    if !root.is_dir() {
        eprintln!("SKIPPED: no kitchen-a in the data folder; set DIVFF_DATA to run this test");
        return;
    }
    let (share, views) = found(&Scene::open(&root).expect("the shipped scene"), &folder("kitchen-a"));
    eprintln!("kitchen-a: found in {:.0} % of {views} views", 100.0 * share);
    assert!(views >= 50 && share >= 0.5, "found in {share} of {views} views");
}
