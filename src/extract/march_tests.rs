//! Known surfaces, hostile values, and the agreement of the two marchers.

use std::collections::HashSet;

use glam::{Vec3A, Vec3Swizzles};

use super::testing::{area, assert_manifold, euler_characteristic, grid, grid_where, noise, soup};
use super::{ExtractError, GridSpec, SparseGrid, TriMesh, march, march_dense};

const CENTER: Vec3A = Vec3A::splat(0.5);

fn close(found: f64, expected: f64, relative: f64) {
    assert!((found / expected - 1.0).abs() < relative, "{found} instead of {expected}");
}

fn assert_closed(mesh: &TriMesh, euler: i64) {
    assert_eq!(assert_manifold(mesh), 0, "boundary edges");
    assert_eq!(euler_characteristic(mesh), euler);
}

#[test]
fn sphere_has_its_area_volume_and_euler_characteristic() {
    // The chord error of a linear patch is (h/r)²/8-ish: 1e-3 at 40 cells over a radius of 0.4.
    let mesh = march(&grid(40, 1.0, |p| 0.4 - p.distance(CENTER)), 0.0).unwrap();
    assert_closed(&mesh, 2);
    close(area(&mesh), 4.0 * std::f64::consts::PI * 0.16, 3e-3);
    close(mesh.signed_volume(), 4.0 / 3.0 * std::f64::consts::PI * 0.064, 3e-3);
}

#[test]
fn what_one_grid_does_not_know_another_one_fills_in() {
    let sphere = |p: Vec3A| 0.4 - p.distance(CENTER);
    let left = grid_where(40, 1.0, &|center, half| center.x - half < 0.45, sphere);
    let whole = grid(40, 1.0, |p| 3.0 * sphere(p));
    let filled = left.or(&whole, |v| v / 3.0).unwrap();
    let mesh = march(&filled, 0.0).unwrap();
    assert!(assert_manifold(&march(&left, 0.0).unwrap()) > 0, "half a sphere is open");
    assert_closed(&mesh, 2);
    close(mesh.signed_volume(), 4.0 / 3.0 * std::f64::consts::PI * 0.064, 3e-3);
    // What is known stays, whatever the other grid says.
    let other = grid(40, 1.0, |_| 1.0);
    assert_eq!(whole.or(&other, |v| v).unwrap().value([20; 3]), whole.value([20; 3]));
}

#[test]
fn torus_has_a_hole() {
    let torus = |p: Vec3A| {
        let q = p - CENTER;
        0.12 - glam::vec2(glam::Vec3::from(q).xy().length() - 0.3, q.z).length()
    };
    let mesh = march(&grid(64, 1.0, torus), 0.0).unwrap();
    assert_closed(&mesh, 0);
    let pi2 = std::f64::consts::PI.powi(2);
    close(area(&mesh), 4.0 * pi2 * 0.3 * 0.12, 5e-3);
    close(mesh.signed_volume(), 2.0 * pi2 * 0.3 * 0.12f64.powi(2), 5e-3);
}

#[test]
fn touching_spheres_and_gyroid_are_manifold() {
    let at = |x: f32| Vec3A::new(x, 0.5, 0.5);
    let pair = |p: Vec3A| (0.25 - p.distance(at(0.25))).max(0.25 - p.distance(at(0.75)));
    // Grown by a hair so that the pair stays inside the box.
    let mesh = march(&grid(48, 1.0, move |p| pair((p - CENTER) * 1.1 + CENTER)), 0.0).unwrap();
    assert_eq!(assert_manifold(&mesh), 0);
    let gyroid = |p: Vec3A| {
        let q = p * 20.0;
        q.x.sin() * q.y.cos() + q.y.sin() * q.z.cos() + q.z.sin() * q.x.cos()
    };
    let closed = |p: Vec3A| gyroid(p).min(0.45 - (p - CENTER).abs().max_element());
    assert_eq!(assert_manifold(&march(&grid(40, 1.0, closed), 0.0).unwrap()), 0);
}

#[test]
fn plane_is_exact_and_faces_the_low_side() {
    let mesh = march(&grid(24, 1.2, |p| 0.63 - p.z), 0.0).unwrap();
    assert!(assert_manifold(&mesh) > 0, "open at the box");
    assert!(mesh.positions.iter().all(|p| (p[2] - 0.63).abs() < 1e-6));
    assert!((0..mesh.triangles.len()).all(|t| mesh.area_normal(t).z > 0.0));
    close(area(&mesh), 1.44, 1e-5);
}

