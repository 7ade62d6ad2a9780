//! The programs that people use open what we write, and find in it what we meant.
//!
//! Needs the tools that `tests/tools/setup.sh` installs; without them these tests fail, they are not skipped.

mod support;

use std::f32::consts::TAU;
use std::fs;
use std::path::Path;
use std::sync::OnceLock;

use divff_exporters::{
    Attribute, AttributeValues, ExrChannel, ExrImage, ExrSamples, Features, Geometry, GlbNode, GlbOptions,
    GlbScene, Interval, NpzCompression, PlyOptions, UpAxis, write_exr, write_glb, write_npz, write_ply,
    write_scene_glb,
};
use half::f16;
use serde_json::{Value, json};
use support::{expect_exr, expect_file, expect_geometry, expect_glb, printed, run_check, run_gltf_validator};

/// Far from the origin: f32 world coordinates would be 0.25 apart here.
const OFFSET: [f64; 3] = [3_500_000.0, -1_200_000.0, 250.0];

/// A closed torus with every kind of column. All values are distinct, so that swapped rows and columns show.
fn torus(name: &str, segments: u32, rings: u32, shift: f32) -> Geometry {
    let mut mesh = Geometry { name: name.into(), offset: OFFSET, ..Geometry::default() };
    for i in 0..segments {
        for j in 0..rings {
            let (u, v) = (TAU * i as f32 / segments as f32, TAU * j as f32 / rings as f32);
            let radius = 1.0 + 0.3 * v.cos();
            mesh.positions.push([radius * u.cos() + shift, radius * u.sin(), 0.3 * v.sin()]);
            mesh.normals.push([v.cos() * u.cos(), v.cos() * u.sin(), v.sin()]);
            mesh.colors.push([(i * 255 / segments) as u8, (j * 255 / rings) as u8, ((i + j) % 256) as u8]);
            let (right, up) = ((i + 1) % segments, (j + 1) % rings);
            let at = |i: u32, j: u32| i * rings + j;
            mesh.triangles.push([at(i, j), at(right, j), at(right, up)]);
            mesh.triangles.push([at(i, j), at(right, up), at(i, up)]);
        }
    }
    add_columns(&mut mesh);
    mesh
}

fn add_columns(geometry: &mut Geometry) {
    let vertices = geometry.positions.len();
    let floats = |scale: f32| AttributeValues::F32((0..vertices).map(|i| (i as f32 * scale).sin()).collect());
    let mut add = |name: &str, values| geometry.attributes.push(Attribute { name: name.into(), values });
    add("affordance_wash", floats(0.01));
    add("affordance_cut", floats(0.02));
    add("confidence", floats(0.03));
    add("label", AttributeValues::I32((0..vertices).map(|i| i as i32 * 31 - 500).collect()));
    add("stream", AttributeValues::U8((0..vertices).map(|i| (i % 3) as u8).collect()));
    for (name, dim) in [("clip", 30), ("egovideo", 4)] {
        let values = (0..vertices * dim).map(|i| (i as f32 * 0.37).cos()).collect();
        geometry.features.push(Features { name: name.into(), dim, values });
    }
}

/// A cloud with features of full width.
fn cloud() -> Geometry {
    let points = 2000;
    let mut cloud = Geometry {
        name: "points".into(),
        offset: OFFSET,
        positions: (0..points).map(|i| [i as f32 * 0.01, (i as f32).sqrt(), -0.5 * i as f32]).collect(),
        normals: (0..points).map(|i| [(i as f32).cos(), (i as f32).sin(), 0.0]).collect(),
        colors: (0..points).map(|i| [(i % 256) as u8, (i / 8) as u8, 77]).collect(),
        ..Geometry::default()
    };
    add_columns(&mut cloud);
    cloud.features[0].dim = 512;
    cloud.features[0].values = (0..points * 512).map(|i| (i as f32 * 1e-3).sin()).collect();
    cloud
}

fn view() -> ExrImage {
    let (width, height) = (45, 37);
    let pixels = width * height;
    let half = |name: String, scale: f32| {
        let values = (0..pixels).map(|i| f16::from_f32((i as f32 * scale).sin())).collect();
        ExrChannel { name, samples: ExrSamples::F16(values) }
    };
    let mut channels: Vec<ExrChannel> = ["R", "G", "B", "relevancy_the_red_cup.Y", "stream_dynamic.Y"]
        .into_iter()
        .enumerate()
        .map(|(i, name)| half(name.into(), 0.1 + i as f32))
        .collect();
    for d in 0..16 {
        channels
            .push(half(format!("clip_{:03}.{}", d / 4, ["R", "G", "B", "A"][d % 4]), 0.01 * (d + 1) as f32));
    }
    let depth = (0..pixels).map(|i| 0.25 + i as f32 / 3.0).collect();
    channels.push(ExrChannel { name: "depth.Z".into(), samples: ExrSamples::F32(depth) });
    ExrImage { width, height, channels }
}

