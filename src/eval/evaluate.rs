//! Goes through a scene's test frames and a map's meshes and fills in [`Metrics`].

use std::path::{Path, PathBuf};

use divff_exporters::Geometry;

use super::images::{ImageSums, RenderedView};
use super::surface::{self, DepthView, SurfaceMetrics};
use super::truth::{FrameTruth, depth_view};
use super::{EvalError, Metrics};
use crate::error::FileError;
use crate::scene::{Frame, Scene, Split};

/// Views whose depth says which surfaces were seen: about so many, evenly spread over the training frames.
const VIEWS: usize = 80;

/// The renderer's own error.
type RenderError = Box<dyn std::error::Error + Send + Sync>;

/// Every measure of a run that needs no semantics.
///
/// `render` gives the rendering of a test frame, or `None` where there is none (counted in
/// `missing_frames`). `map` is the folder with `persistent.ply`, `dynamic_<frame>.ply` and
/// `actor_<frame>.ply`.
///
/// # Errors
/// [`EvalError`] for unreadable or damaged files and renderings. Missing truth or an empty mesh is not an
/// error: the measure is left out and [`Metrics::absent`] says why.
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
/// As [`evaluate()`].
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
/// The persistent surface is judged by the depth of about 80 training frames, a dynamic or actor surface by
/// that of the frame it belongs to.
///
/// # Errors
/// As [`evaluate()`].
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

/// `(stem, path)` of each `<stream>_<stem>.ply` in `folder`, sorted by name; none when there is no such
/// folder.
fn meshes_of(folder: &Path, stream: &str) -> Result<Vec<(String, PathBuf)>, EvalError> {
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let io = FileError::at(folder);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(&io)? {
        let path = entry.map_err(&io)?.path();
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synth::{SynthOptions, generate};

    fn scene() -> (tempfile::TempDir, Scene) {
        let dir = tempfile::tempdir().unwrap();
        generate(&SynthOptions { frames: 16, width: 64, height: 36, seed: 1 }, dir.path()).unwrap();
        let scene = Scene::open(dir.path()).unwrap();
        (dir, scene)
    }

    /// The truth itself as a rendering, every colour raised by `offset`.
    fn perfect(scene: &Scene, frame: &Frame, offset: u8) -> RenderedView {
        let truth = FrameTruth::read(scene, frame).unwrap();
        let opacity =
            |s| truth.streams.as_ref().unwrap().iter().map(|t| f32::from(u8::from(*t == s))).collect();
        RenderedView {
            rgb: truth.rgb.iter().map(|p| p.map(|c| c.saturating_add(offset))).collect(),
            depth: truth.depth.clone(),
            streams: Some([opacity(0), opacity(1), opacity(2)]),
        }
    }

    #[test]
    fn truth_compared_with_itself_is_perfect() {
        let (dir, scene) = scene();
        let map = dir.path().join("gt/mesh");
        let m = evaluate(&scene, Some(&map), |f| Ok(Some(perfect(&scene, f, 0)))).unwrap();
        assert_eq!((m.test_frames, m.missing_frames), (2, 0));
        assert_eq!((m.psnr, m.depth_median_abs_m, m.stream_miou), (None, Some(0.0), Some(1.0)));
        assert_eq!(m.absent["psnr"], "the images are identical");
        for surface in [m.persistent, m.dynamic, m.actor] {
            let surface = surface.unwrap();
            // f32 rounding of points a few metres from the origin.
            assert!(surface.chamfer_m < 1e-5 && surface.fscore_2cm == 1.0, "{surface:?}");
        }
        assert_eq!((m.dynamic.unwrap().times, m.persistent.unwrap().times), (Some(2), None));
        let json = serde_json::to_string(&m).unwrap();
        assert_eq!(serde_json::from_str::<Metrics>(&json).unwrap(), m);
    }

    #[test]
    fn what_is_missing_is_absent_with_a_reason() {
        let (dir, scene) = scene();
        let map = tempfile::tempdir().unwrap();
        let header = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n\
                      property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n";
        std::fs::write(map.path().join("persistent.ply"), header).unwrap();
        let m = evaluate(&scene, Some(map.path()), |_| Ok(None)).unwrap();
        assert_eq!((m.missing_frames, m.psnr, m.persistent), (2, None, None));
        assert!(m.absent["persistent"].contains("empty"), "{:?}", m.absent);
        assert!(m.absent["actor_000004"].contains("no actor_000004.ply"), "{:?}", m.absent);

        std::fs::remove_dir_all(dir.path().join("gt")).unwrap();
        let m = evaluate(&scene, Some(map.path()), |f| {
            let rgb = f.load_rgb()?.pixels.iter().map(|p| p.map(|c| c / 2)).collect();
            Ok(Some(RenderedView { rgb, ..Default::default() }))
        });
        let m = m.unwrap();
        assert!(m.psnr.unwrap() > 5.0 && m.ssim.is_some(), "images need no ground truth but themselves");
        assert_eq!((m.psnr_persistent, m.stream_miou, m.persistent, m.dynamic), (None, None, None, None));
    }

    #[test]
    fn failing_renderers_name_the_frame() {
        let (_dir, scene) = scene();
        let error = evaluate_images(&scene, |_| Err("out of memory".into())).unwrap_err();
        assert_eq!(error.to_string(), "cannot render frame 000004: out of memory");
    }
}
