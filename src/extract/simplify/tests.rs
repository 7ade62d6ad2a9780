use std::collections::HashMap;

use glam::{Vec3, Vec3A};

use super::*;
use crate::bvh::TriangleBvh;
use crate::extract::clean::mesh_stats;
use crate::extract::march;
use crate::extract::sample::sample_surface;
use crate::extract::testing::{area, assert_manifold, euler_characteristic, grid, noise};
use crate::rng::Rng;

/// The unit square in `n` × `n` cells, at the height that `height` gives, facing up.
fn sheet(n: u32, height: impl Fn(f32, f32) -> f32) -> TriMesh {
    let at = |i: u32| i as f32 / n as f32;
    let vertex = |i: u32| (at(i % (n + 1)), at(i / (n + 1)));
    let positions = (0..(n + 1) * (n + 1)).map(vertex).map(|(x, y)| [x, y, height(x, y)]).collect();
    let cell = |c: u32| {
        let a = c / n * (n + 1) + c % n;
        [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
    };
    TriMesh { positions, triangles: (0..n * n).flat_map(cell).collect() }
}

/// The surface of a box in `n` × `n` cells a side, facing outwards.
fn cuboid(n: u32, size: [f32; 3]) -> TriMesh {
    let (mut mesh, mut numbers) = (TriMesh::default(), HashMap::new());
    for axis in 0..3 {
        for far in [false, true] {
            let face = sheet(n, |_, _| f32::from(u8::from(far)));
            let place = |p: &[f32; 3]| {
                let mut q = [0.0; 3];
                (0..3).for_each(|k| q[(axis + k + 1) % 3] = p[k] * size[(axis + k + 1) % 3]);
                q
            };
            let mut number = |v: u32| {
                let p = place(&face.positions[v as usize]);
                *numbers.entry(p.map(f32::to_bits)).or_insert_with(|| {
                    mesh.positions.push(p);
                    mesh.positions.len() as u32 - 1
                })
            };
            let triangles: Vec<[u32; 3]> = face.triangles.iter().map(|t| t.map(&mut number)).collect();
            mesh.triangles
                .extend(triangles.into_iter().map(|[a, b, c]| if far { [a, b, c] } else { [a, c, b] }));
        }
    }
    mesh
}

/// A ball with random bumps, whole or cut by the grid's sides.
fn bumpy(seed: u64, radius: f32) -> TriMesh {
    let mut rng = Rng::new(seed, 0, 0);
    let waves: Vec<(Vec3A, f32)> = (0..6)
        .map(|_| {
            let mut k = || rng.uniform() * 50.0 - 25.0;
            (Vec3A::new(k(), k(), k()), 6.3 * rng.uniform())
        })
        .collect();
    let bumps = |p: Vec3A| waves.iter().map(|(k, phase)| (k.dot(p) + phase).sin()).sum::<f32>();
    let field = |p: Vec3A| radius - p.distance(Vec3A::splat(0.5)) + 0.012 * bumps(p);
    march(&grid(32, 1.0, field), 0.0).unwrap()
}

/// Largest distance of 20,000 area-uniform samples of `a` and of its vertices to `b`.
fn farthest(a: &TriMesh, b: &TriMesh) -> f32 {
    let bvh = TriangleBvh::new(b.triangles.len(), |t| b.corners(t).map(Vec3::from));
    let samples = sample_surface(a, 20_000, 1).positions;
    let distance = |p: &[f32; 3]| bvh.nearest(Vec3::from_array(*p)).unwrap().distance;
    samples.iter().chain(&a.positions).map(distance).fold(0.0, f32::max)
}

fn hausdorff(a: &TriMesh, b: &TriMesh) -> f32 {
    farthest(a, b).max(farthest(b, a))
}

fn kept<T: Copy>(column: &[T], s: &Simplified) -> Vec<T> {
    s.kept_vertices.iter().map(|&v| column[v as usize]).collect()
}

#[test]
fn a_plane_becomes_two_triangles_and_keeps_a_colour_step() {
    let plane = sheet(32, |_, _| 0.25);
    let bare = simplify(&plane, &[], 0.01).unwrap();
    assert_eq!((bare.mesh.triangles.len(), bare.report.triangles_before), (2, 2048));
    assert_eq!(bare.mesh.positions, kept(&plane.positions, &bare));
    assert!(bare.report.max_distance < 1e-6 && bare.report.kept_patches == 0);

    let colour: Vec<f32> = plane.positions.iter().map(|p| if p[0] < 0.5 { 0.0 } else { 100.0 }).collect();
    let column = Column { values: &colour, dim: 1, tolerance: 10.0 };
    let stepped = simplify(&plane, &[column], 0.01).unwrap();
    assert!(stepped.mesh.triangles.len() < 2048 / 4, "{}", stepped.mesh.triangles.len());
    assert!(stepped.report.deviations[0] <= 10.0);
    // What the new triangles interpolate at every vertex of the original, found by looking at all of them.
    let colours = kept(&colour, &stepped);
    for (p, &c) in plane.positions.iter().zip(&colour) {
        let holds = |t: &[u32; 3]| {
            let [a, b, d] = t.map(|v| Vec3::from_array(stepped.mesh.positions[v as usize]).truncate());
            let p = Vec3::from_array(*p).truncate();
            let w = [(b - p).perp_dot(d - p), (d - p).perp_dot(a - p), (a - p).perp_dot(b - p)];
            let sum: f32 = w.iter().sum();
            let mean = (0..3).map(|k| w[k] / sum * colours[t[k] as usize]).sum::<f32>();
            (w.iter().all(|w| *w >= -1e-6 * sum)).then_some(mean)
        };
        let found: Vec<f32> = stepped.mesh.triangles.iter().filter_map(holds).collect();
        assert!(!found.is_empty() && found.iter().all(|f| (f - c).abs() <= 10.1), "{p:?} {c} {found:?}");
    }
}

#[test]
fn a_room_becomes_twelve_triangles() {
    let room = cuboid(12, [4.0, 3.0, 2.5]);
    assert_eq!(assert_manifold(&room), 0);
    let inside = TriMesh {
        positions: room.positions.clone(),
        triangles: room.triangles.iter().map(|&[a, b, c]| [a, c, b]).collect(),
    };
    for mesh in [room, inside] {
        let s = simplify(&mesh, &[], 0.01).unwrap();
        assert_eq!((s.mesh.triangles.len(), s.mesh.positions.len()), (12, 8));
        assert_eq!(assert_manifold(&s.mesh), 0);
        assert!((s.mesh.signed_volume() / mesh.signed_volume() - 1.0).abs() < 1e-5);
        assert!(hausdorff(&mesh, &s.mesh) < 1e-5);
    }
}

#[test]
fn closed_surfaces_stay_closed_manifold_of_the_same_genus_and_within_tolerance() {
    let centre = Vec3A::splat(0.5);
    let ball = march(&grid(40, 1.0, |p| 0.35 - p.distance(centre)), 0.0).unwrap();
    let ring = |p: Vec3A| {
        let q = p - centre;
        0.12 - Vec3A::new(q.truncate().length() - 0.3, q.z, 0.0).length()
    };
    let torus = march(&grid(40, 1.0, ring), 0.0).unwrap();
    for (mesh, characteristic, left) in [(&ball, 2, 0.35), (&torus, 0, 0.5)] {
        for tolerance in [0.001, 0.004, 0.02] {
            let s = simplify(mesh, &[], tolerance).unwrap();
            assert_eq!(assert_manifold(&s.mesh), 0);
            assert_eq!(euler_characteristic(&s.mesh), characteristic);
            let found = hausdorff(mesh, &s.mesh);
            assert!(found <= 1.05 * tolerance, "{found} of {tolerance}");
            assert!(s.report.max_distance <= tolerance && found <= 1.2 * s.report.max_distance + 1e-5);
            let share = s.mesh.triangles.len() as f32 / mesh.triangles.len() as f32;
            assert!(tolerance < 0.004 || share < left, "{share} of the triangles at {tolerance}");
        }
    }
}

#[test]
fn random_bumps_stay_within_both_tolerances() {
    let (mut before, mut after) = (0, 0);
    for seed in 0..8 {
        // Every other one is cut by the grid, so that it has a border.
        let mesh = bumpy(seed, if seed % 2 == 0 { 0.33 } else { 0.55 });
        let heat: Vec<f32> = mesh.positions.iter().flat_map(|p| [p[0] * p[1], (9.0 * p[2]).sin()]).collect();
        let column = Column { values: &heat, dim: 2, tolerance: 0.1 };
        let s = simplify(&mesh, &[column], 0.008).unwrap();
        let (was, is) = (mesh_stats(&mesh), mesh_stats(&s.mesh));
        assert_eq!(
            (was.components, was.non_manifold_edges),
            (is.components, is.non_manifold_edges),
            "{seed}"
        );
        assert_manifold(&s.mesh);
        let characteristic = |m: &TriMesh, border: usize| {
            2 * m.positions.len() as i64 - m.triangles.len() as i64 - border as i64
        };
        let (a, b) = (characteristic(&mesh, was.boundary_edges), characteristic(&s.mesh, is.boundary_edges));
        assert_eq!(a, b, "{seed}");
        let found = hausdorff(&mesh, &s.mesh);
        assert!(found <= 1.1 * 0.008, "{seed}: {found}");
        assert!(s.report.max_distance <= 0.008 && s.report.deviations[0] <= 0.1001, "{:?}", s.report);
        assert!((area(&s.mesh) / area(&mesh) - 1.0).abs() < 0.1);
        before += mesh.triangles.len();
        after += s.mesh.triangles.len();
    }
    assert!(after < before * 6 / 10, "{after} of {before}");
}

/// A furnished room as it is reconstructed: with noise, and without what nobody saw.
fn scanned_room(seed: u64) -> TriMesh {
    let voxel = 1.0 / 48.0;
    let to_box = |p: Vec3A, low: Vec3A, high: Vec3A| (p - (low + high) * 0.5).abs() - (high - low) * 0.5;
    let solid = |q: Vec3A| q.max(Vec3A::ZERO).length() + q.max_element().min(0.0);
    let field = |p: Vec3A| {
        let air = -solid(to_box(p, Vec3A::splat(0.08), Vec3A::new(0.92, 0.85, 0.7)));
        let table = solid(to_box(p, Vec3A::new(0.3, 0.3, 0.05), Vec3A::new(0.6, 0.7, 0.3)));
        let lamp = p.distance(Vec3A::new(0.7, 0.5, 0.6)) - 0.12;
        0.2 * voxel * noise(p) - air.min(table).min(lamp)
    };
    let mut mesh = march(&grid(48, 1.0, field), 0.0).unwrap();
    let mut rng = Rng::new(seed, 2, 0);
    let unseen: Vec<Vec3A> =
        (0..12).map(|_| Vec3A::new(rng.uniform(), rng.uniform(), rng.uniform())).collect();
    let seen: Vec<[u32; 3]> = (0..mesh.triangles.len())
        .filter(|&t| unseen.iter().all(|u| mesh.corners(t)[0].distance(*u) > 0.1))
        .map(|t| mesh.triangles[t])
        .collect();
    mesh.triangles = seen;
    mesh.drop_unused_vertices();
    mesh
}

#[test]
fn scanned_rooms_lose_most_triangles_and_nothing_else() {
    for seed in 0..3 {
        let room = scanned_room(seed);
        let tolerance = 0.25 / 48.0;
        let s = simplify(&room, &[], tolerance).unwrap();
        let (was, is) = (mesh_stats(&room), mesh_stats(&s.mesh));
        assert!(was.boundary_edges > 100 && is.non_manifold_edges == 0 && is.components == was.components);
        assert!(is.triangles < was.triangles * 4 / 10, "{:?}", s.report);
        let found = hausdorff(&room, &s.mesh);
        assert!(found <= 1.1 * tolerance, "{seed}: {found}");
        assert!(s.report.max_distance <= tolerance && found <= 1.2 * s.report.max_distance);
        assert!((is.area / was.area - 1.0).abs() < 0.05);
    }
}

#[test]
fn parts_of_a_large_mesh_fit_together() {
    let centre = Vec3A::splat(0.5);
    let wavy = |p: Vec3A| 0.4 - p.distance(centre) + 0.004 * (40.0 * p.x).sin() * (40.0 * p.y).sin();
    let mesh = march(&grid(80, 1.0, wavy), 0.0).unwrap();
    assert!(mesh.triangles.len() > 30_000, "several cubes' worth: {}", mesh.triangles.len());
    let heat: Vec<f32> = mesh.positions.iter().map(|p| (12.0 * p[2]).sin()).collect();
    let column = Column { values: &heat, dim: 1, tolerance: 0.05 };
    let s = simplify(&mesh, &[column], 0.002).unwrap();
    assert_eq!(assert_manifold(&s.mesh), 0);
    assert_eq!(euler_characteristic(&s.mesh), 2);
    assert!(s.mesh.triangles.len() < mesh.triangles.len() / 4, "{:?}", s.report);
    assert!(hausdorff(&mesh, &s.mesh) <= 1.05 * 0.002);
    assert!(s.report.deviations[0] <= 0.05001);
}

#[test]
fn nothing_vanishes_whatever_the_tolerance() {
    let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let simplex = |triangles: &[[u32; 3]]| TriMesh { positions: corners.into(), triangles: triangles.into() };
    let solid = simplex(&[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]);
    for mesh in [&solid, &cuboid(3, [1.0; 3]), &bumpy(2, 0.33)] {
        let s = simplify(mesh, &[], 10.0).unwrap();
        assert_eq!(assert_manifold(&s.mesh), 0);
        assert_eq!(euler_characteristic(&s.mesh), 2);
        assert!(s.mesh.triangles.len() >= 4);
    }
    for mesh in [simplex(&[[0, 1, 2]]), sheet(4, |_, _| 0.0)] {
        let s = simplify(&mesh, &[], 10.0).unwrap();
        assert!(!s.mesh.triangles.is_empty() && assert_manifold(&s.mesh) >= 3);
    }
}

#[test]
fn both_sides_of_a_thin_plate_stay_apart() {
    for thickness in [1e-3, 1e-5] {
        let plate = cuboid(10, [1.0, 1.0, thickness]);
        let s = simplify(&plate, &[], 0.02).unwrap();
        assert_eq!(assert_manifold(&s.mesh), 0);
        assert_eq!(euler_characteristic(&s.mesh), 2);
    }
}

#[test]
fn a_border_stays_in_its_place() {
    let sheet = sheet(32, |x, y| 0.02 * ((9.0 * x).sin() + (7.0 * y).cos()));
    let s = simplify(&sheet, &[], 0.004).unwrap();
    assert!(s.mesh.triangles.len() < sheet.triangles.len() / 4, "{:?}", s.report);
    assert!(hausdorff(&sheet, &s.mesh) <= 0.0044);
    assert!(assert_manifold(&s.mesh) >= 4);
    for corner in [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]] {
        assert!(s.mesh.positions.iter().any(|p| [p[0], p[1]] == corner));
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let mesh = bumpy(3, 0.33);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| simplify(&mesh, &[], 0.006).unwrap())
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn without_a_tolerance_or_triangles_nothing_changes() {
    let mesh = bumpy(1, 0.33);
    let values = vec![0.5; mesh.positions.len()];
    let s = simplify(&mesh, &[Column { values: &values, dim: 1, tolerance: 0.1 }], 0.0).unwrap();
    assert_eq!((&s.mesh, s.report.triangles_after), (&mesh, mesh.triangles.len()));
    assert_eq!(s.kept_vertices, (0..mesh.positions.len() as u32).collect::<Vec<_>>());
    assert_eq!(simplify(&TriMesh::default(), &[], 0.1).unwrap().mesh, TriMesh::default());
}

#[test]
fn what_makes_no_sense_is_refused() {
    let mesh = sheet(2, |_, _| 0.0);
    let values = vec![0.5; mesh.positions.len()];
    for tolerance in [-1.0, f32::NAN, f32::INFINITY] {
        assert!(matches!(simplify(&mesh, &[], tolerance), Err(ExtractError::Invalid { .. })));
        let column = Column { values: &values, dim: 1, tolerance };
        assert!(matches!(simplify(&mesh, &[column], 0.1), Err(ExtractError::Invalid { .. })));
    }
    let short = Column { values: &values[1..], dim: 1, tolerance: 0.1 };
    assert!(matches!(simplify(&mesh, &[short], 0.1), Err(ExtractError::Length { .. })));
    let mut broken = values.clone();
    broken[3] = f32::NAN;
    let broken = simplify(&mesh, &[Column { values: &broken, dim: 1, tolerance: 0.1 }], 0.1);
    assert!(matches!(broken, Err(ExtractError::NonFinite { index: 3, .. })));
    let mut lost = mesh.clone();
    lost.positions[2][1] = f32::INFINITY;
    assert!(matches!(simplify(&lost, &[], 0.1), Err(ExtractError::NonFinite { index: 2, .. })));
    lost.positions.truncate(2);
    assert!(matches!(simplify(&lost, &[], 0.1), Err(ExtractError::Invalid { .. })));
}

#[test]
fn degenerate_triangles_survive_without_harm() {
    let sheet = sheet(12, |x, y| 0.01 * (20.0 * x * y).sin());
    let last = sheet.positions.len() as u32 - 1;
    let extra: [&[[u32; 3]]; 5] = [
        &[[0, 0, 0], [3, 3, 4]],            // repeated corners
        &[[0, 1, 2], [0, 13, 26]],          // collinear corners
        &[[40, 41, last], [40, 41, 0]],     // edges with three and four triangles
        &[[14, 28, 15], [14, 15, 28]],      // one that is there already, both ways round
        &[[last, 0, last - 1], [5, 70, 9]], // long ones that cut through
    ];
    for triangles in extra {
        let mut mesh = sheet.clone();
        mesh.triangles.extend(triangles);
        let s = simplify(&mesh, &[], 0.005).unwrap();
        assert!(hausdorff(&mesh, &s.mesh) <= 0.0055, "{triangles:?}");
        let flat = |t: &[u32; 3]| t[0] == t[1] || t[1] == t[2] || t[2] == t[0];
        let count = |m: &TriMesh| m.triangles.iter().filter(|t| flat(t)).count();
        assert_eq!(count(&mesh), count(&s.mesh));
    }
    // Every vertex twice in its place, no two triangles joined.
    let soup: Vec<[f32; 3]> =
        sheet.triangles.iter().flatten().map(|&v| sheet.positions[v as usize]).collect();
    let soup = TriMesh {
        triangles: (0..soup.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
        positions: soup,
    };
    assert_eq!(simplify(&soup, &[], 0.005).unwrap().mesh.triangles.len(), soup.triangles.len());
    // All in one point, and all on one line.
    for place in [|_| [1.0; 3], |p: [f32; 3]| [p[0], p[0], p[0]]] {
        let mesh =
            TriMesh { positions: sheet.positions.iter().map(|&p| place(p)).collect(), ..sheet.clone() };
        assert_eq!(simplify(&mesh, &[], 0.005).unwrap().mesh.triangles.len(), mesh.triangles.len());
    }
}

#[test]
fn random_triangles_never_panic() {
    for seed in 0..60 {
        let mut rng = Rng::new(seed, 1, 0);
        let vertices = 4 + rng.below(30);
        // On a coarse grid every other time, for exact coincidences.
        let steps = if seed % 2 == 0 { 4.0 } else { 4096.0 };
        let mut x = || (rng.uniform() * steps).round() / steps;
        let positions: Vec<[f32; 3]> = (0..vertices).map(|_| [x(), x(), x()]).collect();
        let triangles = (0..3 * vertices).map(|_| [0; 3].map(|_| rng.below(vertices) as u32)).collect();
        let mesh = TriMesh { positions, triangles };
        let s = simplify(&mesh, &[], 0.1).unwrap();
        assert!(s.report.max_distance <= 0.1, "{seed}: {}", s.report.max_distance);
    }
}

#[test]
fn far_from_the_origin_and_at_any_scale_it_is_the_same_room() {
    for (scale, shift) in [(1.0, 1e4), (1e-4, 0.0), (1e5, 0.0), (1.0, 1e6), (1e-12, 0.0), (1e18, 0.0)] {
        let mut mesh = cuboid(8, [4.0, 3.0, 2.5]);
        for x in mesh.positions.as_flattened_mut() {
            *x = *x * scale + shift;
        }
        let s = simplify(&mesh, &[], 0.02 * scale).unwrap();
        let (was, is) = (mesh_stats(&mesh), mesh_stats(&s.mesh));
        assert_eq!(was.non_manifold_edges + was.boundary_edges, is.non_manifold_edges + is.boundary_edges);
        assert!(s.report.max_distance <= 0.02 * scale);
        if shift <= 1e4 && (1e-6..=1e6).contains(&scale) {
            assert!(s.mesh.triangles.len() < mesh.triangles.len() / 4, "{scale} {shift} {:?}", s.report);
        }
    }
}
