//! Every broken input is an error that names the place and what to do, never a panic.

use serde_json::json;

use super::super::{Place, SceneError};
use super::*;

/// Opens the test scene after `edit` and checks that the message holds all of `wanted`.
fn assert_error(edit: impl FnOnce(&mut Value), wanted: &[&str]) {
    let message = Folder::nerfstudio(edit).error();
    for part in wanted {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

fn rotation_edit(f: impl Fn(usize, usize, f64) -> f64) -> impl FnOnce(&mut Value) {
    move |v| {
        for row in 0..3 {
            for column in 0..3 {
                let entry = &mut v["frames"][3]["transform_matrix"][row][column];
                *entry = json!(f(row, column, entry.as_f64().unwrap()));
            }
        }
    }
}

#[test]
fn poses_that_are_not_rigid_name_their_frame() {
    let frame = "frame images/frame_000003.png";
    assert_error(rotation_edit(|_, _, x| 2.0 * x), &[frame, "not a rotation", "divided by its scale"]);
    assert_error(rotation_edit(|_, _, _| 0.0), &[frame, "singular"]);
    assert_error(rotation_edit(|_, column, x| if column == 0 { -x } else { x }), &[frame, "left-handed"]);
    assert_error(|v| v["frames"][3]["transform_matrix"][3][0] = json!(1.0), &[frame, "last row"]);
    assert_error(
        |v| v["frames"][3]["transform_matrix"] = json!([[1, 2], [3, 4]]),
        &[frame, "transform_matrix"],
    );
    assert_error(|v| v["frames"][3]["transform_matrix"][0][0] = json!("a"), &[frame, "transform_matrix"]);
    assert_error(
        |v| {
            v["frames"][3].as_object_mut().unwrap().remove("transform_matrix");
        },
        &[frame, "transform_matrix", "missing"],
    );
}

#[test]
fn small_noise_in_a_rotation_is_repaired() {
    let folder = Folder::nerfstudio(rotation_edit(|row, _, x| x * (1.0 + 1e-4 * row as f64)));
    let r = folder.open().unwrap().frames[3].c2w.matrix3;
    assert!((r.transpose() * r).abs_diff_eq(glam::DMat3::IDENTITY, 1e-14));
    assert!(r.abs_diff_eq(poses()[3].matrix3, 1e-3));
}

#[test]
fn nan_and_infinity_as_python_writes_them_name_their_frame() {
    for word in ["NaN", "Infinity", "-Infinity"] {
        let folder = Folder::nerfstudio(|v| v["frames"][3]["transform_matrix"][1][3] = json!("HERE"));
        let text = std::fs::read_to_string(folder.path("transforms.json")).unwrap();
        folder.write("transforms.json", text.replace("\"HERE\"", word));
        let message = folder.error();
        assert!(message.contains("images/frame_000003.png") && message.contains("NaN"), "{message}");
    }
    let folder = Folder::nerfstudio(|v| v["frames"][3]["fl_x"] = json!("HERE"));
    let text = std::fs::read_to_string(folder.path("transforms.json")).unwrap();
    folder.write("transforms.json", text.replace("\"HERE\"", "NaN"));
    assert!(folder.error().contains("images/frame_000003.png, key `fl_x`"), "{}", folder.error());
}

#[test]
fn lenses_that_are_not_read_are_unsupported_with_a_remedy() {
    assert_error(|v| v["camera_model"] = json!("OPENCV_FISHEYE"), &["OPENCV_FISHEYE", "undistort"]);
    assert_error(|v| v["k3"] = json!(0.1), &["k3", "undistort"]);
    assert_error(|v| v["frames"][2]["k4"] = json!(0.1), &["frame images/frame_000002.png", "k4"]);
    let folder = Folder::nerfstudio(|v| v["camera_model"] = json!("OPENCV_FISHEYE"));
    assert!(matches!(folder.open(), Err(SceneError::Unsupported { .. })));
}

#[test]
fn intrinsics_must_be_possible() {
    assert_error(|v| v["fl_x"] = json!(0.0), &["focal lengths"]);
    assert_error(|v| v["fl_x"] = json!("wide"), &["fl_x", "expected a finite number, found a text"]);
    assert_error(|v| v["w"] = json!(12.5), &["key `w`", "12.5"]);
    assert_error(|v| v["w"] = json!(0), &["holds no pixels"]);
    assert_error(|v| v["w"] = json!(16), &["frame_000000", "12×8", "16×8", "cropped"]);
    assert_error(|v| (v["w"], v["h"]) = (json!(8), json!(12)), &["12×8", "8×12", "turned"]);
}

#[test]
fn missing_files_name_frame_file_and_remedy() {
    for (key, kind) in [("file_path", "image"), ("mask_path", "mask"), ("depth_file_path", "depth")] {
        let folder = Folder::nerfstudio(|v| v["frames"][5][key] = json!("gone/lost.png"));
        let error = folder.open().unwrap_err();
        assert!(matches!(error, SceneError::MissingFile { kind: k, .. } if k == kind), "{error}");
        let message = error.to_string();
        assert!(message.contains("lost.png") && message.contains("put the"), "{message}");
        if key != "file_path" {
            assert!(message.contains("frame images/frame_000005.png"), "{message}");
        }
    }
}

#[test]
fn lists_that_contradict_themselves_are_errors() {
    assert_error(|v| v["frames"] = json!([]), &["no frames"]);
    assert_error(|v| v["frames"] = json!({}), &["key `frames`", "expected a list"]);
    assert_error(|v| v["frames"][1] = json!(5), &["frame number 1"]);
    assert_error(|v| v["train_filenames"] = json!([]), &["train"]);
    assert_error(
        |v| v["test_filenames"] = json!(["images/none.png"]),
        &["test_filenames", "images/none.png"],
    );
    assert_error(
        |v| v["frames"][3]["time"] = json!(0.5),
        &["frame images/frame_000000.png", "time", "for all"],
    );
    assert_error(
        |v| {
            for i in 0..9 {
                v["frames"][i]["frame_index"] = json!(i / 2);
            }
        },
        &["frame images/frame_000001.png", "frame_index", "twice"],
    );
    assert_error(|v| v["frames"][3]["frame_index"] = json!(-1), &["frame_000003", "-1"]);
}

#[test]
fn frames_that_share_a_stem_are_an_error() {
    let folder = Folder::nerfstudio(|v| v["frames"][1]["file_path"] = json!(format!("other/{}", name(0))));
    write_images(&folder.path("other"));
    let message = folder.error();
    assert!(message.contains("`frame_000000`") && message.contains("rename"), "{message}");
}

#[test]
fn bounds_must_hold_something_that_is_seen() {
    assert_error(|v| v["aabb"] = json!([[1, 1, 1], [0, 2, 2]]), &["key `aabb`", "empty"]);
    assert_error(|v| v["aabb"] = json!([[1, 1], [2, 2]]), &["key `aabb`", "expected"]);
    assert_error(|v| v["aabb"] = json!([[500, 500, 500], [501, 501, 501]]), &["aabb", "no camera sees"]);
    let folder = Folder::nerfstudio(|v| v["aabb"] = json!([[-1, -1, -1], [1, 1, 1]]));
    let warnings = folder.open().unwrap().warnings;
    assert!(warnings.iter().any(|w| w.starts_with("9 of 9 cameras are outside")), "{warnings:?}");
}

#[test]
fn a_folder_without_a_scene_says_what_was_looked_for() {
    let folder = Folder::new();
    assert!(matches!(folder.open(), Err(SceneError::NotAScene { .. })));
    assert!(folder.error().contains("transforms.json"), "{}", folder.error());
    let message = Scene::open(folder.path("nowhere")).unwrap_err().to_string();
    assert!(message.contains("nowhere") && message.contains("cannot be read"), "{message}");
    folder.write("odd.json", "{\"a\": 1}");
    assert!(folder.error().contains("odd.json"), "{}", folder.error());
    folder.write("transforms.json", "[1]");
    assert!(folder.error().contains("not an object"), "{}", folder.error());
}

#[test]
fn transforms_json_rejects_every_truncation() {
    let folder = Folder::nerfstudio(|v| v["frames"].as_array_mut().unwrap().truncate(2));
    let text = std::fs::read(folder.path("transforms.json")).unwrap();
    folder.open().unwrap();
    for length in 0..text.len() {
        folder.write("transforms.json", &text[..length]);
        let error = folder.open().expect_err("a cut file was read");
        assert!(matches!(error, SceneError::Invalid { at: Place::Line(_), .. }), "{length}: {error}");
    }
}

#[test]
fn colmap_rejects_every_truncation_of_its_binaries() {
    let folder = Folder::new();
    write_images(&folder.path("images"));
    write_colmap_bin(&folder);
    for file in ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"] {
        let whole = std::fs::read(folder.path(file)).unwrap();
        for length in 0..whole.len() {
            folder.write(file, &whole[..length]);
            let error = folder.open().expect_err("a cut file was read");
            assert!(
                matches!(error, SceneError::Invalid { at: Place::Byte(_), .. }),
                "{file} {length}: {error}"
            );
        }
        folder.write(file, whole);
    }
    folder.open().unwrap();
}

#[test]
fn counts_in_colmap_headers_do_not_drive_allocation() {
    let folder = Folder::new();
    write_images(&folder.path("images"));
    write_colmap_bin(&folder);
    for file in ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"] {
        let whole = std::fs::read(folder.path(file)).unwrap();
        let mut lying = whole.clone();
        lying[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        folder.write(file, &lying);
        assert!(folder.error().contains("bytes are announced"), "{}", folder.error());
        folder.write(file, whole);
    }
    let mut images = std::fs::read(folder.path("sparse/0/images.bin")).unwrap();
    let observations = images.len() - 48 - 8;
    images[observations..observations + 8].copy_from_slice(&u64::MAX.to_le_bytes());
    folder.write("sparse/0/images.bin", images);
    assert!(folder.error().contains("announced"), "{}", folder.error());
}

#[test]
fn colmap_text_errors_name_the_line() {
    let folder = Folder::new();
    write_images(&folder.path("images"));
    write_colmap_txt(&folder);
    let path = "sparse/0/images.txt";
    let whole = std::fs::read_to_string(folder.path(path)).unwrap();
    // Line 1 is a comment; image 8 is on line 2, image 7 on line 4.
    let cut: Vec<&str> = whole.lines().take(3).chain(["121 0.5 0.5"]).collect();
    folder.write(path, cut.join("\n"));
    assert!(folder.error().contains("images.txt, line 4"), "{}", folder.error());
    folder.write(path, whole.replacen(" 7 frame", " 8 frame", 1));
    assert!(folder.error().contains("camera 8, which is not listed"), "{}", folder.error());
    folder.write(path, whole);
    folder.write("sparse/0/cameras.txt", "7 FOV 12 8 1 2 3 4 5\n");
    assert!(folder.error().contains("cameras.txt, line 1: camera model FOV"), "{}", folder.error());
    folder.write("sparse/0/cameras.txt", "7 PINHOLE 12 8 1 2 3\n");
    assert!(folder.error().contains("4 parameters, not 3"), "{}", folder.error());
}

#[test]
fn colmap_quaternions_must_be_rotations() {
    let folder = Folder::new();
    write_images(&folder.path("images"));
    write_colmap_txt(&folder);
    for (quaternion, wanted) in [("0 0 0 0", "length 1"), ("NaN 0 0 0", "NaN"), ("2 0 0 0", "length 1")] {
        let image = format!("1 {quaternion} 0 0 1 7 {}\n\n", name(3));
        folder.write("sparse/0/images.txt", image);
        let message = folder.error();
        assert!(message.contains(wanted) && message.contains("frame_000003"), "{message}");
    }
}

#[test]
fn ply_rejects_every_truncation() {
    let header = "ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty float x\nproperty short y\n\
        property double z\nend_header\n";
    let mut whole = header.as_bytes().to_vec();
    for i in 0..2i16 {
        whole.extend((f32::from(i) + 0.5).to_be_bytes());
        whole.extend((-i).to_be_bytes());
        whole.extend((f64::from(i) * 0.25).to_be_bytes());
    }
    let folder = Folder::new();
    let read = |bytes: &[u8]| {
        folder.write("p.ply", bytes);
        divff_exporters::read_ply_positions(&folder.path("p.ply"))
    };
    assert_eq!(read(&whole).unwrap(), [[0.5, 0.0, 0.0], [1.5, -1.0, 0.25]]);
    for length in 0..whole.len() {
        assert!(read(&whole[..length]).is_err(), "{length} of {} bytes were read", whole.len());
    }
    let lying = header.replace("vertex 2", "vertex 18446744073709551615");
    assert!(read(lying.as_bytes()).is_err());
    let ascii = header.replace("binary_big_endian", "ascii") + "1 2 3\n4 5";
    let message = read(ascii.as_bytes()).unwrap_err().to_string();
    assert!(message.contains(&format!("byte {}", ascii.len())), "{message}");
}

#[test]
fn epic_fields_without_frames_says_where_to_put_them() {
    let folder = Folder::new();
    write_epic_fields(&folder);
    let message = folder.error();
    assert!(message.contains("extract the video's frames") && message.contains("P01_01"), "{message}");
    write_images(&folder.path("images"));
    let text = std::fs::read_to_string(folder.path("P01_01.json")).unwrap();
    let mut value: Value = serde_json::from_str(&text).unwrap();
    value["images"][name(2)] = json!([1, 0, 0]);
    folder.write("P01_01.json", value.to_string());
    assert!(folder.error().contains("frame_000002"), "{}", folder.error());
}

#[test]
fn epic_diff_names_the_frame_without_pose() {
    let folder = Folder::new();
    write_images(&folder.path("frames"));
    let mut meta = epic_diff();
    meta["poses"].as_object_mut().unwrap().remove("6");
    folder.write("meta.json", meta.to_string());
    let message = folder.error();
    assert!(message.contains("frame_000006.png, key `poses`"), "{message}");
}
