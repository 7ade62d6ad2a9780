//! Stores a generated scene: the layout of DESIGN.md, section 4.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use divff_exporters::atomic::write_bytes_atomically;
use divff_exporters::{Geometry, PlyOptions, write_ply};
use glam::{Affine3A, Mat4, Vec3};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde_json::{Map, Value, json};

use super::mesh::Mesh;
use super::{Kitchen, Shot, SynthError, SynthOptions, features};
use crate::error::FileError;

/// Millimetres per metre: depth is stored as 16-bit millimetres.
const DEPTH_UNITS: f32 = 1000.0;
/// The box is larger than the room by so much on every side, m.
const MARGIN: f32 = 0.05;
const STREAMS: [&str; 3] = ["persistent", "dynamic", "actor"];

/// Makes the folders.
pub(super) fn prepare(out: &Path) -> Result<(), SynthError> {
    if out.exists() && fs::read_dir(out).map_err(FileError::at(out))?.next().is_some() {
        return Err(SynthError::NotEmpty { path: out.to_path_buf() });
    }
    let folders =
        ["images", "depth", "gt/streams", "gt/instances", "gt/mesh"].into_iter().chain(features::FOLDERS);
    for folder in folders.map(str::to_owned).chain(features::affordance_folders()) {
        let folder = out.join(folder);
        fs::create_dir_all(&folder).map_err(FileError::at(&folder))?;
    }
    Ok(())
}

/// Image, depth, streams and instances of one frame.
pub(super) fn frame(shot: &Shot, kitchen: &Kitchen) -> Result<(), SynthError> {
    let Shot { out, options, frame, picture } = shot;
    let name = format!("{frame:06}.png");
    let depth: Vec<u16> =
        picture.depth.iter().map(|z| (z * DEPTH_UNITS).round().min(65535.0) as u16).collect();
    let streams: Vec<u8> = picture.instance.iter().map(|i| kitchen.stream(*i)).collect();
    let size = (options.width, options.height);
    png(&out.join("images").join(&name), &picture.rgb, size, ExtendedColorType::Rgb8)?;
    png(&out.join("depth").join(&name), bytemuck::cast_slice(&depth), size, ExtendedColorType::L16)?;
    png(&out.join("gt/streams").join(&name), &streams, size, ExtendedColorType::L8)?;
    let instances = bytemuck::cast_slice(&picture.instance);
    png(&out.join("gt/instances").join(&name), instances, size, ExtendedColorType::L16)
}

/// `pixels` in native byte order, as the encoder wants them.
pub(super) fn png(
    path: &Path,
    pixels: &[u8],
    size: (u32, u32),
    color: ExtendedColorType,
) -> Result<(), SynthError> {
    let mut file = Cursor::new(Vec::new());
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Adaptive)
        .write_image(pixels, size.0, size.1, color)
        .map_err(|source| SynthError::Image { path: path.to_path_buf(), source })?;
    // Plain writes: it is `transforms.json` that makes the folder a scene.
    Ok(fs::write(path, file.into_inner()).map_err(FileError::at(path))?)
}

/// `gt/mesh/persistent.ply`, and `dynamic_…` and `actor_…` of some test frames.
pub(super) fn meshes(out: &Path, kitchen: &Kitchen, options: &SynthOptions) -> Result<(), SynthError> {
    mesh(out, "persistent".into(), &kitchen.still.mesh)?;
    for frame in options.mesh_frames() {
        let time = options.time(frame);
        mesh(out, format!("dynamic_{frame:06}"), &kitchen.dynamic(time))?;
        mesh(out, format!("actor_{frame:06}"), &kitchen.actor(time))?;
    }
    Ok(())
}

fn mesh(out: &Path, name: String, mesh: &Mesh) -> Result<(), SynthError> {
    let path = out.join("gt/mesh").join(format!("{name}.ply"));
    let geometry = Geometry {
        name,
        positions: mesh.vertices.iter().map(|v| v.position.to_array()).collect(),
        triangles: mesh.triangles.clone(),
        ..Default::default()
    };
    Ok(write_ply(&path, &geometry, &PlyOptions::default())?)
}

