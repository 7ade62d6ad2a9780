//! `run`, `train`, `export`, `render` and `eval`.

use std::path::Path;

use divff::config::Config;
use divff::field::Stream;
use divff::map::Format;
use divff::pipeline::folder::{create_writable, write_json};
use divff::pipeline::{self, Cost, Event, Observer, Outcome, RunFolder, RunMetrics, RunOptions, Stage};
use divff::render::views::Layer;
use divff::scene::{Frame, Scene, Split};
use divff::train::Trained;

use super::args::{EvalArgs, ExportArgs, FormatArg, LayerArg, RenderArgs, RunArgs, SplitArg, StreamArg};
use super::error::CliError;
use super::output::say;
use super::progress::{Reporter, human};
use super::query;
use super::settings;
use super::stop::StopFlag;

/// `divff run`.
pub fn run(args: &RunArgs, stop: StopFlag) -> Result<(), CliError> {
    let config = settings::resolve(&args.settings)?;
    let mut reporter = Reporter::new(stop);
    let scene = open(&args.scene, &reporter)?;
    let options = RunOptions { fresh: args.fresh };
    let outcome = pipeline::run(&scene, &config, &args.out, &options, &mut reporter)?;
    drop(reporter);
    match outcome {
        Outcome::Finished(metrics) => {
            say(summary(&metrics))?;
            say(format_args!("report: {}", RunFolder::new(&args.out).report_path().display()))
        }
        Outcome::Stopped { step } => Err(CliError::Stopped { step }),
    }
}

/// `divff train`.
pub fn train(args: &RunArgs, stop: StopFlag) -> Result<(), CliError> {
    let config = settings::resolve(&args.settings)?;
    let mut reporter = Reporter::new(stop);
    let scene = open(&args.scene, &reporter)?;
    let run = RunFolder::new(&args.out);
    reporter.event(&Event::Stage(Stage::Training));
    let session = pipeline::train(&scene, &config, &run, args.fresh, &mut reporter)?;
    let progress = session.trained().progress.clone();
    let finished = progress.finished
        && pipeline::train_features(&scene, session, &config, &run, &mut reporter)?.is_some();
    drop(reporter);
    if !finished {
        return Err(CliError::Stopped { step: progress.step });
    }
    say(format_args!("trained {} steps in {}", progress.step, human(progress.seconds)))
}

/// `divff export`.
pub fn export(args: &ExportArgs, stop: StopFlag) -> Result<(), CliError> {
    let run = RunFolder::open(&args.run)?;
    let mut reporter = Reporter::new(stop);
    let scene = run.scene(args.scene.as_deref())?;
    let mut config = run.config()?;
    let wanted = chosen_streams(&args.streams);
    config.map.streams = Stream::ALL.into_iter().filter(|s| wanted[*s as usize]).collect();
    config.map.times = args.times.clone();
    config.map.voxel_size = args.voxel.or(config.map.voxel_size);
    config.map.simplify = args.simplify.unwrap_or(config.map.simplify);
    config.validate()?;
    create_writable(&args.out)?;
    let trained = run.trained()?;
    let formats: Vec<Format> = args.formats.iter().filter_map(|f| map_format(*f)).collect();
    let views = match args.formats.contains(&FormatArg::Exr) {
        true => export_views(&scene, &trained, &config, &args.out, &mut reporter)?,
        false => Vec::new(),
    };
    let cost = &mut Cost::default();
    let fields = pipeline::features(&run, &trained)?;
    let fields = fields.as_ref();
    let out = &args.out;
    let manifest =
        pipeline::export_map(&scene, &trained, fields, &config, out, &formats, cost, &mut reporter)?;
    drop(reporter);
    let Some(mut manifest) = manifest else { return Err(CliError::Interrupted) };
    if !views.is_empty() {
        for file in &views {
            manifest.add_file(&args.out, file, 0, 0)?;
        }
        manifest.write(&args.out)?;
    }
    for s in &manifest.skipped {
        say(format_args!("skipped {}: {}", s.what, s.why))?;
    }
    for s in &manifest.simplified {
        say(format_args!(
            "{}: {} of {} triangles, at most {:.4} from where they were",
            s.name, s.triangles_after, s.triangles_before, s.largest_distance
        ))?;
    }
    say(format_args!("{} files in {}", manifest.files.len(), args.out.display()))
}

