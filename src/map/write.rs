//! A map as files: one per object, the point cloud, the animated scene, and last the manifest.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use divff_exporters::manifest::{
    AffordanceEntry, AttributeEntry, FORMAT_VERSION, FeatureEntry, MANIFEST_NAME, SkippedEntry, TimeInterval,
};
use divff_exporters::npz::write_npz_matrices;
use divff_exporters::{
    Attribute, AttributeValues, Geometry, GlbNode, GlbOptions, GlbScene, Manifest, NpzCompression,
    PlyOptions, write_glb, write_npz, write_ply, write_scene_glb,
};
use serde::{Deserialize, Serialize};

use super::{MapError, MapFeatures, MapObject, SemanticMap};
use crate::error::FileError;
use crate::field::{Normalisation, Stream};

/// Kinds of files that a map can be written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// `<object>.ply` and `points.ply`.
    Ply,
    /// `<object>.glb` and `scene.glb`.
    Glb,
    /// `points.npz`.
    Npz,
}

impl Format {
    /// All, in the order in which they are written.
    pub const ALL: [Self; 3] = [Self::Ply, Self::Glb, Self::Npz];

    /// Bytes of the arrays that its files of a map hold.
    pub fn bytes(self, map: &SemanticMap) -> u64 {
        let all = map.geometries.iter().map(geometry_bytes).sum::<u64>();
        match self {
            Self::Ply => all + geometry_bytes(&map.points),
            // Each object, and all of them once more in the scene.
            Self::Glb => 2 * all,
            Self::Npz => geometry_bytes(&map.points),
        }
    }

    /// Extension of its files and name on the command line.
    pub fn name(self) -> &'static str {
        ["ply", "glb", "npz"][self as usize]
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Format {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|f| f.name() == text);
        found.ok_or_else(|| format!("`{text}` is no format of a map; give ply, glb or npz"))
    }
}

fn geometry_bytes(g: &Geometry) -> u64 {
    let column = |a: &Attribute| match &a.values {
        AttributeValues::U8(v) => v.len(),
        wider => 4 * wider.len(),
    };
    let attributes = g.attributes.iter().map(column).sum::<usize>();
    let features = g.features.iter().map(|f| 4 * f.values.len()).sum::<usize>();
    let vectors = 12 * (g.positions.len() + g.normals.len() + g.triangles.len()) + 3 * g.colors.len();
    (vectors + attributes + features) as u64
}

/// Writes the map into `folder` (made if need be) and returns the manifest, which is written last.
///
/// Files of an earlier export in the same folder that this one does not replace are deleted, as far as that export's
/// manifest names them.
///
/// # Errors
/// A file or the folder cannot be written; nothing is left half-written, and there is then no manifest.
pub fn write(map: &SemanticMap, folder: &Path, formats: &[Format]) -> Result<Manifest, MapError> {
    std::fs::create_dir_all(folder).map_err(FileError::at(folder))?;
    let earlier = retract(folder)?;
    let mut export = Export { folder, manifest: describe(map) };
    for format in Format::ALL.into_iter().filter(|f| formats.contains(f)) {
        for object in &map.objects {
            export.object(map, object, format)?;
        }
        export.points(map, format)?;
        if format == Format::Glb {
            export.scene(map)?;
        }
    }
    export.feature_maps(map)?;
    let Export { manifest, .. } = export;
    for path in earlier.iter().filter(|old| manifest.files.iter().all(|f| f.path != **old)) {
        remove(&folder.join(path))?;
    }
    manifest.write(folder)?;
    Ok(manifest)
}

/// Removes an earlier manifest, so that the folder does not look complete while it is rewritten; returns its files.
fn retract(folder: &Path) -> Result<Vec<String>, MapError> {
    let path = folder.join(MANIFEST_NAME);
    if !path.exists() {
        return Ok(Vec::new());
    }
    // A manifest that cannot be read names no files of ours to clear away.
    let files = Manifest::read(folder).map_or(Vec::new(), |m| m.files.into_iter().map(|f| f.path).collect());
    remove(&path)?;
    let inside = |p: &String| !p.contains('/') && !p.contains('\\') && p != "..";
    Ok(files.into_iter().filter(inside).collect())
}

fn remove(path: &Path) -> Result<(), MapError> {
    match std::fs::remove_file(path) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(FileError::at(path)(source).into())
        }
        _ => Ok(()),
    }
}

struct Export<'a> {
    folder: &'a Path,
    manifest: Manifest,
}

