//! Marching cubes on a dense grid, for grids that are all there.
//!
//! The same surface as [`super::march`] makes, from rows of 64-bit masks: one bit per corner, so that 64
//! cells are dismissed with a few instructions and only cells on the surface cost anything. Three passes over
//! the layers, each in parallel: bits; counts, whose running sums say where every row's vertices and every
//! layer's triangles go; and the output, which is written once, where it stays.

pub(super) mod bits;
mod cells;
mod rows;

use pulp::Arch;
use rayon::prelude::*;

use self::bits::Inside;
use self::rows::{Layout, WriteLayer};
use super::march::{check_vertex_count, split};
use super::{ExtractError, TriMesh};

/// Extracts the surface `value = iso` (greater is inside) of a dense grid, in units of a cell.
///
/// `values` `[dims[0] * dims[1] * dims[2]]` at the corners, x fastest. The surface is open where it leaves
/// the grid.
///
/// # Errors
/// `Length` where `values` does not fit `dims`, `NonFinite` ("march_dense") with the index of the value,
/// `TooLarge` for more than 2³² vertices.
pub fn march_dense(values: &[f32], dims: [usize; 3], iso: f32) -> Result<TriMesh, ExtractError> {
    ExtractError::require(iso.is_finite(), "iso", iso, "finite")?;
    let count = dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).unwrap_or(usize::MAX);
    ExtractError::same_length(|| format!("a dense grid of {dims:?}"), count, values.len())?;
    if dims.iter().any(|&d| d < 2) {
        return Ok(TriMesh::default());
    }
    let arch = Arch::new();
    let inside = Inside::new(arch, values, dims, iso)?;
    let (layout, sizes) = Layout::new(arch, &inside);
    let [vertices, triangles] = [0, 1].map(|kind| sizes.iter().map(|s| s[kind]).sum());
    check_vertex_count(vertices)?;

    // Zeroed by the system, page by page, when a thread first writes there.
    let mut mesh = TriMesh { positions: vec![[0.0; 3]; vertices], triangles: vec![[0; 3]; triangles] };
    let positions = split(&mut mesh.positions, sizes.iter().map(|s| s[0]));
    let triangles = split(&mut mesh.triangles, sizes.iter().map(|s| s[1]));
    positions.into_par_iter().zip(triangles).enumerate().for_each(|(z, (positions, triangles))| {
        arch.dispatch(WriteLayer { values, iso, inside: &inside, layout: &layout, z, positions, triangles });
    });
    Ok(mesh)
}
