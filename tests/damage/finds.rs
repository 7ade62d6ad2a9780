//! Damage that once got through, by name.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use crate::scenes;
use crate::subject::{self, Outcome, Subject};
use crate::trial::{alone, outcome};

/// The message with which a subject's reader refuses a folder that `break_it` has changed.
fn refused(subject: &Subject, break_it: impl FnOnce(&Path)) -> String {
    let _alone = alone();
    let folder = tempfile::tempdir().unwrap();
    (subject.make)(folder.path());
    break_it(folder.path());
    let size = fs::metadata(folder.path().join(&subject.file)).unwrap().len() as usize;
    let outcome: Outcome = outcome(subject, folder.path(), size).unwrap();
    outcome.expect_err("damage must be refused")
}

/// Changes a field of the JSON header of a checkpoint.
fn edit_header(run: &Path, change: impl FnOnce(&mut Value)) {
    let path = run.join("checkpoint/field.safetensors");
    let bytes = fs::read(&path).unwrap();
    let (length, rest) = bytes.split_first_chunk::<8>().unwrap();
    let (head, data) = rest.split_at(u64::from_le_bytes(*length) as usize);
    let mut head: Value = serde_json::from_slice(head).unwrap();
    let mut own: Value = serde_json::from_str(head["__metadata__"]["divff"].as_str().unwrap()).unwrap();
    change(&mut own);
    head["__metadata__"]["divff"] = json!(own.to_string());
    let mut head = head.to_string().into_bytes();
    head.resize(head.len().next_multiple_of(8), b' ');
    fs::write(&path, [&(head.len() as u64).to_le_bytes()[..], &head, data].concat()).unwrap();
}

fn checkpoint() -> Subject {
    Subject::new("checkpoint/field.safetensors", scenes::run, subject::checkpoint)
}

#[test]
fn density_grids_larger_than_their_checkpoint() {
    let message = refused(&checkpoint(), |run| edit_header(run, |h| h["grid_cells"] = json!(1024.0)));
    assert!(message.contains("shorter"), "{message}");
}

#[test]
fn poses_of_stereo_that_are_not_as_many_as_the_frames() {
    let message =
        refused(&checkpoint(), |run| edit_header(run, |h| h["progress"]["stereo_from"] = json!([0.0])));
    assert!(message.contains("stereo"), "{message}");
}

#[test]
fn a_checkpoint_whose_settings_are_out_of_range_is_named() {
    refused(&checkpoint(), |run| {
        edit_header(run, |h| h["shape"]["config"]["persistent"]["levels"] = json!(99))
    });
}

#[test]
fn a_box_without_size() {
    for scale in [0.0, -1.0] {
        let change = |h: &mut Value| h["shape"]["normalisation"]["scale"] = json!(scale);
        refused(&checkpoint(), |run| edit_header(run, change));
    }
}

/// Headers promise 96 million pixels; the files could not hold them.
#[test]
fn pictures_that_promise_more_than_they_can_hold() {
    let size = |list: &Path| {
        let path = list.join("transforms.json");
        let mut value: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        (value["w"], value["h"]) = (json!(12_000), json!(8_000));
        fs::write(&path, value.to_string()).unwrap();
    };
    let png = Subject::new("images/frame_000000.png", scenes::nerfstudio, subject::pixels);
    let message = refused(&png, |folder| {
        size(folder);
        patch(&folder.join(&png.file), 16, &[12_000u32, 8_000].map(u32::to_be_bytes).concat());
    });
    assert!(message.contains("frame_000000.png"), "{message}");
    let hotspot = Subject::new("hotspots/frame_000000.png", scenes::nerfstudio, subject::features);
    let message = refused(&hotspot, |folder| {
        patch(&folder.join(&hotspot.file), 16, &[12_000u32, 8_000].map(u32::to_be_bytes).concat());
    });
    assert!(message.contains("hotspot"), "{message}");
}

/// Overwrites bytes of a PNG and puts the checksum of its first chunk right.
fn patch(path: &Path, at: usize, new: &[u8]) {
    let mut bytes = fs::read(path).unwrap();
    bytes[at..at + new.len()].copy_from_slice(new);
    let sum = crate::support::crc32(bytes[12..29].iter().copied()).to_be_bytes();
    bytes[29..33].copy_from_slice(&sum);
    fs::write(path, bytes).unwrap();
}

#[test]
fn times_whose_difference_is_infinite() {
    let list = Subject::new("transforms.json", scenes::nerfstudio, subject::scene);
    let message = refused(&list, |folder| {
        let path = folder.join("transforms.json");
        let mut value: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        (value["frames"][0]["time"], value["frames"][2]["time"]) = (json!(-1.7e308), json!(1.7e308));
        fs::write(&path, value.to_string()).unwrap();
    });
    assert!(message.contains("time"), "{message}");
}