fn node(name: &str, geometry: usize, stream: &str, interval: Option<(f64, f64)>) -> GlbNode {
    GlbNode {
        name: name.into(),
        geometry,
        stream: Some(stream.into()),
        interval: interval.map(|(time_start, time_end)| Interval { time_start, time_end }),
        ..GlbNode::default()
    }
}

/// Two streams over time; the object returns to where it was, so one geometry serves two nodes.
fn kitchen(geometries: &[Geometry]) -> GlbScene<'_> {
    let nodes = vec![
        node("persistent", 0, "persistent", None),
        node("dynamic_000000", 1, "dynamic", Some((0.0, 0.25))),
        node("dynamic_000012", 2, "dynamic", Some((0.25, 0.5))),
        node("dynamic_000024", 1, "dynamic", Some((0.5, 1.0))),
        node("actor_000012", 3, "actor", Some((0.25, 0.75))),
    ];
    GlbScene { geometries: geometries.iter().collect(), nodes, seconds: 8.0 }
}

/// Writes one file of every kind, and what is to be found in them.
fn write_all(folder: &Path) {
    let mesh = torus("persistent", 40, 16, 0.0);
    let mut open = torus("open", 12, 8, 0.0);
    // An open surface, so that `watertight` is seen to be false too; all its vertices are still used.
    open.triangles.pop();
    let cloud = cloud();
    let mut files = Vec::new();
    let plain = PlyOptions::default();
    for (name, geometry, tight) in
        [("persistent", &mesh, Some(true)), ("open", &open, Some(false)), ("points", &cloud, None)]
    {
        write_ply(&folder.join(format!("{name}.ply")), geometry, &plain).unwrap();
        files.push(expect_file(&format!("{name}.ply"), "ply", expect_geometry(geometry, tight)));
        write_npz(&folder.join(format!("{name}.npz")), geometry, NpzCompression::Stored).unwrap();
        files.push(expect_file(&format!("{name}.npz"), "npz", expect_geometry(geometry, tight)));
    }
    write_npz(&folder.join("deflated.npz"), &cloud, NpzCompression::Deflated).unwrap();
    files.push(expect_file("deflated.npz", "npz", expect_geometry(&cloud, None)));
    let for_cloudcompare = PlyOptions { cloudcompare: true, quality: Some("confidence".into()) };
    write_ply(&folder.join("cloudcompare.ply"), &open, &for_cloudcompare).unwrap();
    let mut expected = expect_geometry(&open, Some(false));
    expected.insert("prefix".into(), json!("scalar_"));
    files.push(expect_file("cloudcompare.ply", "ply", expected));

    let glb = |name: &str, geometry: &Geometry, options: GlbOptions, tight| {
        write_glb(&folder.join(name), geometry, &options).unwrap();
        let nodes = vec![GlbNode { name: geometry.name.clone(), ..GlbNode::default() }];
        let scene = GlbScene { geometries: vec![geometry], nodes, seconds: 0.0 };
        expect_glb(name, &scene, &options, &[tight])
    };
    let options = GlbOptions { up_axis: UpAxis::Z, ..GlbOptions::default() };
    files.push(glb("persistent.glb", &mesh, options.clone(), Some(true)));
    files.push(glb("open.glb", &open, GlbOptions { unlit: true, ..options.clone() }, Some(false)));
    files.push(glb(
        "features.glb",
        &open,
        GlbOptions { features: true, float_colors: true, ..options.clone() },
        Some(false),
    ));
    files.push(glb("points.glb", &cloud, options.clone(), None));
    let geometries = [
        mesh,
        torus("dynamic_000000", 9, 7, 3.0),
        torus("dynamic_000012", 11, 5, 4.0),
        torus("actor_000012", 8, 6, -3.0),
    ];
    let scene = kitchen(&geometries);
    write_scene_glb(&folder.join("scene.glb"), &scene, &options).unwrap();
    files.push(expect_glb("scene.glb", &scene, &options, &[Some(true); 4]));

    let view = view();
    files.push(expect_exr("view.exr", &view));
    write_exr(&folder.join("view.exr"), view).unwrap();
    write_expected(folder, &json!({ "up_axis": "Z", "files": files }));
}

fn write_expected(folder: &Path, expected: &Value) {
    fs::write(folder.join("expected.json"), expected.to_string()).unwrap();
}

