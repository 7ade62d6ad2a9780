//! Good features, and every way of damaging them.

use super::testing::{DIM, FeatureScene, axis, map};
use super::*;
use crate::scene::inspect;

const F: &str = "language_features/frame_000000_f.npy";
const S: &str = "language_features/frame_000000_s.npy";

/// The error that reading the masks of frame 0 gives.
fn mask_error(scene: &FeatureScene) -> FeatureError {
    scene.store().frame(&scene.scene.frames[0]).masks().expect_err("broken masks were read")
}

#[test]
fn frames_give_what_their_files_hold_and_none_for_the_rest() {
    let scene = FeatureScene::new();
    let store = scene.store();
    assert_eq!((store.language_dim(), store.video_dim(), store.dino_dim()), (Some(4), Some(4), Some(2)));
    let first = store.frame(&scene.scene.frames[0]);
    let masks = first.masks().unwrap().unwrap();
    assert_eq!((masks.levels, masks.height, masks.width), (1, 8, 12));
    assert_eq!(masks.index[..12], [0, 0, 0, 0, 2, 2, 2, 2, 65535, 65535, 65535, 65535]);
    assert_eq!(masks.masks.row(2), axis(2));
    assert_eq!(masks.boxes.unwrap().row(0), axis(3));
    assert_eq!(first.patch_scales(), [0, 1]);
    assert_eq!(first.patches(0).unwrap().unwrap().layout.scale(), 0.5);
    assert_eq!(first.video_clip().unwrap().unwrap().row(0), axis(2));
    assert_eq!(first.dino().unwrap().unwrap().descriptors.row(5), [11.0, 12.0]);
    assert_eq!(first.hotspot().unwrap().unwrap().inside.iter().filter(|i| **i).count(), 24);
    let last = store.frame(&scene.scene.frames[8]);
    assert!(last.masks().unwrap().is_none() && last.video_patches().unwrap().is_none());
    assert!(last.dino().unwrap().is_none() && last.hotspot().unwrap().is_none());
    assert!(last.patch_scales().is_empty() && last.patches(0).unwrap().is_none());
}

#[test]
fn patches_are_blended_between_their_centres() {
    let scene = FeatureScene::new();
    let store = scene.store();
    let grid = store.frame(&scene.scene.frames[0]).patches(0).unwrap().unwrap();
    let at = |x: f64, how| grid.at([x, 3.0], [12.0, 8.0], how).unwrap().iter().collect::<Vec<_>>();
    // Centres at 4 and 8.
    assert_eq!(at(1.0, Interpolation::Bilinear), [(0, 1.0)]);
    assert_eq!(at(5.0, Interpolation::Bilinear), [(0, 0.75), (1, 0.25)]);
    assert_eq!(at(11.5, Interpolation::Bilinear), [(1, 1.0)]);
    assert_eq!(at(7.0, Interpolation::Nearest), [(1, 1.0)]);
    // The same place of an image at twice the resolution.
    let large = grid.at([10.0, 6.0], [24.0, 16.0], Interpolation::Bilinear).unwrap();
    assert_eq!(large.iter().collect::<Vec<_>>(), [(0, 0.75), (1, 0.25)]);
}

#[test]
fn a_bad_descriptor_is_left_out_and_named() {
    for (bad, why) in [(0.0, "all zeros"), (f32::NAN, "not finite"), (f32::INFINITY, "not finite")] {
        let scene = FeatureScene::new();
        let mut values = [axis(0), axis(1), axis(2)].concat();
        values[DIM..2 * DIM].fill(bad);
        scene.floats(F, &[3, DIM], &values);
        let masks = scene.store().frame(&scene.scene.frames[0]).masks().unwrap().unwrap();
        assert!(masks.masks.is_usable(0) && !masks.masks.is_usable(1) && masks.masks.is_usable(2));
        assert!(masks.masks.values.iter().all(|v| v.is_finite()));
        let warning = masks.masks.warning().unwrap();
        assert!(
            warning.contains("_f.npy") && warning.contains("row 1") && warning.contains(why),
            "{warning}"
        );
        let inspection = inspect(&scene.scene, true);
        assert!(inspection.warnings.contains(&warning), "{:?}", inspection.warnings);
        assert!(inspection.problems.is_empty(), "{:?}", inspection.problems);
    }
}

