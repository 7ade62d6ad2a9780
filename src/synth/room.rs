//! The persistent kitchen: room, units, appliances and what stands about, and the places where things can
//! be put.
//!
//! Metres, z up. The units stand along the back wall (y = depth) and the left wall (x = 0), the table at
//! the front wall (y = 0), the shelf at the right wall.

use glam::Vec3;

use super::furniture;
use super::material::{Material as M, Rgb8};
use super::mesh::{Mesh, Tag};
use super::noise::Rng;

/// Height of the worktops.
pub(super) const TOP: f32 = 0.90;

/// What `gt/objects.json` says about one instance.
#[derive(Clone, Debug)]
pub(super) struct Thing {
    pub name: &'static str,
    pub category: &'static str,
    pub query: &'static str,
    /// 0 persistent, 1 dynamic, 2 actor.
    pub stream: u8,
    pub moves: bool,
}

/// A spot where an object can rest, and where the head is when the wearer uses it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub at: Vec3,
    pub head: Vec3,
}

/// Everything that never moves.
pub(super) struct Room {
    pub mesh: Mesh,
    /// Instance `i + 1` is `things[i]`.
    pub things: Vec<Thing>,
    pub places: Vec<Place>,
    pub size: Vec3,
    /// Middle of the lamp's opening.
    pub lamp: Vec3,
    /// Centre of the window; its normal is −y.
    pub window: Vec3,
    /// Points worth a look, from where to see them.
    pub sights: Vec<Place>,
}

/// Colours of one kitchen.
pub(super) struct Palette {
    pub wall: Rgb8,
    pub tile: Rgb8,
    pub front: Rgb8,
    pub wood: Rgb8,
    pub stone: Rgb8,
    pub floor: M,
    pub accent: Rgb8,
}

const PALETTES: [Palette; 4] = [
    Palette {
        wall: [226, 205, 165],
        tile: [120, 165, 172],
        front: [170, 108, 58],
        wood: [190, 140, 84],
        stone: [118, 112, 108],
        floor: M::FloorTiles([176, 104, 74], 30),
        accent: [196, 44, 36],
    },
    Palette {
        wall: [190, 206, 192],
        tile: [226, 214, 186],
        front: [92, 124, 128],
        wood: [164, 112, 66],
        stone: [172, 160, 146],
        floor: M::FloorBoards([186, 138, 88]),
        accent: [222, 160, 40],
    },
    Palette {
        wall: [214, 190, 178],
        tile: [158, 92, 74],
        front: [222, 212, 190],
        wood: [132, 84, 50],
        stone: [84, 88, 92],
        floor: M::FloorTiles([150, 146, 132], 33),
        accent: [52, 96, 150],
    },
    Palette {
        wall: [176, 192, 208],
        tile: [206, 210, 204],
        front: [196, 152, 100],
        wood: [176, 120, 72],
        stone: [140, 124, 112],
        floor: M::FloorBoards([150, 100, 62]),
        accent: [64, 128, 74],
    },
];

/// Collects geometry and instances.
pub(super) struct Builder<'a> {
    pub mesh: Mesh,
    pub things: Vec<Thing>,
    pub palette: &'a Palette,
    pub size: Vec3,
}

impl Builder<'_> {
    /// Starts a new instance; what is added next belongs to it.
    pub(super) fn thing(&mut self, name: &'static str, category: &'static str, query: &'static str) {
        self.things.push(Thing { name, category, query, stream: 0, moves: false });
    }

    pub(super) fn tag(&self, material: M) -> Tag {
        Tag { instance: self.things.len() as u16, material }
    }

    pub(super) fn cuboid(&mut self, material: M, min: [f32; 3], max: [f32; 3]) {
        self.mesh.cuboid(self.tag(material), min.into(), max.into());
    }

    pub(super) fn lathe(&mut self, material: M, base: [f32; 3], profile: &[(f32, f32)]) {
        self.mesh.lathe(self.tag(material), base.into(), profile, 20);
    }

    pub(super) fn tube(&mut self, material: M, path: &[Vec3], radius: f32) {
        self.mesh.tube(self.tag(material), path, &vec![radius; path.len()], 8);
    }
}

