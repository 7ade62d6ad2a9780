//! Small scenes for the tests of this folder: a coloured wall seen by cameras that have nothing in common.

use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};

use crate::config::Config;
use crate::field::{EncodingKind, FieldShape, FrequencyConfig, Normalisation, StreamConfig};
use crate::rng::Rng;
use crate::scene::{Aabb, Camera, Frame, Pose, Scene, Split};

/// The box of all test scenes: off the origin, and longer than it is high or deep.
pub fn bounds() -> Aabb {
    Aabb { min: DVec3::new(10.0, -4.0, 2.0), max: DVec3::new(12.0, -2.5, 3.0) }
}

/// Height of the wall, which is a plane of constant z.
const WALL: f64 = 2.8;

/// Three cameras: a distorted lens off its centre, a tall wide angle, and one outside the box that partly misses it.
pub fn odd_cameras() -> [(Camera, Pose); 3] {
    let camera = |width, height, [fx, fy, cx, cy]: [f64; 4], distortion| Camera {
        width,
        height,
        fx,
        fy,
        cx,
        cy,
        distortion,
    };
    let at = |x, y, z| DVec3::new(x, y, z);
    [
        (
            camera(24, 16, [20.0, 22.0, 11.3, 8.9], [0.1, -0.05, 0.01, -0.02]),
            look(at(11.0, -3.2, 2.1), at(11.2, -3.1, 2.9), 0.3),
        ),
        (
            camera(16, 25, [9.0, 9.5, 8.0, 12.5], [0.0; 4]),
            look(at(10.4, -3.6, 2.2), at(11.1, -3.2, 2.8), -1.2),
        ),
        (
            camera(17, 13, [10.0, 10.0, 8.5, 6.5], [0.0; 4]),
            look(at(11.0, -3.0, 1.0), at(11.3, -3.2, 2.8), 2.0),
        ),
    ]
}

/// Camera-to-world pose at `from`, looking at `to`, rolled by `roll` rad.
pub fn look(from: DVec3, to: DVec3, roll: f64) -> Pose {
    let forward = (to - from).normalize();
    let right = DVec3::Y.cross(forward).normalize();
    let axes = DMat3::from_cols(right, forward.cross(right), forward) * DMat3::from_rotation_z(roll);
    DAffine3 { matrix3: axes, translation: from }
}

/// Training frames of the odd cameras (the `n`-th at time n/2), their pictures of the wall written to `folder`.
pub fn frames(folder: &Path) -> Vec<Frame> {
    odd_cameras().into_iter().enumerate().map(|(n, (camera, pose))| frame(folder, n, camera, pose)).collect()
}

fn frame(folder: &Path, n: usize, camera: Camera, pose: Pose) -> Frame {
    let image_path = folder.join(format!("{n:03}.png"));
    image::RgbImage::from_fn(camera.width, camera.height, |x, y| {
        let dir = camera.unproject(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        let dir = pose.matrix3 * dir;
        let p = pose.translation + dir * ((WALL - pose.translation.z) / dir.z);
        let wave = |v: f64| (127.5 + 100.0 * (4.0 * v).sin()) as u8;
        image::Rgb([wave(p.x), wave(p.y), wave(p.x + p.y)])
    })
    .save(&image_path)
    .expect("the temporary folder can be written");
    Frame {
        stem: format!("{n:03}"),
        image_path,
        camera,
        c2w: pose,
        time: n as f64 / 2.0,
        frame_index: n as u32,
        split: Split::Train,
        depth_path: None,
        mask_path: None,
    }
}

/// A scene of [`frames`] in `folder`.
pub fn scene(folder: &Path) -> Scene {
    Scene {
        root: folder.to_owned(),
        frames: frames(folder),
        bounds: bounds(),
        depth_unit: 1.0,
        depth_is_ground_truth: true,
        points: Vec::new(),
        warnings: Vec::new(),
    }
}

/// Settings of a field that is small in everything, with widths that are not multiples of the kernels' blocks.
pub fn config() -> Config {
    let mut config = Config { seed: 7, ..Config::default() };
    let small = |c: &mut StreamConfig, code: usize, knots: usize| {
        *c = StreamConfig {
            levels: 3,
            coarsest: 3.0,
            finest: 20.0,
            log2_rows: 9,
            hidden: 10,
            code,
            knots,
            time_finest: 12.0,
            time_cells: 0.5,
            density_bias: 0.5,
            ..c.clone()
        };
    };
    small(&mut config.field.persistent, 0, 0);
    small(&mut config.field.dynamic, 5, 4);
    small(&mut config.field.actor, 3, 0);
    config.field.actor_reach = 0.4;
    config.train.rays = 512;
    config.train.patch = 2;
    config.train.samples = 10;
    config.train.grid_cells = 16.0;
    config
}

/// [`config`] with another encoding. Frequencies are few, and their networks deep enough for a layer on either side of the
/// one that sees the input again.
pub fn config_of(encoding: EncodingKind) -> Config {
    let mut config = config();
    config.field.encoding = encoding;
    config.field.frequency = FrequencyConfig { bands: 6, hidden: 14, layers: 5, head: 10 };
    config
}

/// The shape of a field for [`scene`] with all three streams.
pub fn shape(config: &Config) -> FieldShape {
    FieldShape {
        config: config.field.clone(),
        normalisation: Normalisation::new(bounds()),
        streams: [true; 3],
        times: vec![0.0, 0.5, 1.0],
        background: [0.5; 3],
    }
}

/// `n` numbers, uniform in (−size, size).
pub fn noise(rng: &mut Rng, n: usize, size: f32) -> Vec<f32> {
    (0..n).map(|_| size * (2.0 * rng.uniform() - 1.0)).collect()
}
