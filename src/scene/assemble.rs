//! From what a file lists to a checked [`Scene`].

use std::collections::BTreeMap;
use std::path::Path;

use super::draft::{Draft, DraftFrame, ListedSplit};
use super::error::{Place, SceneError};
use super::{Camera, Frame, Scene, Split, bounds, header, pose, timeline};

/// Every how many frames one is held out, and which of them, where a scene names no split.
const HOLD_OUT_EVERY: usize = 8;
const HOLD_OUT_PHASE: usize = 4;

/// Checks everything that all formats share and puts the frames in time order.
///
/// # Errors
/// [`SceneError`] naming the frame and the key, line or byte at fault, and what to do.
pub(crate) fn assemble(mut draft: Draft) -> Result<Scene, SceneError> {
    let mut warnings = std::mem::take(&mut draft.warnings);
    if draft.frames.is_empty() {
        return Err(SceneError::invalid(
            &draft.source,
            Place::File,
            "it lists no frames",
            "a scene needs at least one posed image",
        ));
    }
    timeline::complete(&mut draft, &mut warnings)?;
    draft.frames.sort_by(|a, b| {
        a.time.unwrap_or(0.0).total_cmp(&b.time.unwrap_or(0.0)).then(a.frame_index.cmp(&b.frame_index))
    });
    let splits = assign_splits(&draft, &mut warnings)?;

    let mut seen = Oddities::default();
    let mut frames = Vec::with_capacity(draft.frames.len());
    for (listed, split) in draft.frames.iter().zip(splits) {
        if let Some(split) = split {
            frames.push(check_frame(&draft.source, listed, split, &mut seen)?);
        }
    }
    check_stems(&draft.source, &frames)?;
    seen.report(&mut warnings);
    let listed = draft.points.len();
    draft.points.retain(|p| p.is_finite());
    if draft.points.len() < listed {
        warnings
            .push(format!("{} sparse points are not finite and are left out", listed - draft.points.len()));
    }
    let bounds = bounds::find(&draft, &frames, &mut warnings)?;
    Ok(Scene {
        root: draft.root,
        frames,
        bounds,
        depth_unit: draft.depth_unit,
        depth_is_ground_truth: draft.depth_is_ground_truth,
        points: draft.points,
        warnings,
    })
}

/// The split of each frame in time order; `None` for frames that are left out.
fn assign_splits(draft: &Draft, warnings: &mut Vec<String>) -> Result<Vec<Option<Split>>, SceneError> {
    let by_default = |index: usize| {
        if index % HOLD_OUT_EVERY == HOLD_OUT_PHASE { ListedSplit::Test } else { ListedSplit::Train }
    };
    let splits: Vec<Option<Split>> = (draft.frames.iter().enumerate())
        .map(|(index, frame)| match frame.split.unwrap_or_else(|| by_default(index)) {
            ListedSplit::Train => Some(Split::Train),
            ListedSplit::Test => Some(Split::Test),
            ListedSplit::LeftOut => None,
        })
        .collect();
    let count = |wanted: Option<Split>| splits.iter().filter(|s| **s == wanted).count();
    if count(Some(Split::Train)) == 0 {
        return Err(SceneError::invalid(
            &draft.source,
            Place::File,
            "no frame is left to train on",
            "name at least one frame in the train split that is not in the test split",
        ));
    }
    if count(Some(Split::Test)) == 0 {
        warnings.push(
            "there are no test frames: nothing will be measured on views that were not trained on".into(),
        );
    }
    match count(None) {
        0 => {}
        n => {
            warnings.push(format!("{n} frames are in neither the train nor the test split and are left out"))
        }
    }
    Ok(splits)
}

/// What is odd about some frames, counted so that a thousand frames make one warning.
#[derive(Default)]
struct Oddities {
    /// Frames whose image has another size than the camera, first of them, and the two sizes.
    rescaled: Option<(usize, String)>,
    /// Frames with an EXIF orientation, and the first of them.
    turned: Option<(usize, String)>,
}

impl Oddities {
    fn report(self, warnings: &mut Vec<String>) {
        if let Some((count, first)) = self.rescaled {
            warnings.push(format!("the intrinsics of {count} frames were scaled to their images ({first})"));
        }
        if let Some((count, first)) = self.turned {
            warnings.push(format!(
                "{count} images have an EXIF orientation (first: {first}); poses are taken to be of the pixels \
                 as stored"
            ));
        }
    }
}

fn note(slot: &mut Option<(usize, String)>, text: impl FnOnce() -> String) {
    match slot {
        Some((count, _)) => *count += 1,
        None => *slot = Some((1, text())),
    }
}

