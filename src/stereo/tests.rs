//! Stereo on pictures of planes whose depth is known.

use glam::{DMat3, DVec2, DVec3};

use super::*;

const CAMERA: Camera =
    Camera { width: 96, height: 72, fx: 80.0, fy: 80.0, cx: 48.0, cy: 36.0, distortion: [0.0; 4] };

/// A picture of the plane z = `depth` at x < 0 and of a nearer one elsewhere, with a texture that never repeats.
fn picture(camera: &Camera, c2w: &DAffine3, plain: bool) -> Vec<[u8; 3]> {
    (0..camera.width * camera.height)
        .map(|n| {
            let uv = DVec2::new(f64::from(n % camera.width), f64::from(n / camera.width)) + 0.5;
            let dir = c2w.matrix3 * camera.unproject(uv);
            let hit = |depth: f64| c2w.translation + dir * ((depth - c2w.translation.z) / dir.z);
            let near = hit(NEAR);
            let p = if near.x > 0.0 { near } else { hit(FAR) };
            let wave = |k: f64| (k * p.x + 0.3 * k * p.y).sin() * (1.3 * k * p.y - 0.2 * k * p.x).cos();
            let v = if plain { 0.0 } else { wave(9.0) + wave(23.0) + wave(41.0) };
            [(127.5 + 40.0 * v).clamp(0.0, 255.0) as u8; 3]
        })
        .collect()
}

const NEAR: f64 = 1.5;
const FAR: f64 = 2.2;

fn poses() -> Vec<DAffine3> {
    [[-0.15, 0.0], [-0.05, 0.08], [0.05, -0.06], [0.15, 0.03], [0.0, 0.0]]
        .map(|[x, y]| DAffine3 {
            matrix3: DMat3::from_rotation_y(-0.3 * x) * DMat3::from_rotation_z(y),
            translation: DVec3::new(x, y, 0.0),
        })
        .to_vec()
}

fn search(camera: &Camera, poses: &[DAffine3], plain: bool) -> Search {
    let pictures: Vec<_> = poses.iter().map(|p| picture(camera, p, plain)).collect();
    let frames: Vec<StereoFrame> =
        poses.iter().zip(&pictures).map(|(c2w, rgb)| StereoFrame { camera, c2w: *c2w, rgb }).collect();
    Search::new(&frames, 5.0, &StereoConfig::default())
}

fn look(camera: &Camera, poses: &[DAffine3], plain: bool) -> Vec<StereoDepth> {
    search(camera, poses, plain).depths(false)
}

#[test]
fn depth_is_the_same_whether_poses_were_judged_before() {
    let judging = search(&CAMERA, &poses(), false);
    let share = judging.coverage(&[1]);
    assert!(share > 0.5, "coverage {share}");
    for continues in [false, true] {
        assert!(judging.depths(continues) == search(&CAMERA, &poses(), false).depths(continues));
    }
    assert_eq!(judging.coverage(&[1]), share);
}

#[test]
fn depth_of_textured_planes_is_found() {
    for camera in [CAMERA, Camera { distortion: [0.08, -0.03, 0.002, -0.001], ..CAMERA }] {
        let poses = poses();
        for (found, c2w) in look(&camera, &poses, false).iter().zip(&poses) {
            let (mut known, mut wrong, mut all) = (0, 0, 0);
            for y in 4..camera.height - 4 {
                for x in 4..camera.width - 4 {
                    let dir = camera.unproject(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                    let turned = c2w.matrix3 * dir;
                    let near = c2w.translation + turned * ((NEAR - c2w.translation.z) / turned.z);
                    let at = if near.x > 0.0 { NEAR } else { FAR };
                    let truth = (at - c2w.translation.z) / turned.z;
                    all += 1;
                    if let Some(z) = found.at(dir.as_vec3()) {
                        known += 1;
                        wrong += usize::from((f64::from(z) / truth - 1.0).abs() > 0.02);
                    }
                }
            }
            assert!(known * 10 > all * 6, "{known} of {all}");
            assert!(wrong * 20 < known, "{wrong} of {known} are wrong");
        }
    }
}

#[test]
fn nothing_is_claimed_where_nothing_can_be_known() {
    // No texture; one frame alone; frames from one place; frames that look away from one another.
    let one_place = vec![poses()[0]; 4];
    let back = DAffine3::from_mat3(DMat3::from_rotation_y(std::f64::consts::PI));
    for (poses, plain) in
        [(poses(), true), (poses()[..1].to_vec(), false), (one_place, false), (vec![poses()[0], back], false)]
    {
        for found in look(&CAMERA, &poses, plain) {
            assert!(found.coverage() < 0.02, "{}", found.coverage());
        }
    }
    assert!(Search::new(&[], 5.0, &StereoConfig::default()).depths(true).is_empty());
}

#[test]
fn depth_is_the_same_on_any_number_of_threads() {
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| look(&CAMERA, &poses(), false))
    };
    assert_eq!(with(1), with(3));
}
