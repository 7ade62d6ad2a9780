//! A small ray caster: exact depth and labels through pixel centres, colours from 2 × 2 samples per pixel
//! (which need rays of their own only where the neighbourhood isn't flat).
//!
//! Lambertian surfaces with a faint highlight under an ambient term (darkened where the surroundings are
//! near), a ceiling lamp and a window, both with soft shadows from fixed points: no noise, so that two
//! views of a point agree.

use glam::{Affine3A, Vec3, Vec3A};

use super::mesh::{Mesh, Tag, Vertex};
use super::room::Room;
use crate::bvh::TriangleBvh;

/// Surfaces nearer than this are not seen, m.
const NEAR: f32 = 0.01;
const FAR: f32 = 100.0;
/// Shadow rays start this far off the surface, m.
const LIFT: f32 = 1e-3;
/// How far ambient occlusion looks, m.
const OCCLUSION_RANGE: f32 = 0.5;
/// What moves throws no shadow further than this, m: a pair of arms without a body would cast odd ones on
/// the walls.
const SHADOW_RANGE: f32 = 0.5;

/// A mesh that rays can be cast at.
pub(super) struct Body {
    pub mesh: Mesh,
    bvh: TriangleBvh,
}

impl Body {
    pub(super) fn new(mesh: Mesh) -> Self {
        let bvh = TriangleBvh::new(mesh.triangles.len(), |i| mesh.corners(i));
        Self { mesh, bvh }
    }
}

/// Image size and focal length, px; square pixels, principal point in the middle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    pub width: u32,
    pub height: u32,
    pub focal: f64,
}

/// What one frame shows; all layers are row-major `[height * width]`.
pub(super) struct Picture {
    /// sRGB.
    pub rgb: Vec<u8>,
    /// Along the camera's z axis, m; 0 where nothing is hit.
    pub depth: Vec<f32>,
    /// 0 where nothing is hit.
    pub instance: Vec<u16>,
}

/// Where a ray ends.
#[derive(Clone, Copy)]
struct Seen {
    /// Ray parameter: depth, as rays have length 1 along the camera's axis.
    t: f32,
    at: Vec3,
    normal: Vec3,
    texture: Vec3,
    tag: Tag,
}

/// How much of each light arrives, 0–1.
#[derive(Clone, Copy)]
struct Arriving {
    ambient: f32,
    lamp: f32,
    window: f32,
}

/// Everything that one frame is made of.
pub(super) struct Stage<'a> {
    pub room: &'a Room,
    /// What never moves; what does, at this moment.
    pub bodies: [&'a Body; 2],
}

