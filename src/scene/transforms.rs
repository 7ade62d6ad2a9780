//! nerfstudio's `transforms.json`: the native format.
//!
//! Poses are camera-to-world with OpenGL camera axes. `applied_transform` (and `applied_scale`) lead from the
//! coordinates of the original reconstruction to the ones saved in the file; they are undone for poses,
//! `aabb` and sparse points, so that the scene keeps its original coordinates.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use divff_exporters::read_ply_positions;
use glam::{DMat4, DVec3};
use serde_json::{Map, Value};

use super::draft::{Draft, DraftFrame, ListedSplit};
use super::error::{Place, SceneError};
use super::json::{self, Fields};
use super::{Aabb, Camera, header, pose};

/// Takes the scene out of the JSON object in `file`; paths are relative to its folder.
pub(crate) fn read(file: &Path, map: &Map<String, Value>) -> Result<Draft, SceneError> {
    let root = file.parent().unwrap_or(Path::new("."));
    let top = Fields { path: file, frame: None, map };
    check_camera_model(&top)?;
    let undo = undo_applied_transform(&top)?;
    let splits = Splits::read(&top)?;

    let mut draft = Draft::new(root.to_owned(), file.to_owned());
    let frames = top.list("frames")?.ok_or_else(|| top.invalid("frames", "the key is missing", "add it"))?;
    for (index, value) in frames.iter().enumerate() {
        let mut frame = read_frame(root, &top, index, value)?;
        frame.c2w = undo.of_pose(frame.c2w);
        frame.split = splits.of(&frame.name);
        draft.frames.push(frame);
    }
    splits.check_all_used(&top, &draft.frames)?;

    draft.aabb = read_aabb(&top)?.map(|b| undo.of_box(b));
    draft.depth_unit = top.number("depth_unit_scale_factor")?.unwrap_or(0.001);
    if draft.depth_unit <= 0.0 {
        return Err(top.invalid(
            "depth_unit_scale_factor",
            format!("{} is not above 0", draft.depth_unit),
            "give the world units per stored depth unit (0.001 for millimetres)",
        ));
    }
    draft.depth_is_ground_truth = top.flag("depth_is_ground_truth")?.unwrap_or(false);
    if let Some(ply) = top.text("ply_file_path")? {
        let saved = read_ply_positions(&root.join(ply)).map_err(SceneError::Points)?;
        draft.points = saved.into_iter().map(|p| undo.of_point(p.into())).collect();
    }
    Ok(draft)
}

fn check_camera_model(fields: &Fields) -> Result<(), SceneError> {
    let remedy = "undistort the images to PINHOLE or OPENCV (COLMAP: `colmap image_undistorter`)";
    match fields.text("camera_model")? {
        None | Some("PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV" | "PERSPECTIVE") => {
        }
        Some(model) => {
            let at = fields.place("camera_model");
            return Err(SceneError::unsupported(fields.path, at, format!("camera model {model}"), remedy));
        }
    }
    for key in ["k3", "k4", "k5", "k6"] {
        if fields.number(key)?.is_some_and(|k| k != 0.0) {
            let what = format!("distortion coefficient {key} other than 0");
            return Err(SceneError::unsupported(fields.path, fields.place(key), what, remedy));
        }
    }
    if fields.flag("is_fisheye")?.unwrap_or(false) {
        return Err(SceneError::unsupported(
            fields.path,
            fields.place("is_fisheye"),
            "a fisheye lens",
            remedy,
        ));
    }
    Ok(())
}

fn read_frame(root: &Path, top: &Fields, index: usize, value: &Value) -> Result<DraftFrame, SceneError> {
    let number = format!("number {index}");
    let map = value.as_object().ok_or_else(|| {
        let at = Place::Frame(number.clone());
        SceneError::invalid(top.path, at, "the frame is not an object", "correct the file")
    })?;
    let nameless = Fields { path: top.path, frame: Some(&number), map };
    let name = nameless.text("file_path")?.ok_or_else(|| {
        nameless.invalid("file_path", "the key is missing", "name the frame's image, relative to the folder")
    })?;
    let fields = Fields { path: top.path, frame: Some(name), map };
    check_camera_model(&fields)?;
    let c2w = fields.matrix("transform_matrix")?.ok_or_else(|| {
        fields.invalid("transform_matrix", "the key is missing", "add the camera-to-world matrix")
    })?;
    let image_path = with_extension(root.join(name));
    Ok(DraftFrame {
        name: name.to_owned(),
        camera: read_camera(top, &fields, name, &image_path)?,
        image_path,
        c2w: pose::from_opengl(c2w),
        time: fields.number("time")?,
        frame_index: fields.whole("frame_index")?,
        split: None,
        depth_path: fields.text("depth_file_path")?.map(|p| root.join(p)),
        mask_path: fields.text("mask_path")?.map(|p| root.join(p)),
    })
}

