//! Mesh hygiene: floating components, unused vertices, fallback normals, gentle smoothing, statistics.

use glam::Vec3A;
use rayon::prelude::*;

use super::{ExtractError, TriMesh};

/// Which components go.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CleanOptions {
    /// Components with less than this fraction of the largest component's area are dropped.
    pub min_area_fraction: f64,
    /// Components whose bounding box has a shorter diagonal than this are dropped, world units.
    pub min_diagonal: f32,
}

/// What [`remove_small_components`] did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CleanReport {
    /// Components before.
    pub components: usize,
    /// Components dropped.
    pub dropped_components: usize,
    /// Triangles dropped.
    pub dropped_triangles: usize,
    /// For each vertex that is left, its index before: for the caller's own columns.
    pub kept_vertices: Vec<u32>,
}

/// Facts about a mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MeshStats {
    /// Vertices, used or not.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
    /// Parts connected by shared vertices.
    pub components: usize,
    /// Edges with one triangle.
    pub boundary_edges: usize,
    /// Edges with more than two triangles, or two that disagree about the outside.
    pub non_manifold_edges: usize,
    /// Total area, world units squared.
    pub area: f64,
    /// There are triangles, and no boundary or non-manifold edges.
    pub is_watertight: bool,
}

/// Drops the components (triangles connected by shared vertices) that are small by either rule, and all
/// vertices that no triangle uses. What is left keeps its order. The largest component by area always stays.
///
/// # Errors
/// `Invalid` for a fraction outside `[0, 1]` or a negative or NaN diagonal.
pub fn remove_small_components(
    mesh: &mut TriMesh,
    options: &CleanOptions,
) -> Result<CleanReport, ExtractError> {
    let fraction = options.min_area_fraction;
    ExtractError::require((0.0..=1.0).contains(&fraction), "min_area_fraction", fraction, "between 0 and 1")?;
    let diagonal = options.min_diagonal;
    ExtractError::require(diagonal >= 0.0, "min_diagonal", diagonal, "a length from 0")?;

    let roots = component_roots(mesh);
    let parts = measure_components(mesh, &roots);
    let used = |p: &&Component| p.triangles > 0;
    let largest = (0..parts.len()).reduce(|a, b| if parts[b].area > parts[a].area { b } else { a });
    let keep = |root: usize| {
        let part = &parts[root];
        let big =
            part.area >= fraction * largest.map_or(0.0, |l| parts[l].area) && part.diagonal() >= diagonal;
        big || Some(root) == largest
    };
    let triangles = mesh.triangles.len();
    mesh.triangles.retain(|t| keep(roots[t[0] as usize] as usize));
    let components = parts.iter().filter(used).count();
    let kept = (0..parts.len()).filter(|&r| parts[r].triangles > 0 && keep(r)).count();
    Ok(CleanReport {
        components,
        dropped_components: components - kept,
        dropped_triangles: triangles - mesh.triangles.len(),
        kept_vertices: mesh.drop_unused_vertices(),
    })
}

/// For each vertex the smallest vertex of its component.
fn component_roots(mesh: &TriMesh) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for t in &mesh.triangles {
        let a = find_root(&mut parent, t[0]);
        let b = find_root(&mut parent, t[1]);
        let c = find_root(&mut parent, t[2]);
        let least = a.min(b).min(c);
        for root in [a, b, c] {
            parent[root as usize] = least;
        }
    }
    (0..parent.len() as u32).map(|v| find_root(&mut parent, v)).collect()
}

/// Root of `v`, halving the path on the way.
fn find_root(parent: &mut [u32], mut v: u32) -> u32 {
    while parent[v as usize] != v {
        let grandparent = parent[parent[v as usize] as usize];
        parent[v as usize] = grandparent;
        v = grandparent;
    }
    v
}

#[derive(Clone)]
struct Component {
    triangles: usize,
    area: f64,
    min: Vec3A,
    max: Vec3A,
}

impl Component {
    fn diagonal(&self) -> f32 {
        if self.triangles == 0 { 0.0 } else { (self.max - self.min).length() }
    }
}

/// Size of each component, at the index of its root.
fn measure_components(mesh: &TriMesh, roots: &[u32]) -> Vec<Component> {
    let none = Component { triangles: 0, area: 0.0, min: Vec3A::INFINITY, max: Vec3A::NEG_INFINITY };
    let mut parts = vec![none; mesh.positions.len()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let part = &mut parts[roots[triangle[0] as usize] as usize];
        part.triangles += 1;
        part.area += mesh.area(t);
        for p in mesh.corners(t) {
            part.min = part.min.min(p);
            part.max = part.max.max(p);
        }
    }
    parts
}

/// Unit normals from the triangles round each vertex, weighted by area: the fallback where the field has no
/// gradient. A vertex without any area gets +z.
pub fn vertex_normals(mesh: &TriMesh) -> Vec<[f32; 3]> {
    let mut sums = vec![Vec3A::ZERO; mesh.positions.len()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let normal = mesh.area_normal(t);
        for &v in triangle {
            sums[v as usize] += normal;
        }
    }
    // Divide by the largest component first: squares of tiny areas underflow.
    let unit = |n: &Vec3A| (*n / n.abs().max_element()).try_normalize().unwrap_or(Vec3A::Z).to_array();
    sums.par_iter().map(unit).collect()
}

