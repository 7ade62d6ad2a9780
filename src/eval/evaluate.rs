//! Goes through a scene's test frames and a map's meshes and fills in [`Metrics`].

use std::path::{Path, PathBuf};

use divff_exporters::Geometry;

use super::images::{ImageSums, RenderedView};
use super::surface::{self, DepthView, SurfaceMetrics};
use super::truth::{FrameTruth, depth_view};
use super::{EvalError, Metrics};
use crate::scene::{Frame, Scene, Split};

/// Views whose depth says which surfaces were seen: about so many, evenly spread over the training frames.
const VIEWS: usize = 80;

/// The renderer's own error.
type RenderError = Box<dyn std::error::Error + Send + Sync>;

/// Every measure of a run that needs no semantics.
///
/// `render` gives the rendering of a test frame, or `None` where there is none (counted in `missing_frames`).
/// `map` is the folder with `persistent.ply`, `dynamic_<frame>.ply` and `actor_<frame>.ply`.
///
/// # Errors
/// [`EvalError`] for unreadable or damaged files and renderings. Missing truth or an empty mesh is not an error:
/// the measure is left out and [`Metrics::absent`] says why.
pub fn evaluate(
    scene: &Scene,
    map: Option<&Path>,
    render: impl FnMut(&Frame) -> Result<Option<RenderedView>, RenderError>,
) -> Result<Metrics, EvalError> {
    let mut metrics = evaluate_images(scene, render)?;
    match map {
        Some(map) => evaluate_geometry(scene, map, &mut metrics)?,
        None => {
            metrics.absent.insert("persistent".into(), "no map was given".into());
        }
    }
    Ok(metrics)
}

/// The per-pixel measures over the test frames.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_images(
    scene: &Scene,
    mut render: impl FnMut(&Frame) -> Result<Option<RenderedView>, RenderError>,
) -> Result<Metrics, EvalError> {
    let mut metrics = Metrics::default();
    let mut sums = ImageSums::default();
    for frame in scene.frames.iter().filter(|f| f.split == Split::Test) {
        metrics.test_frames += 1;
        let view = render(frame).map_err(|source| EvalError::Render { frame: frame.stem.clone(), source })?;
        match view {
            Some(view) => sums.add(frame, &view, &FrameTruth::read(scene, frame)?)?,
            None => metrics.missing_frames += 1,
        }
    }
    fill_in_images(&mut metrics, &sums);
    Ok(metrics)
}

fn fill_in_images(metrics: &mut Metrics, sums: &ImageSums) {
    let nothing =
        if metrics.test_frames == 0 { "the scene has no test frames" } else { "no frame was rendered" };
    let rendered = metrics.test_frames > metrics.missing_frames;
    let absent = &mut metrics.absent;
    let mut keep = |name: &str, value: Option<f64>, reason: &str| {
        let reason = match value {
            Some(v) if v.is_finite() => return value,
            Some(_) => "the images are identical",
            None if rendered => reason,
            None => nothing,
        };
        absent.insert(name.into(), reason.into());
        None
    };
    let streams = sums.stream_ious();
    let no_streams = "no true stream covers 50 px, or no stream was rendered";
    metrics.psnr = keep("psnr", sums.psnr(), "no pixels");
    metrics.psnr_persistent =
        keep("psnr_persistent", sums.psnr_persistent(), "the scene has no true streams");
    metrics.ssim = keep("ssim", sums.ssim(), "the images are smaller than the 11 px window");
    metrics.depth_median_abs_m =
        keep("depth_median_abs_m", sums.depth_median_abs(), "no true depth, or no depth was rendered");
    metrics.stream_iou_persistent = keep("stream_iou_persistent", streams[0], no_streams);
    metrics.stream_iou_dynamic = keep("stream_iou_dynamic", streams[1], no_streams);
    metrics.stream_iou_actor = keep("stream_iou_actor", streams[2], no_streams);
    let present: Vec<f64> = streams.into_iter().flatten().collect();
    metrics.stream_miou = keep("stream_miou", super::images::mean(&present), no_streams);
}

