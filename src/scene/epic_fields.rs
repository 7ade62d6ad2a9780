//! EPIC-Fields: one JSON file a video, camera poses for the frames of EPIC-KITCHENS.
//!
//! `camera` as COLMAP has it; `images` maps frame names to `[qw, qx, qy, qz, tx, ty, tz]`, world-to-camera
//! (the first release: a list with the name as eighth entry); `points` are `[x, y, z, r, g, b]`. Scale is
//! arbitrary. The files pose every frame of a video, of which people extract a part: frames without an image
//! are left out.

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde_json::{Map, Value};

use super::Camera;
use super::colmap::{self, IMAGE_FOLDERS};
use super::draft::{Draft, DraftFrame};
use super::error::{Place, SceneError};
use super::json::{self, Fields};

/// Whether a JSON object looks like an EPIC-Fields file.
pub(crate) fn recognises(map: &Map<String, Value>) -> bool {
    map.get("camera").is_some_and(Value::is_object)
        && map.get("images").is_some_and(|i| i.is_object() || i.is_array())
}

/// Takes the scene out of the JSON object in `file`; the images are looked for around it.
pub(crate) fn read(file: &Path, map: &Map<String, Value>) -> Result<Draft, SceneError> {
    let top = Fields { path: file, frame: None, map };
    let camera = read_camera(&top)?;
    let poses = read_poses(&top)?;
    let root = file.parent().unwrap_or(Path::new(".")).to_owned();
    let mut draft = Draft::new(root, file.to_owned());
    if poses.is_empty() {
        return Ok(draft);
    }
    let images = find_images(&draft.root, file, &poses)?;
    let mut missing = Vec::new();
    for (name, pose) in &poses {
        let image_path = images.join(name);
        if !image_path.is_file() {
            missing.push(*name);
            continue;
        }
        let c2w = colmap::c2w_of(pose).ok_or_else(|| {
            let at = Place::Frame((*name).to_owned());
            SceneError::invalid(file, at, "its quaternion is not of length 1", "download the file again")
        })?;
        draft.frames.push(DraftFrame {
            name: (*name).to_owned(),
            image_path,
            camera,
            c2w,
            time: None,
            frame_index: None,
            split: None,
            depth_path: None,
            mask_path: None,
        });
    }
    if let Some(first) = missing.first() {
        draft.warnings.push(format!(
            "{} of {} posed frames have no image in {} (first: {first}) and are left out",
            missing.len(),
            poses.len(),
            images.display()
        ));
    }
    draft.points = read_points(&top)?;
    Ok(draft)
}

fn read_camera(top: &Fields) -> Result<Camera, SceneError> {
    let camera = Fields { map: top.object("camera")?, ..*top };
    let key = |key: &str| Place::Key(format!("camera.{key}"));
    let missing = |name: &str| SceneError::invalid(top.path, key(name), "the key is missing", "add it");
    let model = camera.text("model")?.ok_or_else(|| missing("model"))?;
    let size = [
        camera.whole("width")?.ok_or_else(|| missing("width"))?,
        camera.whole("height")?.ok_or_else(|| missing("height"))?,
    ];
    let params = camera.list("params")?.ok_or_else(|| missing("params"))?;
    let params: Option<Vec<f64>> = params.iter().map(json::finite).collect();
    let params = params.ok_or_else(|| {
        SceneError::invalid(top.path, key("params"), "expected finite numbers", "download the file again")
    })?;
    colmap::camera(top.path, key("params"), model, size, &params)
}

/// Frame names and `qw qx qy qz tx ty tz`.
fn read_poses<'a>(top: &Fields<'a>) -> Result<Vec<(&'a str, [f64; 7])>, SceneError> {
    let wrong = |name: &str| {
        SceneError::invalid(
            top.path,
            Place::Frame(name.to_owned()),
            "its pose is not [qw, qx, qy, qz, tx, ty, tz] with finite numbers",
            "remove the frame or download the file again",
        )
    };
    match top.required("images")? {
        Value::Object(images) => {
            let pose = |(name, value): (&'a String, &'a Value)| {
                json::finite_array(value).map(|p| (name.as_str(), p)).ok_or_else(|| wrong(name))
            };
            images.iter().map(pose).collect()
        }
        Value::Array(images) => {
            let pose = |(index, value): (usize, &'a Value)| {
                let row = value.as_array().filter(|r| r.len() == 8);
                let name =
                    row.and_then(|r| r[7].as_str()).ok_or_else(|| wrong(&format!("number {index}")))?;
                let mut pose = [0.0; 7];
                for (slot, x) in pose.iter_mut().zip(row.into_iter().flatten()) {
                    *slot = json::finite(x).ok_or_else(|| wrong(name))?;
                }
                Ok((name, pose))
            };
            images.iter().enumerate().map(pose).collect()
        }
        _ => Err(top.invalid("images", "expected an object or a list", "download the file again")),
    }
}

/// The folder around `file` that holds most of what it names: that of the first frame that is found.
fn find_images(root: &Path, file: &Path, poses: &[(&str, [f64; 7])]) -> Result<PathBuf, SceneError> {
    let video = file.file_stem().and_then(|s| s.to_str()).unwrap_or_default();
    let person = video.split('_').next().unwrap_or_default();
    let own = [
        video.to_owned(),
        format!("rgb_frames/{video}"),
        format!("{person}/rgb_frames/{video}"),
        format!("frames/{video}"),
        format!("images/{video}"),
    ];
    let folders: Vec<&str> = own.iter().map(String::as_str).chain(IMAGE_FOLDERS).collect();
    let roots = [root.to_owned()];
    // The first posed frames are often not extracted: ask for frames all over the video.
    let step = poses.len().div_ceil(500);
    let found = poses.iter().step_by(step).find_map(|p| colmap::image_folder(&roots, &folders, p.0));
    let found = found.or_else(|| poses.iter().find_map(|p| colmap::image_folder(&roots, &folders, p.0)));
    found.ok_or_else(|| SceneError::MissingFile {
        listed_in: file.to_owned(),
        frame: poses[0].0.to_owned(),
        kind: "image",
        path: root.join("images").join(poses[0].0),
        remedy: format!(
            "EPIC-Fields holds poses only: extract the video's frames from EPIC-KITCHENS into one of {}",
            folders.join(", ")
        ),
    })
}

fn read_points(top: &Fields) -> Result<Vec<DVec3>, SceneError> {
    let wrong = |index: usize| {
        let what = format!("point {index} does not start with three finite coordinates");
        top.invalid("points", what, "remove the point or download the file again")
    };
    let point = |(index, value): (usize, &Value)| {
        let row = value.as_array().filter(|r| r.len() >= 3).ok_or_else(|| wrong(index))?;
        let at = |i: usize| json::finite(&row[i]).ok_or_else(|| wrong(index));
        Ok(DVec3::new(at(0)?, at(1)?, at(2)?))
    };
    top.list("points")?.unwrap_or_default().iter().enumerate().map(point).collect()
}
