//! What holds for all contents: pictures and arrays come back bit for bit, and no writer lets a NaN or infinity through.

use std::path::PathBuf;

use half::f16;
use proptest::prelude::*;

use crate::samples::any_geometry;
use crate::*;

fn temp_file(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    (folder, path)
}

/// Any finite half, by its bits.
fn any_half() -> impl Strategy<Value = f16> {
    any::<u16>().prop_map(f16::from_bits).prop_filter("finite", |v| v.is_finite())
}

/// Any finite float: the extremes of each kind often, else any bits.
fn any_float() -> impl Strategy<Value = f32> {
    let extremes = [f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-45, -1e-45, 0.0, -0.0, 1.0];
    prop_oneof![
        prop::sample::select(extremes.to_vec()),
        any::<u32>().prop_map(f32::from_bits).prop_filter("finite", |v| v.is_finite()),
    ]
}

fn any_picture() -> impl Strategy<Value = ExrImage> {
    let names = prop::sample::subsequence(vec!["A", "R", "Z", "clip_000.R", "depth.Z", "~"], 1..5);
    (1usize..24, 1usize..40, names).prop_flat_map(|(width, height, names)| {
        let pixels = width * height;
        let samples = prop_oneof![
            prop::collection::vec(any_half(), pixels).prop_map(ExrSamples::F16),
            prop::collection::vec(any_float(), pixels).prop_map(ExrSamples::F32),
        ];
        prop::collection::vec(samples, names.len()).prop_map(move |samples| ExrImage {
            width,
            height,
            channels: (names.iter().zip(samples))
                .map(|(name, samples)| ExrChannel { name: (*name).into(), samples })
                .collect(),
        })
    })
}

/// Bits of all values, so that -0.0 and 0.0 differ.
fn bits(samples: &ExrSamples) -> Vec<u32> {
    match samples {
        ExrSamples::F16(values) => values.iter().map(|v| v.to_bits().into()).collect(),
        ExrSamples::F32(values) => values.iter().map(|v| v.to_bits()).collect(),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_picture_survives_bit_for_bit(picture in any_picture()) {
        let (_folder, path) = temp_file("a.exr");
        write_exr(&path, picture.clone()).unwrap();
        let read = read_exr(&path).unwrap();
        prop_assert_eq!((read.width, read.height), (picture.width, picture.height));
        prop_assert_eq!(read.channels.len(), picture.channels.len());
        for channel in &picture.channels {
            let samples = read.channel(&channel.name).unwrap();
            prop_assert_eq!(bits(samples), bits(&channel.samples));
            prop_assert_eq!(samples, &channel.samples);
        }
    }

    /// Arrays keep NaN too: they are what other programs made, not what a map holds.
    #[test]
    fn any_array_survives_bit_for_bit(
        shape in prop::collection::vec(0usize..7, 0..4),
        seed: u32,
    ) {
        let (_folder, path) = temp_file("a.npy");
        let length = shape.iter().product::<usize>() as u32;
        let patterns: Vec<u32> = (0..length).map(|i| (seed ^ i).wrapping_mul(2_654_435_761)).collect();
        let values: Vec<f32> = patterns.iter().map(|v| f32::from_bits(*v)).collect();
        write_npy(&path, &shape, &values).unwrap();
        let read = read_npy(&path).unwrap();
        prop_assert_eq!(&read.header.shape, &shape);
        prop_assert_eq!(read.to_f32().iter().map(|v| v.to_bits()).collect::<Vec<_>>(), patterns.clone());

        let integers: Vec<i32> = patterns.iter().map(|v| *v as i32).collect();
        npy::write_npy_i32(&path, &shape, &integers).unwrap();
        let read = read_npy(&path).unwrap().to_i64().unwrap();
        prop_assert_eq!(read, integers.into_iter().map(i64::from).collect::<Vec<_>>());
    }

    #[test]
    fn a_value_that_is_not_finite_is_refused_by_name_and_leaves_no_file(
        mut geometry in any_geometry().prop_filter("vertices", |g| !g.positions.is_empty()),
        column in 0usize..3,
        at: prop::sample::Index,
        bad in prop::sample::select(vec![f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY]),
    ) {
        let vertex = at.index(geometry.positions.len());
        let expected = match column {
            0 => {
                geometry.positions[vertex][1] = bad;
                "positions".to_owned()
            }
            1 => {
                let AttributeValues::F32(values) = &mut geometry.attributes[0].values else { unreachable!() };
                values[vertex] = bad;
                geometry.attributes[0].name.clone()
            }
            _ => {
                let values = vec![0.0; 2 * geometry.positions.len()];
                geometry.features = vec![Features { name: "clip".into(), dim: 2, values }];
                geometry.features[0].values[2 * vertex + 1] = bad;
                "clip".to_owned()
            }
        };
        let (_folder, path) = temp_file("a");
        for outcome in [
            write_ply(&path, &geometry, &PlyOptions::default()),
            write_glb(&path, &geometry, &GlbOptions::default()),
            write_npz(&path, &geometry, NpzCompression::Stored),
        ] {
            match outcome {
                Err(Error::NonFinite { column, row, .. }) => prop_assert_eq!((column, row), (expected.clone(), vertex)),
                other => prop_assert!(false, "{:?}", other),
            }
            prop_assert!(!path.exists());
        }
    }
}
