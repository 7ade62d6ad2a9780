//! Round trips, an independent reader, and damaged files.

use std::fs;
use std::path::PathBuf;

use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::error::Error;
use crate::samples::*;

fn temp_file() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    (folder, path)
}

fn with_features(up_axis: UpAxis) -> GlbOptions {
    GlbOptions { up_axis, features: true, ..GlbOptions::default() }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn any_geometry_survives_bit_for_bit(
        geometry in any_geometry(),
        z_up: bool,
        unlit: bool,
        float_colors: bool,
    ) {
        let (_folder, path) = temp_file();
        let up_axis = if z_up { UpAxis::Z } else { UpAxis::Y };
        write_glb(&path, &geometry, &GlbOptions { unlit, float_colors, ..with_features(up_axis) }).unwrap();
        let read = read_glb(&path).unwrap();
        prop_assert_eq!(read.up_axis, up_axis);
        if geometry.positions.is_empty() {
            // Without a mesh only the node is left.
            prop_assert_eq!(&read.geometries, &[Geometry { name: geometry.name, ..Geometry::default() }]);
        } else {
            prop_assert_eq!(bits(&read.geometries[0]), bits(&geometry));
            prop_assert_eq!(&read.geometries, &[geometry]);
        }
    }
}

#[test]
fn a_z_up_world_is_stored_y_up_with_bounds_and_linear_colours() {
    let (_folder, path) = temp_file();
    let mesh = tetrahedron();
    write_glb(&path, &mesh, &with_features(UpAxis::Z)).unwrap();
    // The gltf crate checks the document against the specification's rules as it opens it.
    let file = fs::read(&path).unwrap();
    let gltf = gltf::Gltf::from_slice(&file).unwrap();
    let blob = gltf.blob.clone().unwrap();
    let primitive = gltf.meshes().next().unwrap().primitives().next().unwrap();
    let reader = primitive.reader(|_| Some(&blob));
    let expected: Vec<_> = mesh.positions.iter().map(|[x, y, z]| [*x, *z, -*y]).collect();
    assert_eq!(reader.read_positions().unwrap().collect::<Vec<_>>(), expected);
    assert_eq!(primitive.bounding_box(), gltf::mesh::Bounds { min: [-0.5; 3], max: [0.5; 3] });
    let colors: Vec<_> = reader.read_colors(0).unwrap().into_rgba_u16().collect();
    // IEC 61966-2-1 by hand: 128/255 = 0.50196 -> ((0.50196 + 0.055) / 1.055)^2.4 = 0.215861 -> 14146.
    assert_eq!(colors[1][1], 14146);
    assert_eq!(colors[2][2..], [65535, 65535]);
    assert_eq!(reader.read_indices().unwrap().into_u32().count(), 12);
    let names: Vec<String> = primitive.attributes().map(|(semantic, _)| semantic.to_string()).collect();
    for name in ["_CONFIDENCE", "_AFFORDANCE_WASH", "_LABEL", "_STREAM"] {
        assert!(names.contains(&name.to_owned()), "{names:?}");
    }
    assert!(primitive.material().index().is_none());
    assert_eq!(gltf.meshes().nth(1).unwrap().name(), Some("persistent_features"));
}

#[test]
fn a_cloud_is_points_and_an_empty_geometry_a_node_without_mesh() {
    let (_folder, path) = temp_file();
    write_glb(&path, &cloud(), &GlbOptions::default()).unwrap();
    let gltf = gltf::Gltf::open(&path).unwrap();
    let primitive = gltf.meshes().next().unwrap().primitives().next().unwrap();
    assert_eq!(primitive.mode(), gltf::mesh::Mode::Points);

    let empty = Geometry { name: "dynamic_000007".into(), ..Geometry::default() };
    write_glb(&path, &empty, &GlbOptions::default()).unwrap();
    assert!(gltf::Gltf::open(&path).unwrap().nodes().next().unwrap().mesh().is_none());
    assert_eq!(read_glb(&path).unwrap().geometries, [empty]);
}

fn kitchen(geometries: &[Geometry]) -> GlbScene<'_> {
    let timed = |name: &str, geometry, time_start, time_end| GlbNode {
        name: name.into(),
        geometry,
        stream: Some("dynamic".into()),
        interval: Some(Interval { time_start, time_end }),
        ..GlbNode::default()
    };
    let persistent = GlbNode {
        name: "persistent".into(),
        stream: Some("persistent".into()),
        extras: Map::from_iter([("source".to_owned(), json!("kitchen"))]),
        ..GlbNode::default()
    };
    let nodes = vec![
        persistent,
        timed("dynamic_000000", 1, 0.0, 0.25),
        timed("dynamic_000010", 2, 0.25, 0.5),
        // The object is back where it was: the geometry is shared, not stored again.
        timed("dynamic_000020", 1, 0.5, 1.0),
    ];
    GlbScene { geometries: geometries.iter().collect(), nodes, seconds: 8.0 }
}

fn three_geometries() -> Vec<Geometry> {
    ["persistent", "dynamic_000000", "dynamic_000010"]
        .map(|name| Geometry { name: name.into(), ..tetrahedron() })
        .to_vec()
}

