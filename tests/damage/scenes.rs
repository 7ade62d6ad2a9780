//! Small valid folders: one scene of three frames in every format, and a run of it.

use std::f64::consts::FRAC_PI_2;
use std::fs;
use std::path::Path;

use divff::config::Config;
use divff::field::StreamConfig;
use divff::pipeline::RunFolder;
use divff::scene::Scene;
use divff::train::{StreamChoice, Trainer};
use divff_exporters::npy::write_npy_i32;
use divff_exporters::write_npy;
use image::{DynamicImage, GrayImage, ImageBuffer, Luma, Rgb, RgbImage};
use serde_json::{Map, Value, json};

const WIDTH: u32 = 12;
const HEIGHT: u32 = 8;
/// `fx fy cx cy`.
const LENS: [f64; 4] = [10.0, 11.0, 5.5, 4.25];
const NAMES: [&str; 3] = ["frame_000000.png", "frame_000001.png", "frame_000002.jpg"];

/// Positions of the cameras, all of which look along +z of the world with OpenCV axes.
const CENTRES: [[f64; 3]; 3] = [[0.0, 0.0, -2.0], [0.5, 0.1, -2.1], [1.0, -0.1, -1.9]];

pub fn write(folder: &Path, name: &str, content: impl AsRef<[u8]>) {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, content).unwrap();
}

fn picture(n: u32) -> RgbImage {
    RgbImage::from_fn(WIDTH, HEIGHT, |x, y| Rgb([x as u8 * 20, y as u8 * 30, n as u8 * 80]))
}

fn save(folder: &Path, name: &str, picture: impl Into<DynamicImage>) {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let picture: DynamicImage = picture.into();
    picture.save(path).unwrap();
}

fn pictures(folder: &Path, inside: &str) {
    for (n, name) in (0..).zip(NAMES) {
        save(folder, &format!("{inside}/{name}"), picture(n));
    }
}

/// nerfstudio's format with all that a frame can have, and features of frame 0.
pub fn nerfstudio(folder: &Path) {
    pictures(folder, "images");
    let depth = |x: u32, y: u32| Luma([(x * 1000 + y) as u16]);
    save(folder, "depth/frame_000001.png", ImageBuffer::from_fn(WIDTH, HEIGHT, depth));
    save(folder, "masks/frame_000001.png", GrayImage::from_pixel(WIDTH, HEIGHT, Luma([255])));
    let frames: Vec<Value> = (0..3)
        .map(|n| {
            let [x, y, z] = CENTRES[n];
            // OpenGL axes: y and z of the camera are turned round.
            let pose = [[1.0, 0.0, 0.0, x], [0.0, -1.0, 0.0, y], [0.0, 0.0, -1.0, z], [0.0, 0.0, 0.0, 1.0]];
            let mut frame = json!({"file_path": format!("images/{}", NAMES[n]), "transform_matrix": pose,
                "time": n as f64 * 0.5, "frame_index": n});
            if n == 1 {
                frame["depth_file_path"] = json!("depth/frame_000001.png");
                frame["mask_path"] = json!("masks/frame_000001.png");
            }
            frame
        })
        .collect();
    let [fx, fy, cx, cy] = LENS;
    let list = json!({"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
        "k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_angle_x": FRAC_PI_2,
        "depth_unit_scale_factor": 0.001, "aabb": [[-2.0, -1.0, -3.0], [2.0, 1.0, 2.0]],
        "ply_file_path": "points.ply", "applied_scale": 1.0,
        "applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
        "train_filenames": [format!("images/{}", NAMES[0]), format!("images/{}", NAMES[2])],
        "test_filenames": [format!("images/{}", NAMES[1])], "frames": frames});
    write(folder, "transforms.json", list.to_string());
    let head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
                property float z\nend_header\n";
    let points = [0.1f32, 0.2, 0.3, -0.4, 0.5, 1.0].map(f32::to_le_bytes);
    write(folder, "points.ply", [head.as_bytes(), points.as_flattened()].concat());
    features(folder);
}

fn features(folder: &Path) {
    let floats = |name: &str, shape: &[usize]| {
        let path = folder.join(format!("{name}.npy"));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let values: Vec<f32> = (0..shape.iter().product::<usize>()).map(|n| 1.0 + n as f32).collect();
        write_npy(&path, shape, &values).unwrap();
    };
    for (part, shape) in [("f", &[3, 4][..]), ("b", &[3, 4][..]), ("p0", &[1, 2, 4][..])] {
        floats(&format!("language_features/frame_000000_{part}"), shape);
    }
    let map: Vec<i32> = (0..(WIDTH * HEIGHT) as i32).map(|n| n % 4 - 1).collect();
    let shape = [1, HEIGHT as usize, WIDTH as usize];
    write_npy_i32(&folder.join("language_features/frame_000000_s.npy"), &shape, &map).unwrap();
    write(
        folder,
        "language_features/meta.json",
        r#"{"model": "toy", "dim": 4, "image_size": [12, 8],
            "patches": [{"file": "p0", "size_px": [8, 4], "stride_px": 4, "origin_px": [0, 0]}]}"#,
    );
    floats("video_features/frame_000000_p", &[1, 2, 4]);
    floats("video_features/frame_000000_g", &[4]);
    floats("dino_features/frame_000000", &[2, 3, 2]);
    floats("text/clip", &[2, 4]);
    write(folder, "text/clip.txt", "red mug\nobject\n");
    save(
        folder,
        "hotspots/frame_000000.png",
        GrayImage::from_fn(12, 8, |x, _| Luma([u8::from(x < 6) * 255])),
    );
}

