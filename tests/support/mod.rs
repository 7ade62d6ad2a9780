//! What several test programs need: `expected.json` for the checks in `tests/tools`, and running those
//! checks.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use divff_exporters::{AttributeValues, ExrImage, ExrSamples, Geometry, GlbOptions, GlbScene};
use serde_json::{Map, Value, json};

/// Rows whose values are written out, so that a difference can be shown; the others are under the checksum.
const SAMPLES: usize = 64;

/// Description of a geometry as `checks.py` wants it. `watertight`: `None` where it is not to be checked.
pub fn expect_geometry(geometry: &Geometry, watertight: Option<bool>) -> Map<String, Value> {
    let mut columns = Map::new();
    columns.insert("positions".into(), column(3, "f32", false, geometry.positions.as_flattened()));
    if !geometry.normals.is_empty() {
        columns.insert("normals".into(), column(3, "f32", false, geometry.normals.as_flattened()));
    }
    if !geometry.colors.is_empty() {
        let values: Vec<f32> = geometry.colors.as_flattened().iter().map(|&c| f32::from(c)).collect();
        columns.insert("colors".into(), column(3, "u8", false, &values));
    }
    for attribute in &geometry.attributes {
        let (kind, values): (_, Vec<f32>) = match &attribute.values {
            AttributeValues::F32(values) => ("f32", values.clone()),
            AttributeValues::I32(values) => ("i32", values.iter().map(|&v| v as f32).collect()),
            AttributeValues::U8(values) => ("u8", values.iter().map(|&v| f32::from(v)).collect()),
        };
        columns.insert(attribute.name.clone(), column(1, kind, false, &values));
    }
    for features in &geometry.features {
        columns.insert(features.name.clone(), column(features.dim, "f32", true, &features.values));
    }
    let Value::Object(expected) = json!({
        "name": geometry.name,
        "vertices": geometry.positions.len(),
        "faces": geometry.triangles.len(),
        "offset": geometry.offset,
        "watertight": watertight,
        "columns": columns,
    }) else {
        unreachable!("an object literal")
    };
    expected
}

/// Adds where the geometry is to be found.
pub fn expect_file(path: &str, format: &str, mut geometry: Map<String, Value>) -> Value {
    geometry.insert("path".into(), json!(path));
    geometry.insert("format".into(), json!(format));
    Value::Object(geometry)
}

/// Description of a GLB file; `watertight` answers for each geometry.
pub fn expect_glb(path: &str, scene: &GlbScene, options: &GlbOptions, watertight: &[Option<bool>]) -> Value {
    let objects: Vec<_> = scene
        .geometries
        .iter()
        .zip(watertight)
        .map(|(geometry, tight)| expect_geometry(geometry, *tight))
        .collect();
    let nodes = scene.nodes.iter().map(|node| {
        let geometry = scene.geometries[node.geometry];
        json!({
            "name": node.name,
            "object": (!geometry.positions.is_empty()).then_some(&geometry.name),
            "faces": geometry.triangles.len(),
            "stream": node.stream,
            "time_start": node.interval.map(|interval| interval.time_start),
            "time_end": node.interval.map(|interval| interval.time_end),
        })
    });
    json!({
        "path": path,
        "format": "glb",
        "features": options.features,
        "float_colors": options.float_colors,
        "objects": objects,
        "nodes": nodes.collect::<Vec<_>>(),
        "seconds": scene.seconds,
    })
}

/// Description of a picture.
pub fn expect_exr(path: &str, image: &ExrImage) -> Value {
    let channels = image.channels.iter().map(|channel| {
        let (kind, values): (_, Vec<f32>) = match &channel.samples {
            ExrSamples::F16(values) => ("float16", values.iter().map(|v| v.to_f32()).collect()),
            ExrSamples::F32(values) => ("float32", values.clone()),
        };
        (channel.name.clone(), column(1, kind, false, &values))
    });
    let channels: Map<String, Value> = channels.collect();
    let (width, height) = (image.width, image.height);
    json!({ "path": path, "format": "exr", "width": width, "height": height, "channels": channels })
}

fn column(dim: usize, kind: &str, feature: bool, values: &[f32]) -> Value {
    let rows = values.len() / dim;
    let sampled: Vec<usize> = (0..rows).step_by(rows.div_ceil(SAMPLES).max(1)).collect();
    let samples: Vec<&[f32]> = sampled.iter().map(|row| &values[row * dim..(row + 1) * dim]).collect();
    json!({
        "dim": dim,
        "type": kind,
        "feature": feature,
        "crc32": crc32_of(values),
        "rows": sampled,
        "values": samples,
    })
}

/// [`crc32`] of the values as little-endian f32. Adding 0 turns -0 into 0, which readers may do too.
fn crc32_of(values: &[f32]) -> u32 {
    crc32(values.iter().flat_map(|value| (value + 0.0).to_le_bytes()))
}

/// CRC-32, as in zip and PNG.
pub fn crc32(bytes: impl Iterator<Item = u8>) -> u32 {
    let table: [u32; 256] = std::array::from_fn(|byte| {
        (0..8).fold(byte as u32, |crc, _| if crc & 1 == 1 { (crc >> 1) ^ 0xEDB8_8320 } else { crc >> 1 })
    });
    !bytes.fold(!0, |crc, byte| table[((crc ^ u32::from(byte)) & 0xFF) as usize] ^ (crc >> 8))
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Runs `tests/tools/check_<reader>.py` on a folder. Panics when the tools are not set up.
pub fn run_check(reader: &str, folder: &Path, hash_seed: u32) -> Output {
    let python = root().join(".venv/bin/python");
    assert!(python.exists(), "{} is missing; run tests/tools/setup.sh once", python.display());
    let script = root().join(format!("tests/tools/check_{reader}.py"));
    let mut command = Command::new(python);
    command.arg(script).arg(folder).env("PYTHONHASHSEED", hash_seed.to_string());
    command.env("PYTHONDONTWRITEBYTECODE", "1").output().expect("Python starts")
}

/// Runs the Khronos validator on all `.glb` of a folder. Panics when it is not set up.
pub fn run_gltf_validator(folder: &Path) -> Output {
    let stamp = root().join("node_modules/stamp");
    assert!(stamp.exists(), "the glTF validator is missing; run tests/tools/setup.sh once");
    let script = root().join("tests/tools/validate_gltf.mjs");
    Command::new("node").arg(script).arg(folder).output().expect("node starts")
}

/// Everything that a check printed, for the message of a failing test.
pub fn printed(output: &Output) -> String {
    format!("{}\n{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}
