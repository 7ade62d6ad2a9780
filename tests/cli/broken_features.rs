//! Features and embeddings that cannot be used: one message that says which file, frame and row and what to do, exit
//! code 2, and a run that is as good as before. What can be worked with is a warning.

use std::fs;
use std::path::{Path, PathBuf};

use divff_exporters::npy::write_npy_i32;
use divff_exporters::{read_npy, write_npy};

use crate::kit::{Done, arg, assert_same_files, copy, divff, files, folder, run, scene, tiny};

/// Gives the command of a finished run again, on a copy of its scene that `break_it` has changed; `again` are settings
/// that make it do more than it has done already.
fn run_on_broken(name: &str, again: &[&str], break_it: impl FnOnce(&Path)) -> (Done, PathBuf) {
    let folder = folder(name);
    let (broken, out) = (folder.join("scene"), folder.join("run"));
    copy(scene(), &broken);
    copy(run(), &out);
    break_it(&broken);
    let arguments = ["run", arg(&broken), "--out", arg(&out), "--config", arg(tiny())];
    (divff(&[&arguments, again].concat()), out)
}

/// Settings of other features, which are therefore trained again.
const OTHER_FEATURES: [&str; 2] = ["--set", "semantics.steps=30"];

/// As [`run_on_broken`] for what must be refused; geometry, features and map are then those of before.
fn refused(name: &str, parts: &[&str], break_it: impl FnOnce(&Path)) {
    let again: &[&str] = if parts[0].contains("clip.npy") { &[] } else { &OTHER_FEATURES };
    let (done, out) = run_on_broken(name, again, break_it);
    done.fails(2, parts);
    for part in ["checkpoint", "map", "views"] {
        assert_same_files(&out.join(part), &run().join(part));
    }
    let answer = out.with_file_name("answer");
    let intact = ["--scene", arg(scene()), "--out", arg(&answer)];
    divff(&[&["query", arg(&out), "--text", "mug"], &intact[..]].concat()).ok();
}

/// Changes the numbers of an array, whose shape stays.
fn edit(path: &Path, change: impl FnOnce(&mut [f32])) {
    let array = read_npy(path).unwrap();
    let mut values = array.to_f32();
    change(&mut values);
    write_npy(path, &array.header.shape, &values).unwrap();
}

/// Cuts the last dimension of an array down to 8 numbers.
fn narrow(path: &Path) {
    let array = read_npy(path).unwrap();
    let mut shape = array.header.shape.clone();
    let full = shape.pop().unwrap();
    let values: Vec<f32> = array.to_f32().chunks_exact(full).flat_map(|row| row[..8].to_vec()).collect();
    shape.push(8);
    write_npy(path, &shape, &values).unwrap();
}

fn cut(path: &Path) {
    let bytes = fs::read(path).unwrap();
    fs::write(path, &bytes[..bytes.len() - 40]).unwrap();
}

#[test]
fn descriptors_of_another_width_name_both_widths() {
    refused("narrow-masks", &["000002_f.npy", "8 numbers", "64", "same model"], |scene| {
        narrow(&scene.join("language_features/000002_f.npy"));
    });
    refused("narrow-video", &["000002_p.npy", "8 numbers", "64", "same model"], |scene| {
        narrow(&scene.join("video_features/000002_p.npy"));
    });
    refused("narrow-text", &["clip.npy", "8 numbers", "64"], |scene| narrow(&scene.join("text/clip.npy")));
}

#[test]
fn a_mask_without_a_descriptor_names_its_pixel() {
    refused("mask-index", &["000002_s.npy", "index 999", "row 3, column 5", "000002_f.npy"], |scene| {
        let path = scene.join("language_features/000002_s.npy");
        let array = read_npy(&path).unwrap();
        let mut index: Vec<i32> = array.to_i64().unwrap().into_iter().map(|i| i as i32).collect();
        index[3 * array.header.shape[2] + 5] = 999;
        write_npy_i32(&path, &array.header.shape, &index).unwrap();
    });
}

#[test]
fn arrays_that_were_cut_short_are_named() {
    for (name, file) in [
        ("cut-masks", "language_features/000002_f.npy"),
        ("cut-video", "video_features/000002_p.npy"),
        ("cut-parts", "dino_features/000002.npy"),
        ("cut-text", "text/clip.npy"),
    ] {
        refused(name, &[file, "bytes", "make the file again"], |scene| cut(&scene.join(file)));
    }
}