/// Taubin's smoothing (1995): each iteration a shrinking step (λ = 0.5) and an inflating one (μ = −0.53).
///
/// No vertex ends up farther than `max_shift` (world units; half a voxel is the marching's own uncertainty)
/// from where it was, and vertices on a boundary stay, so parts that were cut apart still fit.
pub fn smooth(mesh: &mut TriMesh, iterations: u32, max_shift: f32) {
    if iterations == 0 || mesh.triangles.is_empty() {
        return;
    }
    let neighbours = Neighbours::new(mesh);
    let start: Vec<Vec3A> = mesh.positions.iter().map(|&p| Vec3A::from_array(p)).collect();
    let mut now = start.clone();
    for factor in [0.5, -0.53].repeat(iterations as usize) {
        now = (0..now.len()).into_par_iter().map(|v| neighbours.relaxed(&now, v, factor)).collect();
    }
    for ((out, &p0), p) in mesh.positions.iter_mut().zip(&start).zip(now) {
        *out = (p0 + (p - p0).clamp_length_max(max_shift.max(0.0))).to_array();
    }
}

/// Vertices joined by an edge, as one array with the start of each vertex's part.
struct Neighbours {
    start: Vec<u32>,
    of: Vec<u32>,
    fixed: Vec<bool>,
}

impl Neighbours {
    fn new(mesh: &TriMesh) -> Self {
        let n = mesh.positions.len();
        let edges = sorted_edges(mesh);
        let (mut start, mut of, mut fixed) = (vec![0u32; n + 1], Vec::new(), vec![false; n]);
        let mut pairs = Vec::with_capacity(edges.len());
        for group in edges.chunk_by(|a, b| a >> 1 == b >> 1) {
            let (a, b) = ends(group[0]);
            pairs.extend([(a, b), (b, a)]);
            if group.len() != 2 {
                fixed[a as usize] = true;
                fixed[b as usize] = true;
            }
        }
        pairs.par_sort_unstable();
        for (a, b) in pairs {
            start[a as usize + 1] += 1;
            of.push(b);
        }
        for v in 0..n {
            start[v + 1] += start[v];
        }
        Self { start, of, fixed }
    }

    fn relaxed(&self, now: &[Vec3A], v: usize, factor: f32) -> Vec3A {
        let of = &self.of[self.start[v] as usize..self.start[v + 1] as usize];
        if self.fixed[v] || of.is_empty() {
            return now[v];
        }
        let mean = of.iter().map(|&u| now[u as usize]).sum::<Vec3A>() / of.len() as f32;
        now[v] + factor * (mean - now[v])
    }
}

/// All triangle sides, sorted: the smaller vertex from bit 64, the larger from bit 1, bit 0 = runs from large
/// to small.
fn sorted_edges(mesh: &TriMesh) -> Vec<u128> {
    let key = |a: u32, b: u32| u128::from(a.min(b)) << 64 | u128::from(a.max(b)) << 1 | u128::from(a > b);
    let sides = |t: &[u32; 3]| [key(t[0], t[1]), key(t[1], t[2]), key(t[2], t[0])];
    let mut edges: Vec<u128> = mesh.triangles.par_iter().flat_map_iter(sides).collect();
    edges.par_sort_unstable();
    edges
}

fn ends(edge: u128) -> (u32, u32) {
    ((edge >> 64) as u32, (edge >> 1) as u32)
}

/// Facts about a mesh.
pub fn mesh_stats(mesh: &TriMesh) -> MeshStats {
    let edges = sorted_edges(mesh);
    let (mut boundary_edges, mut non_manifold_edges) = (0, 0);
    for group in edges.chunk_by(|a, b| a >> 1 == b >> 1) {
        match group {
            [_] => boundary_edges += 1,
            [a, b] if a != b => {}
            _ => non_manifold_edges += 1,
        }
    }
    let roots = component_roots(mesh);
    let mut used = vec![false; mesh.positions.len()];
    mesh.triangles.iter().for_each(|t| used[roots[t[0] as usize] as usize] = true);
    MeshStats {
        vertices: mesh.positions.len(),
        triangles: mesh.triangles.len(),
        components: used.iter().filter(|&&u| u).count(),
        boundary_edges,
        non_manifold_edges,
        area: (0..mesh.triangles.len()).map(|t| mesh.area(t)).sum(),
        is_watertight: !mesh.triangles.is_empty() && boundary_edges + non_manifold_edges == 0,
    }
}

#[cfg(test)]
mod tests {
    use super::super::march;
    use super::super::testing::{assert_manifold, grid};
    use super::*;

    fn spheres() -> TriMesh {
        let ball = |p: Vec3A, c: [f32; 3], r: f32| r - p.distance(Vec3A::from_array(c));
        let field = |p: Vec3A| ball(p, [0.4, 0.4, 0.4], 0.3).max(ball(p, [0.85, 0.85, 0.85], 0.08));
        march(&grid(40, 1.0, field), 0.0).unwrap()
    }