impl Stage<'_> {
    /// Takes the picture of a camera (OpenCV axes to world).
    pub(super) fn picture(&self, lens: &Lens, c2w: &Affine3A) -> Picture {
        let (width, pixels) = (lens.width as usize, (lens.width * lens.height) as usize);
        let origin = Vec3::from(c2w.translation);
        let (cx, cy) = (lens.width as f32 / 2.0, lens.height as f32 / 2.0);
        let focal = lens.focal as f32;
        let cast = |i: usize, du: f32, dv: f32| {
            let (u, v) = ((i % width) as f32 + 0.5 + du, (i / width) as f32 + 0.5 + dv);
            let dir = c2w.matrix3 * Vec3A::new((u - cx) / focal, (v - cy) / focal, 1.0);
            self.see(origin, dir.into())
        };
        let centres: Vec<Option<Seen>> = (0..pixels).map(|i| cast(i, 0.0, 0.0)).collect();
        let mut rgb = Vec::with_capacity(3 * pixels);
        for (i, centre) in centres.iter().enumerate() {
            let shared = centre.map(|seen| (seen, self.arriving(&seen)));
            let slopes = slopes(&centres, i, width);
            let mut sum = Vec3::ZERO;
            for (du, dv) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                let seen = match &slopes {
                    Some((x, y, centre)) => Some(centre.moved(x, du).moved(y, dv)),
                    None => cast(i, du, dv),
                };
                sum += seen.map_or(Vec3::ZERO, |seen| self.shade(&seen, origin, focal, shared.as_ref()));
            }
            // Gamma 2, as in the materials.
            let srgb = (sum / 4.0).clamp(Vec3::ZERO, Vec3::ONE).map(f32::sqrt);
            rgb.extend(srgb.to_array().map(|c| (c * 255.0 + 0.5) as u8));
        }
        let depth = centres.iter().map(|c| c.map_or(0.0, |seen| seen.t)).collect();
        let instance = centres.iter().map(|c| c.map_or(0, |seen| seen.tag.instance)).collect();
        Picture { rgb, depth, instance }
    }

    fn see(&self, origin: Vec3, dir: Vec3) -> Option<Seen> {
        let mut nearest = None;
        let mut t_max = FAR;
        for body in self.bodies {
            if let Some(hit) = body.bvh.first_hit(origin, dir, NEAR, t_max) {
                t_max = hit.t;
                nearest = Some((body, hit));
            }
        }
        let (body, hit) = nearest?;
        let corners = body.mesh.triangles[hit.triangle as usize].map(|v| body.mesh.vertices[v as usize]);
        let [u, v] = hit.uv;
        let blend =
            |f: fn(&Vertex) -> Vec3| f(&corners[0]) * (1.0 - u - v) + f(&corners[1]) * u + f(&corners[2]) * v;
        let normal = blend(|c| c.normal).normalize_or(-dir);
        // Thin things are lit on the side that is looked at.
        let normal = if normal.dot(dir) > 0.0 { -normal } else { normal };
        let tag = body.mesh.tags[hit.triangle as usize];
        Some(Seen { t: hit.t, at: origin + dir * hit.t, normal, texture: blend(|c| c.texture), tag })
    }

    fn shade(&self, seen: &Seen, eye: Vec3, focal: f32, shared: Option<&(Seen, Arriving)>) -> Vec3 {
        let footprint = 0.6 * seen.t / focal;
        let look = seen.tag.material.look(seen.texture, seen.normal, footprint);
        if look.shines {
            return look.albedo;
        }
        let arriving = match shared {
            Some((centre, arriving)) if same_spot(seen, centre) => *arriving,
            _ => self.arriving(seen),
        };
        let ambient = Vec3::new(0.50, 0.49, 0.48) * (0.92 + 0.12 * seen.normal.z) * arriving.ambient;
        let (lamp_dir, lamp_falloff) = towards(seen.at, self.room.lamp);
        let (window_dir, window_falloff) = towards(seen.at, self.room.window);
        let lamp = arriving.lamp * lamp_falloff * 1.1;
        // The window shines into the room, −y.
        let window = arriving.window * window_falloff * 1.5 * window_dir.y.max(0.0);
        let diffuse = ambient
            + Vec3::new(1.0, 0.90, 0.74) * lamp * seen.normal.dot(lamp_dir).max(0.0)
            + Vec3::new(0.86, 0.95, 1.0) * window * seen.normal.dot(window_dir).max(0.0);
        let half = (lamp_dir + (eye - seen.at).normalize_or(seen.normal)).normalize_or(seen.normal);
        let highlight = look.gloss * 0.5 * lamp * half.dot(seen.normal).max(0.0).powi(24);
        look.albedo * diffuse + Vec3::splat(highlight)
    }

    fn arriving(&self, seen: &Seen) -> Arriving {
        let from = seen.at + seen.normal * LIFT;
        let side = seen.normal.any_orthonormal_vector();
        let up = seen.normal.cross(side);
        let near = |dir: Vec3| {
            let mut t = OCCLUSION_RANGE;
            for body in self.bodies {
                t = body.bvh.first_hit(from, dir, 0.0, t).map_or(t, |hit| hit.t);
            }
            1.0 - t / OCCLUSION_RANGE
        };
        let slanted =
            [side + up, side - up, up - side, -side - up].map(|d| near((seen.normal * 0.9 + d).normalize()));
        let closed = slanted.iter().sum::<f32>() / 4.0;
        let lit = |p: &&Vec3| {
            let way = **p - from;
            let [still, moving] = self.bodies;
            way.dot(seen.normal) > 0.0
                && !moving.bvh.occluded(from, way, 0.0, SHADOW_RANGE / way.length())
                && !still.bvh.occluded(from, way, 0.0, 0.999)
        };
        let share = |points: [Vec3; 2]| points.iter().filter(lit).count() as f32 / 2.0;
        let (lamp, window) = (self.room.lamp, self.room.window);
        let (dx, dy) = (Vec3::X * 0.09, Vec3::Y * 0.09);
        Arriving {
            ambient: 1.0 - 0.75 * closed,
            lamp: share([lamp + dx + dy, lamp - dx - dy]),
            window: share([window - Vec3::Y * 0.06 + dx * 2.0, window - Vec3::Y * 0.06 - dx * 2.0]),
        }
    }
}

impl Seen {
    /// This point moved by `share` of the way that `slope` holds.
    fn moved(mut self, slope: &Slope, share: f32) -> Self {
        self.t += slope.t * share;
        self.at += slope.at * share;
        self.texture += slope.texture * share;
        self
    }
}

/// Change per pixel along a row or a column.
#[derive(Clone, Copy)]
struct Slope {
    t: f32,
    at: Vec3,
    texture: Vec3,
}

/// How what is seen changes along x and y about pixel `i`, and what is seen there; `None` unless the pixel
/// and its four neighbours lie on one plane of one material, where samples between them need no rays of
/// their own.
fn slopes(centres: &[Option<Seen>], i: usize, width: usize) -> Option<(Slope, Slope, Seen)> {
    let (column, row) = (i % width, i / width);
    if column == 0 || column + 1 == width || row == 0 || (row + 1) * width == centres.len() {
        return None;
    }
    let centre = centres[i]?;
    let flat = |j: usize| {
        let n = centres[j]?;
        let coplanar =
            (n.at - centre.at).dot(centre.normal).abs() < 1e-3 && n.normal.dot(centre.normal) > 0.9999;
        (n.tag == centre.tag && coplanar).then_some(n)
    };
    let half = |a: Seen, b: Seen| Slope {
        t: (b.t - a.t) / 2.0,
        at: (b.at - a.at) / 2.0,
        texture: (b.texture - a.texture) / 2.0,
    };
    let along_x = half(flat(i - 1)?, flat(i + 1)?);
    let along_y = half(flat(i - width)?, flat(i + width)?);
    Some((along_x, along_y, centre))
}

/// Whether a sample may use the light found at the pixel's centre.
fn same_spot(a: &Seen, b: &Seen) -> bool {
    a.tag.instance == b.tag.instance && a.normal.dot(b.normal) > 0.95 && (a.t - b.t).abs() < 0.1 * b.t
}

/// Direction and falloff of a light of some size: 1/(1 + d²) stays finite next to it.
fn towards(from: Vec3, light: Vec3) -> (Vec3, f32) {
    let d = light - from;
    (d.normalize_or(Vec3::Z), 1.6 / (0.7 + d.length_squared()))
}
