//! Fusion of analytically rendered rooms.

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3A};

use super::blocks::BlockSet;
use super::testing::{assert_manifold, soup};
use super::tsdf::{DepthFrame, TsdfOptions, TsdfVolume};
use super::{ExtractError, GridReport, GridSpec, TriMesh};
use crate::scene::{Camera, Pose};

/// A room 4 × 3 × 2.5 in which a box stands, far from the world's origin.
const ROOM: [DVec3; 2] = [DVec3::new(5000.0, -70.0, 10.0), DVec3::new(5004.0, -67.0, 12.5)];
const BOX: [DVec3; 2] = [DVec3::new(5001.6, -68.9, 10.0), DVec3::new(5002.3, -68.2, 10.9)];
const VOXEL: f64 = 0.05;

fn camera(distortion: [f64; 4]) -> Camera {
    Camera { width: 120, height: 90, fx: 70.0, fy: 70.0, cx: 60.0, cy: 44.0, distortion }
}

/// Distances along the ray to where it enters and leaves the box.
fn slab(b: [DVec3; 2], o: DVec3, d: DVec3) -> (f64, f64) {
    let (t0, t1) = ((b[0] - o) / d, (b[1] - o) / d);
    (t0.min(t1).max_element(), t0.max(t1).min_element())
}

fn look_at(eye: DVec3, target: DVec3) -> Pose {
    let z = (target - eye).normalize();
    let x = z.cross(DVec3::Z).normalize();
    DAffine3::from_mat3_translation(DMat3::from_cols(x, z.cross(x), z), eye)
}

struct Shot {
    camera: Camera,
    c2w: Pose,
    depth: Vec<f32>,
    rgb: Vec<u8>,
}

/// Depth of the room and the box; the box is red, the room grey.
fn shoot(eye: DVec3, target: DVec3, distortion: [f64; 4]) -> Shot {
    let (camera, c2w) = (camera(distortion), look_at(eye, target));
    let (mut depth, mut rgb) = (Vec::new(), Vec::new());
    for i in 0..camera.width * camera.height {
        let uv = DVec2::new(f64::from(i % camera.width) + 0.5, f64::from(i / camera.width) + 0.5);
        let ray = c2w.matrix3 * camera.unproject(uv);
        let (enter, leave) = slab(BOX, eye, ray);
        let hit = enter < leave && enter > 0.0;
        depth.push(if hit { enter } else { slab(ROOM, eye, ray).1 } as f32);
        rgb.extend(if hit { [200, 20, 20] } else { [90, 90, 90] });
    }
    Shot { camera, c2w, depth, rgb }
}

fn shots(distortion: [f64; 4]) -> Vec<Shot> {
    let middle = (ROOM[0] + ROOM[1]) / 2.0;
    (0..24)
        .map(|i| {
            let a = f64::from(i) * 0.7;
            let eye = middle + DVec3::new(1.3 * a.cos(), 1.0 * a.sin(), 0.5 * (a * 1.7).sin());
            let aim = if i % 2 == 0 {
                (BOX[0] + BOX[1]) / 2.0
            } else {
                eye + (eye - middle) * DVec3::new(1.0, 1.0, -1.0)
            };
            shoot(eye, aim, distortion)
        })
        .collect()
}

fn frames(shots: &[Shot]) -> Vec<DepthFrame<'_>> {
    fn frame(Shot { camera, c2w, depth, rgb }: &Shot) -> DepthFrame<'_> {
        DepthFrame { camera: *camera, c2w: *c2w, depth, confidence: None, rgb: Some(rgb) }
    }
    shots.iter().map(frame).collect()
}

fn spec() -> GridSpec {
    GridSpec::covering((ROOM[0] - 0.33).to_array(), (ROOM[1] + 0.33).to_array(), VOXEL)
}

/// Distance of a point to the walls of a box.
fn to_walls(b: [DVec3; 2], p: DVec3) -> f64 {
    let q = (p - (b[0] + b[1]) / 2.0).abs() - (b[1] - b[0]) / 2.0;
    if q.max_element() < 0.0 { -q.max_element() } else { q.max(DVec3::ZERO).length() }
}

fn errors(mesh: &TriMesh) -> Vec<f64> {
    let origin = DVec3::from_array(spec().origin);
    let world = |p: &[f32; 3]| origin + Vec3A::from_array(*p).as_dvec3();
    let mut e: Vec<f64> =
        mesh.positions.iter().map(world).map(|p| to_walls(ROOM, p).min(to_walls(BOX, p))).collect();
    e.sort_by(f64::total_cmp);
    e
}

#[test]
fn an_analytic_room_is_recovered_within_a_third_of_a_voxel() {
    for distortion in [[0.0; 4], [-0.12, 0.02, 0.001, -0.001]] {
        let shots = shots(distortion);
        let volume = TsdfVolume::fuse(&spec(), &frames(&shots), &TsdfOptions::for_voxel(VOXEL)).unwrap();
        let mesh = volume.mesh().unwrap();
        assert_manifold(&mesh);
        let e = errors(&mesh);
        let at = |q: f64| e[(q * (e.len() - 1) as f64) as usize] / VOXEL;
        // Planes are exact up to interpolation; only the corners (a few percent) are rounded by the
        // truncation.
        assert!(e.len() > 7_000 && at(0.5) < 0.05 && at(0.9) < 0.3, "{} {} {}", e.len(), at(0.5), at(0.95));
        let area = super::testing::area(&mesh);
        // 2(4·3 + 4·2.5 + 3·2.5) of the room and 4·0.7·0.9 of the box are 61.5: no surface is there twice.
        // Twenty-four small views see about a third of it twice.
        assert!((15.0..61.5).contains(&area), "{area}");
        let inward = (0..mesh.triangles.len()).filter(|&t| {
            let middle = ((ROOM[0] + ROOM[1]) / 2.0 - DVec3::from_array(spec().origin)).as_vec3a();
            let c = mesh.corners(t)[0];
            // Walls face the room, the sides of the box face away from it.
            to_walls(BOX, DVec3::from_array(spec().origin) + c.as_dvec3()) > 0.1
                && mesh.area_normal(t).dot(middle - c) < 0.0
        });
        assert!(inward.count() < mesh.triangles.len() / 100);
    }
}

