//! The hierarchy over points and triangles that lie in rows, in planes, on lattices and on each other.

use glam::Vec3;

use crate::bvh::TriangleBvh;
use crate::rng::Rng;

/// A point as a triangle.
fn point(p: Vec3) -> [Vec3; 3] {
    [p; 3]
}

/// Checks the nearest of `triangles`, whose corners are the surface, against all of them.
fn check_points(points: &[Vec3], what: &str) {
    let bvh = TriangleBvh::new(points.len(), |i| point(points[i]));
    let mut rng = Rng::new(1, 0, 0);
    let size = points.iter().fold(1e-30f32, |m, p| m.max(p.abs().max_element()));
    for _ in 0..100 {
        let query = Vec3::from([0; 3].map(|_| size * (2.0 * rng.uniform() - 1.0)));
        for query in [query, points[rng.below(points.len())]] {
            let truth = points.iter().map(|p| p.distance(query)).fold(f32::INFINITY, f32::min);
            let found = bvh.nearest(query).unwrap_or_else(|| panic!("{what}: nothing is near {query}"));
            assert!((found.distance - truth).abs() <= 1e-5 * size, "{what}: {found:?} is not at {truth}");
            let named = points[found.triangle as usize].distance(query);
            assert!((named - truth).abs() <= 1e-5 * size, "{what}: {found:?} is at {named}");
        }
        assert!(bvh.first_hit(query, Vec3::X, 0.0, f32::MAX).is_none(), "{what}: a point has no area");
    }
}

#[test]
fn points_in_rows_in_planes_on_lattices_and_on_each_other() {
    let numbers = |n: usize| (0..n).map(|k| k as f32);
    check_points(&numbers(3000).map(|k| Vec3::new(1.0, 2.0, 3.0) * k).collect::<Vec<_>>(), "a diagonal row");
    check_points(&numbers(3000).map(|k| Vec3::X * (k / 7.0).floor()).collect::<Vec<_>>(), "a row of sevens");
    let lattice = |depth: usize| -> Vec<Vec3> {
        (0..depth * 400).map(|n| Vec3::new((n % 20) as f32, (n / 20 % 20) as f32, (n / 400) as f32)).collect()
    };
    check_points(&lattice(1), "a plane");
    check_points(&lattice(10), "a lattice");
    check_points(&[lattice(3), lattice(3), lattice(3)].concat(), "a lattice three times");
    check_points(&vec![Vec3::new(0.1, -0.2, 0.3); 5000], "one point");
    // Each half as far as the one before: a tree by area alone would be as deep as there are points.
    check_points(&numbers(140).map(|k| Vec3::Y * (-k).exp2()).collect::<Vec<_>>(), "a halving row");
    let halving: Vec<Vec3> = numbers(140).flat_map(|k| [Vec3::splat((-k).exp2()); 40]).collect();
    check_points(&halving, "a halving row of forties");
}

#[test]
fn points_of_any_size_and_ratio_of_axes() {
    let mut rng = Rng::new(2, 0, 0);
    for size in [1e-15f32, 1e-6, 1.0, 1e6, 1e15] {
        for flat in [1.0, 1e-6, 0.0] {
            let scale = Vec3::new(size, size * flat, size);
            let random = || scale * Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
            let points: Vec<Vec3> = std::iter::repeat_with(random).take(800).collect();
            check_points(&points, &format!("size {size:e}, flattened to {flat:e}"));
        }
    }
}

/// A wall of squares, aligned with the axes: rays through its lattice lines and shared edges, not through its rim, hit it.
#[test]
fn rays_along_the_lattice_of_a_wall_hit_it() {
    let square = |n: usize| Vec3::new((n / 2 % 16) as f32, (n / 32) as f32, 4.0);
    let corner = |n: usize, x: f32, y: f32| square(n) + Vec3::new(x, y, 0.0);
    let wall = |n: usize| match n % 2 {
        0 => [corner(n, 0.0, 0.0), corner(n, 1.0, 0.0), corner(n, 1.0, 1.0)],
        _ => [corner(n, 0.0, 0.0), corner(n, 1.0, 1.0), corner(n, 0.0, 1.0)],
    };
    let bvh = TriangleBvh::new(512, wall);
    for y in 1..64 {
        for x in 1..64 {
            let origin = Vec3::new(x as f32 / 4.0, y as f32 / 4.0, 0.0);
            let hit = bvh.first_hit(origin, Vec3::Z, 0.0, f32::MAX);
            assert!(hit.is_some_and(|h| h.t == 4.0), "{origin}: {hit:?}");
            // Along the wall and away from it.
            assert!(bvh.first_hit(origin, Vec3::X, 0.0, f32::MAX).is_none());
            assert!(bvh.first_hit(origin, -Vec3::Z, 0.0, f32::MAX).is_none());
        }
    }
}

#[test]
fn slivers_are_no_farther_than_their_edges() {
    // Collinear corners on a lattice of thirds: their area is nothing but rounding.
    let mut rng = Rng::new(5, 0, 0);
    for _ in 0..20_000 {
        let mut lattice = || Vec3::from([0; 3].map(|_| (rng.uniform() * 4.0).floor() / 12.0));
        let (a, step) = (lattice(), lattice());
        let corners = [a, a + step, a + step * 2.0];
        let p = a.lerp(corners[2], rng.uniform());
        let distance = TriangleBvh::new(1, |_| corners).nearest(p).unwrap().distance;
        assert!(distance < 1e-6, "{distance} from {p} to {corners:?}");
    }
}

#[test]
fn what_is_within_is_what_the_nearest_point_says() {
    let mut rng = Rng::new(3, 0, 0);
    let point = |rng: &mut Rng| Vec3::from([0; 3].map(|_| rng.uniform()));
    let triangles: Vec<[Vec3; 3]> = (0..500)
        .map(|_| {
            let p = point(&mut rng);
            [p, p + 0.2 * point(&mut rng), p + 0.2 * point(&mut rng)]
        })
        .collect();
    let bvh = TriangleBvh::new(triangles.len(), |i| triangles[i]);
    let mut inside = 0;
    for _ in 0..2000 {
        let (p, limit) = (point(&mut rng) * 1.4 - 0.2, 0.2 * rng.uniform());
        let distance = bvh.nearest(p).unwrap().distance;
        inside += usize::from(distance <= limit);
        // Squares may round to either side of the limit.
        if (distance - limit).abs() > 1e-6 {
            assert_eq!(bvh.within(p, limit), distance <= limit, "{p}");
        }
    }
    assert!((200..1800).contains(&inside), "the test must see both: {inside}");
    assert!(!TriangleBvh::new(0, |_| [Vec3::ZERO; 3]).within(Vec3::ZERO, 1.0));
}
