//! `query`, and what the options of `render` ask of the features.

use std::path::{Path, PathBuf};

use divff::config::Config;
use divff::pipeline::RunFolder;
use divff::pipeline::folder::create_writable;
use divff::report::overview;
use divff::scene::Scene;
use divff::scene::features::{Space, TextTable};
use divff::semantics::compress::Compressor;
use divff::semantics::config::SemanticsConfig;
use divff::semantics::layers::FeatureLayers;
use divff::semantics::overlay::overlay;
use divff::semantics::relevancy::{Points, Queries};
use divff::semantics::text::TextError;
use divff::semantics::{SemanticFields, SemanticsError, TextSources, slug};
use divff_exporters::npz::read_npz_matrices;
use divff_exporters::{
    Attribute, AttributeValues, Geometry, GlbOptions, Manifest, PlyOptions, UpAxis, read_glb, read_ply,
    write_glb, write_ply,
};
use glam::DVec3;

use super::args::{LayerArg, QueryArgs, RenderArgs, SpaceArg, TextArgs};
use super::error::CliError;
use super::output::say;

impl From<SpaceArg> for Space {
    fn from(space: SpaceArg) -> Self {
        match space {
            SpaceArg::Clip => Self::Clip,
            SpaceArg::Egovideo => Self::Egovideo,
        }
    }
}

/// Embeddings of the phrases asked for.
pub fn text_source(args: &TextArgs, scene: &Scene) -> Result<TextSources, CliError> {
    let mut text = TextSources::of_scene(scene)?;
    if let Some(path) = &args.text_embedding {
        text.give(args.space.into(), &args.text, path)?;
    }
    if let Some(folder) = &args.text_encoder {
        text.encode_with(args.space.into(), folder)?;
    }
    Ok(text)
}

/// The layers of features that `divff render` is asked for.
pub fn feature_layers<'a>(
    args: &RenderArgs,
    scene: &Scene,
    run: &RunFolder,
    fields: Option<&'a SemanticFields>,
    config: &Config,
) -> Result<FeatureLayers<'a>, CliError> {
    let wants = |layer| args.layers.contains(&layer);
    let scores = wants(LayerArg::Relevancy);
    match (scores, args.text.text.is_empty()) {
        (true, true) => {
            return Err(CliError::Usage {
                option: "--layers relevancy".into(),
                what: "no phrase is given".into(),
                remedy: "say what to look for with --text",
            });
        }
        (false, false) => {
            return Err(CliError::Usage {
                option: "--text".into(),
                what: "no layer shows it".into(),
                remedy: "add relevancy to --layers",
            });
        }
        _ => {}
    }
    let mut layers = FeatureLayers::new(&config.semantics);
    let text = if scores { text_source(&args.text, scene)? } else { TextSources::encoders()? };
    let temperature = args.text.temperature.unwrap_or(config.semantics.temperature);
    for (space, layer) in [(Space::Clip, LayerArg::Clip), (Space::Egovideo, LayerArg::Egovideo)] {
        let scores = scores && Space::from(args.text.space) == space;
        if !scores && !wants(layer) {
            continue;
        }
        let fields = fields.ok_or_else(|| SemanticsError::NoFeatures {
            space,
            why: format!("{} holds none, or of another geometry", run.root().display()),
        })?;
        let phrases: &[String] = if scores { &args.text.text } else { &[] };
        layers.add(fields, space, wants(layer), phrases, &text, temperature)?;
    }
    Ok(layers)
}

/// Size of the pictures, px.
const PICTURE: (usize, usize) = (960, 640);

/// A map to be asked, and where its parts come from.
struct Asked {
    geometries: Vec<Geometry>,
    /// Whether the answer is to be a GLB.
    glb: bool,
    /// Folder with the manifest and the linear maps.
    folder: PathBuf,
}

