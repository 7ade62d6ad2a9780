//! The objects that are picked up and put down. Origin at the middle of the base, z up.

use glam::{Mat3, Vec3};

use super::material::Material as M;
use super::mesh::{Mesh, Tag};
use super::noise::Rng;
use super::room::Thing;

/// A movable object.
pub(super) struct Prop {
    pub thing: Thing,
    pub mesh: Mesh,
    /// Where the hand holds it, in the object's coordinates.
    pub grip: Vec3,
}

/// Adds a prop's surfaces to a mesh; the second argument tags a material with the prop's instance.
type Shape<'a> = &'a dyn Fn(&mut Mesh, &dyn Fn(M) -> Tag);

/// All props; the first has instance number `first`.
pub(super) fn build(first: u16, seed: u64) -> Vec<Prop> {
    let mut rng = Rng::new(seed ^ 0x70_72_6f_70);
    let paint = |choices: [[u8; 3]; 3], rng: &mut Rng| choices[rng.below(3)];
    let china = paint([[226, 220, 206], [222, 176, 60], [120, 160, 190]], &mut rng);
    let glass = paint([[36, 92, 52], [120, 60, 28], [40, 76, 120]], &mut rng);
    let mut parts: Vec<(&'static str, &'static str, Vec3, Mesh)> = Vec::new();
    let mut add = |name, category, grip: [f32; 3], shape: Shape| {
        let instance = first + parts.len() as u16;
        let mut mesh = Mesh::default();
        shape(&mut mesh, &|material| Tag { instance, material });
        parts.push((name, category, grip.into(), mesh));
    };
    add("mug", "mug", [0.05, 0.0, 0.06], &|m, tag| mug(m, tag(M::Stripes(china, [170, 60, 50], 5))));
    add("frying pan", "frying_pan", [0.30, 0.0, 0.06], &|m, tag| {
        pan(m, tag(M::Paint([74, 70, 70])), tag(M::Paint([150, 44, 40])));
    });
    add("chopping board", "chopping_board", [0.0, -0.13, 0.02], &|m, tag| {
        board(m, tag(M::Wood([206, 162, 104], 0)))
    });
    add("bottle", "bottle", [0.0, 0.0, 0.16], &|m, tag| {
        bottle(
            m,
            tag(M::Paint(glass)),
            tag(M::Stripes([232, 222, 196], [190, 50, 44], 4)),
            tag(M::Paint([200, 60, 40])),
        );
    });
    add("bowl", "bowl", [0.10, 0.0, 0.06], &|m, tag| {
        bowl(
            m,
            tag(M::Stripes([70, 110, 168], [226, 226, 220], 4)),
            tag(M::Paint([206, 70, 44])),
            tag(M::Paint([226, 170, 52])),
        );
    });
    add("kettle", "kettle", [0.0, 0.0, 0.23], &|m, tag| {
        kettle(m, tag(M::Steel), tag(M::Paint([46, 44, 46])))
    });
    parts
        .into_iter()
        .map(|(name, category, grip, mesh)| Prop {
            thing: Thing { name, category, query: name, stream: 1, moves: true },
            mesh,
            grip,
        })
        .collect()
}

fn mug(m: &mut Mesh, tag: Tag) {
    let profile = [(0.0, 0.0), (0.042, 0.0), (0.046, 0.1), (0.041, 0.1), (0.037, 0.008), (0.0, 0.008)];
    m.lathe(tag, Vec3::ZERO, &profile, 20);
    let handle: Vec<Vec3> = (0..=6)
        .map(|i| {
            let (s, c) = (i as f32 / 6.0 * std::f32::consts::PI).sin_cos();
            Vec3::new(0.043 + 0.03 * s, 0.0, 0.05 - 0.032 * c)
        })
        .collect();
    m.tube(tag, &handle, &[0.007; 7], 6);
}

fn pan(m: &mut Mesh, metal: Tag, handle: Tag) {
    let profile = [(0.0, 0.0), (0.10, 0.0), (0.13, 0.05), (0.125, 0.05), (0.096, 0.006), (0.0, 0.006)];
    m.lathe(metal, Vec3::ZERO, &profile, 24);
    let path = [Vec3::new(0.122, 0.0, 0.04), Vec3::new(0.2, 0.0, 0.055), Vec3::new(0.34, 0.0, 0.06)];
    m.tube(handle, &path, &[0.010, 0.013, 0.014], 8);
}

fn board(m: &mut Mesh, wood: Tag) {
    m.cuboid(wood, Vec3::new(-0.18, -0.12, 0.0), Vec3::new(0.18, 0.12, 0.022));
}

fn bottle(m: &mut Mesh, glass: Tag, label: Tag, cap: Tag) {
    m.lathe(glass, Vec3::ZERO, &[(0.0, 0.0), (0.036, 0.0), (0.038, 0.05)], 18);
    m.lathe(label, Vec3::ZERO, &[(0.038, 0.05), (0.038, 0.14)], 18);
    m.lathe(glass, Vec3::ZERO, &[(0.038, 0.14), (0.036, 0.17), (0.016, 0.21), (0.014, 0.26)], 18);
    m.lathe(cap, Vec3::ZERO, &[(0.014, 0.26), (0.017, 0.26), (0.017, 0.285), (0.0, 0.285)], 18);
}

fn bowl(m: &mut Mesh, china: Tag, red: Tag, yellow: Tag) {
    let profile =
        [(0.0, 0.0), (0.05, 0.0), (0.09, 0.035), (0.11, 0.075), (0.105, 0.075), (0.085, 0.04), (0.0, 0.012)];
    m.lathe(china, Vec3::ZERO, &profile, 24);
    for (tag, at) in
        [(red, [0.035, 0.02, 0.055]), (yellow, [-0.035, 0.025, 0.055]), (red, [0.0, -0.04, 0.06])]
    {
        m.ellipsoid(tag, at.into(), Mat3::from_diagonal(Vec3::splat(0.035)), 12);
    }
}

fn kettle(m: &mut Mesh, steel: Tag, black: Tag) {
    let body = [(0.0, 0.0), (0.085, 0.0), (0.088, 0.05), (0.065, 0.14), (0.03, 0.155), (0.0, 0.155)];
    m.lathe(steel, Vec3::ZERO, &body, 22);
    m.ellipsoid(black, Vec3::new(0.0, 0.0, 0.165), Mat3::from_diagonal(Vec3::new(0.014, 0.014, 0.014)), 10);
    m.tube(
        steel,
        &[Vec3::new(0.07, 0.0, 0.06), Vec3::new(0.11, 0.0, 0.1), Vec3::new(0.13, 0.0, 0.14)],
        &[0.02, 0.014, 0.011],
        8,
    );
    let handle: Vec<Vec3> = (0..=8)
        .map(|i| {
            let (s, c) = (i as f32 / 8.0 * std::f32::consts::PI).sin_cos();
            Vec3::new(0.06 * c, 0.0, 0.13 + 0.1 * s)
        })
        .collect();
    m.tube(black, &handle, &[0.009; 9], 7);
}