/// Renders the test frames into `views/` of an export; the files' paths relative to it.
fn export_views(
    scene: &Scene,
    trained: &Trained,
    config: &Config,
    out: &Path,
    reporter: &mut Reporter,
) -> Result<Vec<String>, CliError> {
    let frames: Vec<&Frame> = scene.frames.iter().filter(|f| f.split == Split::Test).collect();
    let layers = [Layer::Rgb, Layer::Depth, Layer::Normal, Layer::Stream];
    reporter.event(&Event::Stage(Stage::Rendering));
    let folder = out.join("views");
    let done = pipeline::render_views(trained, config, &frames, [true; 3], &layers, None, &folder, reporter)?;
    let names = |f: &&Frame| ["exr", "png"].map(|kind| format!("views/{}.{kind}", f.stem));
    Ok(frames[..done].iter().flat_map(names).collect())
}

/// `divff render`.
pub fn render(args: &RenderArgs, stop: StopFlag) -> Result<(), CliError> {
    let run = RunFolder::open(&args.run)?;
    let mut reporter = Reporter::new(stop);
    let scene = run.scene(args.scene.as_deref())?;
    let frames = chosen_frames(args, &scene)?;
    create_writable(&args.out)?;
    let (trained, config) = (run.trained()?, run.config()?);
    let streams = chosen_streams(&args.streams);
    let mut layers: Vec<Layer> = args.layers.iter().filter_map(|l| layer(*l)).collect();
    layers.sort();
    layers.dedup();
    let fields = pipeline::features(&run, &trained)?;
    let features = query::feature_layers(args, &scene, &run, fields.as_ref(), &config)?;
    let features = Some(&features).filter(|f| !f.is_empty());
    reporter.event(&Event::Stage(Stage::Rendering));
    let out = &args.out;
    let done =
        pipeline::render_views(&trained, &config, &frames, streams, &layers, features, out, &mut reporter)?;
    drop(reporter);
    if done < frames.len() {
        return Err(CliError::Interrupted);
    }
    say(format_args!("{done} frames in {}", args.out.display()))
}

/// `divff eval`.
pub fn eval(args: &EvalArgs, stop: StopFlag) -> Result<(), CliError> {
    let run = RunFolder::open(&args.run)?;
    let mut reporter = Reporter::new(stop);
    let scene = run.scene(args.scene.as_deref())?;
    let out = args.out.clone().unwrap_or_else(|| run.metrics_path());
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    create_writable(folder)?;
    let (trained, config) = (run.trained()?, run.config()?);
    // What the other stages took is known from when they ran.
    let earlier = pipeline::metrics::read(&run.metrics_path());
    let cost = earlier.as_ref().map_or_else(Cost::default, RunMetrics::known_cost);
    reporter.event(&Event::Stage(Stage::Evaluating));
    let fields = pipeline::features(&run, &trained)?;
    let fields = fields.as_ref();
    let metrics = pipeline::evaluate(&scene, &trained, fields, &config, &run, cost, &mut reporter)?;
    drop(reporter);
    let Some(mut metrics) = metrics else { return Err(CliError::Interrupted) };
    for (key, value) in earlier.map(|m| m.skipped).unwrap_or_default() {
        metrics.skipped.entry(key).or_insert(value);
    }
    write_json(&out, &metrics)?;
    say(summary(&metrics))?;
    say(format_args!("measures: {}", out.display()))
}

/// Opens a scene and passes on what is odd about it.
pub fn open(path: &Path, reporter: &Reporter) -> Result<Scene, CliError> {
    let scene = Scene::open(path)?;
    for warning in &scene.warnings {
        reporter.note(&format!("warning: {warning}"));
    }
    Ok(scene)
}