/// The folder that all tests look into, written once.
fn written() -> &'static Path {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        write_all(folder.path());
        folder
    });
    folder.path()
}

fn assert_reads_everything(reader: &str, hash_seed: u32) {
    let output = run_check(reader, written(), hash_seed);
    assert!(output.status.success(), "{}", printed(&output));
    println!("{}", printed(&output));
}

#[test]
fn open3d_finds_every_column() {
    assert_reads_everything("open3d", 0);
}

#[test]
fn trimesh_finds_every_attribute() {
    assert_reads_everything("trimesh", 0);
}

#[test]
fn openexr_finds_every_channel() {
    assert_reads_everything("openexr", 0);
}

/// Several seeds: Blender 5.0's importer walks attributes in hash order, and fails for some mixes in some
/// orders.
#[test]
fn blender_finds_every_attribute_and_interval() {
    for hash_seed in [0, 1, 2] {
        assert_reads_everything("blender", hash_seed);
    }
}

#[test]
fn the_khronos_validator_finds_no_error_and_no_warning() {
    let output = run_gltf_validator(written());
    assert!(output.status.success(), "{}", printed(&output));
}

/// The good folder with one value of one column of every file changed in the expectations.
fn with_wrong_expectations(change: impl Fn(&mut Value)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for entry in fs::read_dir(written()).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
    }
    let text = fs::read_to_string(written().join("expected.json")).unwrap();
    let mut expected: Value = serde_json::from_str(&text).unwrap();
    expected["files"].as_array_mut().unwrap().iter_mut().for_each(change);
    write_expected(folder.path(), &expected);
    folder
}

fn assert_complains(reader: &str, folder: &Path, about: &str) {
    let output = run_check(reader, folder, 0);
    let text = printed(&output);
    assert!(
        output.status.code() == Some(1) && text.contains(about),
        "{reader} did not complain of {about}:\n{text}"
    );
}

/// One label off in one vertex is noticed: the checks can fail.
#[test]
fn checks_notice_a_wrong_value() {
    let folder = with_wrong_expectations(|file| {
        let columns = match file["format"].as_str() {
            Some("exr") => &mut file["channels"]["depth.Z"],
            Some("glb") => &mut file["objects"][0]["columns"]["label"],
            _ => &mut file["columns"]["label"],
        };
        columns["crc32"] = json!(columns["crc32"].as_u64().unwrap() ^ 1);
    });
    for (reader, about) in [
        ("open3d", "persistent.ply: label"),
        ("trimesh", "persistent.glb: persistent: label"),
        ("blender", "persistent.glb: persistent: label"),
        ("openexr", "view.exr: depth.Z"),
    ] {
        assert_complains(reader, folder.path(), about);
    }
}

#[test]
fn checks_notice_wrong_counts_and_intervals_and_missing_names() {
    let folder = with_wrong_expectations(|file| {
        if file["path"] == "scene.glb" {
            file["nodes"][2]["time_end"] = json!(0.75);
        } else if file["format"] == "exr" {
            let channel = file["channels"]["R"].clone();
            file["channels"]["Q"] = channel;
        } else if file["path"] == "persistent.ply" {
            file["vertices"] = json!(7);
            file["watertight"] = json!(false);
        }
    });
    assert_complains("blender", folder.path(), "dynamic_000012: scale at");
    assert_complains("openexr", folder.path(), "view.exr: channels");
    assert_complains("open3d", folder.path(), "persistent.ply: watertight");
    assert_complains("trimesh", folder.path(), "persistent.ply: vertices");
}

#[test]
fn checks_of_an_empty_folder_fail() {
    let folder = tempfile::tempdir().unwrap();
    write_expected(folder.path(), &json!({ "up_axis": "Z", "files": [] }));
    for reader in ["open3d", "trimesh", "openexr", "blender"] {
        assert_complains(reader, folder.path(), "nothing was checked");
    }
    assert!(!run_gltf_validator(folder.path()).status.success());
}

#[test]
fn the_validator_notices_wrong_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let mut glb = fs::read(written().join("persistent.glb")).unwrap();
    // The first position, 1.3 along x, is the largest; 4 bytes that make it larger than the recorded bound.
    let at = glb.windows(4).position(|bytes| bytes == 1.3f32.to_le_bytes()).unwrap();
    glb[at..at + 4].copy_from_slice(&9.0f32.to_le_bytes());
    fs::write(folder.path().join("broken.glb"), glb).unwrap();
    let output = run_gltf_validator(folder.path());
    assert!(!output.status.success() && printed(&output).contains("ACCESSOR_"), "{}", printed(&output));
}
