//! Analytic fields and mesh checks that the tests of this area share.

use std::collections::{HashMap, HashSet};

use glam::Vec3A;

use super::{GridSpec, SparseGrid, TriMesh};

/// A grid of `n`³ cells over `[0, size]³`, all blocks evaluated.
pub(crate) fn grid(n: u32, size: f64, field: impl Fn(Vec3A) -> f32 + Sync) -> SparseGrid {
    grid_where(n, size, &|_, _| true, field)
}

/// As [`grid`], only where the predicate holds.
pub(crate) fn grid_where(
    n: u32,
    size: f64,
    may_hold: &(dyn Fn(Vec3A, f32) -> bool + Sync),
    field: impl Fn(Vec3A) -> f32 + Sync,
) -> SparseGrid {
    let spec = GridSpec::new([0.0; 3], [n; 3], size / f64::from(n));
    SparseGrid::sample(&spec, may_hold, &|points, out| {
        points.iter().zip(out).for_each(|(&p, v)| *v = field(p));
    })
    .unwrap()
}

/// Same numbers for the same point, no structure.
pub(crate) fn noise(p: Vec3A) -> f32 {
    let mut h = 0x9e37_79b9u32;
    for v in p.to_array() {
        h = (h ^ v.to_bits()).wrapping_mul(0x85eb_ca6b);
        h ^= h >> 13;
    }
    (h >> 8) as f32 / (1 << 24) as f32 - 0.5
}

/// How many triangles use each directed edge.
fn directed_edges(mesh: &TriMesh) -> HashMap<(u32, u32), u32> {
    let mut edges = HashMap::new();
    for t in &mesh.triangles {
        for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
            *edges.entry((a, b)).or_insert(0) += 1;
        }
    }
    edges
}

/// Panics unless every edge has one triangle a side at most, consistently oriented, all vertices are used and
/// distinct, and no triangle is degenerate. Returns the number of boundary edges.
pub(crate) fn assert_manifold(mesh: &TriMesh) -> usize {
    let edges = directed_edges(mesh);
    assert!(edges.values().all(|&n| n == 1), "a directed edge has one triangle");
    let used: HashSet<u32> = mesh.triangles.iter().flatten().copied().collect();
    assert_eq!(used.len(), mesh.positions.len(), "all vertices are used");
    let places: HashSet<[u32; 3]> = mesh.positions.iter().map(|p| p.map(f32::to_bits)).collect();
    assert_eq!(places.len(), mesh.positions.len(), "no two vertices in one place");
    for t in 0..mesh.triangles.len() {
        assert!(mesh.area(t) > 0.0, "triangle {t} is degenerate: {:?}", mesh.corners(t));
    }
    edges.keys().filter(|(a, b)| !edges.contains_key(&(*b, *a))).count()
}

/// V − E + F of a closed mesh.
pub(crate) fn euler_characteristic(mesh: &TriMesh) -> i64 {
    mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2
}

/// Total area.
pub(crate) fn area(mesh: &TriMesh) -> f64 {
    (0..mesh.triangles.len()).map(|t| mesh.area(t)).sum()
}

/// Triangles by the exact positions of their corners, rotated to a canonical first corner.
pub(crate) fn soup(mesh: &TriMesh, scale: f32) -> HashSet<[[u32; 3]; 3]> {
    let key = |t: &[u32; 3]| {
        let mut t = t.map(|v| mesh.positions[v as usize].map(|c| (c * scale).to_bits()));
        let least = (0..3).min_by_key(|&i| t[i]).unwrap();
        t.rotate_left(least);
        t
    };
    mesh.triangles.iter().map(key).collect()
}