#[test]
fn patches_around_a_bad_one_take_its_place() {
    let scene = FeatureScene::new();
    let part = "language_features/frame_000000_p0.npy";
    scene.floats(part, &[1, 2, DIM], &[[f32::NAN; DIM], axis(1)].concat());
    let grid = scene.store().frame(&scene.scene.frames[0]).patches(0).unwrap().unwrap();
    let blend = grid.at([5.0, 3.0], [12.0, 8.0], Interpolation::Bilinear).unwrap();
    assert_eq!(blend.iter().collect::<Vec<_>>(), [(1, 1.0)]);
    assert_eq!(grid.at([1.0, 3.0], [12.0, 8.0], Interpolation::Bilinear), None);
}

#[test]
fn an_index_out_of_range_is_named_with_its_place() {
    for bad in [3, -2, i32::MAX] {
        let scene = FeatureScene::new();
        let mut index = map();
        index[2 * 12 + 7] = bad;
        scene.integers(S, &[1, 8, 12], &index);
        let error = mask_error(&scene);
        let FeatureError::MaskIndex { level: 0, y: 2, x: 7, index, masks: 3, .. } = error else {
            panic!("{error}");
        };
        assert_eq!(index, i64::from(bad));
        let text = mask_error(&scene).to_string();
        assert!(text.contains("_s.npy") && text.contains("row 2, column 7"), "{text}");
    }
}

#[test]
fn a_descriptor_of_another_width_is_an_error() {
    let scene = FeatureScene::new();
    scene.floats(F, &[3, 5], &[1.0; 15]);
    let error = mask_error(&scene);
    assert!(matches!(error, FeatureError::Width { found: 5, expected: 4, .. }), "{error}");
    // Without meta.json the first file sets the width.
    std::fs::remove_file(scene.path("language_features/meta.json")).unwrap();
    let error = scene.store().frame(&scene.scene.frames[0]).patches(0).unwrap_err();
    assert!(matches!(error, FeatureError::Width { found: 4, expected: 5, .. }), "{error}");
    assert!(error.to_string().contains("_f.npy"), "{error}");
}

#[test]
fn shapes_that_do_not_fit_are_errors() {
    let scene = FeatureScene::new();
    scene.integers(S, &[8, 12], &map());
    assert!(matches!(mask_error(&scene), FeatureError::Shape { .. }), "two dimensions");
    scene.integers(S, &[1, 12, 8], &map());
    assert!(mask_error(&scene).to_string().contains("12×8"), "turned by 90 degrees");
    scene.floats(S, &[1, 8, 12], &[0.0; 96]);
    assert!(matches!(mask_error(&scene), FeatureError::Shape { .. }), "floats are no indices");
    scene.integers(S, &[1, 4, 6], &[0; 24]);
    let store = scene.store();
    let masks = store.frame(&scene.scene.frames[0]).masks().unwrap().unwrap();
    assert_eq!(masks.width, 6, "a smaller map of the same shape is welcome");
    scene.floats("language_features/frame_000000_b.npy", &[2, DIM], &[1.0; 8]);
    assert!(mask_error(&scene).to_string().contains("_b.npy"), "boxes without masks");
    std::fs::remove_file(scene.path(F)).unwrap();
    assert!(matches!(mask_error(&scene), FeatureError::Companion { .. }), "no descriptors");
    scene.integers("dino_features/frame_000000.npy", &[2, 3, 2], &[1; 12]);
    let store = scene.store();
    let error = store.frame(&scene.scene.frames[0]).dino().unwrap_err();
    assert!(matches!(error, FeatureError::Shape { .. }), "{error}");
}

