//! `kill -9` at any moment: what is under a final name is whole, and the same command ends at the bytes of a run that
//! was left alone. `DIVFF_KILLS` says how often (20 unless set; half of them training, half exporting).
#![cfg(unix)]

#[allow(dead_code)]
#[path = "cli/kit.rs"]
mod kit;
#[allow(dead_code)]
#[path = "../src/rng.rs"]
mod rng;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use divff::pipeline::RunFolder;
use divff::semantics::SemanticFields;
use divff::train::{Progress, Trained};
use divff_exporters::Manifest;
use safetensors::SafeTensors;
use serde_json::Value;

use crate::kit::{arg, files, folder, scene, tiny};
use crate::rng::Rng;

/// A run of a second that passes through all that training does, with a checkpoint after every step.
const QUICK: [&str; 10] = [
    "--set",
    "train.steps=40",
    "--set",
    "train.rays=256",
    "--set",
    "train.checkpoint_seconds=0",
    "--set",
    "semantics.steps=20",
    "--set",
    "semantics.cached_rays=2000",
];

fn kills() -> usize {
    let asked = std::env::var("DIVFF_KILLS").ok();
    let count: usize = asked.map_or(20_usize, |n| n.parse().expect("DIVFF_KILLS is a number"));
    count.div_ceil(2)
}

fn spawn(arguments: &[String]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_divff"));
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().expect("the program starts")
}

/// Lets a command run to its good end; how long it took.
fn finish(arguments: &[String]) -> Duration {
    let start = Instant::now();
    kit::divff(&arguments.iter().map(String::as_str).collect::<Vec<_>>()).ok();
    start.elapsed()
}

/// Ends the child by `kill -9` after `delay`; false if it had come to its good end by then.
fn kill_after(mut child: Child, delay: Duration) -> bool {
    let start = Instant::now();
    while start.elapsed() < delay {
        if let Some(status) = child.try_wait().expect("the child is ours") {
            assert!(status.success(), "the command failed by itself: {status}");
            return false;
        }
        std::thread::sleep(Duration::from_millis(1).min(delay));
    }
    child.kill().expect("the child is ours");
    let status = child.wait().expect("the child is ours");
    assert!(status.success() || status.code().is_none(), "the command failed by itself: {status}");
    !status.success()
}

fn train(out: &Path) -> Vec<String> {
    let common = ["train", arg(scene()), "--out", arg(out), "--config", arg(tiny()), "--threads", "2"];
    common.into_iter().chain(QUICK).map(str::to_owned).collect()
}

/// A run that was left alone, made once, and how long it took.
fn undisturbed() -> &'static (PathBuf, Duration) {
    static RUN: OnceLock<(PathBuf, Duration)> = OnceLock::new();
    RUN.get_or_init(|| {
        let out = folder("kill-undisturbed");
        let took = finish(&train(&out));
        (out, took)
    })
}

/// Final names: what a killed writer leaves beside them begins with a dot.
fn finals(folder: &Path) -> Vec<String> {
    let hidden = |name: &String| name.rsplit('/').next().is_some_and(|n| n.starts_with('.'));
    files(folder).into_iter().filter(|name| !hidden(name)).collect()
}

/// Checks that every file of a run is complete, whatever was being written.
fn assert_whole(run: &Path) {
    let record = RunFolder::new(run);
    for name in finals(run) {
        match name.as_str() {
            "run.json" => drop(record.record().unwrap()),
            "config.toml" => drop(record.config().unwrap()),
            "checkpoint/field.safetensors" => drop(Trained::resume(run).unwrap()),
            "checkpoint/features.safetensors" => drop(SemanticFields::load(run).unwrap()),
            "log.jsonl" => {
                let text = std::fs::read_to_string(run.join(&name)).unwrap();
                // Lines are added one by one; only the last can be cut short.
                let (whole, _) = text.rsplit_once('\n').unwrap_or_default();
                let is_report = |line: &str| serde_json::from_str::<Progress>(line).is_ok();
                assert!(whole.lines().all(is_report), "{text}");
            }
            other => panic!("nobody knows what {other} is"),
        }
    }
}

