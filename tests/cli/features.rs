//! Features from the synthetic scene to answers.

use std::fs;
use std::path::Path;

use divff::scene::Scene;
use divff::scene::features::{FeatureStore, Space};
use divff_exporters::{Geometry, read_glb, read_ply};
use serde_json::Value;

use crate::kit::{Done, arg, assert_same_files, copy, divff, folder, run, scene};

fn ask(map: &Path, out: &Path, more: &[&str]) -> Done {
    divff(&[&["query", arg(map), "--text", "mug", "--out", arg(out)], more].concat())
}

fn has_scores(geometry: &Geometry) -> bool {
    geometry.attributes.iter().any(|a| a.name == "relevancy_mug")
}

#[test]
fn a_synthetic_scene_has_all_features_and_nothing_is_wrong_with_them() {
    let scene = Scene::open(scene()).unwrap();
    let store = FeatureStore::open(&scene).unwrap();
    let summary = store.summary(&scene.frames, true);
    assert_eq!((summary.problems.len(), summary.warnings.len()), (0, 0), "{summary:?}");
    assert_eq!((store.language_dim(), store.video_dim(), store.dino_dim()), (Some(64), Some(64), Some(16)));
    for space in Space::ALL {
        let text = store.text(space).unwrap().unwrap();
        assert!(space.canonical_phrases().iter().all(|p| text.find(p).is_some()));
    }
}

#[test]
fn a_run_measures_its_features() {
    let metrics: Value = serde_json::from_slice(&fs::read(run().join("metrics.json")).unwrap()).unwrap();
    for key in ["feature_cosine_clip", "feature_cosine_egovideo"] {
        assert!(metrics[key].as_f64().is_some_and(|c| c > 0.5), "{key}: {metrics}");
    }
}

#[test]
fn a_map_file_is_asked_with_the_embeddings_of_the_run_that_it_lies_in() {
    let out = folder("query-file");
    let map = run().join("map");
    ask(&map.join("persistent.ply"), &out.join("found"), &[]).ok();
    ask(&map.join("persistent.ply"), &out.join("named"), &["--scene", arg(scene())]).ok();
    assert_same_files(&out.join("found"), &out.join("named"));
    assert!(has_scores(&read_ply(&out.join("found/persistent.ply")).unwrap()));
    ask(&map.join("persistent.glb"), &out.join("glb"), &[]).ok();
    assert!(has_scores(&read_glb(&out.join("glb/persistent.glb")).unwrap().geometries[0]));
}

#[test]
fn a_map_file_that_was_moved_takes_the_embeddings_beside_it_or_says_what_is_missing() {
    let out = folder("query-moved");
    let map = out.join("map");
    copy(&run().join("map"), &map);
    let file = map.join("persistent.ply");
    ask(&file, &out.join("answer"), &[]).fails(2, &["persistent.ply", "no embeddings", "--scene", "text/"]);
    assert!(!out.join("answer").exists());
    copy(&scene().join("text"), &map.join("text"));
    ask(&file, &out.join("answer"), &[]).ok();
    assert!(has_scores(&read_ply(&out.join("answer/persistent.ply")).unwrap()));
}
