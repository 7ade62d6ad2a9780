//! Every format gives the same scene, and conventions are the ones that are documented.

use glam::{DVec2, DVec3};
use serde_json::json;

use super::super::{Camera, Scene, Split, inspect};
use super::*;

/// What must not depend on the format.
fn assert_is_the_test_scene(scene: &Scene, format: &str) {
    assert_eq!(scene.frames.len(), poses().len(), "{format}");
    for (i, (frame, pose)) in scene.frames.iter().zip(poses()).enumerate() {
        assert_eq!(frame.stem, format!("frame_{i:06}"), "{format}");
        assert_eq!(frame.camera, CAMERA, "{format}");
        assert!(frame.c2w.abs_diff_eq(pose, 1e-12), "{format}: {:?} is not {pose:?}", frame.c2w);
        assert_eq!(frame.frame_index, i as u32, "{format}");
        assert!((frame.time - i as f64 / 8.0).abs() < 1e-15, "{format}");
        assert_eq!(frame.split == Split::Test, i == 4, "{format}");
        frame.load_rgb().unwrap();
    }
}

#[test]
fn every_format_gives_the_same_scene() {
    let nerfstudio = Folder::nerfstudio(|_| {});
    assert_is_the_test_scene(&nerfstudio.open().unwrap(), "nerfstudio");

    for (format, write) in [
        ("colmap bin", write_colmap_bin as fn(&Folder)),
        ("colmap txt", write_colmap_txt),
        ("epic fields", write_epic_fields),
    ] {
        let folder = Folder::new();
        write_images(&folder.path("images"));
        write(&folder);
        let scene = folder.open().unwrap();
        assert_is_the_test_scene(&scene, format);
        assert_eq!(scene.points, [DVec3::new(0.1, 0.2, 0.3)], "{format}");
    }

    let folder = Folder::new();
    write_images(&folder.path("frames"));
    folder.write("meta.json", epic_diff().to_string());
    assert_is_the_test_scene(&folder.open().unwrap(), "epic diff");
}

#[test]
fn a_colmap_model_opens_by_its_own_folder() {
    let folder = Folder::new();
    write_images(&folder.path("images"));
    write_colmap_bin(&folder);
    assert_is_the_test_scene(&Scene::open(folder.path("sparse/0")).unwrap(), "sparse/0");
}

#[test]
fn the_target_projects_to_the_principal_point_and_up_is_up() {
    let scene = Folder::nerfstudio(|_| {}).open().unwrap();
    for frame in &scene.frames {
        let w2c = frame.c2w.inverse();
        let centre = frame.camera.project(w2c.transform_point3(DVec3::ZERO)).unwrap();
        assert!(centre.abs_diff_eq(DVec2::new(CAMERA.cx, CAMERA.cy), 1e-9), "{centre}");
        let above = frame.camera.project(w2c.transform_point3(DVec3::Z * 0.1)).unwrap();
        assert!(above.y < centre.y && (above.x - centre.x).abs() < 1e-9, "z is up, and up is a smaller y");
    }
}

#[test]
fn distortion_round_trips_through_projection() {
    let camera = Camera { distortion: [-0.2, 0.05, 0.003, -0.002], ..CAMERA };
    for x in 0..=12 {
        for y in 0..=8 {
            let uv = DVec2::new(f64::from(x), f64::from(y));
            let back = camera.project(camera.unproject(uv) * 2.5).unwrap();
            assert!(back.abs_diff_eq(uv, 1e-9), "{uv} came back as {back}");
        }
    }
}

#[test]
fn distortion_of_colmap_cameras_lands_where_opencv_has_it() {
    let cases: [(&str, &[f64], [f64; 4]); 4] = [
        ("SIMPLE_RADIAL", &[10.0, 5.0, 4.0, 0.1], [0.1, 0.0, 0.0, 0.0]),
        ("RADIAL", &[10.0, 5.0, 4.0, 0.1, 0.2], [0.1, 0.2, 0.0, 0.0]),
        ("OPENCV", &[10.0, 10.0, 5.0, 4.0, 0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.3, 0.4]),
        ("SIMPLE_PINHOLE", &[10.0, 5.0, 4.0], [0.0; 4]),
    ];
    for (model, params, distortion) in cases {
        let camera =
            crate::scene::colmap::camera(Path::new("c"), crate::scene::Place::File, model, [12, 8], params);
        let wanted = Camera { width: 12, height: 8, fx: 10.0, fy: 10.0, cx: 5.0, cy: 4.0, distortion };
        assert_eq!(camera.unwrap(), wanted, "{model}");
    }
}