fn check_frame(
    source: &Path,
    listed: &DraftFrame,
    split: Split,
    seen: &mut Oddities,
) -> Result<Frame, SceneError> {
    let at = || Place::Frame(listed.name.clone());
    let c2w = pose::checked(listed.c2w)
        .map_err(|(what, remedy)| SceneError::invalid(source, at(), what, remedy))?;
    check_intrinsics(&listed.camera)
        .map_err(|what| SceneError::invalid(source, at(), what, "correct the intrinsics"))?;
    let header = header::of_frame(source, &listed.name, &listed.image_path)?;
    let camera = fit_camera(&listed.camera, header)
        .map_err(|(what, remedy)| SceneError::image(&listed.image_path, &listed.name, what, remedy))?;
    if camera != listed.camera {
        note(&mut seen.rescaled, || {
            let old = &listed.camera;
            format!("{}×{} → {}×{}", old.width, old.height, camera.width, camera.height)
        });
    }
    if header.orientation != 1 {
        note(&mut seen.turned, || listed.name.clone());
    }
    for (kind, path) in [("depth", &listed.depth_path), ("mask", &listed.mask_path)] {
        if let Some(path) = path.as_ref().filter(|p| !p.is_file()) {
            return Err(SceneError::MissingFile {
                listed_in: source.to_owned(),
                frame: listed.name.clone(),
                kind,
                path: path.clone(),
                remedy: format!("put the {kind} there or remove its key from the frame"),
            });
        }
    }
    let stem = listed.image_path.file_stem().and_then(|s| s.to_str()).ok_or_else(|| {
        SceneError::invalid(source, at(), "the name of its image is not UTF-8", "rename the image")
    })?;
    Ok(Frame {
        stem: stem.to_owned(),
        image_path: listed.image_path.clone(),
        camera,
        c2w,
        time: listed.time.unwrap_or(0.0),
        frame_index: listed.frame_index.unwrap_or(0),
        split,
        depth_path: listed.depth_path.clone(),
        mask_path: listed.mask_path.clone(),
    })
}

fn check_intrinsics(camera: &Camera) -> Result<(), String> {
    let Camera { width, height, fx, fy, cx, cy, distortion } = *camera;
    if width == 0 || height == 0 {
        return Err(format!("the image size {width}×{height} holds no pixels"));
    }
    if ![fx, fy, cx, cy].iter().chain(&distortion).all(|x| x.is_finite()) {
        return Err("the intrinsics hold NaN or an infinite number".into());
    }
    if fx <= 0.0 || fy <= 0.0 {
        return Err(format!("the focal lengths {fx}, {fy} are not above 0"));
    }
    Ok(())
}

/// The camera at the size of the stored image, which is what training sees.
///
/// # Errors
/// What is wrong and what to do, if the image is not a plain rescale of what the camera describes.
fn fit_camera(camera: &Camera, header: header::Header) -> Result<Camera, (String, &'static str)> {
    let (width, height) = (header.width, header.height);
    if (width, height) == (camera.width, camera.height) {
        return Ok(*camera);
    }
    let what = format!("the image is {width}×{height}, its camera {}×{}", camera.width, camera.height);
    if (height, width) == (camera.width, camera.height) {
        return Err((what, "the image was turned after the poses were made: store it as it was then"));
    }
    let sx = f64::from(width) / f64::from(camera.width);
    let sy = f64::from(height) / f64::from(camera.height);
    // Whole pixels: both sides may have been rounded by up to one.
    let rounding = 1.0 / f64::from(width.min(camera.width)) + 1.0 / f64::from(height.min(camera.height));
    if (sx / sy - 1.0).abs() > rounding {
        return Err((what, "the image was cropped or padded: correct `w`, `h` and the principal point"));
    }
    Ok(Camera {
        width,
        height,
        fx: camera.fx * sx,
        fy: camera.fy * sy,
        cx: camera.cx * sx,
        cy: camera.cy * sy,
        distortion: camera.distortion,
    })
}

/// Stems key the feature files and outputs: two frames must not share one.
fn check_stems(source: &Path, frames: &[Frame]) -> Result<(), SceneError> {
    let mut owner: BTreeMap<&str, &Frame> = BTreeMap::new();
    for frame in frames {
        if let Some(other) = owner.insert(&frame.stem, frame) {
            return Err(SceneError::invalid(
                source,
                Place::Frame(frame.image_path.display().to_string()),
                format!("it shares the stem `{}` with {}", frame.stem, other.image_path.display()),
                "rename one of the images: features and outputs are named after the stem",
            ));
        }
    }
    Ok(())
}