/// Builds the kitchen of a seed.
pub(super) fn build(seed: u64) -> Room {
    let mut rng = Rng::new(seed);
    let palette = &PALETTES[rng.below(PALETTES.len())];
    let size = Vec3::new(4.0 + rng.range(0.0, 0.3), 3.2 + rng.range(0.0, 0.25), 2.5);
    let mut b = Builder { mesh: Mesh::default(), things: vec![], palette, size };
    let sink = 0.95 + rng.range(-0.05, 0.08);
    let stove = 2.15 + rng.range(-0.05, 0.1);
    let lamp = Vec3::new(size.x * 0.52, size.y * 0.45, 1.98);
    let window = Vec3::new(sink + 0.25, size.y, 1.83);

    shell(&mut b);
    furniture::base_units(&mut b, sink, stove);
    furniture::basin(&mut b, sink);
    furniture::cooker(&mut b, stove);
    furniture::side_unit(&mut b);
    furniture::fridge(&mut b);
    furniture::wall_units(&mut b, window, stove);
    furniture::small_appliances(&mut b, stove);
    furniture::table_and_chair(&mut b);
    furniture::shelf(&mut b, &mut rng);
    furniture::decoration(&mut b, &mut rng);
    furniture::lamp_and_beams(&mut b, lamp);

    let (places, sights) = (places(size, sink, stove), sights(size, window));
    Room { mesh: b.mesh, things: b.things, places, size, lamp, window, sights }
}

fn shell(b: &mut Builder) {
    let (s, wall, tile) = (b.size, b.palette.wall, b.palette.tile);
    let (x, y, z) = (Vec3::X * s.x, Vec3::Y * s.y, Vec3::Z * s.z);
    b.thing("floor", "floor", "floor");
    b.mesh.quad(b.tag(b.palette.floor), Vec3::ZERO, x, y);
    b.thing("ceiling", "ceiling", "ceiling");
    b.mesh.quad(b.tag(M::Plaster([216, 208, 192])), z, y, x);
    b.thing("left wall", "wall", "wall");
    b.mesh.quad(b.tag(M::TiledWall(wall, tile)), Vec3::ZERO, y, z);
    b.thing("right wall", "wall", "wall");
    b.mesh.quad(b.tag(M::Plaster(wall)), x, z, y);
    b.thing("front wall", "wall", "wall");
    b.mesh.quad(b.tag(M::Plaster(wall)), Vec3::ZERO, z, x);
    b.thing("back wall", "wall", "wall");
    b.mesh.quad(b.tag(M::TiledWall(wall, tile)), y, x, z);
}

fn places(s: Vec3, sink: f32, stove: f32) -> Vec<Place> {
    let back = |x: f32, y: f32, z: f32| Place {
        at: Vec3::new(x, y, z),
        head: Vec3::new(x.clamp(0.95, s.x - 1.0), s.y - 1.0, 1.52),
    };
    let table = |x: f32, y: f32| Place { at: Vec3::new(x, y, 0.746), head: Vec3::new(x + 0.05, 1.12, 1.45) };
    vec![
        back(sink + 0.68, s.y - 0.36, TOP),
        back(sink + 0.25, s.y - 0.31, 0.724),
        back(stove + 0.16, s.y - 0.42, TOP + 0.008),
        back(stove + 0.80, s.y - 0.36, TOP),
        back(0.42, s.y - 0.36, TOP),
        Place { at: Vec3::new(0.34, s.y - 0.9, TOP), head: Vec3::new(1.05, s.y - 1.1, 1.5) },
        table(1.0, 0.45),
        table(1.42, 0.48),
        table(1.85, 0.42),
    ]
}

fn sights(s: Vec3, window: Vec3) -> Vec<Place> {
    let sight = |at: [f32; 3], head: [f32; 3]| Place { at: at.into(), head: head.into() };
    vec![
        sight([s.x, 1.4, 1.0], [1.7, s.y * 0.5, 1.58]),
        sight([s.x - 0.9, 0.0, 1.0], [1.6, s.y * 0.55, 1.62]),
        sight([0.1, 0.5, 1.1], [2.3, s.y * 0.5, 1.6]),
        sight([window.x, window.y, 1.7], [2.2, s.y * 0.42, 1.55]),
        sight([s.x - 0.5, s.y, 1.1], [1.3, s.y * 0.45, 1.6]),
        sight([2.0, s.y * 0.5, 0.0], [2.6, s.y * 0.5, 1.6]),
        sight([s.x * 0.5, s.y * 0.75, s.z], [s.x * 0.35, s.y * 0.42, 1.55]),
    ]
}
