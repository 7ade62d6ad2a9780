//! Bad input and bad luck: the exit code, the one message, and nothing half-written.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::{Value, json};

use crate::kit::{Done, arg, copy, divff, files, finish, folder, run, scene, tiny};

/// Trains on a copy of the scene that `break_it` has changed; the run's folder must then hold no result.
fn train_on_broken(name: &str, break_it: impl FnOnce(&Path)) -> Done {
    let folder = folder(name);
    let (broken, out) = (folder.join("scene"), folder.join("run"));
    copy(scene(), &broken);
    break_it(&broken);
    let done = divff(&["train", arg(&broken), "--out", arg(&out), "--config", arg(tiny())]);
    assert_eq!(files(&out), Vec::<String>::new(), "nothing is left of a run that could not start");
    done
}

/// Changes the list of frames.
fn edit(scene: &Path, change: impl FnOnce(&mut Value)) {
    let path = scene.join("transforms.json");
    let mut list: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut list);
    fs::write(&path, serde_json::to_vec(&list).unwrap()).unwrap();
}

#[test]
fn a_missing_scene_is_named() {
    let out = folder("missing-scene");
    let nowhere = out.join("nowhere");
    divff(&["run", arg(&nowhere), "--out", arg(&out.join("run"))])
        .fails(2, &[arg(&nowhere), "check the path"]);
    divff(&["inspect", arg(&nowhere)]).fails(2, &[arg(&nowhere)]);
    assert!(files(&out).is_empty());
}

#[test]
fn a_truncated_image_names_its_frame() {
    train_on_broken("truncated", |scene| {
        let path = scene.join("images/000003.png");
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    })
    .fails(2, &["000003.png", "frame"]);
}

#[test]
fn a_missing_frame_names_the_file_and_the_list() {
    train_on_broken("missing-frame", |scene| fs::remove_file(scene.join("images/000003.png")).unwrap())
        .fails(2, &["000003.png", "transforms.json", "does not exist"]);
}

#[test]
fn impossible_poses_name_their_frame() {
    train_on_broken("nan-pose", |scene| {
        edit(scene, |v| v["frames"][3]["transform_matrix"][0][3] = json!("HERE"));
        let path = scene.join("transforms.json");
        let text = fs::read_to_string(&path).unwrap().replace("\"HERE\"", "NaN");
        fs::write(&path, text).unwrap();
    })
    .fails(2, &["000003", "NaN"]);
    train_on_broken("singular-pose", |scene| {
        edit(scene, |v| {
            for row in 0..3 {
                for column in 0..3 {
                    v["frames"][3]["transform_matrix"][row][column] = json!(0.0);
                }
            }
        });
    })
    .fails(2, &["000003", "pose is singular"]);
}

#[test]
fn a_mask_of_another_size_names_both_sizes() {
    train_on_broken("mask", |scene| {
        image::GrayImage::from_pixel(8, 8, image::Luma([255])).save(scene.join("mask.png")).unwrap();
        edit(scene, |v| v["frames"][3]["mask_path"] = json!("mask.png"));
    })
    .fails(2, &["mask.png", "000003", "48", "8"]);
}

#[test]
fn a_scene_that_leaves_nothing_to_train_on_is_refused() {
    train_on_broken("no-train", |scene| edit(scene, |v| v["train_filenames"] = json!([])))
        .fails(2, &["transforms.json", "no frame is left to train on"]);
    train_on_broken("empty-masks", |scene| {
        image::GrayImage::new(48, 28).save(scene.join("mask.png")).unwrap();
        edit(scene, |v| {
            for frame in v["frames"].as_array_mut().unwrap() {
                frame["mask_path"] = json!("mask.png");
            }
        });
    })
    .fails(2, &["mask", "empty"]);
}

