//! Embeddings from the scene and from a file, and where encoders are looked for.

use std::path::Path;

use super::{TextError, TextSource};
use crate::scene::features::Space;
use crate::scene::features::testing::{DIM, FeatureScene, axis};

#[test]
fn given_embeddings_come_first_then_the_scenes() {
    let scene = FeatureScene::new();
    let mut source = TextSource::of_scene(&scene.store(), Space::Clip).unwrap();
    assert_eq!(source.embed("red mug").unwrap(), axis(0));
    scene.floats("mine.npy", &[2, DIM], &[axis(2).map(|v| 5.0 * v), axis(3)].concat());
    let phrases = ["Red mug".to_owned(), "blue mug".to_owned()];
    source.add_file(&phrases, &scene.path("mine.npy")).unwrap();
    assert_eq!(source.embed("red mug").unwrap(), axis(2));
    assert_eq!(source.embed("blue mug").unwrap(), axis(3));
    assert_eq!(source.embed("object").unwrap(), axis(1));
    assert_eq!(source.phrases().collect::<Vec<_>>(), ["Red mug", "blue mug", "red mug", "object"]);
}

#[test]
fn one_embedding_may_come_without_its_first_dimension() {
    let scene = FeatureScene::new();
    let mut source = TextSource::new(Space::Egovideo, None);
    scene.floats("one.npy", &[DIM], &axis(3));
    source.add_file(&["wash".to_owned()], &scene.path("one.npy")).unwrap();
    assert_eq!(source.embed("wash").unwrap(), axis(3));
}

#[test]
fn a_phrase_that_nothing_knows_is_named_with_what_to_do() {
    let scene = FeatureScene::new();
    let source = TextSource::of_scene(&scene.store(), Space::Clip).unwrap();
    let message = source.embed("teapot").unwrap_err().to_string();
    for part in ["\"teapot\"", "known are \"object\", \"red mug\"", "--text-embedding", "$DIVFF_TEXT_CLIP"] {
        assert!(message.contains(part), "{message}");
    }
    let message = source.canonical().unwrap_err().to_string();
    assert!(message.contains("\"thing\""), "{message}");
}

#[test]
fn files_that_do_not_fit_are_errors() {
    let scene = FeatureScene::new();
    let mut source = TextSource::of_scene(&scene.store(), Space::Clip).unwrap();
    let mug = ["mug".to_owned()];
    scene.floats("a.npy", &[2, DIM], &[1.0; 2 * DIM]);
    let error = source.add_file(&mug, &scene.path("a.npy")).unwrap_err();
    assert!(matches!(error, TextError::Count { rows: 2, phrases: 1, .. }));
    scene.floats("a.npy", &[1, 3], &[1.0; 3]);
    let error = source.add_file(&mug, &scene.path("a.npy")).unwrap_err();
    assert!(matches!(error, TextError::Width { found: 3, expected: DIM, .. }));
    scene.floats("a.npy", &[1, DIM], &[f32::NAN; DIM]);
    let error = source.add_file(&mug, &scene.path("a.npy")).unwrap_err();
    assert!(matches!(error, TextError::Features(_)), "{error}");
}

/// A folder with an `encoder.json` and nothing else.
fn encoder(root: &Path, space: &str, dim: usize) {
    std::fs::create_dir_all(root).unwrap();
    let about = format!(r#"{{"space": "{space}", "model": "x", "context": 77, "pad": 0, "dim": {dim}}}"#);
    std::fs::write(root.join("encoder.json"), about).unwrap();
}

#[test]
fn encoders_are_found_where_they_are_named_and_loaded_only_when_needed() {
    let scene = FeatureScene::new();
    let mut source = TextSource::of_scene(&scene.store(), Space::Clip).unwrap();
    let root = tempfile::tempdir().unwrap();
    let (both, other, none) = (root.path().join("both"), root.path().join("other"), root.path().join("none"));
    encoder(&both.join("clip"), "clip", DIM);
    encoder(&other, "egovideo", 7);
    std::fs::create_dir(&none).unwrap();
    // The scene's phrases need no encoder, so a broken one does no harm until another phrase is asked for.
    source.use_encoder(Some(&both), None).unwrap();
    assert_eq!(source.embed("red mug").unwrap(), axis(0));
    assert!(matches!(source.embed("teapot"), Err(TextError::Encoder { .. })));
    source.use_encoder(None, Some(&both.join("clip"))).unwrap();
    assert!(matches!(source.embed("teapot"), Err(TextError::Encoder { .. })));
    source.use_encoder(Some(&other), None).unwrap();
    assert!(matches!(source.embed("teapot"), Err(TextError::Phrase { .. })), "another space's is no error");
    source.use_encoder(Some(&other), Some(&both)).unwrap();
    assert!(matches!(source.embed("teapot"), Err(TextError::Encoder { .. })));
    for (given, fallback) in [(Some(&*none), None), (None, Some(&*none)), (None, Some(&*other))] {
        let error = source.use_encoder(given, fallback).unwrap_err();
        assert!(matches!(error, TextError::NoEncoder { space: Space::Clip, .. }), "{error}");
    }
}

#[test]
fn encoders_that_do_not_fit_are_errors_before_they_are_loaded() {
    let scene = FeatureScene::new();
    let mut source = TextSource::of_scene(&scene.store(), Space::Clip).unwrap();
    let root = tempfile::tempdir().unwrap();
    encoder(root.path(), "clip", DIM + 1);
    let error = source.use_encoder(Some(root.path()), None).unwrap_err();
    assert!(matches!(error, TextError::Width { found: 5, expected: DIM, .. }), "{error}");
    std::fs::write(root.path().join("encoder.json"), "{").unwrap();
    let error = source.use_encoder(Some(root.path()), None).unwrap_err().to_string();
    assert!(error.contains("encoder.json") && error.contains("export_text_encoders.py"), "{error}");
}