/// `divff query`.
pub fn query(args: &QueryArgs) -> Result<(), CliError> {
    if args.text.text.is_empty() {
        return Err(CliError::Usage {
            option: "--text".into(),
            what: "no phrase is given".into(),
            remedy: "say what to look for, as --text mug",
        });
    }
    let Asked { mut geometries, glb, folder } = asked(&args.path)?;
    let space = Space::from(args.text.space);
    let scene = embeddings_folder(args)?;
    let mut text = match &scene {
        Some(root) => TextSources::of_folder(root)?,
        None => TextSources::encoders()?,
    };
    if let Some(path) = &args.text.text_embedding {
        text.give(space, &args.text.text, path)?;
    }
    if let Some(folder) = &args.text.text_encoder {
        text.encode_with(space, folder)?;
    }
    let name = format!("{}_pca", space.name());
    let compressor = compressor(&folder, &name)?;
    let temperature = args.text.temperature.unwrap_or(SemanticsConfig::default().temperature);
    let queries = text
        .queries(space, &compressor, &args.text.text, temperature)
        .map_err(|e| explained(e, args, scene.as_deref()))?;
    create_writable(&args.out)?;
    for geometry in &mut geometries {
        score(geometry, &name, &queries, &args.text.text, &args.path)?;
    }
    let up_axis = Manifest::read(&folder).map_or(UpAxis::Z, |m| m.up_axis);
    for geometry in &geometries {
        let file = args.out.join(format!("{}.{}", geometry.name, if glb { "glb" } else { "ply" }));
        match glb {
            true => write_glb(&file, geometry, &GlbOptions { up_axis, ..GlbOptions::default() })?,
            false => write_ply(&file, geometry, &PlyOptions::default())?,
        }
    }
    for phrase in &args.text.text {
        say(answer(&mut geometries, phrase, up_axis, &args.out)?)?;
    }
    say(format_args!("scored map and pictures in {}", args.out.display()))
}

/// The geometries of a file, or the persistent and the first dynamic surface of a run's map.
fn asked(path: &Path) -> Result<Asked, CliError> {
    let bad = |what: String, remedy| CliError::Input { path: path.to_owned(), what, remedy };
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    match extension.as_str() {
        "ply" if path.is_file() => Ok(Asked { geometries: vec![read_ply(path)?], glb: false, folder }),
        "glb" if path.is_file() => {
            let mut geometries = read_glb(path)?.geometries;
            for geometry in &mut geometries {
                take_features(geometry, &folder)?;
            }
            Ok(Asked { geometries, glb: true, folder })
        }
        _ if path.is_dir() => {
            let folder = RunFolder::open(path)?.map();
            let manifest = Manifest::read(&folder).map_err(|_| {
                bad("has no complete map".into(), "make one with `divff export` or `divff run`")
            })?;
            let named = |stream: &str| {
                manifest.files.iter().map(|f| &f.path).find(|p| p.starts_with(stream) && p.ends_with(".ply"))
            };
            let files = ["persistent", "dynamic"].into_iter().filter_map(named);
            let read = files.map(|file| Ok(read_ply(&folder.join(file))?));
            let geometries = read.collect::<Result<Vec<_>, CliError>>()?;
            if geometries.is_empty() {
                return Err(bad("its map has no .ply files".into(), "export it with --formats ply"));
            }
            Ok(Asked { geometries, glb: false, folder })
        }
        _ => Err(bad("is neither a run nor a .ply or .glb file".into(), "name one of these")),
    }
}

/// An export's GLB files hold scores but no features; those are in the PLY file of the same mesh beside it.
fn take_features(geometry: &mut Geometry, folder: &Path) -> Result<(), CliError> {
    let path = folder.join(format!("{}.ply", geometry.name));
    if geometry.features.is_empty() && path.is_file() {
        let same = read_ply(&path)?;
        if same.positions.len() == geometry.positions.len() {
            geometry.features = same.features;
        }
    }
    Ok(())
}

/// Where embeddings come from: what is named, the scene of the run, or for a map's file the scene of the run that it
/// lies in, else the map's own folder.
fn embeddings_folder(args: &QueryArgs) -> Result<Option<PathBuf>, CliError> {
    if let Some(scene) = &args.scene {
        return Ok(Some(scene.clone()));
    }
    if args.path.is_dir() {
        return Ok(Some(RunFolder::open(&args.path)?.scene(None)?.root));
    }
    // A bare `persistent.ply` lies in the working folder, whose parent only its full path tells.
    let file = std::path::absolute(&args.path).unwrap_or_else(|_| args.path.clone());
    let map = file.parent().unwrap_or(Path::new("/"));
    let of_run = map.ancestors().take(2).find_map(scene_of_run);
    Ok(of_run.or_else(|| has_embeddings(map).then(|| map.to_owned())))
}

/// The scene of a run if it is still there and has embeddings. Only these are read of it, so it need not be the
/// same to the last frame.
fn scene_of_run(folder: &Path) -> Option<PathBuf> {
    let named = RunFolder::open(folder).ok()?.record().ok()?.scene;
    let scene = if named.is_file() { named.parent()?.to_owned() } else { named };
    has_embeddings(&scene).then_some(scene)
}

fn has_embeddings(folder: &Path) -> bool {
    Space::ALL.into_iter().any(|space| TextTable::paths(folder, space).iter().any(|p| p.is_file()))
}

