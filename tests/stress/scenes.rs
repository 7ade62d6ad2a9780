//! A filmed kitchen of eight small frames, and what can be made of it.

use std::fs;
use std::path::Path;
use std::sync::OnceLock;

use divff::config::Config;
use divff::field::StreamConfig;
use divff::scene::Scene;
use divff::synth::{SynthOptions, generate};
use divff::train::StreamChoice;
use serde_json::{Value, json};
use tempfile::TempDir;

/// The frames of the kitchen, made once.
fn kitchen() -> &'static Path {
    static KITCHEN: OnceLock<TempDir> = OnceLock::new();
    let folder = KITCHEN.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let options = SynthOptions { frames: 8, width: 32, height: 20, seed: 3 };
        generate(&options, folder.path()).unwrap();
        folder
    });
    folder.path()
}

/// The pictures and poses of the kitchen, its list changed by `edit`.
pub fn filmed(edit: impl FnOnce(&mut Value)) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("images")).unwrap();
    for picture in fs::read_dir(kitchen().join("images")).unwrap() {
        let picture = picture.unwrap();
        fs::copy(picture.path(), folder.path().join("images").join(picture.file_name())).unwrap();
    }
    let mut list: Value =
        serde_json::from_slice(&fs::read(kitchen().join("transforms.json")).unwrap()).unwrap();
    for frame in list["frames"].as_array_mut().unwrap() {
        frame.as_object_mut().unwrap().remove("depth_file_path");
    }
    edit(&mut list);
    fs::write(folder.path().join("transforms.json"), list.to_string()).unwrap();
    folder
}

/// Calls `f(axis, coordinate)` on every position of the list: the cameras', and the corners of the box.
pub fn move_all(list: &mut Value, f: impl Fn(usize, &mut f64)) {
    move_cameras(list, |_, axis, x| f(axis, x));
    for corner in list["aabb"].as_array_mut().unwrap() {
        for axis in 0..3 {
            change(&mut corner[axis], |x| f(axis, x));
        }
    }
}

/// Calls `f(frame, axis, coordinate)` on the position of every camera.
pub fn move_cameras(list: &mut Value, f: impl Fn(usize, usize, &mut f64)) {
    for (n, frame) in list["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        for axis in 0..3 {
            change(&mut frame["transform_matrix"][axis][3], |x| f(n, axis, x));
        }
    }
}

fn change(number: &mut Value, f: impl FnOnce(&mut f64)) {
    let mut x = number.as_f64().unwrap();
    f(&mut x);
    *number = json!(x);
}

/// Paints all pictures of a scene.
pub fn paint(folder: &Path, colour: [u8; 3]) {
    for picture in fs::read_dir(folder.join("images")).unwrap() {
        let path = picture.unwrap().path();
        let (width, height) = image::image_dimensions(&path).unwrap();
        image::RgbImage::from_pixel(width, height, image::Rgb(colour)).save(path).unwrap();
    }
}

/// Settings of a run of about a second that passes through everything but features.
pub fn quick(scene: &Scene) -> Config {
    let mut config = Config { seed: 5, ..Config::default() };
    let small = |c: &mut StreamConfig| {
        *c = StreamConfig { levels: 3, log2_rows: 9, coarsest: 4.0, finest: 24.0, hidden: 12, ..c.clone() };
    };
    small(&mut config.field.persistent);
    small(&mut config.field.dynamic);
    small(&mut config.field.actor);
    config.train.steps = 40;
    config.train.rays = 256;
    config.train.samples = 8;
    config.train.render_samples = 12;
    config.train.grid_cells = 16.0;
    config.train.streams = StreamChoice::All;
    config.train.static_until = 0.5;
    config.train.align_after = 0;
    config.semantics.enabled = false;
    let diagonal = (scene.bounds.max - scene.bounds.min).length();
    config.map.voxel_size = Some(diagonal / 60.0);
    config.map.points = 500;
    config.map.depth_rays = 4000;
    config.map.depth_samples = 12;
    config
}
