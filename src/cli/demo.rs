//! `synth` and `demo`.

use std::fs;
use std::path::Path;

use divff::config::{Config, Preset};
use divff::pipeline::{self, Outcome, RunFolder, RunOptions};
use divff::scene::Scene;
use divff::synth::{SynthOptions, SynthSummary, generate};
use divff::train::StreamChoice;

use super::args::{DemoArgs, SynthArgs};
use super::error::CliError;
use super::output::say;
use super::progress::Reporter;
use super::run::{open, summary};
use super::stop::StopFlag;

/// Frames of the demo's video: enough for every place to be seen from several sides.
pub const DEMO_FRAMES: u32 = 200;

/// `divff synth`.
pub fn synth(args: &SynthArgs) -> Result<(), CliError> {
    let options =
        SynthOptions { frames: args.frames, width: args.width, height: args.height, seed: args.seed };
    let made = generate(&options, &args.out)?;
    say(format_args!("{}: {}", args.out.display(), described(&made)))
}

/// `divff demo`.
pub fn demo(args: &DemoArgs, stop: StopFlag) -> Result<(), CliError> {
    let (scene_path, run_path) = (args.out.join("scene"), args.out.join("run"));
    let options = SynthOptions { frames: DEMO_FRAMES, seed: args.seed, ..SynthOptions::default() };
    let mut reporter = Reporter::new(stop);
    let scene = own_scene(&scene_path, &options, &reporter)?;
    let mut config = Config::preset(Preset::Draft);
    config.seed = args.seed;
    config.field.encoding = args.encoding.into();
    // The short budget is too short to find out that something moves; here it is known.
    config.train.streams = StreamChoice::All;
    // Its surrogate features are simple: a fifth of the work tells the things apart.
    config.semantics.steps = 400;
    config.semantics.joint_steps = 20;
    config.semantics.rays = 2048;
    config.semantics.cached_rays = 200_000;
    config.time_budget_s = Some(args.time_budget.as_secs_f64());
    let outcome = pipeline::run(&scene, &config, &run_path, &RunOptions::default(), &mut reporter)?;
    drop(reporter);
    match outcome {
        Outcome::Finished(metrics) => {
            say(summary(&metrics))?;
            say(opening(&RunFolder::new(run_path)))
        }
        Outcome::Stopped { step } => Err(CliError::Stopped { step }),
    }
}

/// The synthetic scene in a folder of a command of ours, made unless it is there.
pub fn own_scene(path: &Path, options: &SynthOptions, reporter: &Reporter) -> Result<Scene, CliError> {
    // A command that was stopped goes on: its scene is complete as soon as it has its list of frames.
    if path.join("transforms.json").is_file() {
        reporter.note(&format!("scene: {} is there already", path.display()));
    } else {
        clear_half_made(path)?;
        let made = generate(options, path)?;
        reporter.note(&format!("scene: {}: {}", path.display(), described(&made)));
    }
    open(path, reporter)
}

/// Removes the pictures of a scene whose making was cut off; nothing else is ever in this folder.
fn clear_half_made(scene: &Path) -> Result<(), CliError> {
    match fs::remove_dir_all(scene) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(CliError::Input {
            path: scene.to_owned(),
            what: format!("what an earlier one left cannot be removed: {e}"),
            remedy: "choose another --out",
        }),
        _ => Ok(()),
    }
}

fn described(made: &SynthSummary) -> String {
    format!(
        "{} frames, {} things, {} of them moved, {} triangles that stay",
        made.frames, made.instances, made.moves, made.persistent_triangles
    )
}

/// What to open with what.
fn opening(run: &RunFolder) -> String {
    let map = run.map();
    let rows = [
        (run.report_path(), "report with pictures and figures: any web browser"),
        (map.join("scene.glb"), "everything, in time: Blender (File > Import > glTF 2.0)"),
        (map.join("persistent.ply"), "what stays, as a mesh: MeshLab, CloudCompare, Open3D"),
        (map.join("points.npz"), "points with all attributes: numpy.load, Open3D"),
        (run.views(), "rendered test frames, EXR with depth and streams: tev, Nuke, Blender"),
    ];
    let mut text = String::from("made:");
    for (path, how) in rows.iter().filter(|(path, _)| path.exists()) {
        text.push_str(&format!("\n  {}\n      {how}", path.display()));
    }
    text.push_str(&format!("\nask it: divff query {} --text mug --out mug", run.root().display()));
    text
}
