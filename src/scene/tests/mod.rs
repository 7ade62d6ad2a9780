//! Tiny scenes on disk, the same cameras in every format.

mod broken;
mod formats;
mod pixels;
mod shipped;

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat4, DQuat, DVec3};
use serde_json::{Value, json};

use super::{Camera, Scene, SceneError};

/// The camera of all test scenes: nothing in it is symmetric, so that no two numbers can be swapped
/// unnoticed.
pub(super) const CAMERA: Camera =
    Camera { width: 12, height: 8, fx: 10.0, fy: 11.0, cx: 5.5, cy: 4.25, distortion: [0.0; 4] };

/// Nine cameras around the origin, looking at it from changing heights.
pub(super) fn poses() -> Vec<DAffine3> {
    (0..9)
        .map(|i| {
            let angle = 0.6 * f64::from(i);
            let eye = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.5 + 0.1 * f64::from(i));
            look_at(eye, DVec3::ZERO)
        })
        .collect()
}

/// A camera at `eye` (z up) with `target` in its middle.
pub(super) fn look_at(eye: DVec3, target: DVec3) -> DAffine3 {
    let z = (target - eye).normalize();
    let x = z.cross(DVec3::Z).normalize();
    DAffine3::from_mat3_translation(glam::DMat3::from_cols(x, z.cross(x), z), eye)
}

pub(super) fn name(i: usize) -> String {
    format!("frame_{i:06}.png")
}

/// Writes the images of `poses()` into `folder`, of the size of [`CAMERA`].
pub(super) fn write_images(folder: &Path) {
    fs::create_dir_all(folder).unwrap();
    for i in 0..poses().len() {
        let pixel = |x: u32, y: u32| image::Rgb([x as u8 * 20, y as u8 * 30, i as u8 * 25]);
        image::RgbImage::from_fn(CAMERA.width, CAMERA.height, pixel).save(folder.join(name(i))).unwrap();
    }
}

/// Rows of a camera-to-world matrix with OpenGL camera axes, as nerfstudio and NeuralDiff write it.
pub(super) fn opengl_rows(c2w: &DAffine3) -> Vec<Vec<f64>> {
    let m = DMat4::from(*c2w).transpose().to_cols_array_2d();
    m.iter().map(|r| vec![r[0], -r[1], -r[2], r[3]]).collect()
}