fn chosen_frames<'a>(args: &RenderArgs, scene: &'a Scene) -> Result<Vec<&'a Frame>, CliError> {
    let chosen: Vec<&Frame> = match (args.frame, args.split) {
        (Some(index), _) => scene.frames.iter().filter(|f| f.frame_index == index).collect(),
        (None, SplitArg::All) => scene.frames.iter().collect(),
        (None, SplitArg::Test) => scene.frames.iter().filter(|f| f.split == Split::Test).collect(),
        (None, SplitArg::Train) => scene.frames.iter().filter(|f| f.split == Split::Train).collect(),
    };
    if !chosen.is_empty() {
        return Ok(chosen);
    }
    let (option, remedy) = match args.frame {
        Some(index) => (format!("--frame {index}"), "`divff inspect` says which frames there are"),
        None => ("--split test".into(), "choose --split train or --split all"),
    };
    Err(CliError::Usage { option, what: "the scene has no such frame".into(), remedy })
}

fn chosen_streams(streams: &[StreamArg]) -> [bool; 3] {
    [StreamArg::Persistent, StreamArg::Dynamic, StreamArg::Actor].map(|s| streams.contains(&s))
}

/// `None` for what is not a file of the map but a view.
fn map_format(format: FormatArg) -> Option<Format> {
    match format {
        FormatArg::Glb => Some(Format::Glb),
        FormatArg::Ply => Some(Format::Ply),
        FormatArg::Npz => Some(Format::Npz),
        FormatArg::Exr => None,
    }
}

/// `None` for what is not of the geometry but of the features.
fn layer(layer: LayerArg) -> Option<Layer> {
    match layer {
        LayerArg::Rgb => Some(Layer::Rgb),
        LayerArg::Depth => Some(Layer::Depth),
        LayerArg::Normal => Some(Layer::Normal),
        LayerArg::Stream => Some(Layer::Stream),
        LayerArg::Clip | LayerArg::Egovideo | LayerArg::Relevancy => None,
    }
}

/// The figures that matter, in a few lines; what was not measured is not in it.
pub fn summary(metrics: &RunMetrics) -> String {
    let (q, c) = (&metrics.quality, &metrics.cost);
    let mut lines = Vec::new();
    let mut line = |name: &str, parts: &[Option<String>]| {
        let parts: Vec<&str> = parts.iter().flatten().map(String::as_str).collect();
        if !parts.is_empty() {
            lines.push(format!("{name:9} {}", parts.join(", ")));
        }
    };
    let pictures = [
        q.psnr.map(|v| format!("PSNR {v:.2} dB")),
        q.psnr_persistent.map(|v| format!("persistent {v:.2} dB")),
        q.ssim.map(|v| format!("SSIM {v:.3}")),
        q.depth_median_abs_m.map(|v| format!("depth off by {v:.3} (median)")),
        q.stream_miou.map(|v| format!("stream mIoU {v:.3}")),
    ];
    let phrases = [
        q.object_miou.map(|v| format!("objects mIoU {v:.3}")),
        q.affordance_miou.map(|v| format!("affordances mIoU {v:.3}")),
    ];
    line("pictures", &pictures);
    line("phrases", &phrases);
    for (name, surface) in [("surface", &q.persistent), ("dynamic", &q.dynamic), ("actor", &q.actor)] {
        let surface = surface.as_ref();
        line(
            name,
            &[
                surface.map(|s| format!("chamfer {:.3}", s.chamfer_m)),
                surface.map(|s| format!("F-score at 5 cm {:.3}", s.fscore_5cm)),
            ],
        );
    }
    line(
        "time",
        &[
            c.train_seconds.map(|s| format!("training {}", human(s))),
            c.extract_seconds.map(|s| format!("map {}", human(s))),
            c.export_seconds.map(|s| format!("export {}", human(s))),
            c.peak_rss_mb.map(|v| format!("at most {v:.0} MB of memory")),
        ],
    );
    lines.join("\n")
}