#[test]
fn settings_that_do_not_exist_or_cannot_be_name_their_key() {
    let out = folder("settings-broken");
    let file = out.join("c.toml");
    let train = |extra: &[&str]| {
        let run = out.join("run");
        let mut arguments = vec!["train", arg(scene()), "--out", arg(&run)];
        arguments.extend(extra);
        let done = divff(&arguments);
        assert!(!run.exists(), "settings are checked before anything is made");
        done
    };
    train(&["--set", "train.stepz=5"]).fails(2, &["--set train.stepz=5", "stepz"]);
    train(&["--set", "train.steps=0"]).fails(2, &["train.steps", "at least 1"]);
    train(&["--set", "train.steps"]).fails(2, &["--set train.steps", "="]);
    train(&["--config", arg(&out.join("none.toml"))]).fails(2, &["none.toml"]);
    fs::write(&file, "[train]\nstepz = 5\n").unwrap();
    assert_eq!(train(&["--config", arg(&file)]).code, Some(2));
    fs::write(&file, "train = [").unwrap();
    assert_eq!(train(&["--config", arg(&file)]).code, Some(2));
    train(&["--time-budget", "5 bananas"]).usage("bananas");
    train(&["--preset", "fast"]).usage("fast");
}

#[test]
fn what_is_not_a_run_is_refused() {
    let out = folder("not-a-run");
    for command in ["export", "render"] {
        divff(&[command, arg(scene()), "--out", arg(&out)]).fails(2, &["run.json", "divff run"]);
    }
    divff(&["eval", arg(&out.join("nowhere"))]).fails(2, &["nowhere", "does not exist"]);
    let damaged = out.join("damaged");
    copy(run(), &damaged);
    let field = damaged.join("checkpoint/field.safetensors");
    let bytes = fs::read(&field).unwrap();
    fs::write(&field, &bytes[..bytes.len() / 2]).unwrap();
    divff(&["eval", arg(&damaged)]).fails(2, &["field.safetensors"]);
    fs::write(damaged.join("run.json"), "{").unwrap();
    divff(&["eval", arg(&damaged)]).fails(2, &["run.json"]);
}

/// A path below a regular file: not even root can write there.
#[test]
fn an_unwritable_folder_is_noticed_before_the_work() {
    let folder = folder("unwritable");
    fs::write(folder.join("file"), "in the way").unwrap();
    let out: PathBuf = folder.join("file/run");
    divff(&["run", arg(scene()), "--out", arg(&out)]).fails(1, &[arg(&out), "cannot be written to", "--out"]);
    divff(&["render", arg(run()), "--out", arg(&out)]).fails(1, &[arg(&out), "--out"]);
    divff(&["export", arg(run()), "--out", arg(&out)]).fails(1, &[arg(&out), "--out"]);
    divff(&["synth", "--out", arg(&out)]).fails(1, &["file"]);
    assert_eq!(fs::read_to_string(folder.join("file")).unwrap(), "in the way");
}

/// A limit on the size of files stands in for a full disk: the write fails in the same place.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_nothing_under_a_final_name() {
    let out = folder("full");
    let limited = |blocks: &str, arguments: &[&str]| {
        let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$@\"");
        finish(
            Command::new("bash").args(["-c", &script, "bash", env!("CARGO_BIN_EXE_divff")]).args(arguments),
        )
    };
    let run_folder = out.join("run");
    limited("8", &["run", arg(scene()), "--out", arg(&run_folder), "--config", arg(tiny())])
        .fails(1, &["field.safetensors", "make room"]);
    let left = files(&run_folder);
    assert!(!left.iter().any(|n| n.contains("field.safetensors") || n.ends_with(".tmp")), "{left:?}");

    let map = out.join("map");
    limited("8", &["export", arg(run()), "--out", arg(&map)]).fails(1, &["map", "make room"]);
    let left = files(&map);
    assert!(!left.iter().any(|n| n == "manifest.json" || n.ends_with(".tmp")), "{left:?}");
}

#[test]
fn synth_never_writes_into_a_folder_that_is_in_use() {
    let out = folder("in-use");
    fs::write(out.join("mine.txt"), "keep").unwrap();
    divff(&["synth", "--out", arg(&out)]).fails(2, &["not empty"]);
    assert_eq!(files(&out), ["mine.txt"]);
    divff(&["synth", "--out", arg(&out.join("new")), "--frames", "2"]).fails(2, &["frames is 2", "8"]);
}

#[test]
fn unknown_commands_are_bad_usage() {
    divff(&["frobnicate"]).usage("frobnicate");
    for not_yet in ["query", "compare", "bench"] {
        divff(&[not_yet]).usage(not_yet);
    }
}