#[test]
fn noise_is_manifold_and_closed() {
    let inside = |p: Vec3A| if (p - CENTER).abs().max_element() < 0.46 { noise(p) } else { -1.0 };
    for iso in [-0.3, 0.0, 0.2] {
        let mesh = march(&grid(24, 1.0, inside), iso).unwrap();
        assert!(mesh.triangles.len() > 3000);
        assert_eq!(assert_manifold(&mesh), 0);
    }
}

#[test]
fn values_exactly_at_iso_make_no_degenerate_triangle() {
    assert_eq!(march(&grid(16, 1.0, |_| 0.5), 0.5).unwrap(), TriMesh::default());
    // Three levels, the middle one exactly at iso: every kind of corner touch.
    let levels = |p: Vec3A| ((noise(p) * 3.0).round() * 0.5).clamp(-0.5, 0.5);
    let mesh = march(&grid(20, 1.0, levels), 0.0).unwrap();
    assert!(mesh.triangles.len() > 1000);
    assert_manifold(&mesh);
    let extremes = |p: Vec3A| if noise(p) > 0.0 { f32::MAX } else { -f32::MAX };
    let mesh = march(&grid(8, 1.0, extremes), 0.0).unwrap();
    assert!(mesh.positions.iter().flatten().all(|v| v.is_finite()));
    assert_manifold(&mesh);
}

#[test]
fn nan_and_inf_are_errors_that_name_the_corner() {
    let spec = GridSpec::new([0.0; 3], [20, 12, 9], 1.0);
    let poisoned = |bad: f32, at: Vec3A| {
        SparseGrid::sample(&spec, &|_, _| true, &move |points, out| {
            points.iter().zip(out).for_each(|(&p, v)| *v = if p == at { bad } else { 0.0 });
        })
    };
    let index = (9 * 13 + 8) * 21 + 16;
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let error = poisoned(bad, Vec3A::new(16.0, 8.0, 9.0)).unwrap_err();
        assert_eq!(error, ExtractError::NonFinite { stage: "density grid", index });
        let mut dense = vec![0.0; 1000];
        dense[321] = bad;
        let error = march_dense(&dense, [10; 3], 0.0).unwrap_err();
        assert_eq!(error, ExtractError::NonFinite { stage: "march_dense", index: 321 });
    }
    assert!(march(&poisoned(1.0, Vec3A::ONE).unwrap(), f32::NAN).is_err());
}

#[test]
fn bad_grids_are_refused() {
    let sample = |spec: GridSpec| SparseGrid::sample(&spec, &|_, _| true, &|_, out| out.fill(0.0));
    let good = GridSpec::new([0.0; 3], [8; 3], 0.1);
    assert!(sample(good).is_ok());
    for bad in [
        GridSpec { voxel: 0.0, ..good },
        GridSpec { voxel: f64::NAN, ..good },
        GridSpec { dims: [8, 0, 8], ..good },
        GridSpec { dims: [8, 8, u32::MAX], ..good },
        GridSpec { origin: [0.0, f64::INFINITY, 0.0], ..good },
        GridSpec::covering([0.0; 3], [f64::NAN; 3], 0.1),
    ] {
        assert!(matches!(sample(bad), Err(ExtractError::Invalid { .. })), "{bad:?}");
    }
    let small = GridSpec { dims: [128; 3], max_bytes: 1_000_000, ..good };
    assert!(matches!(sample(small), Err(ExtractError::TooLarge { .. })));
    assert!(march_dense(&[0.0; 7], [2; 3], 0.0).is_err());
}

#[test]
fn nothing_evaluated_is_an_empty_mesh() {
    let sampled = grid_where(32, 1.0, &|_, _| false, |_| 1.0);
    assert_eq!(march(&sampled, 0.0).unwrap(), TriMesh::default());
    let report = sampled.report();
    assert_eq!((report.evaluated_blocks, report.skipped_blocks, report.evaluated_points), (0, 64, 0));
    assert_eq!(march_dense(&[], [0, 4, 4], 0.0).unwrap(), TriMesh::default());
}

