//! The command line as clap sees it; plain data, turned into settings by the commands.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use divff::bench::Kind;
use divff::map::{Simplify, Times};

/// Semantic 3D maps from egocentric video, on a plain CPU.
#[derive(Debug, Parser)]
#[command(name = "divff", version, propagate_version = true, arg_required_else_help = true)]
#[command(after_help = "Start with `divff demo`: it makes a small scene and runs everything on it.\n\
    Exit codes: 0 done, 1 failed, 2 bad usage or bad input.")]
pub struct Cli {
    /// Number of threads [default: all cores]; results do not depend on it
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// What to do
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Make a small scene, run everything on it, and say how to open the results
    #[command(after_help = "Example:\n  divff demo --out divff-demo")]
    Demo(DemoArgs),
    /// Make a synthetic egocentric scene with ground truth
    #[command(after_help = "Example:\n  divff synth --out kitchen --frames 120 --width 320 --height 180")]
    Synth(SynthArgs),
    /// Train, build and write the map, render and measure the test frames, and report
    #[command(after_help = "Example:\n  divff run kitchen --out runs/kitchen --preset draft")]
    Run(RunArgs),
    /// Train alone; goes on where it was stopped
    #[command(after_help = "Ctrl-C stops with a checkpoint; the same command goes on from there.\n\n\
        Example:\n  divff train kitchen --out runs/kitchen --set train.steps=9000")]
    Train(RunArgs),
    /// Write meshes and points of a trained run
    #[command(after_help = "Example:\n  divff export runs/kitchen --out map --formats glb,ply --voxel 0.02")]
    Export(ExportArgs),
    /// Render frames of a trained run: <stem>.png (sRGB) and <stem>.exr (all layers)
    #[command(after_help = "Example:\n  divff render runs/kitchen --split test --layers rgb,depth,stream \
        --out views")]
    Render(RenderArgs),
    /// Find a phrase in a map: scores at all vertices, and a picture
    #[command(after_help = "Example:\n  divff query runs/kitchen --text mug --text kettle --out mug\n  \
        divff query map/persistent.ply --text mug --scene kitchen --out mug")]
    Query(QueryArgs),
    /// Measure a run against its scene's test frames and ground truth
    #[command(after_help = "Example:\n  divff eval runs/kitchen")]
    Eval(EvalArgs),
    /// Weigh run time against error: what each setting costs and gives on a scene with ground truth
    #[command(
        after_help = "Open index.html in the folder. Stopped and given again, it goes on from what was trained.\n\
        DIVFF_PYTHON names a Python whose packages (scikit-image, open3d, plyfile, trimesh) are timed beside ours.\n\n\
        Example:\n  divff bench --quick --out bench\n  divff bench kitchen --out bench --sweeps training,voxel"
    )]
    Bench(BenchArgs),
    /// Say what a scene, a run, a map or a single file holds, and what is wrong with it
    #[command(after_help = "Example:\n  divff inspect kitchen --deep")]
    Inspect(InspectArgs),
}

/// `divff demo`.
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Folder for the scene and the run
    #[arg(long, value_name = "DIR", default_value = "divff-demo")]
    pub out: PathBuf,
    /// Seed of the scene and of the training
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Time for training; the rest takes about a minute
    #[arg(long, value_name = "TIME", default_value = "90s", value_parser = parse_duration)]
    pub time_budget: Duration,
    /// How positions are encoded
    #[arg(long, value_enum, default_value = "hash")]
    pub encoding: EncodingArg,
}

/// `divff synth`.
#[derive(Debug, Args)]
pub struct SynthArgs {
    /// Folder to make; must not hold anything yet
    #[arg(long, value_name = "SCENE")]
    pub out: PathBuf,
    /// Number of frames; every eighth is held out for tests
    #[arg(long, value_name = "N", default_value_t = 60)]
    pub frames: u32,
    /// Image width, px
    #[arg(long, value_name = "PX", default_value_t = 160)]
    pub width: u32,
    /// Image height, px
    #[arg(long, value_name = "PX", default_value_t = 90)]
    pub height: u32,
    /// Seed of the kitchen and of what happens in it
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

/// How positions are encoded.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum EncodingArg {
    /// Lattices of learned features, the fine ones hashed, and small networks
    Hash,
    /// The same without hashing: only as fine as the tables allow
    Dense,
    /// The paper's sines and cosines and deep networks: slow
    Frequency,
}

/// How good a run should get.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum PresetArg {
    /// Under a minute: a first look
    Draft,
    /// Under five minutes
    Standard,
    /// Until it hardly gets better
    Fine,
}

