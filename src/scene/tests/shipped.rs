//! The data sets that come with the project, where they are there.

use glam::{DVec2, DVec3};

use super::super::{Aabb, Scene, Split, inspect};

#[path = "../../../tests/support/data.rs"]
mod data;

#[test]
fn shipped_scenes_open_with_their_splits() {
    for (name, train, test) in [("redkitchen", 175, 25), ("kitchen-a", 210, 30)] {
        let Some(folder) = data::scene(name) else { continue };
        let scene = Scene::open(&folder).unwrap();
        let count = |split| scene.frames.iter().filter(|f| f.split == split).count();
        assert_eq!((count(Split::Train), count(Split::Test)), (train, test), "{name}");
        let frame = &scene.frames[4];
        assert_eq!(frame.split, Split::Test);
        let rgb = frame.load_rgb().unwrap();
        assert_eq!(rgb.pixels.len(), (frame.camera.width * frame.camera.height) as usize);
        let depth = frame.load_depth(scene.depth_unit).unwrap().unwrap();
        let far = depth.iter().copied().fold(0.0, f32::max);
        assert!((1.0..10.0).contains(&far), "{name}: {far} m across a kitchen");
    }
}

/// Share of the depth pixels that lie in `bounds`.
fn share_inside(scene: &Scene, bounds: &Aabb) -> f64 {
    let (mut inside, mut all) = (0, 0);
    for frame in scene.frames.iter().step_by(20) {
        let depth = frame.load_depth(scene.depth_unit).unwrap().unwrap();
        for (i, z) in depth.iter().enumerate().step_by(37).filter(|(_, z)| **z > 0.0) {
            let (x, y) = (i as u32 % frame.camera.width, i as u32 / frame.camera.width);
            let uv = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let p = frame.c2w.transform_point3(frame.camera.unproject(uv) * f64::from(*z));
            inside += usize::from(bounds.contains(p));
            all += 1;
        }
    }
    f64::from(inside as u32) / f64::from(all)
}

#[test]
fn depth_of_shipped_scenes_lies_in_their_bounds() {
    // Poses, axes, depth and box only fit together if every convention is right.
    for name in ["redkitchen", "kitchen-a"] {
        let Some(folder) = data::scene(name) else { continue };
        let scene = Scene::open(&folder).unwrap();
        let slack = DVec3::splat(0.02);
        let wider = Aabb { min: scene.bounds.min - slack, max: scene.bounds.max + slack };
        let share = share_inside(&scene, &wider);
        assert!(share >= 0.97, "{name}: {share} of the depth pixels are inside the box");
    }
}

#[test]
fn bounds_guessed_from_the_cameras_hold_what_they_see() {
    for name in ["redkitchen", "kitchen-a"] {
        let Some(folder) = data::scene(name) else { continue };
        let mut draft = super::super::open::read(&folder).unwrap();
        let given = draft.aabb.take().unwrap();
        let scene = super::super::assemble::assemble(draft).unwrap();
        let share = share_inside(&scene, &scene.bounds);
        let size = |b: &Aabb| (b.max - b.min).element_product().cbrt();
        println!("{name}: {share} inside, {} times the size", size(&scene.bounds) / size(&given));
        assert!(share >= 0.9, "{name}: {share} of the depth pixels are inside the guessed box");
        assert!(size(&scene.bounds) < 3.0 * size(&given), "{name}: {:?}", scene.bounds);
    }
}

#[test]
fn shipped_scenes_have_no_problems() {
    for name in ["redkitchen", "kitchen-a"] {
        let Some(folder) = data::scene(name) else { continue };
        let report = inspect(&Scene::open(&folder).unwrap(), true);
        assert_eq!(report.problems, Vec::<String>::new(), "{name}");
        println!("{report}");
    }
}

#[test]
fn the_features_of_kitchen_a_are_read_without_a_complaint() {
    let Some(folder) = data::scene("kitchen-a") else { return };
    let scene = Scene::open(&folder).unwrap();
    let inspection = inspect(&scene, true);
    assert!(inspection.problems.is_empty(), "{:?}", inspection.problems);
    let feature = |name: &str| {
        let kind = inspection.features.iter().find(|k| k.name == name);
        kind.map(|k| (k.count, k.dim))
    };
    for (name, expected) in [
        ("image masks", (90, Some(512))),
        ("image patches 0", (20, Some(512))),
        ("video clips", (240, Some(512))),
        ("part features", (20, Some(64))),
        ("text, clip", (184, Some(512))),
        ("text, egovideo", (29, Some(512))),
    ] {
        assert_eq!(feature(name), Some(expected), "{name}");
    }
}