/// `gt/objects.json`, `gt/affordances.json` and `gt/timeline.json`.
pub(super) fn descriptions(out: &Path, kitchen: &Kitchen, options: &SynthOptions) -> Result<(), SynthError> {
    let things = kitchen.things();
    write_json(&out.join("gt/affordances.json"), &features::affordances(&things))?;
    let objects: Map<String, Value> = things
        .iter()
        .enumerate()
        .map(|(i, t)| {
            let stream = STREAMS[usize::from(t.stream)];
            let entry = json!({
                "name": t.name, "category": t.category, "query": t.query, "stream": stream, "moves": t.moves,
            });
            ((i + 1).to_string(), entry)
        })
        .collect();
    write_json(&out.join("gt/objects.json"), &Value::Object(objects))?;
    write_json(&out.join("gt/timeline.json"), &timeline(kitchen, options))
}

/// What happens: moves with their first and last frame, what is done in each frame, and where each prop is.
fn timeline(kitchen: &Kitchen, options: &SynthOptions) -> Value {
    let frames = || 0..options.frames;
    let carried: Vec<Option<usize>> =
        frames().map(|f| kitchen.story.carried(options.time(f) as f32)).collect();
    let moves: Vec<Value> = kitchen
        .story
        .moves
        .iter()
        .filter_map(|m| {
            let during = |f: &u32| (m.grab..m.release).contains(&(options.time(*f) as f32));
            let (first, last) = (frames().find(during)?, frames().rfind(during)?);
            Some(json!({ "object": kitchen.prop_instance(m.prop), "frames": [first, last] }))
        })
        .collect();
    let action: Vec<String> = carried
        .iter()
        .map(|c| c.map_or(String::new(), |prop| format!("move:{}", kitchen.props[prop].thing.name)))
        .collect();
    let active: Vec<Vec<u16>> =
        carried.iter().map(|c| c.iter().map(|&prop| kitchen.prop_instance(prop)).collect()).collect();
    let object_to_world: Map<String, Value> = (0..kitchen.props.len())
        .map(|prop| {
            let poses: Vec<Vec<f64>> =
                frames().map(|f| rows(&kitchen.prop_pose(prop, options.time(f)))[..12].to_vec()).collect();
            (kitchen.prop_instance(prop).to_string(), json!(poses))
        })
        .collect();
    json!({ "moves": moves, "action": action, "active": active, "object_to_world": object_to_world })
}

/// `transforms.json`: nerfstudio's format, OpenGL camera axes. Makes the folder a scene.
pub(super) fn transforms(out: &Path, kitchen: &Kitchen, options: &SynthOptions) -> Result<(), SynthError> {
    let lens = options.lens();
    let name = |frame: &u32| format!("images/{frame:06}.png");
    let test = options.test_frames();
    let train: Vec<String> = (0..options.frames).filter(|f| !test.contains(f)).map(|f| name(&f)).collect();
    let test: Vec<String> = test.iter().map(name).collect();
    let frames: Vec<Value> = (0..options.frames)
        .map(|frame| {
            let time = options.time(frame);
            // OpenCV's axes to OpenGL's: y up, z backwards.
            let pose = rows(&(kitchen.camera(time) * Affine3A::from_scale(Vec3::new(1.0, -1.0, -1.0))));
            let matrix: Vec<&[f64]> = pose.chunks(4).collect();
            json!({
                "file_path": name(&frame), "transform_matrix": matrix, "time": time, "frame_index": frame,
                "depth_file_path": format!("depth/{frame:06}.png"),
            })
        })
        .collect();
    let corner = |v: Vec3| v.to_array().map(f64::from);
    let scene = json!({
        "camera_model": "PINHOLE",
        "w": options.width, "h": options.height, "fl_x": lens.focal, "fl_y": lens.focal,
        "cx": f64::from(options.width) / 2.0, "cy": f64::from(options.height) / 2.0,
        "depth_unit_scale_factor": 0.001, "depth_is_ground_truth": true,
        "aabb": [corner(Vec3::splat(-MARGIN)), corner(kitchen.room.size + MARGIN)],
        "generator": { "name": "divff synth", "seed": options.seed },
        "train_filenames": train, "test_filenames": test, "val_filenames": test,
        "frames": frames,
    });
    write_json(&out.join("transforms.json"), &scene)
}

/// The 4 × 4 matrix, row by row.
fn rows(pose: &Affine3A) -> [f64; 16] {
    Mat4::from(*pose).transpose().to_cols_array().map(f64::from)
}

pub(super) fn write_json(path: &Path, value: &Value) -> Result<(), SynthError> {
    Ok(write_bytes_atomically(path, format!("{value:#}\n").as_bytes())?)
}
