//! Round trips, other programs' habits, and damaged files.

use std::fs;
use std::io::BufReader;
use std::path::PathBuf;

use proptest::prelude::*;

use super::*;
use crate::error::Error;
use crate::geometry::{Attribute, AttributeValues, Features};
use crate::samples::*;

fn temp_file(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    (folder, path)
}

fn read_text(text: &str) -> Result<crate::Geometry, Error> {
    read_raw(text.as_bytes())
}

fn read_raw(bytes: &[u8]) -> Result<crate::Geometry, Error> {
    let (_folder, path) = temp_file("raw.ply");
    fs::write(&path, bytes).unwrap();
    read_ply(&path)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn any_geometry_survives_bit_for_bit(geometry in any_geometry(), cloudcompare: bool, quality: bool) {
        let (_folder, path) = temp_file("a.ply");
        let options = PlyOptions { cloudcompare, quality: quality.then(|| "score".to_owned()) };
        write_ply(&path, &geometry, &options).unwrap();
        let read = read_ply(&path).unwrap();
        prop_assert_eq!(bits(&read), bits(&geometry));
        prop_assert_eq!(read, geometry);
    }
}

#[test]
fn header_is_the_one_that_all_readers_take() {
    let (_folder, path) = temp_file("a.ply");
    let mut mesh = tetrahedron();
    mesh.name = "line\nbreak".into();
    mesh.features[0] = Features { name: "clip".into(), dim: 2, values: vec![0.0; 8] };
    write_ply(&path, &mesh, &PlyOptions { quality: Some("confidence".into()), cloudcompare: false }).unwrap();
    let file = fs::read(&path).unwrap();
    let end = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let expected = "ply\nformat binary_little_endian 1.0\ncomment divff name line break\n\
        comment divff offset 1000000 -2500000 0.1\ncomment divff quality confidence\nelement vertex 4\n\
        property float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\n\
        property float nz\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
        property float quality\n\
        property float confidence\nproperty float affordance_wash\nproperty int label\n\
        property uchar stream\n\
        property float clip_000\nproperty float clip_001\nproperty float egovideo_000\nelement face 4\n\
        property list uchar int vertex_indices\nend_header\n";
    assert_eq!(std::str::from_utf8(&file[..end]).unwrap(), expected);
    // x y z nx ny nz, rgb, quality and two scores, label, stream, three features; 13 bytes a face.
    assert_eq!(file.len() - end, 4 * (24 + 3 + 12 + 4 + 1 + 12) + 4 * 13);
}

#[test]
fn another_implementation_reads_the_same_numbers() {
    let (_folder, path) = temp_file("a.ply");
    let mesh = tetrahedron();
    write_ply(&path, &mesh, &PlyOptions::default()).unwrap();
    let parser = ply_rs::parser::Parser::<ply_rs::ply::DefaultElement>::new();
    let ply = parser.read_ply(&mut BufReader::new(fs::File::open(&path).unwrap())).unwrap();
    use ply_rs::ply::Property;
    for (row, vertex) in ply.payload["vertex"].iter().enumerate() {
        assert_eq!(vertex["y"], Property::Float(mesh.positions[row][1]));
        assert_eq!(vertex["green"], Property::UChar(mesh.colors[row][1]));
        assert_eq!(vertex["clip_005"], Property::Float(mesh.features[0].values[6 * row + 5]));
        let AttributeValues::I32(labels) = &mesh.attributes[2].values else { unreachable!() };
        assert_eq!(vertex["label"], Property::Int(labels[row]));
    }
    for (row, face) in ply.payload["face"].iter().enumerate() {
        let corners = mesh.triangles[row].iter().map(|&v| v as i32).collect();
        assert_eq!(face["vertex_indices"], Property::ListInt(corners));
    }
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let vertices = 20_000;
    let cloud = crate::Geometry {
        name: "points".into(),
        positions: (0..vertices).map(|i| [i as f32, 0.5, -1.0]).collect(),
        features: vec![Features {
            name: "clip".into(),
            dim: 20,
            values: (0..20 * vertices).map(|i| i as f32).collect(),
        }],
        ..Default::default()
    };
    let (_folder, path) = temp_file("a.ply");
    let files: Vec<Vec<u8>> = [1, 3]
        .into_iter()
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| write_ply(&path, &cloud, &PlyOptions::default())).unwrap();
            fs::read(&path).unwrap()
        })
        .collect();
    assert!(files[0] == files[1]);
    assert_eq!(read_ply(&path).unwrap(), cloud);
}