/// `divff run` and `divff train`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Scene: a folder with transforms.json, meta.json or a COLMAP model, or such a JSON file
    pub scene: PathBuf,
    /// Folder of the run
    #[arg(long, value_name = "RUN")]
    pub out: PathBuf,
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Throw away what the folder holds and start over
    #[arg(long)]
    pub fresh: bool,
}

/// Where settings come from; later ones win.
#[derive(Debug, Args)]
pub struct SettingsArgs {
    /// Where to start from
    #[arg(long, value_enum, default_value = "standard")]
    pub preset: PresetArg,
    /// TOML file with settings that are laid over the preset's
    #[arg(long, value_name = "F.toml")]
    pub config: Option<PathBuf>,
    /// One setting, laid over all others, as often as needed: train.steps=9000
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Seed of everything random
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Time for training, such as 90s, 5m or 1h30m; the schedule then follows the clock
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub time_budget: Option<Duration>,
    /// How positions are encoded [default: as in the file or --set, else hash]
    #[arg(long, value_enum)]
    pub encoding: Option<EncodingArg>,
    /// Compress features to as few numbers as lose at most this (1 - mean cosine, such as 0.02), instead of to 32
    #[arg(long, value_name = "E")]
    pub feature_error: Option<f64>,
    /// Fewer triangles in the map's meshes, none of them farther from where they were than this: 5mm, 0.5cm, 0.005 (world
    /// units), or none [default: none]
    #[arg(long, value_name = "LENGTH", value_parser = Simplify::from_str)]
    pub simplify: Option<Simplify>,
}

/// File formats of an export.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FormatArg {
    /// glTF binary: Blender, the web
    Glb,
    /// PLY: Open3D, CloudCompare, MeshLab
    Ply,
    /// NumPy archive with the points
    Npz,
    /// Rendered test frames with depth and streams, in views/
    Exr,
}

/// The three streams.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum StreamArg {
    /// What stays
    Persistent,
    /// What is moved
    Dynamic,
    /// Who moves it
    Actor,
}

/// `divff export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Folder of a trained run
    pub run: PathBuf,
    /// Folder for the map
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// File formats
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["glb", "ply", "npz"])]
    pub formats: Vec<FormatArg>,
    /// Streams
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["persistent", "dynamic", "actor"])]
    pub streams: Vec<StreamArg>,
    /// Times of dynamic and actor geometry: auto, all, times in [0, 1] such as 0.1,0.5, or frame:12
    #[arg(long, default_value = "auto", value_parser = Times::from_str)]
    pub times: Times,
    /// Side of a voxel, world units [default: 1/350 of the diagonal of the scene's box]
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    pub voxel: Option<f64>,
    /// Fewer triangles, none of them farther from where they were than this: 5mm, 0.5cm, 0.005 (world units), or none
    /// [default: as in the run]
    #[arg(long, value_name = "LENGTH", value_parser = Simplify::from_str)]
    pub simplify: Option<Simplify>,
    /// Where the scene is, if it was moved
    #[arg(long, value_name = "SCENE")]
    pub scene: Option<PathBuf>,
}

/// Which frames are rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SplitArg {
    /// Held-out frames
    Test,
    /// Frames that were trained on
    Train,
    /// All frames
    All,
}

/// What is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LayerArg {
    /// Colour
    Rgb,
    /// Depth along the camera's axis, world units
    Depth,
    /// Surface normals, world axes
    Normal,
    /// Opacity of each stream
    Stream,
    /// Compressed image-language features
    Clip,
    /// Compressed video-language features
    Egovideo,
    /// Scores of the phrases asked for
    Relevancy,
}

/// The two spaces of features.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SpaceArg {
    /// Image-language: what things are
    Clip,
    /// Video-language: what can be done with them
    Egovideo,
}

/// What is asked of the features.
#[derive(Debug, Args)]
pub struct TextArgs {
    /// A phrase to look for, as often as needed
    #[arg(long, value_name = "PHRASE")]
    pub text: Vec<String>,
    /// Space that phrases are looked for in
    #[arg(long, value_enum, default_value = "clip")]
    pub space: SpaceArg,
    /// Embeddings of the phrases, one row for each --text in order, of shape [Q, D] or [D]
    #[arg(long, value_name = "F.npy", requires = "text")]
    pub text_embedding: Option<PathBuf>,
    /// Text encoder for phrases without an embedding (scripts/export_text_encoders.py makes one)
    #[arg(long, value_name = "DIR", requires = "text")]
    pub text_encoder: Option<PathBuf>,
    /// Temperature of the relevancy [default: that of the run]
    #[arg(long, value_name = "TAU")]
    pub temperature: Option<f32>,
}

