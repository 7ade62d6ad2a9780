//! What stands and hangs in the kitchen; each function adds one group of things.

use glam::Vec3;

use super::material::{Material as M, Rgb8};
use super::mesh::Mesh;
use super::noise::Rng;
use super::room::{Builder, TOP};

/// Depth of the base units' carcasses.
const UNIT: f32 = 0.58;

/// Carcasses, plinth, doors and worktop along the back wall, open where the sink is.
pub(super) fn base_units(b: &mut Builder, sink: f32, stove: f32) {
    let (d, end) = (b.size.y, b.size.x - 0.76);
    let (front, wood, stone) = (b.palette.front, b.palette.wood, b.palette.stone);
    let face = d - UNIT;
    b.thing("base cabinets", "cabinet", "cabinet");
    b.cuboid(M::Paint([58, 52, 48]), [0.0, face + 0.06, 0.0], [end, d, 0.1]);
    for (x0, x1, height) in
        [(0.0, sink - 0.02, 0.86), (sink - 0.02, sink + 0.52, 0.68), (sink + 0.52, stove, 0.86)]
    {
        b.cuboid(M::Wood(wood, 2), [x0, face, 0.1], [x1, d, height]);
    }
    b.cuboid(M::Wood(wood, 2), [sink - 0.02, face, 0.68], [sink + 0.52, face + 0.02, 0.86]);
    b.cuboid(M::Wood(wood, 2), [stove + 0.6, face, 0.1], [end, d, 0.86]);
    doors_along_x(b, 0.62, stove, face, 0.12, 0.84, M::Wood(front, 2));
    doors_along_x(b, stove + 0.6, end, face, 0.12, 0.84, M::Wood(front, 2));
    b.thing("worktop", "countertop", "kitchen worktop");
    let (y0, y1) = (d - 0.50, d - 0.14);
    let edge = face - 0.04;
    for (min, max) in [
        ([0.0, edge, 0.86], [sink, d, TOP]),
        ([sink, edge, 0.86], [sink + 0.5, y0, TOP]),
        ([sink, y1, 0.86], [sink + 0.5, d, TOP]),
        ([sink + 0.5, edge, 0.86], [stove, d, TOP]),
        ([stove + 0.6, edge, 0.86], [end, d, TOP]),
    ] {
        b.cuboid(M::Granite(stone), min, max);
    }
}

/// Panels about half a metre wide with a bar handle each, in front of a carcass that faces −y.
fn doors_along_x(b: &mut Builder, x0: f32, x1: f32, face: f32, z0: f32, z1: f32, material: M) {
    let count = ((x1 - x0) / 0.5).round().max(1.0);
    let width = (x1 - x0) / count;
    for i in 0..count as usize {
        let (left, right) = (x0 + width * i as f32 + 0.008, x0 + width * (i + 1) as f32 - 0.008);
        b.cuboid(material, [left, face - 0.022, z0], [right, face, z1]);
        let x = if i % 2 == 0 { right - 0.05 } else { left + 0.05 };
        let z = if z0 < 1.0 { z1 - 0.06 } else { z0 + 0.20 };
        bar(b, Vec3::new(x, face - 0.022, z), Vec3::new(x, face - 0.022, z - 0.14), -Vec3::Y);
    }
}

/// A handle: a bar between two feet, 3 cm off the surface.
fn bar(b: &mut Builder, from: Vec3, to: Vec3, out: Vec3) {
    let lift = out * 0.032;
    b.tube(M::Steel, &[from, from + lift, to + lift, to], 0.007);
}

