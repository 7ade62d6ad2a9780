//! Round trips and damaged files.

use std::fs;
use std::path::PathBuf;

use half::f16;
use proptest::prelude::*;

use super::read::parse_array;
use super::*;
use crate::error::Error;
use crate::geometry::Features;
use crate::samples::*;

fn temp_file() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.npz");
    (folder, path)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn any_geometry_survives_bit_for_bit(mut geometry in any_geometry(), deflated: bool) {
        // In NPZ a matrix of one column is an attribute.
        geometry.features.retain(|features| features.dim > 1);
        let (_folder, path) = temp_file();
        let compression = if deflated { NpzCompression::Deflated } else { NpzCompression::Stored };
        write_npz(&path, &geometry, compression).unwrap();
        let read = read_npz(&path).unwrap();
        prop_assert_eq!(bits(&read), bits(&geometry));
        prop_assert_eq!(read, geometry);
    }
}

#[test]
fn halves_of_features_come_back_rounded_and_everything_else_exact() {
    let (_folder, path) = temp_file();
    let mut geometry = tetrahedron();
    let values = vec![0.1, -1.0, 3e-5, 65504.0, 0.5, 1e-9, 2.0, 1.0 / 3.0];
    geometry.features = vec![Features { name: "clip".into(), dim: 2, values }];
    write_npz(&path, &geometry, NpzCompression::HalfFeatures).unwrap();
    let mut read = read_npz(&path).unwrap();
    let found = std::mem::take(&mut read.features[0].values);
    let expected: Vec<f32> = geometry.features[0].values.iter().map(|v| f16::from_f32(*v).to_f32()).collect();
    assert_eq!(found, expected);
    assert_ne!(found, geometry.features[0].values);
    geometry.features[0].values.clear();
    assert_eq!(read, geometry);

    geometry.features[0].values = vec![0.0, 0.0, 0.0, 1e5, 0.0, 0.0, 0.0, 0.0];
    let error = write_npz(&path, &geometry, NpzCompression::HalfFeatures).unwrap_err();
    assert!(matches!(&error, Error::NonFinite { row: 1, .. }), "{error}");
}

#[test]
fn npz_rejects_every_truncation() {
    for compression in [NpzCompression::Stored, NpzCompression::Deflated] {
        let (_folder, path) = temp_file();
        write_npz(&path, &tetrahedron(), compression).unwrap();
        assert_every_truncation_fails(&path, read_npz);
    }
}

#[test]
fn no_damaged_byte_panics() {
    let (_folder, path) = temp_file();
    write_npz(&path, &tetrahedron(), NpzCompression::Deflated).unwrap();
    assert_no_damage_panics(&path, read_npz);
}

#[test]
fn the_same_geometry_gives_the_same_bytes() {
    let (_folder, path) = temp_file();
    let files = [0, 1].map(|_| {
        write_npz(&path, &cloud(), NpzCompression::Deflated).unwrap();
        fs::read(&path).unwrap()
    });
    assert!(files[0] == files[1]);
}

#[test]
fn npy_headers_that_lie_or_are_not_ours_are_errors() {
    let parse = |text: &str, values: usize| {
        let mut file = b"\x93NUMPY\x01\x00".to_vec();
        file.extend((text.len() as u16).to_le_bytes());
        file.extend(text.bytes());
        file.extend(vec![0; values]);
        parse_array("a.npz".as_ref(), "clip", &file).map(|array| (array.columns, array.bytes.len()))
    };
    let dictionary = |descr: &str, order: &str, shape: &str| {
        format!("{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n")
    };
    assert_eq!(parse(&dictionary("'<f4'", "False", "(2, 3)"), 24).unwrap(), (3, 24));
    assert_eq!(parse(&dictionary("'|u1'", "False", "(5,)"), 5).unwrap(), (1, 5));
    for (descr, order, shape) in
        [("'<f8'", "False", "(2, 3)"), ("'<f4'", "True", "(2, 3)"), ("'<f4'", "False", "(2, 3, 1)")]
    {
        let error = parse(&dictionary(descr, order, shape), 24).unwrap_err();
        assert!(matches!(error, Error::Unsupported { .. }), "{error}");
    }
    for shape in ["(2, 4)", "(9223372036854775807, 9223372036854775807)", "(2, -3)", "(2, 3"] {
        let error = parse(&dictionary("'<f4'", "False", shape), 24).unwrap_err();
        assert!(matches!(error, Error::Invalid { .. }), "{error}");
    }
}
