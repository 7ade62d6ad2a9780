//! What the commands make.

use std::fs;
use std::process::{Command, Stdio};

use divff_exporters::{ExrSamples, Manifest, read_exr, read_ply};
use serde_json::Value;

use crate::kit::{arg, assert_same_files, divff, files, folder, run, scene, tiny};

fn json(path: &std::path::Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn a_run_makes_every_file_of_the_contract() {
    let names = files(run());
    for name in [
        "config.toml",
        "run.json",
        "log.jsonl",
        "metrics.json",
        "report.html",
        "checkpoint/field.safetensors",
        "map/manifest.json",
        "map/persistent.ply",
        "map/persistent.glb",
        "map/scene.glb",
        "map/points.ply",
        "map/points.npz",
        "views/000004.png",
        "views/000004.exr",
        "views/000012.png",
    ] {
        assert!(names.iter().any(|n| n == name), "{name} is missing: {names:?}");
    }
    assert!(!names.iter().any(|n| n.ends_with(".tmp")), "{names:?}");
    Manifest::read(&run().join("map")).unwrap().verify(&run().join("map")).unwrap();
}

#[test]
fn metrics_have_the_names_of_the_contract() {
    let metrics = json(&run().join("metrics.json"));
    for key in [
        "psnr",
        "psnr_persistent",
        "ssim",
        "depth_median_abs_m",
        "stream_miou",
        "train_seconds",
        "extract_seconds",
        "export_seconds",
        "samples_per_second",
        "rays_per_second",
    ] {
        assert!(metrics[key].as_f64().is_some_and(f64::is_finite), "{key}: {metrics}");
    }
    assert!(metrics["skipped"].is_object());
    assert_eq!(metrics["peak_rss_mb"].is_number(), cfg!(target_os = "linux"));
}

#[test]
fn every_line_of_the_log_is_a_report() {
    let text = fs::read_to_string(run().join("log.jsonl")).unwrap();
    let steps: Vec<u64> =
        text.lines().map(|l| serde_json::from_str::<Value>(l).unwrap()["step"].as_u64().unwrap()).collect();
    assert_eq!(steps, [50, 100, 150, 200, 250, 300, 350, 400]);
}

#[test]
fn the_report_needs_no_network_and_shows_pictures() {
    let page = fs::read_to_string(run().join("report.html")).unwrap();
    assert!(!page.contains("http://") && !page.contains("https://") && !page.contains("<script"));
    assert!(page.starts_with("<!doctype html>") && page.ends_with("</body></html>\n"));
    // Two test frames, each with truth, rendering, depth and streams.
    assert!(page.matches("src=\"data:image/png;base64,").count() >= 8);
    for part in ["<svg", "map/points.ply", "PSNR of held-out frames", "prefers-color-scheme: dark"] {
        assert!(page.contains(part), "{part}");
    }
}

#[test]
fn config_toml_says_everything_and_gives_the_same_run_again() {
    let text = fs::read_to_string(run().join("config.toml")).unwrap();
    let config: toml::Table = text.parse().unwrap();
    assert_eq!(config["train"]["steps"].as_integer(), Some(400));
    assert!(config["train"].get("network_rate").is_some(), "defaults are written out");
    let settings = run().join("config.toml");
    let done = divff(&["train", arg(scene()), "--out", arg(run()), "--config", arg(&settings)]);
    assert!(done.err.contains("already trained"), "{}", done.err);
    done.ok();
}

#[test]
fn the_map_does_not_depend_on_the_number_of_threads() {
    let alone = folder("one-thread");
    divff(&["run", arg(scene()), "--out", arg(&alone), "--config", arg(tiny()), "--threads", "1"]).ok();
    assert_same_files(&alone.join("map"), &run().join("map"));
    assert_same_files(&alone.join("views"), &run().join("views"));
}

#[test]
fn export_writes_the_formats_streams_and_times_asked_for() {
    let out = folder("export");
    let map = out.join("map");
    divff(&[
        "export",
        arg(run()),
        "--out",
        arg(&map),
        "--formats",
        "ply,exr",
        "--streams",
        "persistent",
        "--voxel",
        "0.15",
    ])
    .ok();
    let names = files(&map);
    assert!(names.contains(&"manifest.json".to_owned()) && names.contains(&"views/000004.exr".to_owned()));
    let unwanted = |n: &&String| n.ends_with(".glb") || n.contains("dynamic") || n.contains("actor_");
    assert_eq!(names.iter().find(unwanted), None);
    let manifest = Manifest::read(&map).unwrap();
    manifest.verify(&map).unwrap();
    assert_eq!(manifest.files.len() + 1, names.len(), "every file is in the manifest: {names:?}");
    divff(&["export", arg(run()), "--out", arg(&map), "--times", "2"]).usage("--times");
    divff(&["export", arg(run()), "--out", arg(&map), "--times", "frame:999"]).fails(2, &["999", "0 to 15"]);
    divff(&["export", arg(run()), "--out", arg(&map), "--voxel", "-1"]).fails(2, &["voxel"]);
}

#[test]
fn render_writes_the_layers_asked_for() {
    let out = folder("render");
    divff(&["render", arg(run()), "--split", "test", "--layers", "rgb,depth,stream", "--out", arg(&out)])
        .ok();
    assert_eq!(files(&out), ["000004.exr", "000004.png", "000012.exr", "000012.png"]);
    // The run's own pictures hold the scores of the truth's phrases besides.
    let name = "000004.png";
    assert!(fs::read(out.join(name)).unwrap() == fs::read(run().join("views").join(name)).unwrap(), "{name}");
    let exr = read_exr(&out.join("000004.exr")).unwrap();
    assert_eq!((exr.width, exr.height), (48, 28));
    assert!(matches!(exr.channel("depth.Z"), Some(ExrSamples::F32(z)) if z.iter().all(|z| *z >= 0.0)));
    for name in ["R", "G", "B", "stream_persistent.Y", "stream_dynamic.Y", "stream_actor.Y"] {
        assert!(exr.channel(name).is_some(), "{name}");
    }
    let one = out.join("one");
    divff(&["render", arg(run()), "--frame", "7", "--layers", "normal", "--out", arg(&one)]).ok();
    assert_eq!(files(&one), ["000007.exr"]);
    divff(&["render", arg(run()), "--frame", "99", "--out", arg(&one)]).fails(2, &["--frame 99", "inspect"]);
    divff(&["render", arg(run()), "--frame", "7", "--layers", "clip", "--out", arg(&one)]).ok();
    divff(&["render", arg(run()), "--layers", "relevancy", "--out", arg(&one)]).usage("--text");
}

#[test]
fn eval_measures_what_the_run_measured() {
    let out = folder("eval").join("metrics.json");
    let text = divff(&["eval", arg(run()), "--out", arg(&out)]).ok();
    assert!(text.contains("PSNR") && text.contains(arg(&out)), "{text}");
    let (a, b) = (json(&run().join("metrics.json")), json(&out));
    for key in ["psnr", "ssim", "depth_median_abs_m", "stream_miou", "persistent", "train_seconds", "skipped"]
    {
        assert_eq!(a[key], b[key], "{key}");
    }
    assert_eq!(a["extract_seconds"], b["extract_seconds"], "what the run took is not forgotten");
}

#[test]
fn inspect_describes_scenes_runs_maps_and_files() {
    let map = run().join("map");
    let said = |path: &std::path::Path| divff(&["inspect", arg(path), "--deep"]).ok();
    assert!(said(scene()).contains("16 (14 train, 2 test)"));
    let text = said(run());
    assert!(text.contains("430 steps") && text.contains("finished") && text.contains("PSNR"), "{text}");
    assert!(said(&map).contains("all files are as they were written"));
    let points = read_ply(&map.join("points.ply")).unwrap().positions.len();
    for name in ["points.ply", "points.npz"] {
        let text = said(&map.join(name));
        assert!(text.contains(&format!("points     {points}")) && text.contains("confidence"), "{text}");
    }
    let text = said(&map.join("scene.glb"));
    assert!(text.contains("node       persistent") && text.contains("triangles"), "{text}");
    divff(&["inspect", arg(&map.join("none.ply"))]).fails(2, &["none.ply"]);
}

#[test]
fn a_closed_pipe_is_not_a_failure() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_divff"))
        .args(["inspect", arg(scene())])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.stderr.is_empty());
}

#[test]
fn every_command_explains_itself_with_an_example() {
    assert!(divff(&["--version"]).ok().starts_with("divff "));
    for command in ["demo", "synth", "run", "train", "export", "render", "eval", "bench", "inspect"] {
        let help = divff(&[command, "--help"]).ok();
        assert!(help.contains(&format!("divff {command}")) && help.contains("Example"), "{help}");
    }
}

#[test]
fn the_demo_says_what_to_open() {
    let out = folder("demo");
    let text = divff(&["demo", "--out", arg(&out), "--time-budget", "1s"]).ok();
    assert!(text.contains("report.html") && text.contains("any web browser"), "{text}");
    assert!(text.contains("divff query"), "{text}");
    assert!(out.join("run/report.html").is_file() && out.join("run/map/manifest.json").is_file());
}