#[test]
fn applied_transform_is_undone() {
    // What `ns-process-data` does to COLMAP's world: swap axes, scale; saved = scale · T · original.
    let t = DAffine3::from_mat3(glam::DMat3::from_cols(DVec3::X, -DVec3::Z, DVec3::Y));
    let folder = Folder::nerfstudio(|v| {
        for (frame, pose) in v["frames"].as_array_mut().unwrap().iter_mut().zip(poses()) {
            let mut saved = t * pose;
            saved.translation *= 2.0;
            frame["transform_matrix"] = json!(opengl_rows(&saved));
        }
        v["applied_transform"] = json!([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]);
        v["applied_scale"] = json!(2.0);
        v["aabb"] = json!([[-8.0, -10.0, -12.0], [8.0, 10.0, 12.0]]);
        v["ply_file_path"] = json!("points.ply");
    });
    folder.write(
        "points.ply",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
         end_header\n2 6 -4\n",
    );
    let scene = folder.open().unwrap();
    assert_is_the_test_scene(&scene, "applied_transform");
    assert_eq!(scene.points, [DVec3::new(1.0, 2.0, 3.0)]);
    assert!(scene.bounds.min.abs_diff_eq(DVec3::new(-4.0, -6.0, -5.0), 1e-9), "{:?}", scene.bounds);
}

#[test]
fn a_frame_overrides_the_intrinsics_of_the_file() {
    let folder = Folder::nerfstudio(|v| {
        v["camera_model"] = json!("OPENCV");
        v["k1"] = json!(0.01);
        v["k3"] = json!(0.0);
        v["frames"][2]["fl_x"] = json!(9.0);
        v["frames"][2]["k1"] = json!(-0.02);
    });
    let frames = folder.open().unwrap().frames;
    assert_eq!((frames[2].camera.fx, frames[2].camera.distortion[0]), (9.0, -0.02));
    assert_eq!((frames[3].camera.fx, frames[3].camera.distortion[0]), (CAMERA.fx, 0.01));
}

#[test]
fn a_field_of_view_and_the_image_make_up_for_missing_intrinsics() {
    let folder = Folder::nerfstudio(|v| {
        for key in ["w", "h", "fl_x", "fl_y", "cx", "cy"] {
            v.as_object_mut().unwrap().remove(key);
        }
        v["camera_angle_x"] = json!(std::f64::consts::FRAC_PI_2);
        for i in 0..9 {
            v["frames"][i]["file_path"] = json!(format!("./images/frame_{i:06}"));
        }
    });
    let camera = folder.open().unwrap().frames[0].camera;
    assert!((camera.fx - 6.0).abs() < 1e-12 && camera.fy == camera.fx);
    assert_eq!((camera.width, camera.height, camera.cx, camera.cy), (12, 8, 6.0, 4.0));
}

#[test]
fn intrinsics_follow_images_that_were_only_rescaled() {
    let folder = Folder::nerfstudio(|v| {
        v["w"] = json!(24);
        v["h"] = json!(16);
    });
    let scene = folder.open().unwrap();
    let camera = scene.frames[0].camera;
    assert_eq!((camera.width, camera.height), (12, 8));
    assert_eq!([camera.fx, camera.fy, camera.cx, camera.cy], [5.0, 5.5, 2.75, 2.125]);
    assert!(scene.warnings.iter().any(|w| w.contains("9 frames were scaled")), "{:?}", scene.warnings);
}

#[test]
fn named_splits_are_kept_and_held_out_wins() {
    let images =
        |ids: &[usize]| json!(ids.iter().map(|i| format!("images/{}", name(*i))).collect::<Vec<_>>());
    let folder = Folder::nerfstudio(|v| {
        v["train_filenames"] = images(&[0, 1, 2, 3, 4]);
        v["test_filenames"] = images(&[4, 5]);
        v["val_filenames"] = images(&[6]);
    });
    let scene = folder.open().unwrap();
    let of = |split| -> Vec<u32> {
        scene.frames.iter().filter(|f| f.split == split).map(|f| f.frame_index).collect()
    };
    assert_eq!((of(Split::Train), of(Split::Test)), (vec![0, 1, 2, 3], vec![4, 5]));
    assert!(scene.warnings.iter().any(|w| w.starts_with("3 frames are in neither")), "{:?}", scene.warnings);
}

#[test]
fn epic_diff_validation_frames_are_left_out() {
    let folder = Folder::new();
    write_images(&folder.path("frames"));
    let mut meta = epic_diff();
    (meta["ids_train"], meta["ids_test"], meta["ids_val"]) =
        (json!([0, 1, 2, 5, 6, 7, 8]), json!([3]), json!([4]));
    folder.write("meta.json", meta.to_string());
    let frames = folder.open().unwrap().frames;
    assert_eq!(
        frames.iter().filter(|f| f.split == Split::Test).map(|f| f.frame_index).collect::<Vec<_>>(),
        [3]
    );
    assert_eq!(frames.iter().filter(|f| f.split == Split::Train).count(), 7);
}

