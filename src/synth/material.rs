//! Procedural materials: colour as a function of position.

use glam::{IVec3, Vec3};

use super::noise::{fbm, hash, lines};

/// 8-bit sRGB, for tables of paint.
pub(super) type Rgb8 = [u8; 3];

/// What a surface is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Material {
    /// Square tiles of the given edge in centimetres, with joints; horizontal.
    FloorTiles(Rgb8, u8),
    /// Boards along x; horizontal.
    FloorBoards(Rgb8),
    /// Mottled plaster.
    Plaster(Rgb8),
    /// Plaster above and below a band of wall tiles (z 0.9 m to 1.45 m).
    TiledWall(Rgb8, Rgb8),
    /// Wood, grain along z (0: x, 1: y, 2: z).
    Wood(Rgb8, u8),
    /// Speckled stone.
    Granite(Rgb8),
    /// Brushed metal.
    Steel,
    /// Glossy dark plate.
    Glass,
    /// Plain paint, slightly worn.
    Paint(Rgb8),
    /// Stripes of two paints across x + y + z, period in centimetres.
    Stripes(Rgb8, Rgb8, u8),
    /// Woven check of two colours, period in centimetres.
    Check(Rgb8, Rgb8, u8),
    /// A picture: patches of colour.
    Picture(u8),
    /// Leaves and stems.
    Leaf,
    /// The wearer's hands.
    Skin,
    /// A clock's face in the yz plane, centred on the texture's origin.
    Dial,
    /// What is seen through a window; shines.
    Outdoors,
    /// A lit lamp shade.
    Lamp,
}

/// What the light meets.
#[derive(Clone, Copy, Debug)]
pub(super) struct Look {
    /// Reflectance, linear 0–1; radiance when it shines.
    pub albedo: Vec3,
    /// Strength of the highlight.
    pub gloss: f32,
    /// Gives light by itself.
    pub shines: bool,
}

impl Material {
    /// Appearance at texture position `p` (m) with normal `n`; `footprint` (m) is the width of one image
    /// sample.
    pub(super) fn look(self, p: Vec3, n: Vec3, footprint: f32) -> Look {
        let (srgb, gloss) = self.paint(p, n, footprint);
        let shines = matches!(self, Self::Outdoors | Self::Lamp);
        let srgb = srgb.clamp(Vec3::splat(0.02), Vec3::ONE);
        // Gamma 2 both ways instead of the sRGB curve: no difference to see, and no powers to take.
        Look { albedo: srgb * srgb, gloss, shines }
    }

    fn paint(self, p: Vec3, n: Vec3, f: f32) -> (Vec3, f32) {
        match self {
            Self::FloorTiles(base, cm) => {
                let size = f32::from(cm) / 100.0;
                let tile = IVec3::new((p.x / size).floor() as i32, (p.y / size).floor() as i32, 0);
                let shade = 0.82 + 0.3 * hash(tile, 1) + 0.22 * fbm(p, 0.12, 3, f, 2);
                let joint = lines(p.x, size, 0.012, f).max(lines(p.y, size, 0.012, f));
                (mix(rgb(base) * shade, Vec3::splat(0.34), joint), 0.06)
            }
            Self::FloorBoards(base) => {
                let row = (p.y / 0.14).floor();
                let shift = hash(IVec3::new(row as i32, 0, 0), 3) * 2.0;
                let board = IVec3::new(row as i32, ((p.x + shift) / 1.1).floor() as i32, 1);
                let grain = fbm(Vec3::new(p.x * 0.12, p.y, hash(board, 4) * 9.0), 0.03, 3, f, 5);
                let seam = lines(p.y, 0.14, 0.008, f).max(lines(p.x + shift, 1.1, 0.01, f));
                let shade = 0.72 + 0.45 * hash(board, 6) + 0.4 * grain;
                (mix(rgb(base) * shade, Vec3::splat(0.12), seam), 0.08)
            }
            Self::Plaster(base) => (plaster(rgb(base), p, f), 0.0),
            Self::TiledWall(paint, tile) if p.z > 0.9 && p.z < 1.45 => wall_tiles(paint, tile, p, n, f),
            Self::TiledWall(paint, _) => (plaster(rgb(paint), p, f), 0.0),
            Self::Wood(base, axis) => (wood(rgb(base), p, axis, f), 0.1),
            Self::Granite(base) => {
                let coarse = fbm(p, 0.06, 2, f, 20);
                let speckle = fbm(p, 0.022, 2, f, 23);
                (rgb(base) * (1.0 + 0.45 * coarse + 0.9 * speckle), 0.15)
            }
            Self::Steel => {
                let brushed = fbm(p * Vec3::new(1.0, 1.0, 0.15), 0.03, 2, f, 30);
                let cloudy = fbm(p, 0.25, 3, f, 32);
                (Vec3::new(0.60, 0.62, 0.64) * (1.0 + 0.16 * brushed + 0.3 * cloudy), 0.35)
            }
            Self::Glass => (Vec3::splat(0.13 + 0.05 * fbm(p, 0.1, 3, f, 40)), 0.4),
            Self::Paint(base) => (rgb(base) * (1.0 + 0.16 * fbm(p, 0.08, 3, f, 50)), 0.12),
            Self::Stripes(a, b, cm) => {
                let period = f32::from(cm) / 100.0;
                let share = lines(p.x + p.y + p.z, period, period * 0.4, f);
                (mix(rgb(a), rgb(b), share) * (1.0 + 0.12 * fbm(p, 0.05, 2, f, 55)), 0.08)
            }
            Self::Check(a, b, cm) => {
                let period = f32::from(cm) / 100.0;
                let (u, v) =
                    (lines(p.x + p.z, period, period / 2.0, f), lines(p.y - p.z, period, period / 2.0, f));
                (mix(rgb(a), rgb(b), (u + v) / 2.0) * (1.0 + 0.2 * fbm(p, 0.03, 2, f, 60)), 0.0)
            }
            Self::Picture(salt) => picture(p, f, u32::from(salt)),
            Self::Leaf => {
                let shade = 1.0 + 0.5 * fbm(p, 0.04, 2, f, 70);
                (Vec3::new(0.20, 0.42, 0.16) * shade, 0.05)
            }
            Self::Skin => {
                let tone = fbm(p, 0.03, 3, f, 80);
                (Vec3::new(0.82, 0.60, 0.48) * (1.0 + 0.14 * tone), 0.05)
            }
            Self::Dial => (dial(p, f), 0.05),
            Self::Outdoors => (outdoors(p, f), 0.0),
            Self::Lamp => (Vec3::new(0.98, 0.90, 0.72) * (0.93 + 0.07 * lines(p.z, 0.04, 0.02, f)), 0.0),
        }
    }
}