/// Adds the extension that Blender-style files (`"file_path": "./train/r_0"`) leave out.
fn with_extension(path: PathBuf) -> PathBuf {
    if path.extension().is_some() || path.exists() {
        return path;
    }
    let candidates = ["png", "jpg", "jpeg"].map(|e| path.with_extension(e));
    candidates.into_iter().find(|p| p.exists()).unwrap_or(path)
}

/// The intrinsics of a frame: each key from the frame, else from the file, else from the image's own size.
fn read_camera(top: &Fields, frame: &Fields, name: &str, image_path: &Path) -> Result<Camera, SceneError> {
    let number =
        |key: &str| -> Result<Option<f64>, SceneError> { Ok(frame.number(key)?.or(top.number(key)?)) };
    let whole = |key: &str| -> Result<Option<u32>, SceneError> { Ok(frame.whole(key)?.or(top.whole(key)?)) };
    let (width, height) = match (whole("w")?, whole("h")?) {
        (Some(w), Some(h)) => (w, h),
        _ => {
            let header = header::of_frame(frame.path, name, image_path)?;
            (header.width, header.height)
        }
    };
    let focal = |key: &str, angle_key: &str, extent: u32| -> Result<Option<f64>, SceneError> {
        if let Some(f) = number(key)? {
            return Ok(Some(f));
        }
        let Some(angle) = number(angle_key)? else { return Ok(None) };
        if !(angle > 0.0 && angle < std::f64::consts::PI) {
            return Err(frame.invalid(angle_key, format!("{angle} is not between 0 and π"), "correct it"));
        }
        Ok(Some(0.5 * f64::from(extent) / (0.5 * angle).tan()))
    };
    let fx = focal("fl_x", "camera_angle_x", width)?.ok_or_else(|| {
        frame.invalid(
            "fl_x",
            "neither `fl_x` nor `camera_angle_x` is given",
            "add the focal length in pixels",
        )
    })?;
    let coefficient = |key: &str| -> Result<f64, SceneError> { Ok(number(key)?.unwrap_or(0.0)) };
    Ok(Camera {
        width,
        height,
        fx,
        fy: focal("fl_y", "camera_angle_y", height)?.unwrap_or(fx),
        cx: number("cx")?.unwrap_or(0.5 * f64::from(width)),
        cy: number("cy")?.unwrap_or(0.5 * f64::from(height)),
        distortion: [coefficient("k1")?, coefficient("k2")?, coefficient("p1")?, coefficient("p2")?],
    })
}

fn read_aabb(top: &Fields) -> Result<Option<Aabb>, SceneError> {
    let Some(value) = top.map.get("aabb") else { return Ok(None) };
    let corners = value
        .as_array()
        .filter(|c| c.len() == 2)
        .and_then(|c| Some((json::finite_array::<3>(&c[0])?, json::finite_array::<3>(&c[1])?)));
    let (min, max) = corners.ok_or_else(|| {
        top.invalid("aabb", "expected [[x, y, z], [x, y, z]] with finite numbers", "correct or remove it")
    })?;
    let aabb = Aabb { min: DVec3::from(min), max: DVec3::from(max) };
    // Here and not only after `applied_transform` is undone: that sorts the corners.
    if !aabb.min.cmplt(aabb.max).all() {
        let what = format!("the box from {} to {} is empty", aabb.min, aabb.max);
        return Err(top.invalid("aabb", what, "give the smallest corner first, then the largest"));
    }
    Ok(Some(aabb))
}

/// The way from the file's coordinates back to those of the original reconstruction.
struct Undo {
    /// original ← saved, rigid.
    transform: DMat4,
    /// Saved units per original unit.
    scale: f64,
}

