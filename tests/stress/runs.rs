//! Whole runs on scenes that nobody would film: a map of finite numbers, or an error that says what is wrong.

use std::fs;
use std::path::Path;

use divff::config::Config;
use divff::pipeline::{self, Outcome, RunFolder, RunOptions};
use divff::scene::Scene;
use divff_exporters::{Manifest, read_ply};
use serde_json::{Value, json};

use crate::scenes::{filmed, move_all, move_cameras, paint, quick};

/// Runs a scene from pictures to report. Its numbers are finite, or the error's message is returned.
fn run(scene: &Path, change: impl FnOnce(&mut Config)) -> Result<(), String> {
    let out = tempfile::tempdir().unwrap();
    let scene = Scene::open(scene).map_err(|e| e.to_string())?;
    let mut config = quick(&scene);
    change(&mut config);
    let done = pipeline::run(&scene, &config, out.path(), &RunOptions::default(), &mut ());
    let Outcome::Finished(metrics) = done.map_err(|e| e.to_string())? else {
        panic!("nobody said stop");
    };
    // JSON makes null of a measure that is not finite; those that are not known are left out.
    let measures = serde_json::to_string(&metrics).unwrap();
    assert!(!measures.contains("null"), "{measures}");
    let folder = RunFolder::new(out.path());
    folder.trained().expect("the numbers of the field are finite");
    let map = folder.map();
    let manifest = Manifest::read(&map).unwrap();
    manifest.verify(&map).unwrap();
    for file in manifest.files.iter().filter(|f| f.path.ends_with(".ply")) {
        let geometry = read_ply(&map.join(&file.path)).unwrap();
        let numbers = geometry.positions.as_flattened().iter().chain(geometry.normals.as_flattened());
        assert!(numbers.into_iter().all(|v| v.is_finite()), "{}", file.path);
        assert_near_the_box(&scene, &geometry.positions, geometry.offset);
    }
    Ok(())
}

/// A map lies where its scene is, to a tenth of its size.
fn assert_near_the_box(scene: &Scene, positions: &[[f32; 3]], offset: [f64; 3]) {
    let margin = 0.1 * (scene.bounds.max - scene.bounds.min).max_element();
    for p in positions {
        for axis in 0..3 {
            let x = f64::from(p[axis]) + offset[axis];
            let inside = scene.bounds.min[axis] - margin..=scene.bounds.max[axis] + margin;
            assert!(inside.contains(&x), "{p:?} + {offset:?} is not in {:?}", scene.bounds);
        }
    }
}

/// Runs the kitchen with its list changed.
fn run_edited(edit: impl FnOnce(&mut Value)) -> Result<(), String> {
    run(filmed(edit).path(), |_| ())
}

fn keep_frames(list: &mut Value, keep: usize) {
    list["frames"].as_array_mut().unwrap().truncate(keep);
    for key in ["train_filenames", "test_filenames", "val_filenames"] {
        list.as_object_mut().unwrap().remove(key);
    }
}

#[test]
fn one_frame_and_two() {
    run_edited(|list| keep_frames(list, 1)).unwrap();
    run_edited(|list| keep_frames(list, 2)).unwrap();
}

#[test]
fn identical_cameras_and_cameras_on_one_spot() {
    run_edited(|list| {
        let pose = list["frames"][0]["transform_matrix"].clone();
        for frame in list["frames"].as_array_mut().unwrap() {
            frame["transform_matrix"] = pose.clone();
        }
    })
    .unwrap();
    let spot = [1.0, 1.2, 1.1];
    run_edited(|list| move_cameras(list, |_, axis, x| *x = spot[axis])).unwrap();
}

#[test]
fn cameras_outside_the_box_and_inside_its_walls() {
    run_edited(|list| {
        move_cameras(list, |n, axis, x| *x += if n % 2 == 0 && axis == 0 { -3.0 } else { 0.0 })
    })
    .unwrap();
    let walls =
        |list: &Value, corner: usize| [0, 1, 2].map(|axis| list["aabb"][corner][axis].as_f64().unwrap());
    for corner in [0, 1] {
        let done = run_edited(|list| {
            let wall = walls(list, corner);
            move_cameras(list, |n, axis, x| *x = if axis == n % 3 { wall[axis] } else { *x });
        });
        done.unwrap();
    }
}

#[test]
fn cameras_that_see_nothing_of_the_box_are_told() {
    let behind = |list: &mut Value, frames: std::ops::Range<usize>| {
        for n in frames {
            // Far away, looking along the world's +x, which is away from the box.
            list["frames"][n]["transform_matrix"] =
                json!([[0, 0, -1, 100], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]);
        }
    };
    let message = run_edited(|list| behind(list, 0..8)).unwrap_err();
    assert!(message.contains("no camera sees the box"), "{message}");
    run_edited(|list| behind(list, 0..7)).unwrap();
}

#[test]
fn a_scene_a_thousand_kilometres_from_the_origin() {
    run_edited(|list| move_all(list, |axis, x| *x += [1e6, -1e6, 1e6][axis])).unwrap();
}

#[test]
fn scenes_of_a_millimetre_and_of_ten_kilometres() {
    for scale in [2e-4, 2e3] {
        run_edited(|list| move_all(list, |_, x| *x *= scale)).unwrap();
    }
}

#[test]
fn a_box_a_million_times_as_long_as_it_is_high() {
    run_edited(|list| {
        let height = list["aabb"][0][2].as_f64().unwrap() + 1.2;
        list["aabb"][0][2] = json!(height);
        list["aabb"][1][2] = json!(height + 5e-6);
    })
    .unwrap();
}

#[test]
fn videos_of_one_colour() {
    for colour in [[0; 3], [255; 3], [200, 20, 90]] {
        let scene = filmed(|_| ());
        paint(scene.path(), colour);
        run(scene.path(), |_| ()).unwrap();
    }
}

#[test]
fn a_learning_rate_of_zero_ends_in_a_map_and_one_of_1e20_in_an_error() {
    let scene = filmed(|_| ());
    run(scene.path(), |config| {
        for rate in [&mut config.train.table_rate, &mut config.train.network_rate] {
            *rate = 0.0;
        }
        (config.train.pose_rate, config.train.rig_rate, config.train.exposure_rate) = (0.0, 0.0, 0.0);
    })
    .unwrap();
    let message = run(scene.path(), |config| config.train.network_rate = 1e20).unwrap_err();
    assert!(message.contains("not finite at step") && message.contains("(index "), "{message}");
}

#[test]
fn a_run_that_diverges_leaves_no_checkpoint_that_looks_good() {
    let (folder, out) = (filmed(|_| ()), tempfile::tempdir().unwrap());
    let scene = Scene::open(folder.path()).unwrap();
    let mut config = quick(&scene);
    config.train.table_rate = f32::MAX;
    let done = pipeline::run(&scene, &config, out.path(), &RunOptions::default(), &mut ());
    let message = done.unwrap_err().to_string();
    assert!(message.contains("not finite at step") && message.contains("(index "), "{message}");
    assert!(!RunFolder::new(out.path()).has_checkpoint());
    assert!(!fs::exists(out.path().join("map/manifest.json")).unwrap());
}
