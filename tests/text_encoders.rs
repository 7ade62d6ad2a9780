//! Text towers of the real architectures, with random weights, against PyTorch: the same tokens, the same embeddings.
//!
//! Opt-in, because PyTorch is large: `tests/tools/setup_text.sh` makes the models once (`target/text-models`, or
//! `$DIVFF_TEXT_MODELS`). Without them the tests say so and pass.
#![cfg(feature = "text-encoder")]

use std::path::PathBuf;
use std::time::Instant;

use divff::semantics::text::TextEncoder;
use divff_exporters::read_npy;
use serde::Deserialize;

#[derive(Deserialize)]
struct Expected {
    phrases: Vec<String>,
    tokens: Vec<Vec<u32>>,
}

fn models(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("DIVFF_TEXT_MODELS").map(PathBuf::from);
    let root = root.unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("target/text-models"));
    let folder = root.join(name);
    if folder.join("expected.npy").is_file() {
        return Some(folder);
    }
    eprintln!("SKIPPED: no {} in {}; run tests/tools/setup_text.sh once", name, root.display());
    None
}

/// Smallest cosine with PyTorch's embeddings, and the median of the milliseconds that a phrase takes.
fn compare(name: &str, every: usize) -> Option<(f64, f64)> {
    let folder = models(name)?;
    let expected: Expected =
        serde_json::from_slice(&std::fs::read(folder.join("expected.json")).unwrap()).unwrap();
    let truth = read_npy(&folder.join("expected.npy")).unwrap();
    let dim = truth.header.shape[1];
    let truth = truth.to_f32();
    let start = Instant::now();
    let encoder = TextEncoder::open(&folder).unwrap();
    let loading = start.elapsed().as_secs_f64();
    assert_eq!((expected.phrases.len(), encoder.dim()), (200, dim));
    for (phrase, tokens) in expected.phrases.iter().zip(&expected.tokens) {
        assert_eq!(encoder.tokens(phrase).unwrap().0, *tokens, "{phrase:?}");
    }
    let (mut worst, mut times) = (1.0f64, Vec::new());
    for (phrase, truth) in expected.phrases.iter().zip(truth.chunks_exact(dim)).step_by(every) {
        let start = Instant::now();
        let found = encoder.embed(phrase).unwrap();
        times.push(1e3 * start.elapsed().as_secs_f64());
        let dot = |a: &[f32], b: &[f32]| -> f64 {
            a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        worst = worst.min(dot(&found, truth) / (dot(&found, &found) * dot(truth, truth)).sqrt());
    }
    times.sort_by(f64::total_cmp);
    let median = times[times.len() / 2];
    eprintln!("{name}: loaded in {loading:.2} s, {median:.1} ms a phrase, cosine ≥ {worst:.7}");
    Some((worst, median))
}

#[test]
fn clip_embeds_as_in_pytorch() {
    if let Some((worst, _)) = compare("clip", 1) {
        assert!(worst > 0.9999, "{worst}");
    }
}

#[test]
fn egovideo_embeds_as_in_pytorch() {
    if let Some((worst, _)) = compare("egovideo", 1) {
        assert!(worst > 0.9999, "{worst}");
    }
}

/// `cargo test --release --features text-encoder --test text_encoders -- --ignored --nocapture`
#[test]
#[ignore = "measures; run it alone, in release"]
fn a_clip_phrase_takes_at_most_100_ms() {
    if let Some((_, median)) = compare("clip", 4) {
        assert!(median <= 100.0, "{median} ms");
    }
}

#[test]
fn damaged_encoders_are_errors_that_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let error = || TextEncoder::open(folder.path()).err().expect("a broken encoder was opened").to_string();
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