#[test]
fn every_truncation_is_an_error_and_a_problem() {
    let scene = FeatureScene::new();
    let whole = std::fs::read(scene.path(F)).unwrap();
    for length in 0..whole.len() {
        std::fs::write(scene.path(F), &whole[..length]).unwrap();
        assert!(mask_error(&scene).to_string().contains("_f.npy"));
    }
    let problems = inspect(&scene.scene, false).problems;
    assert!(problems.iter().any(|p| p.contains("_f.npy")), "{problems:?}");
}

#[test]
fn text_is_found_whatever_its_case_and_normalised() {
    let scene = FeatureScene::new();
    let text = scene.store().text(Space::Clip).unwrap().unwrap();
    assert_eq!(text.find("Red  Mug ").unwrap(), axis(0));
    assert_eq!(text.find("object").unwrap(), axis(1));
    assert_eq!(text.find("mug"), None);
    assert!(scene.store().text(Space::Egovideo).unwrap().is_none());
}

#[test]
fn text_that_does_not_fit_is_an_error() {
    let scene = FeatureScene::new();
    let error = || scene.store().text(Space::Clip).unwrap_err();
    scene.write("text/clip.txt", "red mug\n");
    assert!(matches!(error(), FeatureError::PhraseCount { phrases: 1, rows: 2, .. }));
    scene.write("text/clip.txt", "red mug\nobject\n");
    scene.floats("text/clip.npy", &[2, DIM], &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(matches!(error(), FeatureError::Descriptor { row: 1, why: Unusable::Zero, .. }));
    scene.floats("text/clip.npy", &[2, 3], &[1.0; 6]);
    assert!(matches!(error(), FeatureError::Width { found: 3, expected: 4, .. }));
    std::fs::remove_file(scene.path("text/clip.npy")).unwrap();
    assert!(matches!(error(), FeatureError::Companion { .. }));
}

#[test]
fn a_damaged_meta_is_an_error_that_names_the_key() {
    let scene = FeatureScene::new();
    for (text, key) in [
        (r#"{"dim": 0}"#, "dim"),
        (r#"{"dim": 4, "image_size": [12]}"#, "image_size"),
        (r#"{"patches": [{"file": "p0", "size_px": -4, "stride_px": 4}]}"#, "patches.size_px"),
        (r#"{"patches": [{"file": "p0", "size_px": 4}]}"#, "patches.stride_px"),
    ] {
        scene.write("language_features/meta.json", text);
        let error = FeatureStore::open(&scene.scene).expect_err(text).to_string();
        assert!(error.contains("meta.json") && error.contains(key), "{error}");
    }
    assert!(inspect(&scene.scene, false).problems.iter().any(|p| p.contains("meta.json")));
}

#[test]
fn inspection_lists_the_kinds_and_what_is_missing() {
    let scene = FeatureScene::new();
    let inspection = inspect(&scene.scene, false);
    let kinds: Vec<_> = inspection.features.iter().map(|k| (k.name.as_str(), k.count, k.dim)).collect();
    assert!(kinds.contains(&("image masks", 1, Some(4))), "{kinds:?}");
    assert!(
        kinds.contains(&("video clips", 2, Some(4))) && kinds.contains(&("hotspots", 1, None)),
        "{kinds:?}"
    );
    assert!(kinds.contains(&("text, clip", 2, Some(4))), "{kinds:?}");
    assert!(inspection.warnings.iter().any(|w| w.contains("thing")), "canonical phrases are missing");
    assert!(inspection.warnings.iter().any(|w| w.contains("video_features/meta.json")), "no layout");
    assert!(inspection.problems.is_empty(), "{:?}", inspection.problems);
    assert!(inspection.to_string().contains("image masks: 1 frames, 4 numbers, by toy"), "{inspection}");
}
