//! Embeddings from the scene and from a file.

use super::*;
use crate::scene::features::testing::{DIM, FeatureScene, axis};

#[test]
fn given_embeddings_come_first_then_the_scenes() {
    let scene = FeatureScene::new();
    let mut sources = TextSources::of_scene(&scene.store(), Space::Clip).unwrap();
    assert_eq!(sources.embed(Space::Clip, "red mug").unwrap(), axis(0));
    scene.floats("mine.npy", &[2, DIM], &[axis(2).map(|v| 5.0 * v), axis(3)].concat());
    let phrases = ["Red mug".to_owned(), "blue mug".to_owned()];
    sources.add_file(Space::Clip, &phrases, &scene.path("mine.npy")).unwrap();
    assert_eq!(sources.embed(Space::Clip, "red mug").unwrap(), axis(2));
    assert_eq!(sources.embed(Space::Clip, "blue mug").unwrap(), axis(3));
    assert_eq!(sources.embed(Space::Clip, "object").unwrap(), axis(1));
    assert!(sources.embed(Space::Egovideo, "object").is_err(), "spaces do not mix");
}

#[test]
fn one_embedding_may_come_without_its_first_dimension() {
    let scene = FeatureScene::new();
    let mut sources = TextSources::default();
    scene.floats("one.npy", &[DIM], &axis(3));
    sources.add_file(Space::Egovideo, &["wash".to_owned()], &scene.path("one.npy")).unwrap();
    assert_eq!(sources.embed(Space::Egovideo, "wash").unwrap(), axis(3));
}

#[test]
fn a_phrase_that_nothing_knows_is_named_with_what_to_do() {
    let scene = FeatureScene::new();
    let sources = TextSources::of_scene(&scene.store(), Space::Clip).unwrap();
    let message = sources.embed(Space::Clip, "teapot").unwrap_err().to_string();
    for part in ["teapot", "clip.npy", "--text-embedding"] {
        assert!(message.contains(part), "{message}");
    }
    let message = sources.canonical(Space::Clip).unwrap_err().to_string();
    assert!(message.contains("\"thing\""), "{message}");
}

#[test]
fn files_that_do_not_fit_are_errors() {
    let scene = FeatureScene::new();
    let mut sources = TextSources::of_scene(&scene.store(), Space::Clip).unwrap();
    let mug = ["mug".to_owned()];
    scene.floats("a.npy", &[2, DIM], &[1.0; 2 * DIM]);
    let error = sources.add_file(Space::Clip, &mug, &scene.path("a.npy")).unwrap_err();
    assert!(matches!(error, TextError::Count { rows: 2, phrases: 1, .. }));
    scene.floats("a.npy", &[1, 3], &[1.0; 3]);
    let error = sources.add_file(Space::Clip, &mug, &scene.path("a.npy")).unwrap_err();
    assert!(matches!(error, TextError::Width { found: 3, expected: DIM, .. }));
    scene.floats("a.npy", &[1, DIM], &[f32::NAN; DIM]);
    let error = sources.add_file(Space::Clip, &mug, &scene.path("a.npy")).unwrap_err();
    assert!(matches!(error, TextError::Features(_)), "{error}");
}
