//! Geometry for tests: small, and generated within the invariants.

use std::fs;
use std::path::Path;

use proptest::prelude::*;

use crate::error::{Error, Result};
use crate::geometry::{Attribute, AttributeValues, Features, Geometry};

/// A tetrahedron with every kind of column.
pub(crate) fn tetrahedron() -> Geometry {
    let s = 1.0 / 3f32.sqrt();
    Geometry {
        name: "persistent".into(),
        positions: vec![[0.5, 0.5, 0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [-0.5, -0.5, 0.5]],
        offset: [1.0e6, -2.5e6, 0.1],
        normals: vec![[s, s, s], [s, -s, -s], [-s, s, -s], [-s, -s, s]],
        colors: vec![[0, 1, 2], [127, 128, 129], [253, 254, 255], [10, 200, 30]],
        triangles: vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
        attributes: vec![
            attribute("confidence", AttributeValues::F32(vec![0.0, 0.25, f32::MIN_POSITIVE, 1.0])),
            attribute("affordance_wash", AttributeValues::F32(vec![-0.0, 1.0 / 3.0, 0.5, 0.9])),
            attribute("label", AttributeValues::I32(vec![-1, 0, 1 << 24, -(1 << 24)])),
            attribute("stream", AttributeValues::U8(vec![0, 1, 2, 255])),
        ],
        features: vec![
            Features { name: "clip".into(), dim: 6, values: (0..24).map(|i| i as f32 / 7.0).collect() },
            Features { name: "egovideo".into(), dim: 1, values: vec![0.1, 0.2, 0.3, 0.4] },
        ],
    }
}

/// The same without triangles.
pub(crate) fn cloud() -> Geometry {
    Geometry { triangles: vec![], ..tetrahedron() }
}

fn attribute(name: &str, values: AttributeValues) -> Attribute {
    Attribute { name: name.into(), values }
}

/// The extremes of each kind of float, which random bits would hardly ever hit.
const EXTREMES: [f32; 8] = [f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-45, -1e-45, 0.0, -0.0, 1.0];

/// Any valid geometry of up to 40 vertices, or none, with or without each kind of column.
pub(crate) fn any_geometry() -> impl Strategy<Value = Geometry> {
    let sizes = (prop_oneof![Just(0), Just(1), 2usize..40], 0usize..9);
    (any_name(), sizes, any::<[bool; 4]>(), any::<u64>()).prop_map(|(name, (vertices, dim), has, seed)| {
        // SplitMix64: one seed keeps shrinking simple.
        let mut state = seed;
        let mut next = move || {
            state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = state;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^ (z >> 31)
        };
        let mut float = || loop {
            let bits = next();
            if bits >> 62 == 0 {
                return EXTREMES[(bits >> 32) as usize % EXTREMES.len()];
            }
            let value = f32::from_bits(bits as u32);
            if value.is_finite() {
                return value;
            }
        };
        let positions: Vec<[f32; 3]> = (0..vertices).map(|_| [float(), float(), float()]).collect();
        let score: Vec<f32> = (0..vertices).map(|_| float()).collect();
        let features: Vec<f32> = (0..vertices * dim).map(|_| float()).collect();
        let offset = if has[0] { [f64::from(float()), f64::from(float()) * 1e-9, 0.1] } else { [0.0; 3] };
        let unit = |i: usize| {
            let angle = i as f32;
            [angle.cos(), angle.sin(), 0.0]
        };
        let corner = |i: usize| [i as u32, ((i + 1) % vertices) as u32, ((i * 7) % vertices) as u32];
        let with = |yes: bool, n: usize| if yes { n } else { 0 };
        Geometry {
            name,
            offset,
            normals: (0..with(has[1], vertices)).map(unit).collect(),
            colors: (0..with(has[2], vertices))
                .map(|i| [i as u8, (seed >> 8) as u8, (i * 31) as u8])
                .collect(),
            triangles: (0..with(has[3] && vertices > 0, vertices)).map(corner).collect(),
            attributes: vec![
                attribute("score", AttributeValues::F32(score)),
                attribute(
                    "label",
                    AttributeValues::I32((0..vertices).map(|i| i as i32 * 1000 - 7).collect()),
                ),
                attribute(
                    NAMES[seed as usize % NAMES.len()],
                    AttributeValues::U8((0..vertices).map(|i| i as u8).collect()),
                ),
            ],
            features: (dim > 0)
                .then_some(Features { name: "clip_pca".into(), dim, values: features })
                .into_iter()
                .collect(),
            positions,
        }
    })
}

/// Names of columns at the edge of what is allowed.
const NAMES: [&str; 6] = ["stream", "v", "a__b_", "n_00", "colours", "relevancy_the_red_cup"];

/// Any text in one line.
fn any_name() -> impl Strategy<Value = String> {
    let characters = any::<char>().prop_filter("no control character", |c| !c.is_control());
    prop::collection::vec(characters, 0..12).prop_map(String::from_iter)
}

/// Bit patterns of all floats, so that -0.0 and 0.0 differ.
pub(crate) fn bits(geometry: &Geometry) -> Vec<u32> {
    let mut values = geometry.positions.as_flattened().to_vec();
    values.extend(geometry.normals.as_flattened());
    for attribute in &geometry.attributes {
        if let AttributeValues::F32(scores) = &attribute.values {
            values.extend(scores);
        }
    }
    values.extend(geometry.features.iter().flat_map(|features| &features.values));
    values.into_iter().map(f32::to_bits).collect()
}

/// Cuts `file` after every byte and asserts that each beginning is an error that names the file.
pub(crate) fn assert_every_truncation_fails<T>(file: &Path, read: impl Fn(&Path) -> Result<T>) {
    let whole = fs::read(file).unwrap();
    let cut = file.with_file_name("cut_short");
    for length in 0..whole.len() {
        fs::write(&cut, &whole[..length]).unwrap();
        let error =
            read(&cut).err().unwrap_or_else(|| panic!("the first {length} bytes were read without error"));
        assert!(matches!(error, Error::Invalid { .. } | Error::Unsupported { .. }), "{length}: {error}");
        assert!(error.to_string().contains("cut_short"), "{length}: {error}");
    }
}

/// Flips bits all over `file` (every byte for small files) and asserts only that reading returns.
pub(crate) fn assert_no_damage_panics<T>(file: &Path, read: impl Fn(&Path) -> Result<T>) {
    let whole = fs::read(file).unwrap();
    let damaged = file.with_file_name("damaged");
    let step = (whole.len() / 3000).max(1);
    for at in (0..whole.len()).step_by(step) {
        for flip in [0x01, 0x80, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] ^= flip;
            fs::write(&damaged, &bytes).unwrap();
            // Damage in a value gives another value; damage elsewhere an error. Neither is a panic.
            let _ = read(&damaged);
        }
    }
}
