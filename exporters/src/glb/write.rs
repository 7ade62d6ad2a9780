//! Geometry → GLB.

use std::collections::BTreeMap;
use std::path::Path;

use gltf_json::accessor::Accessor;
use gltf_json::material::{Material, PbrMetallicRoughness};
use gltf_json::mesh::{Mesh, Mode, Primitive, Semantic};
use gltf_json::validation::{Checked, Checked::Valid};
use gltf_json::{Asset, Index, Scene, scene};
use serde_json::{Map, Value, json};

use super::animation::animate;
use super::container;
use super::document::{Document, Piece, extras};
use super::{GlbNode, GlbOptions, GlbScene};
use crate::atomic::write_atomically;
use crate::error::{Error, Result};
use crate::geometry::{AttributeValues, Geometry};
use crate::validate::EXACT_IN_F32;

/// Writes one mesh, or a point cloud when there are no triangles, as a node of its name.
///
/// # Errors
/// As for [`write_scene_glb`].
pub fn write_glb(path: &Path, geometry: &Geometry, options: &GlbOptions) -> Result<()> {
    let node = GlbNode { name: geometry.name.clone(), ..GlbNode::default() };
    write_scene_glb(path, &GlbScene { geometries: vec![geometry], nodes: vec![node], seconds: 0.0 }, options)
}

/// Writes many objects; those with an interval are animated to be there only then.
///
/// A geometry without vertices becomes a node without a mesh.
///
/// # Errors
/// `Inconsistent` or `NonFinite` when a geometry breaks its invariants, an integer attribute exceeds 2^24,
/// offsets differ, a node has no such geometry or an empty or negative interval, or the file would exceed 4
/// GiB; `Io`.
pub fn write_scene_glb(path: &Path, scene: &GlbScene, options: &GlbOptions) -> Result<()> {
    check(scene)?;
    let mut document = Document::default();
    if options.unlit {
        push_unlit_material(&mut document);
    }
    let meshes: Vec<_> = scene.geometries.iter().map(|g| push_meshes(&mut document, g, options)).collect();
    let nodes: Vec<_> =
        scene.nodes.iter().map(|node| push_node(&mut document, node, &meshes[node.geometry])).collect();
    animate(&mut document, &scene.nodes, &nodes, scene.seconds);
    let mut properties = options.extras.clone();
    properties.insert("up_axis".into(), json!(options.up_axis));
    let offset = scene.geometries.first().map_or([0.0; 3], |geometry| geometry.offset);
    properties.insert("offset".into(), json!(offset));
    let root_scene =
        Scene { extensions: None, extras: extras(&properties), name: Some("divff".into()), nodes };
    document.root.scene = Some(document.root.push(root_scene));
    document.root.asset = Asset {
        generator: Some(concat!("divff-exporters ", env!("CARGO_PKG_VERSION")).into()),
        ..Asset::default()
    };
    write_document(path, document)
}

fn write_document(path: &Path, mut document: Document) -> Result<()> {
    let json = document.json().map_err(|source| Error::io(path, source))?;
    let total = container::total_bytes(json.len(), document.bin_bytes()).ok_or_else(|| {
        let reason =
            format!("{} bytes exceed the 4 GiB of a GLB file; leave features out", document.bin_bytes());
        Error::inconsistent(&path.display().to_string(), reason)
    })?;
    write_atomically(path, |file| {
        container::write_head(file, total, &json, document.bin_bytes())?;
        document.write_bin(file)
    })
}

fn check(scene: &GlbScene) -> Result<()> {
    for geometry in &scene.geometries {
        geometry.validate()?;
        check_exact_integers(geometry)?;
        if geometry.offset != scene.geometries[0].offset {
            let reason =
                format!("its offset {:?} differs from {:?}", geometry.offset, scene.geometries[0].offset);
            return Err(Error::inconsistent(&geometry.name, reason));
        }
    }
    for node in &scene.nodes {
        if node.geometry >= scene.geometries.len() {
            let reason = format!("there is no geometry {} among {}", node.geometry, scene.geometries.len());
            return Err(Error::inconsistent(&node.name, reason));
        }
        if let Some(interval) = node.interval {
            // Written so that NaN fails.
            let valid = interval.time_start >= 0.0
                && interval.time_start < interval.time_end
                && interval.time_end.is_finite()
                && scene.seconds > 0.0
                && scene.seconds.is_finite();
            if !valid {
                let reason =
                    format!("{interval:?} over {} s is no interval of a playable time", scene.seconds);
                return Err(Error::inconsistent(&node.name, reason));
            }
        }
    }
    Ok(())
}

fn check_exact_integers(geometry: &Geometry) -> Result<()> {
    for attribute in &geometry.attributes {
        let AttributeValues::I32(values) = &attribute.values else { continue };
        if let Some(value) = values.iter().find(|value| value.unsigned_abs() > EXACT_IN_F32.unsigned_abs()) {
            let reason =
                format!("{value} in `{}` exceeds 2^24, beyond which GLB's f32 is not exact", attribute.name);
            return Err(Error::inconsistent(&geometry.name, reason));
        }
    }
    Ok(())
}

fn push_unlit_material(document: &mut Document) {
    let name = "KHR_materials_unlit".to_owned();
    document.root.extensions_used.push(name);
    document.root.push(Material {
        double_sided: true,
        extensions: Some(gltf_json::extensions::material::Material {
            unlit: Some(gltf_json::extensions::material::Unlit {}),
        }),
        // glTF's default is metallic, which viewers without the extension would show nearly black.
        pbr_metallic_roughness: PbrMetallicRoughness {
            metallic_factor: gltf_json::material::StrengthFactor(0.0),
            ..Default::default()
        },
        ..Material::default()
    });
}