#[test]
fn dense_grids_of_every_shape_are_manifold_and_whole() {
    // One cell, rows of less than, exactly and just more than a word, and layers of a single row of cells.
    for dims in [[2, 2, 2], [2, 5, 3], [63, 4, 3], [64, 3, 4], [65, 2, 2], [66, 3, 5], [129, 4, 2]] {
        let [nx, ny, nz]: [usize; 3] = dims;
        let at = |i: usize| [i % nx, i / nx % ny, i / (nx * ny)];
        let value = |i: usize| noise(Vec3A::from_array(at(i).map(|c| c as f32)));
        let values: Vec<f32> = (0..nx * ny * nz).map(value).collect();
        let mesh = march_dense(&values, dims, 0.0).unwrap();
        assert_manifold(&mesh);
        // Every cut edge has its vertex, and no other edge.
        let cut = |i: usize, step: usize| (values[i] > 0.0) != (values[i + step] > 0.0);
        let cuts = |axis: usize| {
            let step = [1, nx, nx * ny][axis];
            (0..values.len()).filter(|i| at(*i)[axis] + 1 < dims[axis] && cut(*i, step)).count()
        };
        assert_eq!(mesh.positions.len(), (0..3).map(cuts).sum::<usize>(), "{dims:?}");
        assert!(mesh.triangles.iter().flatten().all(|v| (*v as usize) < mesh.positions.len()));
    }
}

#[test]
fn sparse_equals_dense_on_the_evaluated_cells() {
    // 70 cells: rows longer than one 64-bit word and a last block that sticks out of the box. The voxel is
    // one, so that both marchers' positions are the same numbers up to one rounding.
    let n = 70usize;
    let field = |p: Vec3A| noise(p) + 0.3 * (p.x * 0.2).sin();
    let dense: Vec<f32> = (0..(n + 1).pow(3))
        .map(|i| {
            field(Vec3A::from_array(
                [i % (n + 1), i / (n + 1) % (n + 1), i / (n + 1).pow(2)].map(|c| c as f32),
            ))
        })
        .collect();
    let from_dense = march_dense(&dense, [n + 1; 3], 0.2).unwrap();
    assert_manifold(&from_dense);
    let all = march(&grid(n as u32, n as f64, field), 0.2).unwrap();
    assert_eq!(all.positions.len(), from_dense.positions.len());
    assert_eq!(soup(&all, 1.0), soup(&from_dense, 1.0));

    let wanted = |c: Vec3A, half: f32| half > 4.0 || noise(c * 3.1) > 0.0;
    let sampled = grid_where(n as u32, n as f64, &wanted, field);
    let report = sampled.report();
    assert!(report.evaluated_blocks > 200 && report.skipped_blocks > 200);
    let part = march(&sampled, 0.2).unwrap();
    assert_manifold(&part);
    let evaluated = |t: &[[u32; 3]; 3]| {
        let middle = t.iter().map(|p| Vec3A::from_array(p.map(f32::from_bits))).sum::<Vec3A>() / 3.0;
        wanted((middle / 8.0).floor() * 8.0 + 4.0, 4.0)
    };
    let expected: HashSet<_> = soup(&from_dense, 1.0).into_iter().filter(evaluated).collect();
    assert_eq!(soup(&part, 1.0), expected);
}

#[test]
fn every_point_is_evaluated_once() {
    let count = std::sync::Mutex::new(std::collections::HashMap::new());
    let wanted = |c: Vec3A, half: f32| half > 4.0 || noise(c) > 0.0;
    let spec = GridSpec::new([0.0; 3], [40; 3], 1.0);
    let sampled = SparseGrid::sample(&spec, &wanted, &|points, out| {
        let mut count = count.lock().unwrap();
        for (p, v) in points.iter().zip(out) {
            *count.entry(p.to_array().map(f32::to_bits)).or_insert(0) += 1;
            *v = noise(*p);
        }
    })
    .unwrap();
    let count = count.into_inner().unwrap();
    assert!(count.values().all(|&n| n == 1));
    assert_eq!(count.len(), sampled.report().evaluated_points);
    for p in count.keys().map(|k| k.map(f32::from_bits)) {
        assert_eq!(sampled.value(p.map(|c| c as u32)), Some(noise(Vec3A::from_array(p))));
    }
}

#[test]
fn result_does_not_depend_on_the_number_of_threads() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let sampled = grid_where(48, 1.0, &|c, half| half > 0.1 || noise(c) > -0.2, noise);
            let dense: Vec<f32> = (0..40usize.pow(3)).map(|i| noise(Vec3A::splat(i as f32))).collect();
            (march(&sampled, 0.1).unwrap(), march_dense(&dense, [40; 3], 0.1).unwrap())
        })
    };
    let one = run(1);
    assert!(!one.0.triangles.is_empty());
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}
