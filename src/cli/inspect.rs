//! `inspect`: what a scene, a run, a map or a single file holds.

use std::fmt::Write;
use std::path::Path;

use divff::pipeline::{RunFolder, metrics};
use divff::scene::{Scene, inspect as inspect_scene};
use divff_exporters::manifest::MANIFEST_NAME;
use divff_exporters::{Attribute, AttributeValues, Geometry, Manifest, read_glb, read_npz, read_ply};

use super::args::InspectArgs;
use super::error::CliError;
use super::output::say;
use super::progress::human;

/// `divff inspect`.
pub fn inspect(args: &InspectArgs) -> Result<(), CliError> {
    let path = args.path.as_path();
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let text = match extension.as_str() {
        "ply" if path.is_file() => geometry(&read_ply(path)?),
        "npz" if path.is_file() => geometry(&read_npz(path)?),
        "glb" if path.is_file() => glb(path)?,
        _ if path.join("run.json").is_file() => run(path)?,
        _ if path.join(MANIFEST_NAME).is_file() => map(path, args.deep)?,
        _ => return scene(path, args.deep),
    };
    say(text.trim_end())
}

/// A scene's problems are printed like the rest, and are an error beside: scripts can ask before they start.
fn scene(path: &Path, deep: bool) -> Result<(), CliError> {
    let found = inspect_scene(&Scene::open(path)?, deep);
    say(found.to_string().trim_end())?;
    match found.problems.len() {
        0 => Ok(()),
        n => Err(CliError::Input {
            path: path.to_owned(),
            what: format!("{n} problems, see above"),
            remedy: "restore the files, or take the frames out of the scene",
        }),
    }
}

fn run(path: &Path) -> Result<String, CliError> {
    let run = RunFolder::open(path)?;
    let record = run.record()?;
    let mut text = String::new();
    row(&mut text, "run", path.display());
    row(&mut text, "scene", record.scene.display());
    row(&mut text, "made by", format_args!("divff {}", record.tool_version));
    if run.has_checkpoint() {
        let p = run.trained()?.progress;
        let state = if p.finished { "finished" } else { "not finished: `divff train` goes on" };
        row(&mut text, "training", format_args!("{} steps in {}, {state}", p.step, human(p.seconds)));
    } else {
        row(&mut text, "training", "no checkpoint yet");
    }
    match Manifest::read(&run.map()) {
        Ok(manifest) => row(&mut text, "map", format_args!("{} files, complete", manifest.files.len())),
        Err(_) if run.map().is_dir() => row(&mut text, "map", "not complete: `divff run` makes it again"),
        Err(_) => row(&mut text, "map", "none yet"),
    }
    let views = std::fs::read_dir(run.views()).map_or(0, Iterator::count);
    row(&mut text, "views", format_args!("{views} files"));
    if let Some(m) = metrics::read(&run.metrics_path()) {
        row(&mut text, "measures", super::run::summary(&m).replace('\n', "\n           "));
    }
    Ok(text)
}

fn map(path: &Path, deep: bool) -> Result<String, CliError> {
    let manifest = Manifest::read(path)?;
    let mut text = String::new();
    row(&mut text, "map", path.display());
    row(&mut text, "made by", format_args!("{}, seed {}", manifest.tool_version, manifest.seed));
    row(&mut text, "of", &manifest.source_id);
    row(&mut text, "units", format_args!("{}, {:?} up", manifest.units, manifest.up_axis));
    row(&mut text, "streams", manifest.streams.join(", "));
    for a in &manifest.attributes {
        row(&mut text, "attribute", format_args!("{} ({}) {} to {}", a.name, a.kind, a.range[0], a.range[1]));
    }
    for f in &manifest.features {
        row(&mut text, "features", format_args!("{} [{}] {}", f.name, f.dim, f.model));
    }
    for f in &manifest.files {
        row(&mut text, "file", format_args!("{}: {} vertices, {} triangles", f.path, f.vertices, f.faces));
    }
    if deep {
        manifest.verify(path)?;
        row(&mut text, "checksums", "all files are as they were written");
    }
    Ok(text)
}

fn glb(path: &Path) -> Result<String, CliError> {
    let contents = read_glb(path)?;
    let mut text = String::new();
    for node in &contents.nodes {
        let time = node
            .interval
            .as_ref()
            .map_or(String::new(), |i| format!(", time {:.3} to {:.3}", i.time_start, i.time_end));
        row(&mut text, "node", format_args!("{} shows geometry {}{time}", node.name, node.geometry));
    }
    for (n, g) in contents.geometries.iter().enumerate() {
        let _ = writeln!(text, "geometry {n}:");
        text.push_str(&geometry(g));
    }
    Ok(text)
}

fn geometry(g: &Geometry) -> String {
    let mut text = String::new();
    if !g.name.is_empty() {
        row(&mut text, "name", &g.name);
    }
    let kind = if g.triangles.is_empty() { "points" } else { "vertices" };
    row(&mut text, kind, g.positions.len());
    if !g.triangles.is_empty() {
        row(&mut text, "triangles", g.triangles.len());
    }
    if let Some((min, max)) = bounds(&g.positions) {
        row(&mut text, "bounds", format_args!("{min:?} to {max:?}"));
    }
    if g.offset != [0.0; 3] {
        row(&mut text, "offset", format_args!("{:?}", g.offset));
    }
    let with = [("normals", !g.normals.is_empty()), ("colours", !g.colors.is_empty())];
    let with: Vec<&str> = with.iter().filter(|(_, there)| *there).map(|(name, _)| *name).collect();
    if !with.is_empty() {
        row(&mut text, "with", with.join(", "));
    }
    for attribute in &g.attributes {
        row(&mut text, "attribute", described(attribute));
    }
    for features in &g.features {
        row(&mut text, "features", format_args!("{} [{}]", features.name, features.dim));
    }
    text
}

fn described(attribute: &Attribute) -> String {
    let (kind, values): (_, Vec<f64>) = match &attribute.values {
        AttributeValues::F32(v) => ("f32", v.iter().map(|v| f64::from(*v)).collect()),
        AttributeValues::I32(v) => ("i32", v.iter().map(|v| f64::from(*v)).collect()),
        AttributeValues::U8(v) => ("u8", v.iter().map(|v| f64::from(*v)).collect()),
    };
    let range = values.iter().fold(None, |range: Option<(f64, f64)>, v| {
        Some(range.map_or((*v, *v), |(low, high)| (low.min(*v), high.max(*v))))
    });
    let range = range.map_or(String::new(), |(low, high)| format!(" {low} to {high}"));
    format!("{} ({kind}){range}", attribute.name)
}

fn bounds(positions: &[[f32; 3]]) -> Option<([f32; 3], [f32; 3])> {
    let first = *positions.first()?;
    Some(positions.iter().fold((first, first), |(min, max), p| {
        (std::array::from_fn(|a| min[a].min(p[a])), std::array::from_fn(|a| max[a].max(p[a])))
    }))
}

/// A line of a table.
fn row(text: &mut String, name: &str, value: impl std::fmt::Display) {
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{name:10} {value}");
}
