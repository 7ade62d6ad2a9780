//! Text towers of the real architectures, with random weights, against PyTorch: the same tokens, the same embeddings.
//!
//! `tests/tools/setup_text.sh` makes the models and what PyTorch says about 200 phrases, once.
#![cfg(feature = "text")]

use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Instant;

use divff::semantics::text::TextEncoder;
use divff_exporters::read_npy;
use serde::Deserialize;

const PHRASES: usize = 200;

/// Held while phrases are timed: the two models would take the processors from each other.
static TIMING: Mutex<()> = Mutex::new(());

#[derive(Deserialize)]
struct Expected {
    phrases: Vec<String>,
    tokens: Vec<Vec<u32>>,
}

fn models(name: &str) -> PathBuf {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("target/text-models").join(name);
    assert!(folder.is_dir(), "{} is missing; run tests/tools/setup_text.sh once", folder.display());
    folder
}

/// Smallest cosine with PyTorch's embeddings, and the median of the milliseconds that a phrase takes.
///
/// # Panics
/// If a phrase has other tokens than in Python.
fn compare(name: &str) -> (f64, f64) {
    let folder = models(name);
    let expected: Expected =
        serde_json::from_slice(&std::fs::read(folder.join("expected.json")).unwrap()).unwrap();
    let truth = read_npy(&folder.join("expected.npy")).unwrap();
    let dim = truth.header.shape[1];
    let truth = truth.to_f32();
    let _alone = TIMING.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let start = Instant::now();
    let encoder = TextEncoder::open(&folder).unwrap();
    let loading = start.elapsed().as_secs_f64();
    assert_eq!((expected.phrases.len(), expected.tokens.len(), encoder.dim()), (PHRASES, PHRASES, dim));
    assert_eq!(truth.len(), PHRASES * dim);
    for (phrase, tokens) in expected.phrases.iter().zip(&expected.tokens) {
        assert_eq!(encoder.tokens(phrase).unwrap().0, *tokens, "{phrase:?}");
    }
    let dot =
        |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let rows: Vec<&[f32]> = truth.chunks_exact(dim).collect();
    let alike = rows.windows(2).filter(|w| dot(w[0], w[1]) > 0.999).count();
    assert!(alike < PHRASES / 20, "{alike} embeddings are the next phrase's: the model tells nothing apart");
    let (mut worst, mut times) = (1.0f64, Vec::new());
    for (phrase, truth) in expected.phrases.iter().zip(rows) {
        let start = Instant::now();
        let found = encoder.embed(phrase).unwrap();
        times.push(1e3 * start.elapsed().as_secs_f64());
        assert!((dot(&found, &found) - 1.0).abs() < 1e-6, "{phrase:?}: not of unit length");
        worst = worst.min(dot(&found, truth) / dot(truth, truth).sqrt());
    }
    times.sort_by(f64::total_cmp);
    let median = times[times.len() / 2];
    eprintln!("{name}: loaded in {loading:.2} s, {median:.1} ms a phrase, cosine ≥ {worst:.7}");
    (worst, median)
}

#[test]
fn clip_embeds_as_in_pytorch_within_100_ms() {
    let (worst, median) = compare("clip");
    assert!(worst > 0.9999, "{worst}");
    // Without optimisation it is not ours to promise.
    assert!(median <= 100.0 || cfg!(debug_assertions), "{median} ms");
}

#[test]
fn egovideo_embeds_as_in_pytorch() {
    let (worst, _) = compare("egovideo");
    assert!(worst > 0.9999, "{worst}");
}

#[test]
fn phrases_that_mean_the_same_to_the_tokenizer_have_the_same_embedding() {
    let encoder = TextEncoder::open(&models("clip")).unwrap();
    let embed = |phrase| encoder.embed(phrase).unwrap();
    assert_eq!(embed("Red  Mug"), embed("red mug"));
    assert_ne!(embed("red mug"), embed("blue mug"));
}

#[test]
fn truncated_models_are_errors_that_name_the_file() {
    let (from, folder) = (models("clip"), tempfile::tempdir().unwrap());
    for name in ["encoder.json", "tokenizer.json"] {
        std::fs::copy(from.join(name), folder.path().join(name)).unwrap();
    }
    let model = std::fs::read(from.join("model.onnx")).unwrap();
    for length in [0, 1, 100, 10_000, 1 << 20, model.len() / 2, model.len() - 1] {
        std::fs::write(folder.path().join("model.onnx"), &model[..length]).unwrap();
        let error = TextEncoder::open(folder.path()).expect_err("a truncated model was opened").to_string();
        assert!(error.contains("model.onnx") && error.contains("export the encoder again"), "{error}");
    }
}

#[test]
fn damaged_encoders_are_errors_that_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let error = || TextEncoder::open(folder.path()).expect_err("a broken encoder was opened").to_string();
    assert!(error().contains("encoder.json"));
    let about = r#"{"space": "clip", "model": "x", "context": 77, "pad": 0, "dim": 4}"#;
    std::fs::write(folder.path().join("encoder.json"), about.replace("77", "1")).unwrap();
    assert!(error().contains("context"));
    std::fs::write(folder.path().join("encoder.json"), about).unwrap();
    assert!(error().contains("tokenizer.json"));
    std::fs::write(folder.path().join("tokenizer.json"), "{}").unwrap();
    assert!(error().contains("tokenizer.json"));
    let tokenizer = r#"{"version": "1.0", "added_tokens": [], "model":
        {"type": "WordLevel", "vocab": {"a": 0, "b": 1}, "unk_token": "a"}}"#;
    std::fs::write(folder.path().join("tokenizer.json"), tokenizer).unwrap();
    assert!(error().contains("model.onnx"));
    std::fs::write(folder.path().join("model.onnx"), b"\x08\x07garbage").unwrap();
    assert!(error().contains("model.onnx"));
}