/// That a bare map comes without embeddings, where nothing is known that could give any.
fn explained(error: SemanticsError, args: &QueryArgs, folder: Option<&Path>) -> CliError {
    let nowhere = folder.is_none() && args.text.text_embedding.is_none() && args.text.text_encoder.is_none();
    match &error {
        SemanticsError::Text(text) if nowhere && matches!(**text, TextError::Phrase { .. }) => {
            CliError::Input {
                path: args.path.clone(),
                what: format!("no embeddings come with this map ({error})"),
                remedy: "name the scene that it was made from with --scene, or put the scene's folder text/ beside \
                     the map",
            }
        }
        _ => error.into(),
    }
}

/// The linear map beside a map's files.
fn compressor(folder: &Path, name: &str) -> Result<Compressor, CliError> {
    let path = folder.join(format!("{name}.npz"));
    let bad = |what: &str| CliError::Input {
        path: path.clone(),
        what: what.into(),
        remedy: "keep the file that the export wrote beside the map, or export again",
    };
    if !path.is_file() {
        return Err(bad("is missing: the features of the map cannot be read without it"));
    }
    let matrices = read_npz_matrices(&path)?;
    let named = |n: &str| matrices.iter().find(|m| m.0 == n).map(|m| m.2.clone());
    let (Some(mean), Some(basis)) = (named("mean"), named("basis")) else {
        return Err(bad("does not hold `mean` and `basis`"));
    };
    Compressor::from_linear(mean, basis).map_err(|e| SemanticsError::from(e).into())
}

/// Adds a column of scores for every phrase.
fn score(
    geometry: &mut Geometry,
    name: &str,
    queries: &Queries,
    phrases: &[String],
    path: &Path,
) -> Result<(), CliError> {
    let Some(features) = geometry.features.iter().find(|f| f.name == name) else {
        return Err(CliError::Input {
            path: path.to_owned(),
            what: format!("`{}` has no features `{name}`", geometry.name),
            remedy: "export the map of a run that was trained with such features, and keep the .ply files beside a .glb",
        });
    };
    let found = queries.score(Points::F32(&features.values)).map_err(SemanticsError::from)?;
    for (phrase, scores) in phrases.iter().zip(found.scores) {
        let name = column(phrase);
        geometry.attributes.retain(|a| a.name != name);
        geometry.attributes.push(Attribute { name, values: AttributeValues::F32(scores) });
    }
    Ok(())
}

fn column(phrase: &str) -> String {
    format!("relevancy_{}", slug(phrase))
}

/// The picture of one phrase, and one line about where it is.
fn answer(
    geometries: &mut [Geometry],
    phrase: &str,
    up_axis: UpAxis,
    out: &Path,
) -> Result<String, CliError> {
    let name = column(phrase);
    let mut coloured = Vec::new();
    let (mut best, mut place, mut count) = (0.0, DVec3::ZERO, 0usize);
    for geometry in geometries.iter() {
        let scores = geometry.attributes.iter().find_map(|a| match &a.values {
            AttributeValues::F32(v) if a.name == name => Some(v),
            _ => None,
        });
        let Some(scores) = scores else { continue };
        for (p, score) in geometry.positions.iter().zip(scores) {
            count += usize::from(*score > 0.5);
            if *score > best {
                best = *score;
                place = glam::Vec3::from_array(*p).as_dvec3() + DVec3::from_array(geometry.offset);
            }
        }
        let plain = vec![[190; 3]; scores.len()];
        let colours = if geometry.colors.is_empty() { &plain } else { &geometry.colors };
        coloured.push(Geometry { colors: overlay(colours, scores), ..geometry.clone() });
    }
    let up = if up_axis == UpAxis::Z { DVec3::Z } else { DVec3::Y };
    let all: Vec<&Geometry> = coloured.iter().collect();
    if let Some(picture) = overview(&all, up, PICTURE.0, PICTURE.1) {
        let path = out.join(format!("{name}.png"));
        let pixels = picture.rgba.as_flattened();
        let (width, height) = (picture.width as u32, picture.height as u32);
        image::save_buffer(&path, pixels, width, height, image::ExtendedColorType::Rgba8)
            .map_err(|e| CliError::Input { path, what: e.to_string(), remedy: "choose another --out" })?;
    }
    Ok(match count {
        0 => format!("{phrase}: nothing is closer to it than to a canonical phrase (best score {best:.2})"),
        n => format!(
            "{phrase}: {n} vertices, best score {best:.2} at ({:.2}, {:.2}, {:.2})",
            place.x, place.y, place.z
        ),
    })
}