#[test]
fn ply_rejects_every_truncation() {
    let (_folder, path) = temp_file("a.ply");
    write_ply(&path, &tetrahedron(), &PlyOptions::default()).unwrap();
    assert_every_truncation_fails(&path, read_ply);
}

#[test]
fn no_damaged_byte_panics() {
    let (_folder, path) = temp_file("a.ply");
    write_ply(&path, &tetrahedron(), &PlyOptions::default()).unwrap();
    assert_no_damage_panics(&path, read_ply);
}

#[test]
fn a_header_that_claims_more_than_the_file_holds_is_rejected_at_once() {
    for count in ["18446744073709551615", "4000000000", "5"] {
        let text = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty float x\n\
             property float y\nproperty float z\nend_header\n"
        );
        let mut file = text.into_bytes();
        file.extend([0; 48]);
        assert!(matches!(read_raw(&file), Err(Error::Invalid { .. })), "{count}");
    }
    let empty_rows = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n\
        property float z\nelement ghost 18446744073709551615\nend_header\n";
    assert!(matches!(read_text(empty_rows), Err(Error::Invalid { .. })));
}

#[test]
fn ascii_polygons_and_foreign_columns_are_read() {
    let text = "ply\r\nformat ascii 1.0\r\ncomment by hand\r\nelement vertex 4\r\nproperty double x\r\n\
        property double y\r\nproperty double z\r\nproperty float nx\r\nproperty float ny\r\n\
        property float nz\r\n\
        property ushort Object-Id\r\nproperty float scalar_Heat\r\nelement camera 1\r\n\
        property list uchar float focal\r\nelement face 1\r\nproperty uchar flags\r\n\
        property list uchar uint vertex_index\r\nend_header\r\n\
        0 0 0 0 0 2 7 0.5\r\n1 0 0 0 0 1 8 1\r\n1 1 0 0 0 1 9 1.5\r\n0 1 0 0 0 1 10 2\r\n\
        2 1.5 2.5\r\n3 4 0 1 2 3";
    let mesh = read_text(text).unwrap();
    assert_eq!(mesh.positions[2], [1.0, 1.0, 0.0]);
    assert_eq!(mesh.normals[0], [0.0, 0.0, 1.0]);
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(mesh.attributes[0].name, "object_id");
    assert_eq!(mesh.attributes[0].values, AttributeValues::I32(vec![7, 8, 9, 10]));
    assert_eq!(mesh.attributes[1].name, "heat");
    assert_eq!(mesh.name, "raw");
}

#[test]
fn doubles_far_from_the_origin_keep_their_precision() {
    let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\n\
        property double z\nend_header\n5000000.001 100 0\n5000001.002 100.5 0\n";
    let cloud = read_text(text).unwrap();
    for (row, expected) in [5000000.001, 5000001.002].into_iter().enumerate() {
        let x = cloud.offset[0] + f64::from(cloud.positions[row][0]);
        // Half a unit in the last place of an f32 near 1, and an f64's near 5e6.
        assert!((x - expected).abs() < 1e-7, "{x}");
    }
}