impl Export<'_> {
    fn object(&mut self, map: &SemanticMap, object: &MapObject, format: Format) -> Result<(), MapError> {
        let shared = &map.geometries[object.geometry];
        let name = object.name();
        let renamed;
        // A shared geometry is stored under each of its names, so that every time has its file.
        let geometry = if shared.name == name {
            shared
        } else {
            renamed = Geometry { name: name.clone(), ..shared.clone() };
            &renamed
        };
        let file = format!("{name}.{format}");
        let path = self.folder.join(&file);
        match format {
            Format::Ply => write_ply(&path, geometry, &PlyOptions::default())?,
            Format::Glb => write_glb(&path, geometry, &glb_options(map))?,
            Format::Npz => return Ok(()),
        }
        let (vertices, faces) = (geometry.positions.len(), geometry.triangles.len());
        Ok(self.manifest.add_file(self.folder, &file, vertices, faces)?)
    }

    fn points(&mut self, map: &SemanticMap, format: Format) -> Result<(), MapError> {
        let file = format!("points.{format}");
        let path = self.folder.join(&file);
        if map.points.positions.is_empty() {
            return Ok(());
        }
        match format {
            Format::Ply => write_ply(&path, &map.points, &PlyOptions::default())?,
            Format::Npz => write_npz(&path, &map.points, NpzCompression::Stored)?,
            Format::Glb => return Ok(()),
        }
        Ok(self.manifest.add_file(self.folder, &file, map.points.positions.len(), 0)?)
    }

    /// How compressed features become descriptors again: `<name>.npz` with `mean` and `basis`.
    fn feature_maps(&mut self, map: &SemanticMap) -> Result<(), MapError> {
        for features in &map.features {
            let Some((mean, basis)) = &features.map else { continue };
            let file = format!("{}.npz", features.name);
            let matrices = [("mean", mean.len(), &mean[..]), ("basis", mean.len(), &basis[..])];
            write_npz_matrices(&self.folder.join(&file), &matrices)?;
            self.manifest.add_file(self.folder, &file, 0, 0)?;
        }
        Ok(())
    }

    fn scene(&mut self, map: &SemanticMap) -> Result<(), MapError> {
        if map.objects.is_empty() {
            return Ok(());
        }
        let node = |o: &MapObject| GlbNode {
            name: o.name(),
            geometry: o.geometry,
            stream: Some(o.stream.name().to_owned()),
            interval: o.interval,
            ..GlbNode::default()
        };
        let scene = GlbScene {
            geometries: map.geometries.iter().collect(),
            nodes: map.objects.iter().map(node).collect(),
            seconds: map.animation_seconds,
        };
        write_scene_glb(&self.folder.join("scene.glb"), &scene, &glb_options(map))?;
        let vertices = map.geometries.iter().map(|g| g.positions.len()).sum();
        let faces = map.geometries.iter().map(|g| g.triangles.len()).sum();
        Ok(self.manifest.add_file(self.folder, "scene.glb", vertices, faces)?)
    }
}

fn glb_options(map: &SemanticMap) -> GlbOptions {
    let mut options = GlbOptions { up_axis: map.up_axis, ..GlbOptions::default() };
    options.extras.insert("source_id".into(), map.source_id.clone().into());
    options
}

/// The manifest without its files.
fn describe(map: &SemanticMap) -> Manifest {
    let streams = Stream::ALL.into_iter().filter(|s| map.objects.iter().any(|o| o.stream == *s));
    let interval = |o: &MapObject| {
        let interval = o.interval?;
        Some(TimeInterval {
            name: o.name(),
            stream: o.stream.name().to_owned(),
            time_start: interval.time_start,
            time_end: interval.time_end,
        })
    };
    let mut skipped: Vec<SkippedEntry> =
        map.skipped.iter().map(|s| SkippedEntry { what: s.what.clone(), why: s.why.clone() }).collect();
    if !map.up_is_known {
        skipped.push(SkippedEntry {
            what: "up axis".into(),
            why: "the cameras hold neither +Y nor +Z up; GLB files keep the world's own axes".into(),
        });
    }
    Manifest {
        format_version: FORMAT_VERSION,
        units: "world".into(),
        up_axis: map.up_axis,
        offset: map.points.offset,
        world_from_train: world_from_train(&map.normalisation),
        source_id: map.source_id.clone(),
        streams: streams.map(|s| s.name().to_owned()).collect(),
        time_intervals: map.objects.iter().filter_map(interval).collect(),
        attributes: attributes(map),
        features: map.features.iter().map(feature_entry).collect(),
        affordances: map.affordances.iter().map(affordance_entry).collect(),
        skipped,
        simplified: map.simplified.clone(),
        tool_version: concat!("divff ", env!("CARGO_PKG_VERSION")).into(),
        seed: map.seed,
        ..Manifest::default()
    }
}

fn feature_entry(features: &MapFeatures) -> FeatureEntry {
    FeatureEntry {
        name: features.name.clone(),
        dim: features.dim,
        dtype: "f32".into(),
        model: features.model.clone(),
        // Codes are relative to a mean; what they stand for is normalised after decompression.
        normalised: false,
        pca_file: features.map.is_some().then(|| format!("{}.npz", features.name)),
    }
}

fn affordance_entry((slug, phrase): &(String, String)) -> AffordanceEntry {
    AffordanceEntry { name: slug.clone(), prompts: vec![phrase.clone()] }
}

fn world_from_train(n: &Normalisation) -> [[f64; 4]; 4] {
    let [x, y, z] = n.origin.to_array();
    let s = n.scale;
    [[s, 0.0, 0.0, x], [0.0, s, 0.0, y], [0.0, 0.0, s, z], [0.0, 0.0, 0.0, 1.0]]
}

/// Every column with its range over the meshes and the cloud, in the order of the first geometry that has it.
fn attributes(map: &SemanticMap) -> Vec<AttributeEntry> {
    let mut entries: Vec<AttributeEntry> = Vec::new();
    for column in map.geometries.iter().chain([&map.points]).flat_map(|g| &g.attributes) {
        let (kind, range) = match &column.values {
            AttributeValues::F32(v) => ("f32", range(v.iter().map(|x| f64::from(*x)))),
            AttributeValues::I32(v) => ("i32", range(v.iter().map(|x| f64::from(*x)))),
            AttributeValues::U8(v) => ("u8", range(v.iter().map(|x| f64::from(*x)))),
        };
        let Some([low, high]) = range else { continue };
        match entries.iter_mut().find(|e| e.name == column.name) {
            Some(e) => e.range = [e.range[0].min(low), e.range[1].max(high)],
            None => entries.push(AttributeEntry {
                name: column.name.clone(),
                kind: kind.into(),
                range: [low, high],
            }),
        }
    }
    entries
}

fn range(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    values.fold(None, |range, v| {
        let [low, high] = range.unwrap_or([v, v]);
        Some([low.min(v), high.max(v)])
    })
}