fn rgb(c: Rgb8) -> Vec3 {
    Vec3::from(c.map(f32::from)) / 255.0
}

fn mix(a: Vec3, b: Vec3, share: f32) -> Vec3 {
    a + (b - a) * share
}

fn plaster(base: Vec3, p: Vec3, f: f32) -> Vec3 {
    let tone = fbm(p, 0.45, 5, f, 10);
    let warm = fbm(p, 0.7, 2, f, 16);
    base * (1.0 + 0.24 * tone) + Vec3::new(0.05, 0.0, -0.05) * warm
}

/// Running bond, 20 cm × 10 cm.
fn wall_tiles(paint: Rgb8, tile: Rgb8, p: Vec3, n: Vec3, f: f32) -> (Vec3, f32) {
    let u = if n.x.abs() > n.y.abs() { p.y } else { p.x };
    let row = ((p.z - 0.9) / 0.11).floor();
    let u = u + if row as i32 % 2 == 0 { 0.0 } else { 0.1 };
    let cell = IVec3::new((u / 0.2).floor() as i32, row as i32, i32::from(n.x.abs() > n.y.abs()));
    let shade = 0.78 + 0.34 * hash(cell, 11) + 0.14 * fbm(p, 0.07, 2, f, 12);
    let hue = Vec3::new(0.1, 0.0, -0.06) * (hash(cell, 13) - 0.5);
    let joint = lines(u, 0.2, 0.008, f).max(lines(p.z - 0.9, 0.11, 0.008, f));
    (mix(rgb(tile) * shade + hue, rgb(paint) * 0.95, joint), 0.2)
}

fn wood(base: Vec3, p: Vec3, axis: u8, f: f32) -> Vec3 {
    let mut q = p;
    q[usize::from(axis.min(2))] *= 0.12;
    let warp = fbm(q, 0.2, 2, f, 14);
    let rings = fbm(q + Vec3::splat(0.05 * warp), 0.05, 3, f, 17);
    base * (1.0 + 0.28 * warp + 0.5 * rings)
}

/// The nearest of jittered points decides the colour, as in a stained-glass window.
fn picture(p: Vec3, f: f32, salt: u32) -> (Vec3, f32) {
    let cell = (p / 0.14).floor().as_ivec3();
    let mut nearest = (f32::INFINITY, IVec3::ZERO);
    for i in 0..27 {
        let c = cell + IVec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
        let jitter = Vec3::new(hash(c, salt), hash(c, salt + 1), hash(c, salt + 2));
        let d = ((c.as_vec3() + jitter) * 0.14).distance_squared(p);
        if d < nearest.0 {
            nearest = (d, c);
        }
    }
    let c = nearest.1;
    let colour = Vec3::new(hash(c, salt + 3), hash(c, salt + 4), hash(c, salt + 5));
    (Vec3::splat(0.15) + colour * 0.8 + 0.1 * fbm(p, 0.05, 2, f, salt), 0.05)
}

fn dial(p: Vec3, f: f32) -> Vec3 {
    let radius = p.y.hypot(p.z);
    let hour = p.y.atan2(p.z) / std::f32::consts::TAU * 12.0 + 12.0;
    let tick =
        lines(hour + 0.15, 1.0, 0.3, f / radius.max(0.01) * 2.0) * f32::from(radius > 0.1 && radius < 0.13);
    let short = f32::from(p.y > 0.0 && p.y < 0.07 && (p.z - 0.4 * p.y).abs() < 0.008);
    let long = f32::from(p.z > 0.0 && p.z < 0.11 && (p.y + 0.2 * p.z).abs() < 0.006);
    mix(Vec3::splat(0.92), Vec3::new(0.15, 0.1, 0.1), tick.max(short).max(long))
}

fn outdoors(p: Vec3, f: f32) -> Vec3 {
    let sky = mix(Vec3::new(0.85, 0.92, 0.98), Vec3::new(0.55, 0.75, 0.95), (p.z - 1.3).clamp(0.0, 1.0))
        + 0.15 * fbm(p * Vec3::new(0.5, 0.5, 1.0), 0.2, 3, f, 90).max(0.0);
    let hill = 1.42 + 0.12 * fbm(Vec3::new(p.x, p.y, 0.0), 0.25, 2, f, 93);
    let green = Vec3::new(0.35, 0.52, 0.25) * (1.0 + 0.5 * fbm(p, 0.06, 2, f, 95));
    mix(sky, green, ((hill - p.z) / f.max(0.01) + 0.5).clamp(0.0, 1.0))
}