#[test]
fn an_embedding_that_points_nowhere_names_its_row() {
    refused("nan-text", &["clip.npy", "row 2", "NaN", "encode it again"], |scene| {
        edit(&scene.join("text/clip.npy"), |v| v[2 * 64 + 7] = f32::NAN);
    });
}

#[test]
fn descriptors_that_point_nowhere_are_left_out_with_a_warning() {
    let (done, again) = run_on_broken("nan-masks", &OTHER_FEATURES, |scene| {
        edit(&scene.join("language_features/000002_f.npy"), |v| v[5] = f32::NAN);
        edit(&scene.join("language_features/000006_f.npy"), |v| v[..64].fill(0.0));
    });
    for part in [
        "000002_f.npy",
        "row 0 is not finite",
        "000006_f.npy",
        "row 0 is all zeros",
        "extract the frame again",
    ] {
        assert!(done.err.contains(part), "{part}: {}", done.err);
    }
    done.ok();
    let metrics = fs::read_to_string(again.join("metrics.json")).unwrap();
    assert!(metrics.contains("feature_cosine_clip"), "{metrics}");
}

#[test]
fn a_phrase_that_nothing_knows_says_how_to_embed_it() {
    let out = folder("unknown-phrase");
    divff(&["query", arg(run()), "--text", "flying saucer", "--out", arg(&out)])
        .fails(2, &["flying saucer", "--text-embedding", "--text-encoder"]);
    assert!(files(&out).is_empty());
}

/// A folder with the scene's embeddings but for some phrases.
fn embeddings_without(name: &str, left_out: &[&str]) -> PathBuf {
    let folder = folder(name);
    fs::create_dir(folder.join("text")).unwrap();
    let list = fs::read_to_string(scene().join("text/clip.txt")).unwrap();
    let rows = read_npy(&scene().join("text/clip.npy")).unwrap().to_f32();
    let kept = list.lines().zip(rows.chunks_exact(64)).filter(|(phrase, _)| !left_out.contains(phrase));
    let (phrases, rows): (Vec<&str>, Vec<&[f32]>) = kept.unzip();
    fs::write(folder.join("text/clip.txt"), phrases.join("\n")).unwrap();
    write_npy(&folder.join("text/clip.npy"), &[rows.len(), 64], &rows.concat()).unwrap();
    folder
}

#[test]
fn canonical_phrases_that_are_missing_are_named() {
    let ask = |scene: &Path| {
        let out = scene.join("out");
        divff(&["query", arg(run()), "--scene", arg(scene), "--text", "mug", "--out", arg(&out)])
    };
    let all = ["object", "thing", "stuff", "texture", "hands"];
    ask(&embeddings_without("no-canonical", &all)).fails(2, &["no canonical phrases", "stuff"]);
    let one = ask(&embeddings_without("one-canonical", &["stuff"]));
    assert!(one.err.contains("canonical") && one.err.contains("stuff"), "{}", one.err);
    one.ok();
}

#[test]
fn embeddings_that_are_given_must_fit() {
    let out = folder("given");
    let (file, answer) = (out.join("mug.npy"), out.join("answer"));
    let ask = || {
        let given = ["--text", "mug", "--text-embedding", arg(&file), "--out", arg(&answer)];
        divff(&[&["query", arg(run())], &given[..]].concat())
    };
    write_npy(&file, &[8], &[1.0; 8]).unwrap();
    ask().fails(2, &["8", "64"]);
    write_npy(&file, &[2, 64], &[1.0; 128]).unwrap();
    ask().fails(2, &["mug.npy", "2 embeddings for 1 phrases"]);
    write_npy(&file, &[64], &[0.0; 64]).unwrap();
    ask().fails(2, &["mug.npy", "row 0", "all zeros"]);
    cut(&file);
    ask().fails(2, &["mug.npy"]);
    assert!(!answer.exists());
    write_npy(&file, &[64], &read_npy(&scene().join("text/clip.npy")).unwrap().to_f32()[..64]).unwrap();
    ask().ok();
}