#[test]
fn colours_follow_the_surface() {
    let shots = shots([0.0; 4]);
    let volume = TsdfVolume::fuse(&spec(), &frames(&shots), &TsdfOptions::for_voxel(VOXEL)).unwrap();
    let mesh = volume.mesh().unwrap();
    let colors = volume.colors_at(&mesh.positions).unwrap();
    let origin = DVec3::from_array(spec().origin);
    let (mut right, mut clear) = (0, 0);
    for (p, c) in mesh.positions.iter().zip(&colors) {
        let p = origin + Vec3A::from_array(*p).as_dvec3();
        let (room, boxed) = (to_walls(ROOM, p), to_walls(BOX, p));
        if room.max(boxed) > 0.25 {
            clear += 1;
            right += usize::from((c[0] > 145) == (boxed < room));
        }
    }
    assert!(clear > 5000 && right * 100 > clear * 97, "{right} of {clear}");
    let mut gray = frames(&shots);
    gray[3].rgb = None;
    let gray = TsdfVolume::fuse(&spec(), &gray, &TsdfOptions::for_voxel(VOXEL)).unwrap();
    assert_eq!(gray.colors_at(&mesh.positions), None);
}

#[test]
fn what_was_not_seen_stays_open_and_confidence_zero_counts_for_nothing() {
    let shots = shots([0.0; 4]);
    let fuse = |frames: &[DepthFrame], min_weight: f32| {
        let options = TsdfOptions { min_weight, ..TsdfOptions::for_voxel(VOXEL) };
        TsdfVolume::fuse(&spec(), frames, &options).unwrap().mesh().unwrap()
    };
    let all = frames(&shots);
    let full = fuse(&all, 1.0);
    assert!(fuse(&all, 8.0).triangles.len() < full.triangles.len() * 9 / 10);
    let zero = vec![0.0; shots[0].depth.len()];
    let ignored: Vec<_> = all
        .iter()
        .enumerate()
        .map(|(i, f)| DepthFrame { confidence: (i >= 12).then_some(&zero[..]), ..*f })
        .collect();
    let half = fuse(&all[..12], 1.0);
    // Not bit for bit: the mean depth, which scales the weights, is over all frames.
    let ratio = fuse(&ignored, 1.0).triangles.len() as f64 / half.triangles.len() as f64;
    assert!((0.9..1.1).contains(&ratio), "{ratio}");
    assert_eq!(fuse(&[], 1.0), TriMesh::default());
}

#[test]
fn bad_maps_are_named() {
    let shots = shots([0.0; 4]);
    let options = TsdfOptions::for_voxel(VOXEL);
    let mut depth = shots[1].depth.clone();
    depth[17] = f32::NAN;
    let mut bad = frames(&shots);
    bad[1].depth = &depth;
    let error = TsdfVolume::fuse(&spec(), &bad, &options).unwrap_err();
    assert_eq!(error, ExtractError::NonFinite { stage: "depth map", index: 120 * 90 + 17 });
    bad[1].depth = &shots[1].depth[1..];
    let error = TsdfVolume::fuse(&spec(), &bad, &options).unwrap_err().to_string();
    assert!(error.contains("frame 1"), "{error}");
    let wrong = TsdfOptions { truncation: 0.0, ..options };
    assert!(TsdfVolume::fuse(&spec(), &frames(&shots), &wrong).is_err());
}

#[test]
fn fusion_does_not_depend_on_the_number_of_threads() {
    let shots = shots([0.0; 4]);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let volume = TsdfVolume::fuse(&spec(), &frames(&shots), &TsdfOptions::for_voxel(VOXEL)).unwrap();
            let mesh = volume.mesh().unwrap();
            let colors = volume.colors_at(&mesh.positions);
            (mesh, colors)
        })
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn blocks_without_depth_hold_nothing() {
    let shots = shots([0.0; 4]);
    let (frames, spec) = (frames(&shots), spec());
    let options = TsdfOptions::for_voxel(VOXEL);
    let near = TsdfVolume::fuse(&spec, &frames, &options).unwrap();
    let [nx, ny, nz] = spec.block_dims();
    let all = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])));
    let all = BlockSet::new(spec.block_dims(), all.collect());
    let everywhere = TsdfVolume::fuse_in(&spec, &frames, &options, || all).unwrap();
    let report = near.grid().report();
    assert!(report.skipped_blocks * 4 > everywhere.grid().report().evaluated_blocks, "{report:?}");
    assert_eq!(GridReport::work(report.skipped_blocks).voxels, 512 * report.skipped_blocks as u64);
    let (near, everywhere) = (near.mesh().unwrap(), everywhere.mesh().unwrap());
    assert_eq!(soup(&near, 1.0), soup(&everywhere, 1.0));
}