/// `qw qx qy qz tx ty tz`, world-to-camera.
pub(super) fn colmap_pose(c2w: &DAffine3) -> [f64; 7] {
    let w2c = c2w.inverse();
    let (q, t) = (DQuat::from_mat3(&w2c.matrix3), w2c.translation);
    [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
}

/// The `transforms.json` of the test scene.
pub(super) fn transforms() -> Value {
    let frames: Vec<Value> = (poses().iter().enumerate())
        .map(|(i, p)| json!({"file_path": format!("images/{}", name(i)), "transform_matrix": opengl_rows(p)}))
        .collect();
    json!({"w": CAMERA.width, "h": CAMERA.height, "fl_x": CAMERA.fx, "fl_y": CAMERA.fy, "cx": CAMERA.cx,
        "cy": CAMERA.cy, "frames": frames})
}

/// A scene folder that goes away with the value.
pub(super) struct Folder(tempfile::TempDir);

impl Folder {
    pub fn new() -> Self {
        Folder(tempfile::tempdir().unwrap())
    }

    /// The test scene with `images/` and, as `transforms.json`, what `edit` makes of it.
    pub fn nerfstudio(edit: impl FnOnce(&mut Value)) -> Self {
        let folder = Folder::new();
        write_images(&folder.path("images"));
        let mut value = transforms();
        edit(&mut value);
        folder.write("transforms.json", value.to_string());
        folder
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    pub fn open(&self) -> Result<Scene, SceneError> {
        Scene::open(self.0.path())
    }

    /// The message of the error that opening gives.
    pub fn error(&self) -> String {
        self.open().expect_err("a broken scene was opened").to_string()
    }
}

/// `images.bin` and `cameras.bin` of the test scene.
pub(super) fn write_colmap_bin(folder: &Folder) {
    let mut cameras = Vec::new();
    cameras.extend(1u64.to_le_bytes());
    cameras.extend([7u32, 1].map(u32::to_le_bytes).concat());
    cameras.extend([CAMERA.width.into(), CAMERA.height.into()].map(u64::to_le_bytes).concat());
    cameras.extend([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy].map(f64::to_le_bytes).concat());
    let mut images = Vec::new();
    images.extend((poses().len() as u64).to_le_bytes());
    // COLMAP numbers images in the order it liked, with gaps.
    for (i, pose) in poses().iter().enumerate().rev() {
        images.extend((100 + 3 * i as u32).to_le_bytes());
        images.extend(colmap_pose(pose).map(f64::to_le_bytes).concat());
        images.extend(7u32.to_le_bytes());
        images.extend(name(i).bytes().chain([0]));
        images.extend(2u64.to_le_bytes());
        images.extend([0; 48]);
    }
    let mut points = Vec::new();
    points.extend(1u64.to_le_bytes());
    points.extend(5u64.to_le_bytes());
    points.extend([0.1f64, 0.2, 0.3].map(f64::to_le_bytes).concat());
    points.extend([255, 0, 0]);
    points.extend(0.5f64.to_le_bytes());
    points.extend(1u64.to_le_bytes());
    points.extend([0; 8]);
    folder.write("sparse/0/cameras.bin", cameras);
    folder.write("sparse/0/images.bin", images);
    folder.write("sparse/0/points3D.bin", points);
}

/// The same as text.
pub(super) fn write_colmap_txt(folder: &Folder) {
    let Camera { width, height, fx, fy, cx, cy, .. } = CAMERA;
    let head = "# comment\n";
    folder.write("sparse/0/cameras.txt", format!("{head}7 PINHOLE {width} {height} {fx} {fy} {cx} {cy}\n"));
    let mut images = head.to_owned();
    for (i, pose) in poses().iter().enumerate().rev() {
        let pose = colmap_pose(pose).map(|x| x.to_string()).join(" ");
        let observations = if i % 2 == 0 { "1.0 2.0 -1" } else { "" };
        images += &format!("{} {pose} 7 {}\n{observations}\n", 100 + 3 * i, name(i));
    }
    folder.write("sparse/0/images.txt", images);
    folder.write("sparse/0/points3D.txt", "5 0.1 0.2 0.3 255 0 0 0.5 1 2\n");
}

pub(super) fn write_epic_fields(folder: &Folder) {
    let Camera { width, height, fx, fy, cx, cy, .. } = CAMERA;
    let images: serde_json::Map<String, Value> =
        poses().iter().enumerate().map(|(i, p)| (name(i), json!(colmap_pose(p)))).collect();
    let value = json!({"images": images, "points": [[0.1, 0.2, 0.3, 255, 0, 0]], "camera": {"id": 1,
        "model": "OPENCV", "width": width, "height": height, "params": [fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0]}});
    folder.write("P01_01.json", value.to_string());
}

pub(super) fn epic_diff() -> Value {
    let Camera { fx, fy, cx, cy, .. } = CAMERA;
    let all = poses();
    let keyed = |f: &dyn Fn(usize) -> Value| -> serde_json::Map<String, Value> {
        (0..all.len()).map(|i| (i.to_string(), f(i))).collect()
    };
    json!({
        "ids_all": (0..all.len()).collect::<Vec<_>>(),
        "images": keyed(&|i| json!(name(i))),
        "poses": keyed(&|i| json!(opengl_rows(&all[i])[..3])),
        "nears": keyed(&|_| json!(0.1)),
        "fars": keyed(&|_| json!(5.0)),
        "intrinsics": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
    })
}