#[test]
fn nonsense_is_an_error_that_says_where() {
    let head =
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
    let message = |text: &str| read_text(text).unwrap_err().to_string();
    assert!(message(&format!("{head}end_header\n0 nan 0\n")).contains("row 0"));
    assert!(message(&format!("{head}end_header\n0 zero 0\n")).contains("at byte"));
    let face = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n";
    assert!(message(&format!("{head}{face}3 0 0 1\n")).contains("triangle 0"));
    assert!(message(&format!("{head}{face}3 0 0 -1\n")).contains("no vertex index"));
    assert!(message("ply\nformat binary_pdp_endian 1.0\nend_header\n").contains("binary_little_endian"));
    assert!(message("solid cube\n").contains("no PLY file"));
    assert!(message("ply\nformat ascii 1.0\nproperty float x\nend_header\n").contains("before any element"));
    let list = "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar float clip\nend_header\n1 0\n";
    assert!(message(list).contains("list `clip`"));
    assert!(
        message("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
            .contains("`x`, `y`")
    );
}

#[test]
fn a_refused_geometry_leaves_the_old_file() {
    let (folder, path) = temp_file("a.ply");
    fs::write(&path, "old").unwrap();
    let mut mesh = tetrahedron();
    mesh.positions[1][1] = f32::NAN;
    assert!(matches!(write_ply(&path, &mesh, &PlyOptions::default()), Err(Error::NonFinite { row: 1, .. })));
    let unknown = PlyOptions { quality: Some("beauty".into()), ..PlyOptions::default() };
    assert!(write_ply(&path, &tetrahedron(), &unknown).unwrap_err().to_string().contains("beauty"));
    assert_eq!(fs::read_to_string(&path).unwrap(), "old");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

/// Values are looked at as they are packed; what is told of them is what a look before that finds.
#[test]
fn what_is_refused_is_what_validation_finds_first() {
    let (folder, path) = temp_file("a.ply");
    let vertices = 20_000;
    let valid = crate::Geometry {
        name: "points".into(),
        positions: vec![[1.0; 3]; vertices],
        normals: vec![[0.0, 0.0, 1.0]; vertices],
        attributes: vec![
            float_attribute("wash", vertices),
            float_attribute("cook", vertices),
            float_attribute("sit", vertices),
            float_attribute("open", vertices),
            float_attribute("cut", vertices),
        ],
        features: vec![Features { name: "clip".into(), dim: 3, values: vec![0.5; 3 * vertices] }],
        ..Default::default()
    };
    write_ply(&path, &valid, &PlyOptions::default()).unwrap();
    fs::write(&path, "old").unwrap();
    let breaks: [fn(&mut crate::Geometry); 8] = [
        |g| g.positions[19_999][2] = f32::NAN,
        |g| g.normals[12_345][0] = f32::INFINITY,
        |g| g.normals[7] = [0.0, 0.0, 1.1],
        |g| float_values(&mut g.attributes[0])[19_998] = f32::NEG_INFINITY,
        |g| float_values(&mut g.attributes[4])[3] = f32::NAN,
        |g| g.features[0].values[59_999] = f32::NAN,
        |g| g.offset[0] = f64::NAN,
        |g| g.triangles = vec![[0, 1, 20_000]],
    ];
    let unknown = PlyOptions { quality: Some("beauty".into()), ..PlyOptions::default() };
    let nowhere = folder.path().join("nowhere").join("a.ply");
    for (i, first) in breaks.iter().enumerate() {
        for second in &breaks[i..] {
            let mut broken = valid.clone();
            second(&mut broken);
            first(&mut broken);
            let expected = broken.validate().unwrap_err().to_string();
            for (path, options) in
                [(&path, &PlyOptions::default()), (&path, &unknown), (&nowhere, &PlyOptions::default())]
            {
                assert_eq!(write_ply(path, &broken, options).unwrap_err().to_string(), expected);
            }
        }
    }
    assert_eq!(fs::read_to_string(&path).unwrap(), "old");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

fn float_attribute(name: &str, vertices: usize) -> Attribute {
    Attribute { name: name.into(), values: AttributeValues::F32(vec![0.5; vertices]) }
}

fn float_values(attribute: &mut Attribute) -> &mut [f32] {
    let AttributeValues::F32(values) = &mut attribute.values else { unreachable!() };
    values
}