pub(super) fn basin(b: &mut Builder, sink: f32) {
    let d = b.size.y;
    let (x0, x1, y0, y1, z0) = (sink, sink + 0.5, d - 0.50, d - 0.14, 0.72);
    b.thing("sink", "sink", "sink");
    b.cuboid(M::Steel, [x0, y0, z0 - 0.01], [x1, y1, z0]);
    for (min, max) in [
        ([x0, y0, z0], [x0 + 0.012, y1, TOP + 0.004]),
        ([x1 - 0.012, y0, z0], [x1, y1, TOP + 0.004]),
        ([x0 + 0.012, y0, z0], [x1 - 0.012, y0 + 0.012, TOP + 0.004]),
        ([x0 + 0.012, y1 - 0.012, z0], [x1 - 0.012, y1, TOP + 0.004]),
    ] {
        b.cuboid(M::Steel, min, max);
    }
    b.lathe(M::Paint([40, 40, 42]), [sink + 0.25, d - 0.32, z0], &[(0.04, 0.0), (0.03, 0.003), (0.0, 0.003)]);
    b.thing("faucet", "faucet", "faucet");
    let base = Vec3::new(sink + 0.25, d - 0.08, TOP);
    let arch = |i: usize| {
        let (s, c) = (i as f32 / 8.0 * std::f32::consts::PI).sin_cos();
        base + Vec3::new(0.0, -0.09 + 0.09 * c, 0.2 + 0.1 * s)
    };
    let mut path = vec![base, base + Vec3::Z * 0.1];
    path.extend((0..=8).map(arch));
    path.push(arch(8) - Vec3::Z * 0.04);
    b.tube(M::Steel, &path, 0.013);
    b.lathe(M::Steel, base.to_array(), &[(0.03, 0.0), (0.03, 0.03), (0.0, 0.03)]);
    b.tube(M::Steel, &[base + Vec3::new(0.02, 0.0, 0.06), base + Vec3::new(0.09, -0.02, 0.09)], 0.008);
}

pub(super) fn cooker(b: &mut Builder, x: f32) {
    let (d, accent) = (b.size.y, b.palette.accent);
    let face = d - UNIT - 0.02;
    b.thing("stove", "stove", "stove");
    b.cuboid(M::Paint([224, 222, 214]), [x + 0.004, face, 0.02], [x + 0.596, d, 0.885]);
    b.cuboid(M::Glass, [x + 0.004, face - 0.02, 0.885], [x + 0.596, d - 0.02, TOP + 0.004]);
    b.cuboid(M::Glass, [x + 0.07, face - 0.02, 0.26], [x + 0.53, face, 0.60]);
    b.cuboid(M::Steel, [x + 0.02, face - 0.012, 0.2], [x + 0.58, face, 0.68]);
    b.cuboid(M::Steel, [x + 0.02, face - 0.012, 0.74], [x + 0.58, face, 0.87]);
    bar(b, Vec3::new(x + 0.08, face - 0.012, 0.65), Vec3::new(x + 0.52, face - 0.012, 0.65), -Vec3::Y);
    for i in 0..4 {
        let knob = Vec3::new(x + 0.1 + 0.13 * i as f32, face - 0.012, 0.805);
        b.tube(M::Paint([44, 42, 42]), &[knob, knob - Vec3::Y * 0.03], 0.022);
        b.cuboid(
            M::Paint(accent),
            [knob.x - 0.004, knob.y - 0.034, 0.805],
            [knob.x + 0.004, knob.y - 0.03, 0.825],
        );
    }
    for (cx, cy, r) in [(0.16, 0.42, 0.1), (0.44, 0.42, 0.075), (0.16, 0.17, 0.075), (0.44, 0.17, 0.1)] {
        let base = [x + cx, d - cy, TOP + 0.004];
        b.lathe(
            M::Paint([128, 112, 104]),
            base,
            &[(r, 0.0), (r, 0.003), (r - 0.014, 0.003), (r - 0.014, 0.0)],
        );
        let inner = r * 0.55;
        b.lathe(
            M::Paint([128, 112, 104]),
            base,
            &[(inner, 0.0), (inner, 0.003), (inner - 0.012, 0.003), (inner - 0.012, 0.0)],
        );
    }
}