/// The mesh of a geometry, and the mesh of its features; none without vertices.
type Meshes = (Option<Index<Mesh>>, Option<Index<Mesh>>);

fn push_meshes<'a>(document: &mut Document<'a>, geometry: &'a Geometry, options: &GlbOptions) -> Meshes {
    if geometry.positions.is_empty() {
        return (None, None);
    }
    let up = options.up_axis;
    let positions = document.push(Piece::Vectors(&geometry.positions, up));
    let indices =
        (!geometry.triangles.is_empty()).then(|| document.push(Piece::Indices(&geometry.triangles)));
    let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), positions)]);
    if !geometry.normals.is_empty() {
        let normals = document.push(Piece::Vectors(&geometry.normals, up));
        // Only positions need bounds; on normals they would be clutter.
        let accessor = &mut document.root.accessors[normals.value()];
        (accessor.min, accessor.max) = (None, None);
        attributes.insert(Valid(Semantic::Normals), normals);
    }
    if !geometry.colors.is_empty() {
        let colors = &geometry.colors;
        let piece = if options.float_colors { Piece::FloatColors(colors) } else { Piece::Colors(colors) };
        attributes.insert(Valid(Semantic::Colors(0)), document.push(piece));
    }
    for attribute in &geometry.attributes {
        attributes.insert(custom(&attribute.name), document.push(Piece::Scalars(&attribute.values)));
    }
    let mesh = document.root.push(Mesh {
        extensions: None,
        extras: extras(&mesh_extras(geometry)),
        name: Some(geometry.name.clone()),
        primitives: vec![primitive(attributes, indices, options)],
        weights: None,
    });
    let with_features = options.features && !geometry.features.is_empty();
    let features = with_features.then(|| push_features(document, geometry, positions, indices, options));
    (Some(mesh), features)
}

/// The same surface once more, with the features as its attributes; positions and indices are shared in the
/// file.
fn push_features<'a>(
    document: &mut Document<'a>,
    geometry: &'a Geometry,
    positions: Index<Accessor>,
    indices: Option<Index<Accessor>>,
    options: &GlbOptions,
) -> Index<Mesh> {
    let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), positions)]);
    let mut dims = Map::new();
    for features in &geometry.features {
        dims.insert(features.name.clone(), json!(features.dim));
        for first in (0..features.dim).step_by(4) {
            let quads = Piece::Quads { values: &features.values, dim: features.dim, first };
            attributes.insert(custom(&features.column(first / 4)), document.push(quads));
        }
    }
    let properties = Map::from_iter([
        ("features_of".to_owned(), json!(geometry.name)),
        ("feature_dims".to_owned(), Value::Object(dims)),
    ]);
    document.root.push(Mesh {
        extensions: None,
        extras: extras(&properties),
        name: Some(format!("{}_features", geometry.name)),
        primitives: vec![primitive(attributes, indices, options)],
        weights: None,
    })
}

fn custom(name: &str) -> Checked<Semantic> {
    // gltf-json adds the leading underscore.
    Valid(Semantic::Extras(name.to_ascii_uppercase()))
}

fn primitive(
    attributes: BTreeMap<Checked<Semantic>, Index<Accessor>>,
    indices: Option<Index<Accessor>>,
    options: &GlbOptions,
) -> Primitive {
    Primitive {
        attributes,
        extensions: None,
        extras: None,
        indices,
        material: options.unlit.then(|| Index::new(0)),
        mode: Valid(if indices.is_some() { Mode::Triangles } else { Mode::Points }),
        targets: None,
    }
}

fn mesh_extras(geometry: &Geometry) -> Map<String, Value> {
    let integers = geometry.attributes.iter().filter_map(|attribute| match attribute.values {
        AttributeValues::F32(_) => None,
        AttributeValues::I32(_) => Some((attribute.name.clone(), json!("i32"))),
        AttributeValues::U8(_) => Some((attribute.name.clone(), json!("u8"))),
    });
    let order: Vec<_> = geometry.attributes.iter().map(|attribute| attribute.name.as_str()).collect();
    let mut extras = Map::new();
    extras.insert("offset".into(), json!(geometry.offset));
    extras.insert("attributes".into(), json!(order));
    extras.insert("integer_attributes".into(), Value::Object(integers.collect()));
    extras
}

fn push_node(document: &mut Document, node: &GlbNode, meshes: &Meshes) -> Index<scene::Node> {
    let mut properties = node.extras.clone();
    if let Some(stream) = &node.stream {
        properties.insert("stream".into(), json!(stream));
    }
    if let Some(interval) = node.interval {
        properties.insert("time_start".into(), json!(interval.time_start));
        properties.insert("time_end".into(), json!(interval.time_end));
    }
    // A child, so that it disappears with its parent.
    let features = meshes.1.map(|mesh| {
        document.root.push(scene::Node {
            mesh: Some(mesh),
            name: Some(format!("{}_features", node.name)),
            ..Default::default()
        })
    });
    document.root.push(scene::Node {
        children: features.map(|child| vec![child]),
        extras: extras(&properties),
        mesh: meshes.0,
        name: Some(node.name.clone()),
        ..Default::default()
    })
}