fn undo_applied_transform(top: &Fields) -> Result<Undo, SceneError> {
    let scale = top.number("applied_scale")?.unwrap_or(1.0);
    if scale <= 0.0 {
        return Err(top.invalid("applied_scale", format!("{scale} is not above 0"), "correct or remove it"));
    }
    let transform = match top.matrix("applied_transform")? {
        None => DMat4::IDENTITY,
        Some(m) => {
            let rigid = pose::checked(m).map_err(|(what, _)| {
                top.invalid("applied_transform", what, "only a rotation and a shift can be undone; remove it")
            })?;
            DMat4::from(rigid.inverse())
        }
    };
    Ok(Undo { transform, scale })
}

impl Undo {
    fn of_pose(&self, mut c2w: DMat4) -> DMat4 {
        c2w.w_axis = (c2w.w_axis.truncate() / self.scale).extend(c2w.w_axis.w);
        self.transform * c2w
    }

    fn of_point(&self, p: DVec3) -> DVec3 {
        self.transform.transform_point3(p / self.scale)
    }

    /// The axis-aligned box around the corners of the box.
    fn of_box(&self, b: Aabb) -> Aabb {
        let corners = b.corners().map(|c| self.of_point(c));
        Aabb {
            min: corners.into_iter().reduce(DVec3::min).unwrap_or(b.min),
            max: corners.into_iter().reduce(DVec3::max).unwrap_or(b.max),
        }
    }
}

/// The lists `train_filenames`, `test_filenames` and `val_filenames`.
struct Splits {
    train: Option<BTreeSet<String>>,
    test: Option<BTreeSet<String>>,
    val: Option<BTreeSet<String>>,
}

impl Splits {
    fn read(top: &Fields) -> Result<Self, SceneError> {
        let names = |key: &str| -> Result<Option<BTreeSet<String>>, SceneError> {
            let Some(list) = top.list(key)? else { return Ok(None) };
            let name = |v: &Value| v.as_str().map(plain);
            let names: Option<BTreeSet<String>> = list.iter().map(name).collect();
            let wrong =
                || top.invalid(key, "expected a list of file names", "list the `file_path` of frames");
            names.map(Some).ok_or_else(wrong)
        };
        let (train, test, val) =
            (names("train_filenames")?, names("test_filenames")?, names("val_filenames")?);
        Ok(Splits { train, test, val })
    }

    /// The split of a frame. Held out wins over trained on, so that a test stays a test. Frames in none of
    /// the lists are left out, except where one list alone says what the others are.
    fn of(&self, file_path: &str) -> Option<ListedSplit> {
        let name = plain(file_path);
        let within = |set: &Option<BTreeSet<String>>| set.as_ref().is_some_and(|s| s.contains(&name));
        let held_out = if self.test.is_some() { &self.test } else { &self.val };
        match (&self.train, held_out) {
            (None, None) => None,
            _ if within(held_out) => Some(ListedSplit::Test),
            (Some(_), Some(_)) if within(&self.train) => Some(ListedSplit::Train),
            (Some(_), Some(_)) => Some(ListedSplit::LeftOut),
            (Some(_), None) if within(&self.train) => Some(ListedSplit::Train),
            (Some(_), None) => Some(ListedSplit::Test),
            (None, Some(_)) if within(&self.val) => Some(ListedSplit::LeftOut),
            (None, Some(_)) => Some(ListedSplit::Train),
        }
    }

    /// A listed file that is no frame is most often a path written in another way: nothing would be held out.
    fn check_all_used(&self, top: &Fields, frames: &[DraftFrame]) -> Result<(), SceneError> {
        let known: BTreeSet<String> = frames.iter().map(|f| plain(&f.name)).collect();
        let lists =
            [("train_filenames", &self.train), ("test_filenames", &self.test), ("val_filenames", &self.val)];
        for (key, list) in lists {
            if let Some(name) = list.iter().flatten().find(|n| !known.contains(*n)) {
                let what = format!("{name} is not the `file_path` of any frame");
                return Err(top.invalid(key, what, "write the names as the frames do, or remove it"));
            }
        }
        Ok(())
    }
}

/// A file name without a leading `./` and with forward slashes.
fn plain(name: &str) -> String {
    let name = name.replace('\\', "/");
    name.strip_prefix("./").unwrap_or(&name).to_owned()
}