/// The short leg of the L, along the left wall.
pub(super) fn side_unit(b: &mut Builder) {
    let (y0, y1) = (b.size.y - UNIT - 1.15, b.size.y - UNIT - 0.04);
    let (front, wood, stone) = (b.palette.front, b.palette.wood, b.palette.stone);
    b.thing("side cabinet", "cabinet", "cabinet");
    b.cuboid(M::Paint([58, 52, 48]), [0.0, y0 + 0.02, 0.0], [UNIT - 0.06, y1, 0.1]);
    b.cuboid(M::Wood(wood, 2), [0.0, y0 + 0.02, 0.1], [UNIT, y1 + 0.03, 0.86]);
    for i in 0..2 {
        let (near, far) = (y0 + 0.03 + 0.54 * i as f32, y0 + 0.55 + 0.54 * i as f32);
        for (low, high) in [(0.12, 0.62), (0.635, 0.84)] {
            b.cuboid(M::Wood(front, 2), [UNIT, near, low], [UNIT + 0.022, far, high]);
            let z = high - 0.06;
            let middle = (near + far) / 2.0;
            bar(
                b,
                Vec3::new(UNIT + 0.022, middle - 0.08, z),
                Vec3::new(UNIT + 0.022, middle + 0.08, z),
                Vec3::X,
            );
        }
    }
    b.thing("side worktop", "countertop", "kitchen worktop");
    b.cuboid(M::Granite(stone), [0.0, y0, 0.86], [UNIT + 0.04, y1, TOP]);
}

pub(super) fn fridge(b: &mut Builder) {
    let (x0, x1, d) = (b.size.x - 0.72, b.size.x - 0.03, b.size.y);
    let face = d - 0.64;
    b.thing("fridge", "refrigerator", "refrigerator");
    b.cuboid(M::Steel, [x0, face, 0.04], [x1, d - 0.02, 1.86]);
    for (low, high) in [(0.07, 1.16), (1.18, 1.84)] {
        b.cuboid(M::Steel, [x0 + 0.01, face - 0.05, low], [x1 - 0.01, face, high]);
    }
    let x = x0 + 0.07;
    bar(b, Vec3::new(x, face - 0.05, 0.75), Vec3::new(x, face - 0.05, 1.12), -Vec3::Y);
    bar(b, Vec3::new(x, face - 0.05, 1.24), Vec3::new(x, face - 0.05, 1.5), -Vec3::Y);
    // Notes and a magnet.
    b.cuboid(M::Picture(3), [x0 + 0.3, face - 0.053, 1.4], [x0 + 0.5, face - 0.05, 1.66]);
    b.cuboid(M::Paint(b.palette.accent), [x0 + 0.52, face - 0.06, 1.3], [x0 + 0.58, face - 0.05, 1.36]);
}

/// Cupboards, hood and window on the back wall.
pub(super) fn wall_units(b: &mut Builder, window: Vec3, stove: f32) {
    let (d, end) = (b.size.y, b.size.x - 0.76);
    let (front, wood) = (b.palette.front, b.palette.wood);
    let units = [
        ("left wall cupboard", 0.02, window.x - 0.5),
        ("middle wall cupboard", window.x + 0.5, stove - 0.02),
        ("right wall cupboard", stove + 0.62, end),
    ];
    for (name, x0, x1) in units {
        b.thing(name, "cupboard", "cupboard");
        b.cuboid(M::Wood(wood, 2), [x0, d - 0.33, 1.46], [x1, d, 2.16]);
        doors_along_x(b, x0, x1, d - 0.33, 1.47, 2.15, M::Wood(front, 2));
    }
    b.thing("extractor hood", "hood", "extractor hood");
    b.cuboid(M::Steel, [stove, d - 0.46, 1.52], [stove + 0.6, d, 1.62]);
    b.cuboid(M::Steel, [stove + 0.16, d - 0.3, 1.62], [stove + 0.44, d, 2.5]);
    b.thing("window", "window", "window");
    let (x0, x1, z0, z1) = (window.x - 0.42, window.x + 0.42, window.z - 0.36, window.z + 0.36);
    b.cuboid(M::Outdoors, [x0, d - 0.012, z0], [x1, d, z1]);
    let frame = M::Paint([232, 228, 216]);
    for (min, max) in [
        ([x0 - 0.05, d - 0.05, z1], [x1 + 0.05, d, z1 + 0.05]),
        ([x0 - 0.05, d - 0.14, z0 - 0.04], [x1 + 0.05, d, z0]),
        ([x0 - 0.05, d - 0.05, z0], [x0, d, z1]),
        ([x1, d - 0.05, z0], [x1 + 0.05, d, z1]),
        ([window.x - 0.018, d - 0.04, z0], [window.x + 0.018, d - 0.012, z1]),
        ([x0, d - 0.04, window.z - 0.015], [window.x - 0.018, d - 0.012, window.z + 0.015]),
        ([window.x + 0.018, d - 0.04, window.z - 0.015], [x1, d - 0.012, window.z + 0.015]),
    ] {
        b.cuboid(frame, min, max);
    }
}