/// The measures of the map's meshes against `gt/mesh`, added to `metrics`.
///
/// The persistent surface is judged by the depth of about 80 training frames, a dynamic or actor surface by that of
/// the frame it belongs to.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_geometry(scene: &Scene, map: &Path, metrics: &mut Metrics) -> Result<(), EvalError> {
    let truth = scene.root.join("gt").join("mesh");
    metrics.persistent = match persistent(scene, map, &truth)? {
        Ok(measures) => Some(measures),
        Err(reason) => {
            metrics.absent.insert("persistent".into(), reason);
            None
        }
    };
    metrics.dynamic = over_times(scene, map, &truth, "dynamic", metrics)?;
    metrics.actor = over_times(scene, map, &truth, "actor", metrics)?;
    Ok(())
}

/// Measures, or the reason why there are none.
type Measured = Result<SurfaceMetrics, String>;

fn persistent(scene: &Scene, map: &Path, truth: &Path) -> Result<Measured, EvalError> {
    let (ours, truth) = (map.join("persistent.ply"), truth.join("persistent.ply"));
    if !truth.exists() {
        return Ok(Err("the scene has no gt/mesh/persistent.ply".into()));
    }
    if !ours.exists() {
        return Ok(Err("the map has no persistent.ply".into()));
    }
    measure(&training_views(scene)?, &ours, &truth)
}

/// Average over the times for which both the truth and the map have a mesh.
fn over_times(
    scene: &Scene,
    map: &Path,
    truth: &Path,
    stream: &str,
    metrics: &mut Metrics,
) -> Result<Option<SurfaceMetrics>, EvalError> {
    let mut measured = Vec::new();
    for (stem, truth) in meshes_of(truth, stream)? {
        let name = format!("{stream}_{stem}");
        let ours = map.join(format!("{name}.ply"));
        let result = if ours.exists() {
            let mut views = Vec::new();
            for frame in scene.frames.iter().filter(|f| f.stem == stem) {
                views.extend(depth_view(scene, frame)?);
            }
            measure(&views, &ours, &truth)?
        } else {
            Err(format!("the map has no {name}.ply"))
        };
        match result {
            Ok(m) => measured.push(m),
            Err(reason) => {
                metrics.absent.insert(name, reason);
            }
        }
    }
    let mean = SurfaceMetrics::mean(&measured);
    if mean.is_none() {
        let reason = format!("no time has both a true and an extracted {stream} surface that was seen");
        metrics.absent.insert(stream.into(), reason);
    }
    Ok(mean)
}

fn measure(views: &[DepthView], ours: &Path, truth: &Path) -> Result<Measured, EvalError> {
    match surface::compare(views, &read_mesh(ours)?, &read_mesh(truth)?) {
        Ok(measures) => Ok(Ok(measures)),
        Err(reason) if reason.is_absence() => Ok(Err(reason.to_string())),
        Err(source) => Err(EvalError::Surface { path: ours.to_path_buf(), source }),
    }
}

/// Every `max(1, n / 80)`-th of the training frames that have depth, `n` counting all training frames.
fn training_views(scene: &Scene) -> Result<Vec<DepthView>, EvalError> {
    let train: Vec<&Frame> = scene.frames.iter().filter(|f| f.split == Split::Train).collect();
    let stride = (train.len() / VIEWS).max(1);
    let with_depth = train.into_iter().filter(|f| f.depth_path.is_some()).step_by(stride);
    let views: Result<Vec<_>, _> = with_depth.map(|f| depth_view(scene, f)).collect();
    Ok(views?.into_iter().flatten().collect())
}

/// `(stem, path)` of each `<stream>_<stem>.ply` in `folder`, sorted by name; none when there is no such folder.
fn meshes_of(folder: &Path, stream: &str) -> Result<Vec<(String, PathBuf)>, EvalError> {
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let io = |source| EvalError::Io { path: folder.to_path_buf(), source };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let stem =
            name.strip_prefix(stream).and_then(|n| n.strip_prefix('_')).and_then(|n| n.strip_suffix(".ply"));
        if let Some(stem) = stem {
            found.push((stem.to_owned(), path.clone()));
        }
    }
    found.sort();
    Ok(found)
}

fn read_mesh(path: &Path) -> Result<Geometry, EvalError> {
    divff_exporters::read_ply(path).map_err(|source| EvalError::Ply { source: source.into() })
}
