//! Targets of the toy scene, pixel by pixel.

use super::*;
use crate::scene::features::testing::{DIM, FeatureScene, axis};
use crate::scene::features::{Blend, Interpolation};

fn image(scene: &FeatureScene, mode: ImageMode) -> ImageTargets {
    let config = ImageTargetConfig { mode, ..ImageTargetConfig::default() };
    ImageTargets::load(&scene.store(), &scene.scene.frames, config).unwrap().unwrap()
}

/// With boxes that weigh alike.
fn boxed(scene: &FeatureScene) -> ImageTargets {
    let config = ImageTargetConfig { box_agreement: false, ..ImageTargetConfig::default() };
    ImageTargets::load(&scene.store(), &scene.scene.frames, config).unwrap().unwrap()
}

/// The blended descriptor of a target.
fn value(table: &TargetTable, blend: Blend) -> [f32; DIM] {
    let mut out = [0.0; DIM];
    table.blend(&blend, &mut out);
    out
}

fn assert_near(found: [f32; DIM], expected: [f32; DIM]) {
    let norm = expected.iter().map(|v| v * v).sum::<f32>().sqrt();
    for (f, e) in found.iter().zip(expected) {
        // Rows are stored in half precision: 2^-11 of a number below 1.
        assert!((f - e / norm).abs() < 6e-4, "{found:?} is not along {expected:?}");
    }
}

#[test]
fn masks_give_every_pixel_its_own_and_none_outside() {
    let scene = FeatureScene::new();
    let targets = image(&scene, ImageMode::Masks);
    assert_eq!(targets.frames().collect::<Vec<_>>(), [0]);
    assert_eq!(targets.table.len(), 3);
    for y in 0..8 {
        assert_near(value(&targets.table, targets.at(0, 0, y).unwrap()), axis(0));
        assert_near(value(&targets.table, targets.at(0, 7, y).unwrap()), axis(2));
        assert_eq!(targets.at(0, 8, y), None);
    }
    assert_eq!(targets.at(1, 0, 0), None, "a frame without features");
}

#[test]
fn boxes_weigh_a_quarter() {
    let scene = FeatureScene::new();
    let targets = boxed(&scene);
    assert_near(value(&targets.table, targets.at(0, 0, 0).unwrap()), [0.75, 0.0, 0.0, 0.25]);
    assert_eq!(targets.at(0, 0, 0).unwrap().iter().count(), 1, "one row, nothing to blend");
    assert!(targets.warnings.is_empty());
}

#[test]
fn lengths_of_descriptors_do_not_matter() {
    let scene = FeatureScene::new();
    scene.floats("language_features/frame_000000_b.npy", &[3, DIM], &[axis(3).map(|v| 50.0 * v); 3].concat());
    let targets = boxed(&scene);
    assert_near(value(&targets.table, targets.at(0, 0, 0).unwrap()), [0.75, 0.0, 0.0, 0.25]);
}

#[test]
fn a_box_counts_as_far_as_it_shows_what_its_mask_does() {
    let scene = FeatureScene::new();
    // Pixels are in the masks of axes 0, on the left, and 2. The first box shows just its mask, the third its own and the first.
    let boxes = [axis(0), axis(0), [1.0, 0.0, 1.0, 0.0]];
    scene.floats("language_features/frame_000000_b.npy", &[3, DIM], &boxes.concat());
    let targets = image(&scene, ImageMode::MasksAndBoxes);
    assert_near(value(&targets.table, targets.at(0, 0, 0).unwrap()), axis(0));
    // The third mask is like its own box by √½ and like the others not at all.
    let (half, weight) = (0.5f32.sqrt(), 0.25 * 0.5f32.sqrt());
    let expected = [weight * half, 0.0, 1.0 - weight + weight * half, 0.0];
    assert_near(value(&targets.table, targets.at(0, 5, 0).unwrap()), expected);
    scene.floats("language_features/frame_000000_b.npy", &[3, DIM], &[axis(0); 3].concat());
    let targets = image(&scene, ImageMode::MasksAndBoxes);
    assert_near(value(&targets.table, targets.at(0, 5, 0).unwrap()), axis(2));
}

#[test]
fn a_box_without_others_to_be_told_from_counts_in_full() {
    let scene = FeatureScene::new();
    let nan = [f32::NAN; DIM];
    scene.floats("language_features/frame_000000_b.npy", &[3, DIM], &[axis(3), nan, nan].concat());
    let targets = image(&scene, ImageMode::MasksAndBoxes);
    assert_near(value(&targets.table, targets.at(0, 0, 0).unwrap()), [0.75, 0.0, 0.0, 0.25]);
}

#[test]
fn a_bad_box_leaves_the_mask_and_a_bad_mask_leaves_nothing() {
    let scene = FeatureScene::new();
    let nan = [f32::NAN; DIM];
    scene.floats("language_features/frame_000000_b.npy", &[3, DIM], &[nan, axis(3), axis(3)].concat());
    scene.floats("language_features/frame_000000_f.npy", &[3, DIM], &[axis(0), axis(1), nan].concat());
    let targets = image(&scene, ImageMode::MasksAndBoxes);
    assert_near(value(&targets.table, targets.at(0, 0, 0).unwrap()), axis(0));
    assert_eq!(targets.at(0, 5, 0), None);
    assert_eq!(targets.warnings.len(), 2, "{:?}", targets.warnings);
    assert_eq!(targets.table.sample(10).len(), 2 * DIM, "what is left out is not learned from");
}

