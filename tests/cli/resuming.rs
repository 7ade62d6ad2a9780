//! Stopping, going on, and what a folder with a run in it refuses.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use divff::config::Config;
use divff::map::Format;
use divff::pipeline::{self, Cost, Event, Observer, RunFolder};
use divff::scene::Scene;

use crate::kit::{TINY, arg, assert_same_files, divff, files, folder, run, scene, tiny};

/// Stops training after some reports.
struct Impatient {
    patience: usize,
}

impl Observer for Impatient {
    fn event(&mut self, event: &Event) {
        self.patience -= usize::from(matches!(event, Event::Training(_)));
    }

    fn stop(&self) -> bool {
        self.patience == 0
    }
}

#[test]
fn a_stopped_run_that_goes_on_gives_the_bytes_of_an_uninterrupted_one() {
    let out = folder("stopped");
    let scene = Scene::open(scene()).unwrap();
    let config = Config::default().overlaid(TINY, "TINY").unwrap();
    let stopped = RunFolder::new(&out);
    // Once while what stays is trained alone, and once when all streams are.
    for (patience, step) in [(1, 50), (5, 300)] {
        let observer = &mut Impatient { patience };
        let session = pipeline::train(&scene, &config, &stopped, false, observer).unwrap();
        let progress = &session.trained().progress;
        assert_eq!((progress.step, progress.finished), (step, false));
    }
    let session = pipeline::train(&scene, &config, &stopped, false, &mut ()).unwrap();
    let progress = &session.trained().progress;
    assert_eq!((progress.step, progress.finished), (400, true));
    // Features from the checkpoint, as after a stop between the two.
    drop(session);
    let session = pipeline::train(&scene, &config, &stopped, false, &mut ()).unwrap();
    let cost = &mut Cost::default();
    let map = stopped.map();
    let (fields, trained) =
        pipeline::train_features(&scene, session, &config, &stopped, &mut ()).unwrap().unwrap();
    pipeline::export_map(&scene, &trained, Some(&fields), &config, &map, &Format::ALL, cost, &mut ())
        .unwrap()
        .unwrap();
    assert_same_files(&map, &run().join("map"));
    let log = fs::read_to_string(stopped.log_path()).unwrap();
    assert_eq!(log.lines().count(), 8, "{log}");
}

#[cfg(unix)]
#[test]
fn ctrl_c_stops_with_a_checkpoint_and_the_same_command_goes_on() {
    let out = folder("interrupted");
    let settings = ["--config", arg(tiny()), "--set", "train.steps=1000000"];
    for word in ["training", "going on after step"] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_divff"))
            .args(["train", arg(scene()), "--out", arg(&out)])
            .args(settings)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = log_lines(&out);
        wait_until(|| log_lines(&out) > lines);
        let pid = child.id().to_string();
        assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
        wait_until(|| child.try_wait().unwrap().is_some());
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(word) && said.contains("error: stopped after"), "{said}");
        assert!(out.join("checkpoint/field.safetensors").is_file());
    }
    let said = divff(&["inspect", arg(&out)]).ok();
    assert!(said.contains("not finished"), "{said}");
    divff(&["train", arg(scene()), "--out", arg(&out), "--config", arg(tiny())])
        .fails(2, &["train.steps is 1000000 there and 400 now", "--fresh"]);
    divff(&["train", arg(scene()), "--out", arg(&out), "--config", arg(tiny()), "--fresh"]).ok();
    assert_eq!(log_lines(&out), 8, "what was there is gone");
}

#[test]
fn a_run_of_another_scene_is_refused() {
    let out = folder("other-scene");
    let other = out.join("scene");
    divff(&[
        "synth",
        "--out",
        arg(&other),
        "--frames",
        "16",
        "--width",
        "48",
        "--height",
        "28",
        "--seed",
        "9",
    ])
    .ok();
    let before = files(run());
    divff(&["train", arg(&other), "--out", arg(run()), "--config", arg(tiny())])
        .fails(2, &["another scene", "--out", "--fresh"]);
    divff(&["eval", arg(run()), "--scene", arg(&other), "--out", arg(&out.join("m.json"))])
        .fails(2, &["is not the scene", "--scene"]);
    assert_eq!(files(run()), before);
}

#[test]
fn a_moved_scene_is_found_again_with_an_option() {
    let out = folder("moved");
    let (here, there, run) = (out.join("here"), out.join("there"), out.join("run"));
    crate::kit::copy(scene(), &here);
    divff(&["train", arg(&here), "--out", arg(&run), "--config", arg(tiny())]).ok();
    fs::rename(&here, &there).unwrap();
    let views = out.join("views");
    divff(&["render", arg(&run), "--frame", "4", "--out", arg(&views)])
        .fails(2, &["not there any more", "--scene"]);
    divff(&["render", arg(&run), "--frame", "4", "--out", arg(&views), "--scene", arg(&there)]).ok();
}

fn log_lines(run: &Path) -> usize {
    fs::read_to_string(run.join("log.jsonl")).map_or(0, |text| text.lines().count())
}

fn wait_until(mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(120), "nothing happened for two minutes");
        std::thread::sleep(Duration::from_millis(20));
    }
}
