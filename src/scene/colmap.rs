//! COLMAP's sparse models: `cameras`, `images` and `points3D`, as `.bin` or `.txt`.
//!
//! Poses are world-to-camera (quaternion w first, OpenCV axes). Ids have gaps. Scale and orientation of the
//! world are whatever the reconstruction made them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DQuat, DVec3};

use super::draft::{Draft, DraftFrame};
use super::error::{Place, SceneError};
use super::{Camera, colmap_bin, colmap_txt, pose};

/// The parts of a model, whichever way they are stored.
pub(crate) struct Model {
    pub cameras: BTreeMap<u32, Camera>,
    pub images: Vec<PosedImage>,
    pub points: Vec<DVec3>,
}

/// One registered image.
pub(crate) struct PosedImage {
    pub name: String,
    /// `qw qx qy qz tx ty tz`, world-to-camera.
    pub pose: [f64; 7],
    pub camera_id: u32,
    /// Where the file lists it.
    pub at: Place,
}

/// Folders below a scene in which COLMAP and the tools around it leave a model.
const MODEL_FOLDERS: [&str; 5] = ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."];
/// Folders below a scene that may hold its images.
pub(crate) const IMAGE_FOLDERS: [&str; 6] = ["images", "frames", "input", "rgb", "rgb_frames", "."];

/// The folder of the model and whether it is binary, if there is a model at or below `root`.
pub(crate) fn find_model(root: &Path) -> Option<(PathBuf, bool)> {
    MODEL_FOLDERS.iter().map(|f| root.join(f)).find_map(|folder| {
        let has = |ext: &str| folder.join(format!("images.{ext}")).is_file();
        if has("bin") { Some((folder, true)) } else { has("txt").then_some((folder, false)) }
    })
}

/// Reads the model in `folder` of the scene in `root`.
pub(crate) fn read(root: &Path, folder: &Path, binary: bool) -> Result<Draft, SceneError> {
    let model = if binary { colmap_bin::read(folder)? } else { colmap_txt::read(folder)? };
    let source = folder.join(if binary { "images.bin" } else { "images.txt" });
    let mut draft = Draft::new(root.to_owned(), source.clone());
    let Some(first) = model.images.first() else { return Ok(draft) };
    // A model that was opened by its own folder: the images are further up.
    let roots = [root.to_owned(), root.join(".."), root.join("../..")];
    let images = image_folder(&roots, &IMAGE_FOLDERS, &first.name).unwrap_or_else(|| root.join("images"));
    for image in &model.images {
        let camera = model.cameras.get(&image.camera_id).ok_or_else(|| {
            let what = format!("image {} has camera {}, which is not listed", image.name, image.camera_id);
            SceneError::invalid(&source, image.at.clone(), what, "cameras and images must be of one model")
        })?;
        let c2w = c2w_of(&image.pose).ok_or_else(|| {
            let what = format!("the quaternion of image {} is not of length 1", image.name);
            SceneError::invalid(&source, image.at.clone(), what, "run the reconstruction again")
        })?;
        draft.frames.push(DraftFrame {
            image_path: images.join(&image.name),
            name: image.name.clone(),
            camera: *camera,
            c2w,
            time: None,
            frame_index: None,
            split: None,
            depth_path: None,
            mask_path: None,
        });
    }
    draft.points = model.points;
    if folder.ends_with("sparse/0") && folder.with_file_name("1").is_dir() {
        draft.warnings.push(
            "COLMAP found several models; only sparse/0 is used, and frames of the others are missing".into(),
        );
    }
    Ok(draft)
}

/// The first of `folders` below the first of `roots` that holds `name`.
pub(crate) fn image_folder(roots: &[PathBuf], folders: &[&str], name: &str) -> Option<PathBuf> {
    let mut all = roots.iter().flat_map(|root| folders.iter().map(move |f| root.join(f)));
    all.find(|folder| folder.join(name).is_file()).map(|folder| folder.components().collect())
}

/// Camera-to-world of `qw qx qy qz tx ty tz`; `None` if the quaternion is not one of a rotation.
///
/// Numbers that are not finite go through: the pose check names them.
pub(crate) fn c2w_of(pose: &[f64; 7]) -> Option<DMat4> {
    let [w, x, y, z, tx, ty, tz] = *pose;
    let q = DQuat::from_xyzw(x, y, z, w);
    // Text files keep at least five digits; a quaternion further off was not one.
    if (q.length() - 1.0).abs() > 1e-3 {
        return None;
    }
    Some(pose::inverse_rigid(DMat3::from_quat(q.normalize()), DVec3::new(tx, ty, tz)))
}

/// COLMAP's camera models that are read: id, name and number of parameters.
const MODELS: [(u32, &str, usize); 5] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
];
/// Those that are known by number and not read.
const OTHER_MODELS: [&str; 6] =
    ["OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"];

/// Name and number of parameters of a model, by id.
///
/// # Errors
/// The name of the model, if it is not read.
pub(crate) fn model_by_id(id: u32) -> Result<(&'static str, usize), String> {
    match MODELS.iter().find(|m| m.0 == id) {
        Some(m) => Ok((m.1, m.2)),
        None => {
            let index = (id as usize).wrapping_sub(MODELS.len());
            Err(OTHER_MODELS.get(index).map_or_else(|| format!("number {id}"), |m| (*m).to_owned()))
        }
    }
}

/// The camera that a model's name and parameters describe.
///
/// # Errors
/// Unsupported model or wrong number of parameters, at `at`.
pub(crate) fn camera(
    path: &Path,
    at: Place,
    model: &str,
    [width, height]: [u32; 2],
    params: &[f64],
) -> Result<Camera, SceneError> {
    let Some(&(_, _, count)) = MODELS.iter().find(|m| m.1 == model) else {
        return Err(unsupported_model(path, at, model));
    };
    if params.len() != count {
        let what = format!("{model} has {count} parameters, not {}", params.len());
        return Err(SceneError::invalid(path, at, what, "correct the camera"));
    }
    let (f, rest) = match model {
        "PINHOLE" | "OPENCV" => ([params[0], params[1]], &params[2..]),
        _ => ([params[0], params[0]], &params[1..]),
    };
    let mut distortion = [0.0; 4];
    distortion[..rest.len() - 2].copy_from_slice(&rest[2..]);
    Ok(Camera { width, height, fx: f[0], fy: f[1], cx: rest[0], cy: rest[1], distortion })
}

pub(crate) fn unsupported_model(path: &Path, at: Place, model: &str) -> SceneError {
    SceneError::unsupported(
        path,
        at,
        format!("camera model {model}"),
        "undistort the images first (`colmap image_undistorter`) or reconstruct with OPENCV",
    )
}