#[test]
fn without_boxes_masks_stand_alone_and_a_warning_says_so() {
    let scene = FeatureScene::new();
    std::fs::remove_file(scene.path("language_features/frame_000000_b.npy")).unwrap();
    let targets = image(&scene, ImageMode::MasksAndBoxes);
    assert_near(value(&targets.table, targets.at(0, 0, 0).unwrap()), axis(0));
    assert!(targets.warnings[0].contains("_b.npy"), "{:?}", targets.warnings);
}

#[test]
fn levels_of_masks_count_alike() {
    let scene = FeatureScene::new();
    let mut index = vec![0; 96];
    index.extend(vec![1; 96]);
    index.extend(vec![-1; 96]);
    scene.integers("language_features/frame_000000_s.npy", &[3, 8, 12], &index);
    let targets = image(&scene, ImageMode::Masks);
    assert_near(value(&targets.table, targets.at(0, 9, 4).unwrap()), [1.0, 1.0, 0.0, 0.0]);
}

#[test]
fn patches_of_all_scales_count_alike() {
    let scene = FeatureScene::new();
    let targets = image(&scene, ImageMode::Patches);
    // Column 5 has its centre at 5.5: between the centres at 4 and 8 of scale 0, and in the one patch of scale 1.
    assert_near(value(&targets.table, targets.at(0, 5, 3).unwrap()), [0.625, 0.375, 1.0, 0.0]);
}

#[test]
fn a_scale_between_two_takes_from_both() {
    let scene = FeatureScene::new();
    let targets = image(&scene, ImageMode::ScaledPatches);
    assert_eq!(targets.scales(0), Some([0.5, 1.0]));
    assert_eq!(targets.all_scales(8), [0.5, 1.0]);
    assert_eq!(image(&scene, ImageMode::Masks).all_scales(8), [0.0; 0]);
    let at = |scale: f32| value(&targets.table, targets.at_scale(0, 0, 3, scale).unwrap());
    assert_near(at(0.5), axis(0));
    assert_near(at(0.1), axis(0));
    assert_near(at(1.0), axis(2));
    assert_near(at(3.0), axis(2));
    assert_near(at(0.625), [0.75, 0.0, 0.25, 0.0]);
}

#[test]
fn weights_sum_to_one_at_every_pixel() {
    let scene = FeatureScene::new();
    for mode in [ImageMode::Patches, ImageMode::ScaledPatches, ImageMode::Masks, ImageMode::MasksAndBoxes] {
        let targets = image(&scene, mode);
        for (x, y) in (0..12).flat_map(|x| (0..8).map(move |y| (x, y))) {
            for blend in [targets.at(0, x, y), targets.at_scale(0, x, y, 0.8)].into_iter().flatten() {
                let sum: f32 = blend.iter().map(|(_, w)| w).sum();
                assert!((sum - 1.0).abs() < 1e-6, "{mode:?} at {x}, {y}: {sum}");
                assert!(blend.iter().all(|(row, _)| (row as usize) < targets.table.len()));
            }
        }
    }
}

#[test]
fn the_clip_counts_inside_the_hotspot_only() {
    let scene = FeatureScene::new();
    let load = |config| VideoTargets::load(&scene.store(), &scene.scene.frames, config).unwrap().unwrap();
    let targets = load(VideoTargetConfig::default());
    // Frame 1 has a clip, but no hotspot says where it counts.
    assert_eq!(targets.frames().collect::<Vec<_>>(), [0]);
    let inside = targets.at(0, 5, 3);
    assert_near(value(&targets.table, Blend::one(inside.clip.unwrap())), axis(2));
    assert_eq!(targets.at(0, 6, 3).clip, None);
    assert_eq!(targets.at(0, 5, 4).clip, None);
    assert_eq!(targets.at(1, 0, 0), VideoTarget::default());
    // Two patches that cover the image and overlap by half: 8 px wide, centres at 4 and 8.
    assert_near(value(&targets.table, inside.patch.unwrap()), [0.625, 0.375, 0.0, 0.0]);
    let off = load(VideoTargetConfig { hotspots: false, ..VideoTargetConfig::default() });
    assert_eq!(off.at(0, 5, 3).clip, None);
    let off = load(VideoTargetConfig { patches: false, ..VideoTargetConfig::default() });
    assert!(off.at(0, 5, 3).patch.is_none() && off.at(0, 5, 3).clip.is_some());
    let nearest = VideoTargetConfig { interpolation: Interpolation::Nearest, ..VideoTargetConfig::default() };
    let nearest = load(nearest);
    assert_near(value(&nearest.table, nearest.at(0, 5, 3).patch.unwrap()), axis(0));
}

#[test]
fn parts_are_those_of_the_pixels_cell() {
    let scene = FeatureScene::new();
    let targets = PartTargets::load(&scene.store(), &scene.scene.frames).unwrap().unwrap();
    assert_eq!(targets.at(0, 3, 3), Some(0));
    assert_eq!(targets.at(0, 4, 3), Some(1));
    assert_eq!(targets.at(0, 11, 7), Some(5));
    assert_eq!(targets.at(1, 0, 0), None);
}

#[test]
fn a_scene_without_features_has_no_targets() {
    let scene = FeatureScene::new();
    for name in ["language_features", "video_features", "dino_features"] {
        std::fs::remove_dir_all(scene.path(name)).unwrap();
    }
    let (store, frames) = (scene.store(), &scene.scene.frames);
    assert!(ImageTargets::load(&store, frames, ImageTargetConfig::default()).unwrap().is_none());
    assert!(VideoTargets::load(&store, frames, VideoTargetConfig::default()).unwrap().is_none());
    assert!(PartTargets::load(&store, frames).unwrap().is_none());
}