pub(super) fn small_appliances(b: &mut Builder, stove: f32) {
    let (d, accent) = (b.size.y, b.palette.accent);
    b.thing("toaster", "toaster", "toaster");
    let x = stove - 0.3;
    b.cuboid(M::Paint(accent), [x, d - 0.24, TOP], [x + 0.26, d - 0.08, TOP + 0.19]);
    for y in [d - 0.205, d - 0.145] {
        b.cuboid(M::Paint([30, 28, 28]), [x + 0.04, y, TOP + 0.19], [x + 0.22, y + 0.03, TOP + 0.192]);
    }
    b.cuboid(M::Steel, [x + 0.1, d - 0.25, TOP + 0.1], [x + 0.16, d - 0.24, TOP + 0.13]);
    b.thing("microwave", "microwave_oven", "microwave oven");
    let y = d - UNIT - 1.1;
    b.cuboid(M::Paint([226, 224, 218]), [0.05, y, TOP + 0.01], [0.42, y + 0.5, TOP + 0.3]);
    b.cuboid(M::Glass, [0.42, y + 0.15, TOP + 0.05], [0.432, y + 0.47, TOP + 0.26]);
    b.cuboid(M::Paint([70, 70, 74]), [0.42, y + 0.02, TOP + 0.04], [0.428, y + 0.13, TOP + 0.27]);
    bar(b, Vec3::new(0.432, y + 0.17, TOP + 0.08), Vec3::new(0.432, y + 0.17, TOP + 0.23), Vec3::X);
}

pub(super) fn table_and_chair(b: &mut Builder) {
    let wood = b.palette.wood;
    b.thing("table", "table", "table");
    for i in 0..5 {
        let y = 0.08 + 0.152 * i as f32;
        b.cuboid(M::Wood(wood, 0), [0.75, y, 0.71], [2.15, y + 0.15, 0.745]);
    }
    for (x, y) in [(0.80, 0.12), (2.04, 0.12), (0.80, 0.74), (2.04, 0.74)] {
        b.cuboid(M::Wood(wood, 2), [x, y, 0.0], [x + 0.06, y + 0.06, 0.71]);
    }
    b.cuboid(M::Wood(wood, 0), [0.86, 0.14, 0.62], [2.04, 0.16, 0.71]);
    b.cuboid(M::Wood(wood, 0), [0.86, 0.77, 0.62], [2.04, 0.79, 0.71]);
    b.thing("chair", "chair", "chair");
    let (x, y) = (2.32, 0.22);
    b.cuboid(M::Wood([120, 78, 46], 1), [x, y, 0.43], [x + 0.42, y + 0.42, 0.46]);
    for (dx, dy, h) in [(0.0, 0.0, 0.43), (0.0, 0.38, 0.43), (0.38, 0.0, 0.95), (0.38, 0.38, 0.95)] {
        b.cuboid(M::Wood([120, 78, 46], 2), [x + dx, y + dy, 0.0], [x + dx + 0.04, y + dy + 0.04, h]);
    }
    for z in [0.58, 0.70, 0.84] {
        b.cuboid(M::Wood([120, 78, 46], 1), [x + 0.385, y + 0.04, z], [x + 0.41, y + 0.38, z + 0.07]);
    }
    b.cuboid(
        M::Check([150, 60, 56], [226, 214, 190], 7),
        [x + 0.02, y + 0.05, 0.46],
        [x + 0.36, y + 0.37, 0.49],
    );
}

