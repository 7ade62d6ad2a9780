//! Fewer triangles within a stated error.
//!
//! ```text
//! triangles ─ regions (patches: height fields over a plane)
//!               └─ patches (constrained Delaunay triangulation of each rim: sheet; greedy insertion: refine)
//!                    └─ passes (edges collapse, cubes of the surface at a time)
//! ```
//!
//! The vertices that are left are some of the mesh's own, so their attributes stay as they are. Patches and cubes are worked
//! on apart, and each keeps its rim, so a closed mesh stays closed, and a manifold one manifold; the next pass has its rims
//! elsewhere. At every step each triangle knows which samples of the original (vertices, middles of sides, centres) lie over
//! it, and a step is only taken if these stay within the tolerance of it, and the places of its raster within the tolerance
//! of the original: that both surfaces are close to each other need not be repaired afterwards, only measured.

mod collapse;
mod columns;
mod cover;
mod measure;
mod overlaps;
mod passes;
mod patches;
mod quadric;
mod refine;
mod regions;
mod scene;
mod sheet;
#[cfg(test)]
mod tests;
mod topology;

pub use self::columns::Column;
use self::columns::Rows;
use super::{ExtractError, TriMesh};

/// A mesh with fewer triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct Simplified {
    /// Triangles over the vertices that are left, which keep their order.
    pub mesh: TriMesh,
    /// For each vertex that is left, its index before: for the caller's own columns.
    pub kept_vertices: Vec<u32>,
    /// What was done, and how exact it is.
    pub report: SimplifyReport,
}

/// What [`simplify`] did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SimplifyReport {
    /// Triangles before.
    pub triangles_before: usize,
    /// Triangles after.
    pub triangles_after: usize,
    /// Patches that the mesh was divided into.
    pub patches: usize,
    /// Patches among them that were left to the collapses alone: too small, or not to be triangulated within the tolerances.
    pub kept_patches: usize,
    /// Largest distance found between the two surfaces, looked at from both sides, world units.
    pub max_distance: f32,
    /// For each column the largest deviation at any of the original's vertices, in the column's own units.
    pub deviations: Vec<f32>,
}

/// Simplifies a mesh so that neither surface is farther than `tolerance` (world units) from the other, and every
/// attribute stays within its own tolerance of what the new triangles interpolate at the original's vertices.
///
/// With a tolerance of 0 the mesh is returned as it is. Results are the same for any number of threads.
///
/// # Errors
/// `Invalid` for a tolerance or a column that makes no sense or a triangle without its vertices, `Length` for a column
/// of another length, `NonFinite` for positions and attributes (by index) that are not finite.
pub fn simplify(mesh: &TriMesh, columns: &[Column], tolerance: f32) -> Result<Simplified, ExtractError> {
    simplify_watched(mesh, columns, tolerance, &mut |_| {})
}

/// As [`simplify`]; `progress` hears the share of the work that is done, from time to time.
///
/// # Errors
/// Those of [`simplify`].
pub fn simplify_watched(
    mesh: &TriMesh,
    columns: &[Column],
    tolerance: f32,
    progress: &mut dyn FnMut(f32),
) -> Result<Simplified, ExtractError> {
    let sane = tolerance.is_finite() && tolerance >= 0.0;
    ExtractError::require(sane, "simplification tolerance", tolerance, "a length from 0")?;
    if let Some(index) = mesh.positions.iter().position(|p| p.iter().any(|x| !x.is_finite())) {
        return Err(ExtractError::NonFinite { stage: "simplify (positions)", index });
    }
    let vertices = mesh.positions.len();
    let stray = mesh.triangles.iter().flatten().find(|&&v| v as usize >= vertices);
    ExtractError::require(stray.is_none(), "vertex of a triangle", stray, "one of the mesh's")?;
    let rows = Rows::new(columns, vertices)?;
    if tolerance == 0.0 || mesh.triangles.is_empty() {
        return Ok(unchanged(mesh, columns.len()));
    }
    Ok(passes::run(mesh, &rows, tolerance, progress))
}

fn unchanged(mesh: &TriMesh, columns: usize) -> Simplified {
    let triangles = mesh.triangles.len();
    Simplified {
        mesh: mesh.clone(),
        kept_vertices: (0..mesh.positions.len() as u32).collect(),
        report: SimplifyReport {
            triangles_before: triangles,
            triangles_after: triangles,
            deviations: vec![0.0; columns],
            ..SimplifyReport::default()
        },
    }
}
