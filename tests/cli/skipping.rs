//! What a run skips: that the result is the same without, and that `metrics.json` says what it saved.

use std::fs;

use divff::config::Config;
use divff::map;
use divff::pipeline::{self, Cost, RunFolder, RunOptions};
use divff::scene::Scene;
use divff::semantics::SemanticFields;
use divff::semantics::bake::annotate;
use serde_json::Value;

use crate::kit::{TINY, copy, folder, run, scene};

fn work(run: &RunFolder) -> Value {
    let metrics: Value = serde_json::from_slice(&fs::read(run.metrics_path()).unwrap()).unwrap();
    metrics["skipped"]["work"].clone()
}

#[test]
fn metrics_say_what_was_saved() {
    let work = work(&RunFolder::new(run()));
    for (what, unit) in [
        ("empty_space", "samples"),
        ("empty_blocks", "voxels"),
        ("empty_blocks", "bytes"),
        ("layers", "bytes"),
    ] {
        assert!(work[what][unit].as_u64().is_some_and(|n| n > 0), "{what} {unit}: {work}");
    }
    // Nothing becomes so dense in so few steps that a ray is cut off, and what saved nothing is not listed.
    assert_eq!(work.get("saturated_rays"), None, "{work}");
    assert_eq!(work.get("formats"), None, "a run writes all formats: {work}");
    assert_eq!(work.get("finished_training"), None, "it was trained here: {work}");
}

#[test]
fn a_finished_training_is_not_repeated_and_says_what_that_saved() {
    let out = folder("finished");
    copy(run(), &out);
    let before = fs::read(out.join("checkpoint/field.safetensors")).unwrap();
    let config = Config::default().overlaid(TINY, "TINY").unwrap();
    let scene = Scene::open(scene()).unwrap();
    pipeline::run(&scene, &config, &out, &RunOptions::default(), &mut ()).unwrap();
    assert!(fs::read(out.join("checkpoint/field.safetensors")).unwrap() == before);
    for file in ["persistent.ply", "points.npz", "scene.glb"] {
        let [old, new] = [run(), &out].map(|run| fs::read(run.join("map").join(file)).unwrap());
        assert!(old == new, "{file} has changed");
    }
    let metrics: Value = serde_json::from_slice(&fs::read(out.join("metrics.json")).unwrap()).unwrap();
    let saved = &metrics["skipped"]["work"]["finished_training"]["seconds"];
    assert!(saved.as_f64().is_some_and(|s| s > 0.0));
    assert_eq!(*saved, metrics["train_seconds"]);
}

#[test]
fn a_space_of_features_is_the_same_without_the_other() {
    let run = RunFolder::open(run()).unwrap();
    let (scene, config) = (Scene::open(scene()).unwrap(), run.config().unwrap());
    let trained = run.trained().unwrap();
    let both = pipeline::features(&run, &trained).unwrap().unwrap();
    let bare = map::build(&scene, &trained, &config, &mut |_| {}).unwrap();
    let with = |fields: &SemanticFields| {
        let mut map = bare.clone();
        annotate(&mut map, &scene, &trained, fields, &config.semantics).unwrap();
        map
    };
    let all = with(&both);
    assert!(!all.saved.contains_key("feature_spaces"));
    for space in 0..2 {
        let mut one = both.clone();
        one.spaces[1 - space] = None;
        let map = with(&one);
        let vertices = bare.geometries.iter().chain([&bare.points]).map(|g| g.positions.len() as u64);
        assert_eq!(map.saved["feature_spaces"].samples, vertices.sum::<u64>());
        for (found, all) in map.geometries.iter().zip(&all.geometries) {
            assert_eq!(found.features.len(), 1);
            assert!(all.features.contains(&found.features[0]), "{}", found.name);
            assert!(found.attributes.iter().all(|a| all.attributes.contains(a)), "{}", found.name);
        }
    }
}

#[test]
fn an_export_of_one_format_says_what_the_others_would_have_taken() {
    let run = RunFolder::open(run()).unwrap();
    let (scene, config) = (Scene::open(scene()).unwrap(), run.config().unwrap());
    let (trained, out) = (run.trained().unwrap(), folder("one-format"));
    let mut cost = Cost::default();
    pipeline::export_map(&scene, &trained, None, &config, &out, &[map::Format::Ply], &mut cost, &mut ())
        .unwrap()
        .unwrap();
    assert!(cost.saved["formats"].bytes > 0 && cost.saved["empty_blocks"].voxels > 0);
}