/// Name, bytes and header of all that a file of tensors holds, but for the clock.
fn tensors(path: &Path) -> (Vec<(String, Vec<u8>)>, Value) {
    let bytes = std::fs::read(path).unwrap();
    let (_, metadata) = SafeTensors::read_metadata(&bytes).unwrap();
    let header = &metadata.metadata().as_ref().expect("there is a header")["divff"];
    let mut header: Value = serde_json::from_str(header).unwrap();
    for clock in ["/seconds", "/progress/seconds"] {
        if let Some(seconds) = header.pointer_mut(clock) {
            *seconds = Value::Null;
        }
    }
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let mut all: Vec<_> = tensors.iter().map(|(name, t)| (name.to_owned(), t.data().to_vec())).collect();
    all.sort();
    (all, header)
}

#[test]
fn killed_training_goes_on_to_the_bytes_of_an_undisturbed_run() {
    let (reference, took) = undisturbed();
    let out = folder("kill-train");
    let mut rng = Rng::new(1, 0, 0);
    let (mut killed, mut finished) = (0, 0);
    while killed < kills() || finished == 0 {
        // After the last kill it is left alone.
        let delay = if killed < kills() { took.mul_f32(rng.uniform()) } else { Duration::MAX };
        if kill_after(spawn(&train(&out)), delay) {
            killed += 1;
            assert_whole(&out);
            continue;
        }
        for name in ["field", "features"] {
            let [a, b] =
                [&out, reference].map(|run| tensors(&run.join(format!("checkpoint/{name}.safetensors"))));
            assert_eq!(a.1, b.1, "the header of {name} after {killed} kills");
            assert!(a.0 == b.0, "{name} differs after {killed} kills");
        }
        assert_eq!(files(&out), finals(reference), "what the kills left over is gone");
        finished += 1;
        std::fs::remove_dir_all(&out).unwrap();
    }
}

#[test]
fn a_killed_export_leaves_old_and_new_files_and_the_next_one_is_complete() {
    let run = kit::run();
    let base = folder("kill-export");
    let export = |out: &Path, voxel: &str| {
        ["export", arg(run), "--out", arg(out), "--voxel", voxel].map(str::to_owned).to_vec()
    };
    // Two maps of one run, so that a new file can be told from an old one.
    let voxels = ["0.1", "0.13"];
    let references = ["a", "b"].map(|name| base.join(name));
    let took = references.iter().zip(voxels).map(|(out, voxel)| finish(&export(out, voxel))).max().unwrap();
    let out = base.join("map");
    let manifest = out.join("manifest.json");
    let mut rng = Rng::new(2, 0, 0);
    for kill in 0..kills() {
        let arguments = export(&out, voxels[kill % 2]);
        let mut child = spawn(&arguments);
        let delay = if kill % 2 == 0 || !manifest.exists() {
            took.mul_f32(rng.uniform())
        } else {
            // Writing takes a small part of the time; it begins when the old manifest goes.
            while manifest.exists() && child.try_wait().unwrap().is_none() {
                std::thread::sleep(Duration::from_micros(200));
            }
            Duration::from_secs_f32(0.05 * rng.uniform())
        };
        kill_after(child, delay);
        assert_old_or_new(&out, &references);
        if kill % 2 == 1 {
            finish(&arguments);
        }
    }
    finish(&export(&out, voxels[0]));
    assert_eq!(files(&out), finals(&references[0]), "what the kills left over is gone");
    assert_old_or_new(&out, &references[..1]);
}

/// Checks that every file of a map is one of the references' files of that name, and that a manifest tells the truth.
fn assert_old_or_new(map: &Path, references: &[PathBuf]) {
    for name in finals(map) {
        let bytes = std::fs::read(map.join(&name)).unwrap();
        let known = references.iter().any(|r| std::fs::read(r.join(&name)).is_ok_and(|whole| whole == bytes));
        assert!(known, "{name} is neither the old file nor the new one ({} bytes)", bytes.len());
    }
    if map.join("manifest.json").exists() {
        Manifest::read(map).unwrap().verify(map).unwrap();
    }
}
