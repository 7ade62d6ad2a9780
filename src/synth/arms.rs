//! The wearer's two arms, in camera coordinates (x right, y down, z forward).

use glam::{Mat3, Vec3};

use super::material::Material as M;
use super::mesh::{Mesh, Tag};
use super::room::Thing;

/// Length of the forearm, m.
const FOREARM: f32 = 0.30;

/// Where one palm is, camera coordinates, and how far the fingers are closed (0–1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hand {
    pub palm: Vec3,
    pub grip: f32,
}

/// The four instances of the actor, in the order in which [`build`] numbers them.
pub(super) fn things() -> [Thing; 4] {
    let thing = |name, category, query| Thing { name, category, query, stream: 2, moves: false };
    [
        thing("left hand", "person", "hand"),
        thing("right hand", "person", "hand"),
        thing("left sleeve", "sweater", "sleeve"),
        thing("right sleeve", "sweater", "sleeve"),
    ]
}

/// Both arms; instance numbers start at `first`.
pub(super) fn build(first: u16, left: Hand, right: Hand) -> Mesh {
    let mut mesh = Mesh::default();
    for (i, (side, hand)) in [(-1.0, left), (1.0, right)].into_iter().enumerate() {
        let skin = Tag { instance: first + i as u16, material: M::Skin };
        let sleeve = M::Check([38, 62, 140], [92, 112, 186], 5);
        arm(&mut mesh, skin, Tag { instance: first + 2 + i as u16, material: sleeve }, side, hand);
    }
    mesh
}

fn arm(mesh: &mut Mesh, skin: Tag, sleeve: Tag, side: f32, hand: Hand) {
    let shoulder = Vec3::new(side * 0.22, 0.30, -0.14);
    let pivot = Vec3::new(side * 0.27, 0.42, 0.12);
    let forward = (hand.palm - pivot).normalize_or(Vec3::Z);
    let elbow = hand.palm - forward * FOREARM;
    let cuff = hand.palm - forward * 0.085;
    let upper = elbow + (shoulder - elbow).normalize_or(-Vec3::Z) * 0.06;
    mesh.tube(sleeve, &[shoulder, upper, elbow + forward * 0.04, cuff], &[0.056, 0.053, 0.050, 0.040], 14);

    // The thumbs point at each other; the back of the hand faces up.
    let inward = -side * Vec3::X;
    let thumb = (inward - forward * inward.dot(forward)).normalize_or(Vec3::Y);
    let mut back = forward.cross(thumb);
    back *= if back.y > 0.0 { -1.0 } else { 1.0 };
    mesh.tube(skin, &[cuff - forward * 0.02, hand.palm - forward * 0.02], &[0.027, 0.031], 12);
    mesh.ellipsoid(skin, hand.palm, Mat3::from_cols(thumb * 0.043, back * 0.021, forward * 0.055), 16);
    let curl = 0.35 + 0.65 * hand.grip;
    for (i, length) in [0.95, 1.05, 1.0, 0.8].into_iter().enumerate() {
        let base = hand.palm + forward * 0.042 + thumb * (0.030 - 0.02 * i as f32);
        finger(mesh, skin, base, forward, back, curl, length);
    }
    let root = hand.palm + thumb * 0.032 - forward * 0.012;
    let knuckle = root + thumb * 0.024 + forward * 0.026 - back * 0.008;
    let tip = knuckle + forward * 0.032 - thumb * 0.012 * hand.grip - back * 0.01;
    let end = tip + (tip - knuckle).normalize_or(forward) * 0.006;
    mesh.tube(skin, &[root, knuckle, tip, end], &[0.013, 0.012, 0.010, 0.005], 8);
}

/// Three phalanges that bend away from the back of the hand by up to a quarter turn in all.
fn finger(mesh: &mut Mesh, skin: Tag, base: Vec3, forward: Vec3, back: Vec3, curl: f32, length: f32) {
    let mut path = vec![base - forward * 0.01, base];
    for (i, bone) in [0.034, 0.024, 0.018, 0.005].into_iter().enumerate() {
        let (sin, cos) = (curl * [0.35, 0.9, 1.4, 1.4][i]).sin_cos();
        path.push(path[path.len() - 1] + (forward * cos - back * sin) * bone * length);
    }
    mesh.tube(skin, &path, &[0.0095, 0.0105, 0.0098, 0.009, 0.0078, 0.004], 8);
}
