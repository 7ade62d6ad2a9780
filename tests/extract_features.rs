//! `scripts/extract_features.py` with tiny stand-in models, end to end: our readers take what it writes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use divff::scene::features::FeatureStore;
use divff::scene::{Scene, inspect};
use divff::semantics::targets::{
    ImageMode, ImageTargetConfig, ImageTargets, PartTargets, VideoTargetConfig, VideoTargets,
};
use divff::synth::{SynthOptions, generate};

const FRAMES: u32 = 10;
const FOLDERS: [&str; 4] = ["language_features", "video_features", "hotspots", "dino_features"];
const KINDS: [&str; 5] = ["segmenter", "image", "video", "hands", "parts"];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Runs the script; each model fails after so many calls.
fn extract(scene: &Path, calls: usize, more: &[&str]) -> Output {
    let python = root().join(".venv/bin/python");
    assert!(python.exists(), "{} is missing; run tests/tools/setup.sh once", python.display());
    let models = root().join("tests/tools/standin_models.py");
    let mut command = Command::new(python);
    command.arg(root().join("scripts/extract_features.py")).arg(scene).env("PYTHONDONTWRITEBYTECODE", "1");
    command.env("STANDIN_CALLS", calls.to_string());
    for kind in KINDS {
        command.arg(format!("--{kind}")).arg(format!("{}:{kind}=none", models.display()));
    }
    command.args(more).output().expect("Python starts")
}

/// A scene whose features are still to be extracted.
fn synth() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene");
    generate(&SynthOptions { frames: FRAMES, width: 48, height: 32, seed: 1 }, &path).unwrap();
    // The embeddings are those of the surrogate features.
    for kind in FOLDERS.into_iter().chain(["text"]) {
        std::fs::remove_dir_all(path.join(kind)).unwrap();
    }
    (folder, path)
}

/// All feature files and their bytes.
fn files(scene: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for name in FOLDERS {
        for entry in std::fs::read_dir(scene.join(name)).into_iter().flatten() {
            let path = entry.unwrap().path();
            found.insert(path.strip_prefix(scene).unwrap().to_owned(), std::fs::read(path).unwrap());
        }
    }
    found
}

fn assert_success(output: &Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn what_is_extracted_is_read_and_makes_targets() {
    let (_folder, path) = synth();
    assert_success(&extract(&path, 10_000, &[]));
    let scene = Scene::open(&path).unwrap();
    let inspection = inspect(&scene, true);
    assert!(inspection.problems.is_empty(), "{:?}", inspection.problems);
    let odd: Vec<_> = inspection.warnings.iter().filter(|w| w.contains("features")).collect();
    assert!(odd.is_empty(), "{odd:?}");
    let store = FeatureStore::open(&scene).unwrap();
    let train = scene.frames.iter().position(|f| f.split == divff::scene::Split::Train).unwrap();
    let test = scene.frames.iter().position(|f| f.split == divff::scene::Split::Test).unwrap();
    let masks = store.frame(&scene.frames[train]).masks().unwrap().unwrap();
    assert_eq!(masks.masks.rows(), 3, "neither duplicates nor bad masks");
    assert!(store.frame(&scene.frames[test]).masks().unwrap().is_none(), "test frames are left alone");
    let config = |mode| ImageTargetConfig { mode, ..ImageTargetConfig::default() };
    for mode in [ImageMode::MasksAndBoxes, ImageMode::Patches] {
        let targets = ImageTargets::load(&store, &scene.frames, config(mode)).unwrap().unwrap();
        assert_eq!(targets.frames().count(), FRAMES as usize - 1);
        assert!(targets.at(train, 0, 0).is_some() && targets.at(train, 47, 31).is_some(), "{mode:?}");
    }
    let video = VideoTargets::load(&store, &scene.frames, VideoTargetConfig::default()).unwrap().unwrap();
    // The stand-in's box is the lower left quarter.
    assert!(video.at(train, 0, 31).clip.is_some() && video.at(train, 0, 0).clip.is_none());
    assert!(video.at(train, 30, 5).patch.is_some());
    assert!(PartTargets::load(&store, &scene.frames).unwrap().unwrap().at(train, 47, 31).is_some());
}

#[test]
fn an_interrupted_run_is_finished_by_the_next_and_gives_the_same() {
    let (_folder, path) = synth();
    let (_other, whole) = synth();
    assert_success(&extract(&whole, 10_000, &[]));
    let broken = extract(&path, 7, &[]);
    assert!(!broken.status.success());
    let before = files(&path);
    assert!(before.len() > 10 && before.len() < files(&whole).len());
    assert!(before.keys().all(|name| !name.to_string_lossy().contains("tmp")), "half a file is left");
    // Files that are there are kept: a changed one would be written again.
    let kept = path.join(before.keys().find(|k| k.to_string_lossy().ends_with("_f.npy")).unwrap());
    let time = std::fs::metadata(&kept).unwrap().modified().unwrap();
    assert_success(&extract(&path, 10_000, &[]));
    assert_eq!(std::fs::metadata(&kept).unwrap().modified().unwrap(), time);
    assert!(files(&path) == files(&whole));
}

#[test]
fn other_settings_are_refused_unless_forced() {
    let (_folder, path) = synth();
    assert_success(&extract(&path, 10_000, &["--patch-scales", "0.5"]));
    let refused = extract(&path, 10_000, &["--patch-scales", "0.3"]);
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && message.contains("another patches"), "{message}");
    assert_success(&extract(&path, 10_000, &["--patch-scales", "0.3", "--force"]));
}

#[test]
fn what_is_wrong_is_said_in_one_line() {
    let (_folder, path) = synth();
    let models = root().join("tests/tools/standin_models.py");
    let (lossy, absent) = (format!("{}:too_few=none", models.display()), "nothing.py:image=none".to_owned());
    let refused = |more: &[&str], parts: &[&str]| {
        let output = extract(&path, 10_000, more);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        let one_line =
            message.starts_with("extract_features.py: ") && message.trim_end().lines().count() == 1;
        assert!(!output.status.success() && one_line, "{message}");
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    };
    refused(&["--patch-scales", "0.3,wide"], &["--patch-scales 0.3,wide"]);
    refused(&["--patch-scales", "1.5"], &["at most 1"]);
    refused(&["--image", &absent], &["--image", "nothing.py does not exist"]);
    refused(&["--image", "openclip"], &["ADAPTER=WEIGHTS"]);
    refused(&["--image", &lossy], &["the model gave an array (2, 16) for 3 items"]);
    let meta = path.join("language_features/meta.json");
    std::fs::write(&meta, "{").unwrap();
    refused(&[], &["meta.json"]);
    std::fs::remove_file(&meta).unwrap();
    let transforms = path.join("transforms.json");
    std::fs::write(&transforms, "{\"frames\": [{}]}").unwrap();
    refused(&[], &["transforms.json", "file_path"]);
    std::fs::remove_file(&transforms).unwrap();
    refused(&[], &["transforms.json does not exist"]);
}