/// Bookcase at the right wall, with books and jars.
pub(super) fn shelf(b: &mut Builder, rng: &mut Rng) {
    let (x0, x1, y0, y1) = (b.size.x - 0.3, b.size.x, 1.05, 1.95);
    let wood = M::Wood(b.palette.wood, 1);
    b.thing("bookcase", "bookcase", "bookcase");
    for y in [y0, y1 - 0.025] {
        b.cuboid(M::Wood(b.palette.wood, 2), [x0, y, 0.0], [x1, y + 0.025, 1.7]);
    }
    let levels = [0.05, 0.45, 0.85, 1.25, 1.67];
    for z in levels {
        b.cuboid(wood, [x0, y0 + 0.025, z], [x1, y1 - 0.025, z + 0.022]);
    }
    b.thing("books", "book", "book");
    for z in &levels[..4] {
        let mut y = y0 + 0.04;
        while y < y1 - 0.12 {
            if rng.below(6) == 0 {
                y += rng.range(0.04, 0.12);
                continue;
            }
            let (width, height, deep) = (rng.range(0.025, 0.06), rng.range(0.2, 0.32), rng.range(0.17, 0.24));
            let colour = [0, 1, 2].map(|_| rng.range(40.0, 215.0) as u8);
            let cover =
                if rng.below(3) == 0 { M::Stripes(colour, [222, 206, 170], 6) } else { M::Paint(colour) };
            b.cuboid(cover, [x1 - deep - 0.01, y, z + 0.022], [x1 - 0.01, y + width, z + 0.022 + height]);
            y += width + 0.002;
        }
    }
}

/// Pictures, clock, plant, wall board with jars, door, rug, bin.
pub(super) fn decoration(b: &mut Builder, rng: &mut Rng) {
    let (s, accent, wood) = (b.size, b.palette.accent, b.palette.wood);
    let salt = rng.below(200) as u8;
    b.thing("poster", "poster", "poster");
    b.cuboid(M::Wood(wood, 0), [1.08, 0.0, 1.25], [1.92, 0.02, 1.97]);
    b.cuboid(M::Picture(salt), [1.12, 0.02, 1.29], [1.88, 0.024, 1.93]);
    b.thing("picture", "painting", "painting");
    b.cuboid(M::Wood([90, 60, 40], 1), [s.x - 0.02, 0.25, 1.35], [s.x, 0.85, 1.85]);
    b.cuboid(M::Picture(salt.wrapping_add(31)), [s.x - 0.024, 0.29, 1.39], [s.x - 0.02, 0.81, 1.81]);
    b.thing("wall clock", "clock", "clock");
    clock(b, Vec3::new(0.0, 0.72, 1.95));
    b.thing("door", "door", "door");
    let x = s.x - 1.25;
    b.cuboid(M::Wood([206, 178, 140], 2), [x, 0.0, 0.0], [x + 0.82, 0.03, 2.02]);
    for (z0, z1) in [(0.15, 0.9), (1.05, 1.88)] {
        b.cuboid(M::Wood([180, 150, 112], 2), [x + 0.12, 0.03, z0], [x + 0.7, 0.045, z1]);
    }
    bar(b, Vec3::new(x + 0.06, 0.03, 1.0), Vec3::new(x + 0.18, 0.03, 1.0), Vec3::Y);
    b.thing("rug", "rug", "rug");
    let (y0, y1) = (s.y * 0.34, s.y * 0.62);
    b.cuboid(M::Check(accent, [214, 196, 160], 16), [1.1, y0, 0.0], [2.9, y1, 0.012]);
    b.thing("trash can", "trash_can", "trash can");
    let bin = [(0.0, 0.002), (0.13, 0.002), (0.16, 0.42), (0.15, 0.42), (0.12, 0.03), (0.0, 0.03)];
    b.lathe(M::Stripes([54, 92, 74], [40, 70, 58], 8), [0.24, 1.28, 0.0], &bin);
    wall_board(b, accent);
    plant(b, rng);
}