    #[test]
    fn small_components_go_by_area_or_by_diagonal_and_the_largest_stays() {
        let all = mesh_stats(&spheres());
        assert_eq!((all.components, all.is_watertight), (2, true));
        // Area ratio (0.08/0.3)² = 0.071; diagonal of the small one 0.16·√3 = 0.277.
        for (min_area_fraction, min_diagonal, left) in
            [(0.05, 0.2, 2), (0.1, 0.0, 1), (0.0, 0.3, 1), (0.0, 9.0, 1), (1.0, 0.0, 1)]
        {
            let mut mesh = spheres();
            let report =
                remove_small_components(&mut mesh, &CleanOptions { min_area_fraction, min_diagonal })
                    .unwrap();
            assert_eq!((report.components, report.dropped_components), (2, 2 - left));
            assert_eq!(mesh_stats(&mesh).components, left);
            assert_eq!(report.kept_vertices.len(), mesh.positions.len());
            assert_eq!(assert_manifold(&mesh), 0);
            if left == 1 {
                assert!((mesh.signed_volume() - 4.0 / 3.0 * std::f64::consts::PI * 0.027).abs() < 1e-3);
            }
        }
        let bad = CleanOptions { min_area_fraction: f64::NAN, min_diagonal: 0.0 };
        assert!(remove_small_components(&mut spheres(), &bad).is_err());
        let none = CleanOptions { min_area_fraction: 0.1, min_diagonal: 0.1 };
        assert_eq!(remove_small_components(&mut TriMesh::default(), &none).unwrap().components, 0);
    }

    #[test]
    fn stats_count_boundaries_and_bad_edges() {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
        let fan = |triangles: &[[u32; 3]]| {
            mesh_stats(&TriMesh { positions: positions.clone(), triangles: triangles.to_vec() })
        };
        assert_eq!(fan(&[[0, 1, 2]]).boundary_edges, 3);
        assert_eq!(fan(&[[0, 1, 2], [1, 0, 3]]).boundary_edges, 4);
        let disagree = fan(&[[0, 1, 2], [0, 1, 3]]);
        assert_eq!((disagree.boundary_edges, disagree.non_manifold_edges), (4, 1));
        assert_eq!(fan(&[[0, 1, 2], [1, 0, 3], [0, 1, 4]]).non_manifold_edges, 1);
        assert!(!fan(&[]).is_watertight);
    }

    #[test]
    fn normals_of_a_sphere_are_radial() {
        let mut mesh = spheres();
        remove_small_components(&mut mesh, &CleanOptions { min_area_fraction: 0.1, min_diagonal: 0.0 })
            .unwrap();
        for (p, n) in mesh.positions.iter().zip(vertex_normals(&mesh)) {
            let radial = (Vec3A::from_array(*p) - 0.4).normalize();
            assert!(radial.dot(Vec3A::from_array(n)) > 0.98, "{p:?} {n:?}");
        }
        let line = TriMesh { positions: vec![[1.0; 3]; 3], triangles: vec![[0, 1, 2]] };
        assert_eq!(vertex_normals(&line), vec![[0.0, 0.0, 1.0]; 3]);
    }

    #[test]
    fn smoothing_reduces_noise_and_stays_within_its_bound() {
        let voxel = 1.0 / 40.0;
        let rough =
            |p: Vec3A| 0.3 - p.distance(Vec3A::splat(0.5)) + 0.3 * voxel * super::super::testing::noise(p);
        let before = march(&grid(40, 1.0, rough), 0.0).unwrap();
        let mut after = before.clone();
        smooth(&mut after, 5, voxel / 2.0);
        let rms = |m: &TriMesh| {
            let error = |p: &[f32; 3]| (Vec3A::from_array(*p).distance(Vec3A::splat(0.5)) - 0.3).powi(2);
            (m.positions.iter().map(error).sum::<f32>() / m.positions.len() as f32).sqrt()
        };
        assert!(rms(&after) < 0.75 * rms(&before), "{} {}", rms(&before), rms(&after));
        let shift = |(a, b): (&[f32; 3], &[f32; 3])| Vec3A::from_array(*a).distance(Vec3A::from_array(*b));
        assert!(before.positions.iter().zip(&after.positions).all(|x| shift(x) <= voxel / 2.0 + 1e-6));
        assert!((after.signed_volume() / before.signed_volume() - 1.0).abs() < 0.01, "no shrinking");
        let open =
            march(&grid(16, 1.0, |p| 0.5 - p.z + 0.01 * super::super::testing::noise(p)), 0.0).unwrap();
        let mut flat = open.clone();
        smooth(&mut flat, 3, 0.02);
        let border = |p: &[f32; 3]| p[0] < 1e-6 || p[0] > 1.0 - 1e-6;
        assert!(open.positions.iter().zip(&flat.positions).all(|(a, b)| !border(a) || a == b));
    }
}