#[test]
fn scene_nodes_share_geometry_and_are_animated_by_steps() {
    let (_folder, path) = temp_file();
    let geometries = three_geometries();
    let scene = kitchen(&geometries);
    write_scene_glb(&path, &scene, &with_features(UpAxis::Z)).unwrap();
    let read = read_glb(&path).unwrap();
    assert_eq!(read.geometries, geometries);
    let by_name = |name: &str| read.nodes.iter().find(|node| node.name == name).unwrap();
    for node in &scene.nodes {
        assert_eq!(by_name(&node.name), node);
    }

    let file = fs::read(&path).unwrap();
    let gltf = gltf::Gltf::from_slice(&file).unwrap();
    assert_eq!(gltf.meshes().count(), 6);
    let blob = gltf.blob.as_ref().unwrap();
    let animation = gltf.animations().next().unwrap();
    let keys: Vec<(String, Vec<f32>)> = animation
        .channels()
        .map(|channel| {
            assert_eq!(channel.sampler().interpolation(), gltf::animation::Interpolation::Step);
            let name = channel.target().node().name().unwrap().to_owned();
            (name, channel.reader(|_| Some(&blob[..])).read_inputs().unwrap().collect())
        })
        .collect();
    let expected = [
        ("dynamic_000000".to_owned(), vec![0.0, 2.0]),
        ("dynamic_000010".to_owned(), vec![0.0, 2.0, 4.0]),
        ("dynamic_000020".to_owned(), vec![0.0, 4.0]),
    ];
    assert_eq!(keys, expected);
    let rest_scale =
        |name: &str| gltf.nodes().find(|n| n.name() == Some(name)).unwrap().transform().decomposed().2;
    assert_eq!(rest_scale("dynamic_000000"), [1.0; 3]);
    assert_eq!(rest_scale("dynamic_000010"), [0.0; 3]);
}

#[test]
fn inconsistent_scenes_are_refused() {
    let (_folder, path) = temp_file();
    let geometries = three_geometries();
    let complaint = |change: fn(&mut GlbScene)| {
        let mut scene = kitchen(&geometries);
        change(&mut scene);
        write_scene_glb(&path, &scene, &GlbOptions::default()).unwrap_err().to_string()
    };
    assert!(complaint(|s| s.nodes[1].geometry = 3).contains("no geometry 3"));
    assert!(
        complaint(|s| s.nodes[1].interval = Some(Interval { time_start: 0.5, time_end: 0.5 }))
            .contains("dynamic_000000")
    );
    assert!(
        complaint(|s| s.nodes[2].interval = Some(Interval { time_start: f64::NAN, time_end: 0.5 }))
            .contains("dynamic_000010")
    );
    assert!(complaint(|s| s.seconds = 0.0).contains("0 s"));
    let moved = Geometry { offset: [1.0; 3], ..tetrahedron() };
    let scene = GlbScene { geometries: vec![&geometries[0], &moved], ..kitchen(&geometries[..1]) };
    assert!(
        write_scene_glb(&path, &scene, &GlbOptions::default()).unwrap_err().to_string().contains("offset")
    );
    let big = AttributeTooBig::geometry();
    assert!(write_glb(&path, &big, &GlbOptions::default()).unwrap_err().to_string().contains("2^24"));
    assert!(!path.exists());
}

struct AttributeTooBig;

impl AttributeTooBig {
    fn geometry() -> Geometry {
        let mut geometry = tetrahedron();
        geometry.attributes[2].values = crate::AttributeValues::I32(vec![0, 0, 0, (1 << 24) + 1]);
        geometry
    }
}

#[test]
fn glb_rejects_every_truncation() {
    let (_folder, path) = temp_file();
    write_glb(&path, &tetrahedron(), &with_features(UpAxis::Z)).unwrap();
    assert_every_truncation_fails(&path, read_glb);
}

#[test]
fn no_damaged_byte_panics() {
    let (_folder, path) = temp_file();
    let geometries = three_geometries();
    write_scene_glb(&path, &kitchen(&geometries), &with_features(UpAxis::Z)).unwrap();
    assert_no_damage_panics(&path, read_glb);
}

/// Rewrites the JSON chunk of a good file, lengths adjusted, so that the damage is behind valid containers.
fn read_with_json(from: &str, to: &str) -> Error {
    let (_folder, path) = temp_file();
    write_glb(&path, &tetrahedron(), &GlbOptions::default()).unwrap();
    let file = fs::read(&path).unwrap();
    let (json, bin) = container::split(&path, &file).unwrap();
    let json = std::str::from_utf8(json).unwrap();
    assert!(json.contains(from), "{json}");
    let mut json = json.replacen(from, to, 1).into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut changed = Vec::new();
    let total = container::total_bytes(json.len(), bin.len()).unwrap();
    container::write_head(&mut changed, total, &json, bin.len()).unwrap();
    changed.extend(bin);
    fs::write(&path, changed).unwrap();
    read_glb(&path).unwrap_err()
}

#[test]
fn hostile_documents_are_errors() {
    assert!(
        read_with_json("\"count\":4", "\"count\":18446744073709551615").to_string().contains("more items")
    );
    assert!(read_with_json("\"count\":4", "\"count\":5").to_string().contains("more items"));
    assert!(
        read_with_json("\"byteOffset\":0", "\"byteOffset\":18446744073709551615")
            .to_string()
            .contains("outside")
    );
    assert!(read_with_json("\"POSITION\":0", "\"POSITION\":99").to_string().contains("accessor 99"));
    assert!(read_with_json("\"VEC3\"", "\"MAT4\"").to_string().contains("more items"));
    assert!(read_with_json("\"mesh\":0", "\"mesh\":9").to_string().contains("no such mesh"));
    let moved = read_with_json("\"mesh\":0", "\"mesh\":0,\"translation\":[1,0,0]");
    assert!(matches!(moved, Error::Unsupported { .. }), "{moved}");
}