fn clock(b: &mut Builder, centre: Vec3) {
    // A disc that faces +x; its texture is centred on it.
    let mut disc = Mesh::default();
    let profile = [(0.16, 0.0), (0.16, 0.03), (0.14, 0.035)];
    disc.lathe(b.tag(M::Paint([60, 40, 34])), Vec3::ZERO, &profile, 28);
    disc.lathe(b.tag(M::Dial), Vec3::ZERO, &[(0.14, 0.03), (0.0, 0.03)], 28);
    let turn = glam::Quat::from_rotation_y(std::f32::consts::FRAC_PI_2);
    for vertex in &mut disc.vertices {
        vertex.texture = turn * vertex.texture;
    }
    b.mesh.append(&disc, &glam::Affine3A::from_rotation_translation(turn, centre));
}

/// A board on the left wall, with jars.
fn wall_board(b: &mut Builder, accent: Rgb8) {
    b.thing("wall shelf", "shelf", "shelf");
    b.cuboid(M::Wood(b.palette.wood, 1), [0.0, 0.3, 1.4], [0.2, 1.15, 1.425]);
    for y in [0.4, 1.02] {
        b.cuboid(M::Steel, [0.0, y, 1.28], [0.015, y + 0.02, 1.4]);
    }
    b.thing("jars", "jar", "jar");
    let colours = [accent, [206, 170, 96], [116, 142, 90], [188, 120, 88]];
    for (i, colour) in colours.into_iter().enumerate() {
        let (y, h) = (0.42 + 0.19 * i as f32, 0.13 + 0.03 * (i % 2) as f32);
        let jar =
            [(0.0, 0.0), (0.05, 0.0), (0.052, h), (0.035, h + 0.015), (0.035, h + 0.035), (0.0, h + 0.035)];
        b.lathe(M::Stripes(colour, [232, 224, 206], 5), [0.1, y, 1.425], &jar);
    }
}

fn plant(b: &mut Builder, rng: &mut Rng) {
    b.thing("potted plant", "flowerpot", "potted plant");
    let base = Vec3::new(0.35, 0.35, 0.0);
    let pot = [(0.0, 0.002), (0.12, 0.002), (0.17, 0.3), (0.15, 0.3), (0.14, 0.27), (0.0, 0.27)];
    b.lathe(M::Paint([176, 92, 60]), base.to_array(), &pot);
    for i in 0..16 {
        let (yaw, lean) = (i as f32 * 2.4 + rng.range(-0.3, 0.3), rng.range(0.08, 0.26));
        let out = Vec3::new(yaw.cos(), yaw.sin(), 0.0);
        let height = rng.range(0.5, 0.95);
        let tip = base + out * lean + Vec3::Z * height;
        b.mesh.tube(
            b.tag(M::Leaf),
            &[base + Vec3::Z * 0.25, base + out * lean * 0.4 + Vec3::Z * height * 0.7, tip],
            &[0.006; 3],
            5,
        );
        let along = (out + Vec3::Z * 0.4).normalize();
        let across = Vec3::Z.cross(along).normalize();
        let axes = glam::Mat3::from_cols(along * 0.11, across * 0.05, along.cross(across) * 0.008);
        b.mesh.ellipsoid(b.tag(M::Leaf), tip, axes, 8);
    }
}

pub(super) fn lamp_and_beams(b: &mut Builder, lamp: Vec3) {
    let s = b.size;
    b.thing("ceiling beams", "beam", "ceiling beam");
    for share in [0.2, 0.5, 0.8] {
        let y = s.y * share;
        b.cuboid(M::Wood([128, 86, 52], 0), [0.0, y - 0.06, s.z - 0.1], [s.x, y + 0.06, s.z]);
    }
    b.thing("ceiling lamp", "lamp", "lamp");
    let shade = [(0.19, 0.0), (0.06, 0.2), (0.0, 0.2), (0.0, 0.195), (0.055, 0.195), (0.184, 0.0)];
    b.lathe(M::Lamp, (lamp + Vec3::Z * 0.02).to_array(), &shade);
    b.tube(M::Paint([50, 46, 44]), &[lamp + Vec3::Z * 0.2, Vec3::new(lamp.x, lamp.y, s.z)], 0.008);
}
