//! Renders frames of a run to files, and measures the result.

use std::path::Path;
use std::time::Instant;

use divff_exporters::Manifest;

use super::folder::create_writable;
use super::metrics::{RunMetrics, peak_rss_mb, saved_in_training, skipped_in_training};
use super::semantics::SemanticEvaluation;
use super::{Cost, Event, Observer, PipelineError, RunFolder};
use crate::config::Config;
use crate::eval::{self, RenderedView};
use crate::render::forward::Model;
use crate::render::image::{RenderedFrame, render};
use crate::render::refined::refined_camera;
use crate::render::views::{Layer, quantised, write_view};
use crate::scene::{Frame, Scene, Split};
use crate::semantics::SemanticFields;
use crate::semantics::layers::FeatureLayers;
use crate::train::Trained;
use crate::work::Work;

/// Layers of the files in `views/`.
const VIEW_LAYERS: [Layer; 3] = [Layer::Rgb, Layer::Depth, Layer::Stream];

/// Renders `frames` with the streams, layers and features asked for, into `<stem>.png` and `<stem>.exr` in `out`.
///
/// Returns the number of frames written: fewer than asked for if the observer said stop.
///
/// # Errors
/// A file cannot be written.
#[allow(clippy::too_many_arguments)]
pub fn render_views(
    trained: &Trained,
    config: &Config,
    frames: &[&Frame],
    streams: [bool; 3],
    layers: &[Layer],
    features: Option<&FeatureLayers>,
    out: &Path,
    observer: &mut dyn Observer,
) -> Result<usize, PipelineError> {
    create_writable(out)?;
    let model = Model::new(&trained.field, &trained.grids, streams);
    let sampling = config.train.render_sampling();
    for (done, frame) in frames.iter().enumerate() {
        if observer.stop() {
            return Ok(done);
        }
        let image = render(&model, frame, &sampling, 1);
        // Normals follow from the camera that the picture really was taken with.
        let (camera, c2w) = refined_camera(&trained.field, frame);
        let extra = match features {
            Some(features) => features.render(&model, frame, &sampling)?.channels(),
            None => Vec::new(),
        };
        write_view(out, &frame.stem, &image, &camera, &c2w, layers, extra)?;
        observer.event(&Event::Views { done: done + 1, total: frames.len() });
    }
    Ok(frames.len())
}

/// Renders the test frames into `views/`, and compares them and the meshes in `map/` with the scene's truth.
///
/// `cost` is what the stages before took. `None` if the observer said stop.
///
/// # Errors
/// The truth cannot be read, a view cannot be written.
pub fn evaluate(
    scene: &Scene,
    trained: &Trained,
    fields: Option<&SemanticFields>,
    config: &Config,
    run: &RunFolder,
    mut cost: Cost,
    observer: &mut dyn Observer,
) -> Result<Option<RunMetrics>, PipelineError> {
    let start = Instant::now();
    create_writable(&run.views())?;
    let model = Model::new(&trained.field, &trained.grids, [true; 3]);
    let sampling = config.train.render_sampling();
    let total = scene.frames.iter().filter(|f| f.split == Split::Test).count();
    let mut semantic = SemanticEvaluation::new(scene, fields, config)?;
    let mut done = 0;
    let mut quality = eval::evaluate_images(scene, |frame| {
        if observer.stop() {
            return Ok(None);
        }
        let image = render(&model, frame, &sampling, 1);
        let extra = semantic.add(&model, frame, &sampling)?;
        write_view(&run.views(), &frame.stem, &image, &frame.camera, &frame.c2w, &VIEW_LAYERS, extra)?;
        done += 1;
        observer.event(&Event::Views { done, total });
        Ok(Some(measurable(image)))
    })?;
    if observer.stop() {
        return Ok(None);
    }
    let compression = semantic.fill_in(&mut quality, &model, &sampling)?;
    let mut skipped = skipped_in_training(&trained.progress, trained.field.shape.streams);
    let reasons = fields.map(|f| f.skipped.iter().map(|(what, why)| (what.clone(), why.clone().into())));
    skipped.insert("features".to_owned(), serde_json::Value::Object(reasons.into_iter().flatten().collect()));
    // Without a manifest the files there are, if any, are not a whole map.
    match Manifest::read(&run.map()) {
        Ok(manifest) => {
            eval::evaluate_geometry(scene, &run.map(), &mut quality)?;
            let reasons = manifest.skipped.into_iter().map(|s| (s.what, s.why.into())).collect();
            skipped.insert("map".to_owned(), serde_json::Value::Object(reasons));
        }
        Err(_) => {
            quality.absent.insert("persistent".into(), "the run has no complete map".into());
        }
    }
    cost.set_training(&trained.progress);
    cost.saved.extend(saved_in_training(&trained.progress).map(|(what, work)| (what.to_owned(), work)));
    cost.saved.insert("layers".to_owned(), unasked_layers(scene));
    cost.saved.retain(|_, work| *work != Work::default());
    skipped.insert("work".to_owned(), serde_json::json!(cost.saved));
    cost.eval_seconds = Some(start.elapsed().as_secs_f64());
    cost.peak_rss_mb = peak_rss_mb();
    Ok(Some(RunMetrics { quality, cost, compression, skipped }))
}

/// What the layers that [`VIEW_LAYERS`] leaves out would take of the test frames' views.
fn unasked_layers(scene: &Scene) -> Work {
    let unasked = Layer::ALL.into_iter().filter(|l| !VIEW_LAYERS.contains(l)).map(Layer::bytes_per_pixel);
    let frames = scene.frames.iter().filter(|f| f.split == Split::Test);
    let pixels = frames.map(|f| u64::from(f.camera.width) * u64::from(f.camera.height));
    Work::bytes(unasked.sum::<u64>() * pixels.sum::<u64>())
}

/// What is measured of a frame: the colours as 8-bit PNGs hold them.
pub(super) fn measurable(image: RenderedFrame) -> RenderedView {
    RenderedView {
        rgb: quantised(&image.rgb).as_chunks::<3>().0.to_vec(),
        depth: Some(image.depth),
        streams: Some(std::array::from_fn(|s| image.opacity.iter().map(|o| o[s]).collect())),
    }
}