/// EPIC-Diff's format.
pub fn epic_diff(folder: &Path) {
    pictures(folder, "frames");
    let keyed = |f: &dyn Fn(usize) -> Value| -> Map<String, Value> {
        (0..3).map(|n| (n.to_string(), f(n))).collect()
    };
    let pose = |n: usize| {
        let [x, y, z] = CENTRES[n];
        json!([[1.0, 0.0, 0.0, x], [0.0, -1.0, 0.0, y], [0.0, 0.0, -1.0, z]])
    };
    let [fx, fy, cx, cy] = LENS;
    let list = json!({"ids_all": [0, 1, 2], "ids_train": [0, 2], "ids_test": [1], "ids_val": [],
        "images": keyed(&|n| json!(NAMES[n])), "poses": keyed(&pose), "nears": keyed(&|_| json!(0.1)),
        "fars": keyed(&|_| json!(5.0)), "intrinsics": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]});
    write(folder, "meta.json", list.to_string());
}

/// `qw qx qy qz tx ty tz`, world-to-camera.
fn colmap_pose(n: usize) -> [f64; 7] {
    let [x, y, z] = CENTRES[n];
    [1.0, 0.0, 0.0, 0.0, -x, -y, -z]
}

/// EPIC-Fields' format.
pub fn epic_fields(folder: &Path) {
    pictures(folder, "images");
    let [fx, fy, cx, cy] = LENS;
    let images: Map<String, Value> = (0..3).map(|n| (NAMES[n].to_owned(), json!(colmap_pose(n)))).collect();
    let list = json!({"images": images, "points": [[0.1, 0.2, 0.3, 255, 0, 0]], "camera": {"id": 1,
        "model": "OPENCV", "width": WIDTH, "height": HEIGHT, "params": [fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0]}});
    write(folder, "P01_01.json", list.to_string());
}

/// COLMAP's binary model.
pub fn colmap_bin(folder: &Path) {
    pictures(folder, "images");
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend([7u32, 1].map(u32::to_le_bytes).concat());
    cameras.extend([u64::from(WIDTH), u64::from(HEIGHT)].map(u64::to_le_bytes).concat());
    cameras.extend(LENS.map(f64::to_le_bytes).concat());
    let mut images = 3u64.to_le_bytes().to_vec();
    for n in 0..3 {
        images.extend((n as u32).to_le_bytes());
        images.extend(colmap_pose(n).map(f64::to_le_bytes).concat());
        images.extend(7u32.to_le_bytes());
        images.extend(NAMES[n].bytes().chain([0]));
        images.extend(1u64.to_le_bytes());
        images.extend([0; 24]);
    }
    let mut points = 1u64.to_le_bytes().to_vec();
    points.extend(5u64.to_le_bytes());
    points.extend([0.1f64, 0.2, 0.3].map(f64::to_le_bytes).concat());
    points.extend([255, 0, 0]);
    points.extend(0.5f64.to_le_bytes());
    points.extend(1u64.to_le_bytes());
    points.extend([0; 8]);
    for (name, bytes) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        write(folder, &format!("sparse/0/{name}.bin"), bytes);
    }
}

/// COLMAP's model as text.
pub fn colmap_txt(folder: &Path) {
    pictures(folder, "images");
    let words = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    write(folder, "sparse/0/cameras.txt", format!("# one\n7 PINHOLE {WIDTH} {HEIGHT} {}\n", words(&LENS)));
    let image = |n: usize| format!("{n} {} 7 {}\n1.0 2.0 -1\n", words(&colmap_pose(n)), NAMES[n]);
    write(folder, "sparse/0/images.txt", (0..3).map(image).collect::<String>());
    write(folder, "sparse/0/points3D.txt", "5 0.1 0.2 0.3 255 0 0 0.5 1 2\n");
}

/// Settings of the smallest field that there is.
fn smallest() -> Config {
    let mut config = Config::default();
    let small = |c: &mut StreamConfig, code: usize| {
        *c = StreamConfig {
            levels: 1,
            coarsest: 2.0,
            finest: 2.0,
            log2_rows: 3,
            hidden: 4,
            layers: 1,
            code,
            knots: 2,
            time_levels: 0,
            ..c.clone()
        };
    };
    small(&mut config.field.persistent, 0);
    small(&mut config.field.dynamic, 4);
    small(&mut config.field.actor, 4);
    config.train.streams = StreamChoice::All;
    config.train.grid_cells = 8.0;
    config.train.rays = 1;
    config.train.samples = 2;
    config
}

/// A run that was stopped after its first step.
pub fn run(folder: &Path) {
    let input = folder.join("scene");
    nerfstudio(&input);
    let (scene, config) = (Scene::open(&input).unwrap(), smallest());
    let mut trainer = Trainer::new(&scene, &config).unwrap();
    trainer.step(0.0, None).unwrap();
    trainer.save(folder).unwrap();
    RunFolder::new(folder).write_record(&scene, &config).unwrap();
    let line = r#"{"step":50,"fraction":0.5,"seconds":1.0,"loss":0.25,"psnr":20.0,"test_psnr":null,"rays_per_second":1e5,"samples_per_second":1e6}"#;
    write(folder, "log.jsonl", format!("{line}\n{line}\n"));
}