/// `divff render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Folder of a trained run
    pub run: PathBuf,
    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Frames to render
    #[arg(long, value_enum, default_value = "test", conflicts_with = "frame")]
    pub split: SplitArg,
    /// One frame, by its index in the video
    #[arg(long, value_name = "N")]
    pub frame: Option<u32>,
    /// Streams to show
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["persistent", "dynamic", "actor"])]
    pub streams: Vec<StreamArg>,
    /// Layers of the EXR files
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["rgb", "depth", "stream"])]
    pub layers: Vec<LayerArg>,
    #[command(flatten)]
    pub text: TextArgs,
    /// Where the scene is, if it was moved
    #[arg(long, value_name = "SCENE")]
    pub scene: Option<PathBuf>,
}

/// `divff query`.
#[derive(Debug, Args)]
pub struct QueryArgs {
    /// Folder of a run with a map, or a .ply or .glb file of a map
    pub path: PathBuf,
    #[command(flatten)]
    pub text: TextArgs,
    /// Folder for the scored map and the pictures
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Scene (or any folder with text/) whose embeddings are used [default: that of the run; for a file that of the
    /// run that it lies in, else the file's own folder]
    #[arg(long, value_name = "SCENE")]
    pub scene: Option<PathBuf>,
}

/// `divff eval`.
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Folder of a trained run
    pub run: PathBuf,
    /// File for the measures [default: RUN/metrics.json]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Where the scene is, if it was moved
    #[arg(long, value_name = "SCENE")]
    pub scene: Option<PathBuf>,
}

/// `divff bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Scene with ground truth [default: a synthetic one, made in the folder]
    pub scene: Option<PathBuf>,
    /// Folder for tables, plots and runs
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What is varied: training, encoding, voxel, method, features, export
    #[arg(long, value_delimiter = ',', value_parser = Kind::from_str, default_values = Kind::ALL.map(Kind::name))]
    pub sweeps: Vec<Kind>,
    /// Fewer settings and short runs: under five minutes on two cores with the synthetic scene
    #[arg(long)]
    pub quick: bool,
    #[command(flatten)]
    pub settings: SettingsArgs,
}

/// `divff inspect`.
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// Scene, run, map folder, or a .ply, .glb or .npz file
    pub path: PathBuf,
    /// Decode every image and compare every checksum
    #[arg(long)]
    pub deep: bool,
}

/// `90s`, `5m`, `1h30m`, `1.5h`; units h, m, s in this order, each at most once.
pub fn parse_duration(text: &str) -> Result<Duration, String> {
    let wrong = || format!("`{text}` is not a time; write it as 90s, 5m or 1h30m");
    let (mut seconds, mut rest, mut smallest) = (0.0, text.trim(), f64::INFINITY);
    while !rest.is_empty() {
        let digits = rest.find(|c: char| !c.is_ascii_digit() && c != '.').ok_or_else(wrong)?;
        let number: f64 = rest[..digits].parse().map_err(|_| wrong())?;
        let unit = match rest.as_bytes()[digits] {
            b'h' => 3600.0,
            b'm' => 60.0,
            b's' => 1.0,
            _ => return Err(wrong()),
        };
        if unit >= smallest {
            return Err(wrong());
        }
        smallest = unit;
        seconds += number * unit;
        rest = &rest[digits + 1..];
    }
    match Duration::try_from_secs_f64(seconds) {
        Ok(duration) if !duration.is_zero() => Ok(duration),
        _ => Err(wrong()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn times_are_read_in_hours_minutes_and_seconds() {
        let seconds = |text| parse_duration(text).map(|d| d.as_secs_f64());
        assert_eq!(seconds("90s"), Ok(90.0));
        assert_eq!(seconds("5m"), Ok(300.0));
        assert_eq!(seconds("1h30m"), Ok(5400.0));
        assert_eq!(seconds("0.5h1s"), Ok(1801.0));
        for wrong in ["", "90", "5 m", "m", "1m1h", "1s1s", "-5m", "5d", "0s", "1e400s", "1.2.3s", "5m\u{e9}"]
        {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_does_not_exist_yet_is_not_offered() {
        let names: Vec<String> = Cli::command().get_subcommands().map(|c| c.get_name().to_owned()).collect();
        assert_eq!(
            names,
            ["demo", "synth", "run", "train", "export", "render", "query", "eval", "bench", "inspect"]
        );
    }
}