#[test]
fn frames_come_in_time_order_and_seconds_are_stretched() {
    let folder = Folder::nerfstudio(|v| {
        for i in 0..9 {
            v["frames"][i]["time"] = json!(20.0 - 2.0 * i as f64);
            v["frames"][i]["frame_index"] = json!(100 - i);
        }
    });
    let scene = folder.open().unwrap();
    assert_eq!(scene.frames[0].stem, "frame_000008");
    assert_eq!((scene.frames[0].time, scene.frames[8].time, scene.frames[8].frame_index), (0.0, 1.0, 100));
    assert!(scene.warnings.iter().any(|w| w.contains("from 4 to 20")), "{:?}", scene.warnings);
}

#[test]
fn epic_fields_leaves_frames_without_image_out() {
    let folder = Folder::new();
    write_images(&folder.path("P01/rgb_frames/P01_01"));
    write_epic_fields(&folder);
    std::fs::remove_file(folder.path("P01/rgb_frames/P01_01").join(name(0))).unwrap();
    let scene = folder.open().unwrap();
    assert_eq!(scene.frames.len(), 8);
    assert!(scene.warnings.iter().any(|w| w.contains("1 of 9 posed frames")), "{:?}", scene.warnings);
}

#[test]
fn bounds_of_an_orbit_hold_the_cameras_and_what_they_circle() {
    let bounds = Folder::nerfstudio(|_| {}).open().unwrap().bounds;
    assert!(poses().iter().all(|p| bounds.contains(p.translation)), "{bounds:?}");
    // Radius 3: what is behind the object is in, and the box is not out of all proportion.
    assert!(bounds.contains(DVec3::new(-2.0, 2.0, -1.0)), "{bounds:?}");
    assert!((bounds.max - bounds.min).max_element() < 30.0, "{bounds:?}");
}

#[test]
fn bounds_from_points_ignore_a_few_wild_ones() {
    let folder = Folder::nerfstudio(|v| v["ply_file_path"] = json!("points.ply"));
    let mut ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 300\nproperty uchar red\n\
        property double x\nproperty double y\nproperty double z\nelement face 0\n\
        property list uchar int vertex_indices\nend_header\n"
        .to_vec();
    for i in 0..300 {
        let t = f64::from(i) / 299.0;
        let p = if i == 150 { [1e6, -1e6, 1e6] } else { [8.0 * t - 4.0, 4.0 - 8.0 * t, 4.0 * t - 2.0] };
        ply.push(9);
        ply.extend(p.map(f64::to_le_bytes).concat());
    }
    folder.write("points.ply", ply);
    let bounds = folder.open().unwrap().bounds;
    assert!((bounds.max - bounds.min).max_element() < 10.0, "{bounds:?}");
    assert!(bounds.contains(DVec3::new(3.8, -3.8, 1.9)), "{bounds:?}");
}

#[test]
fn a_scene_far_from_the_origin_opens_as_well() {
    let shift = DVec3::new(1e6, -2e6, 3e6);
    let folder = Folder::nerfstudio(|v| {
        for (frame, mut pose) in v["frames"].as_array_mut().unwrap().iter_mut().zip(poses()) {
            pose.translation += shift;
            frame["transform_matrix"] = json!(opengl_rows(&pose));
        }
    });
    let far = folder.open().unwrap().bounds;
    let near = Folder::nerfstudio(|_| {}).open().unwrap().bounds;
    assert!((far.min - shift).abs_diff_eq(near.min, 1e-6), "{far:?} {near:?}");
}

#[test]
fn inspection_counts_what_is_there_and_names_what_is_wrong() {
    let folder = Folder::nerfstudio(|v| {
        let same = v["frames"][5]["transform_matrix"].clone();
        v["frames"][6]["transform_matrix"] = same;
    });
    folder.write("language_features/frame_000001_s.npy", "x");
    folder.write("language_features/frame_000001_f.npy", "x");
    folder.write("language_features/meta.json", "{}");
    folder.write("language_features/other_s.npy", "x");
    folder.write("text/clip.txt", "wash");
    let scene = folder.open().unwrap();
    let whole = std::fs::read(folder.path("images").join(name(3))).unwrap();
    folder.write(&format!("images/{}", name(3)), &whole[..whole.len() / 2]);
    let report = inspect(&scene, true);
    assert_eq!((report.frames, report.train, report.test), (9, 8, 1));
    assert_eq!(report.folders[0].frames, Some(1));
    assert_eq!(report.folders[0].files, 4);
    assert_eq!(report.folders[1].name, "text");
    assert_eq!(report.problems.len(), 3, "{report}");
    assert!(report.problems[0].contains("frame_000003"), "{report}");
    assert!(report.problems[1].contains("frame_000001_f.npy"), "{report}");
    assert!(report.problems[2].contains("clip.npy"), "{report}");
    assert!(report.warnings.iter().any(|w| w.contains("first: frame_000006")), "{report}");
    assert!(report.warnings.iter().any(|w| w.starts_with("1 files in language_features")), "{report}");
    assert_eq!(inspect(&scene, false).problems.len(), 3, "headers alone, for features; the images look fine");
    assert!(serde_json::to_string(&report).unwrap().contains("\"frames\":9"));
}
