//! Marching cubes on a sparse grid: crack-free across blocks, each vertex made once.
//!
//! Two passes over the blocks, both in parallel and without any map from edges to vertices. First every block
//! turns its corners into bit rows (inside or not), and the cut edges that it owns into bit rows as well; a
//! running count gives every block the number of its first vertex. Then every block writes its own vertices
//! and its cells' triangles: the number of an edge's vertex is its owner's first number, plus the count
//! before that row, plus the cut edges before it in the row (a population count).
//!
//! The surface is watertight and edge-manifold wherever all cells are known and is open at the border of the
//! unknown.

use rayon::prelude::*;

use super::blocks::{BlockSet, CELLS, CORNERS, POINTS};
use super::mc_table::{EDGES, McTable, TABLE};
use super::{ExtractError, SparseGrid, TriMesh};

/// Rows of corners in a block.
const ROWS: usize = CORNERS * CORNERS;
/// Smallest distance of a vertex from the ends of its edge, in edges. With it no triangle degenerates,
/// whatever the values are (even all exactly at the iso-level), and the surface moves by less than 1/500
/// voxel.
const EDGE_MARGIN: f32 = 1.0 / 512.0;

/// Extracts the surface `value = iso`; greater is inside.
///
/// Cells with an unknown corner are left out, so the surface is open there. Vertices and triangles come in
/// block order, then row order.
///
/// # Errors
/// `Invalid` for a non-finite `iso`; `TooLarge` for more than 2³² vertices.
pub fn march(grid: &SparseGrid, iso: f32) -> Result<TriMesh, ExtractError> {
    ExtractError::require(iso.is_finite(), "iso", iso, "finite")?;
    let bits: Vec<BlockBits> = grid.values.par_chunks(POINTS).map(|v| BlockBits::new(v, iso)).collect();
    let mut cuts: Vec<Option<Box<CutEdges>>> =
        (0..bits.len()).into_par_iter().map(|b| CutEdges::new(&bits[b], &grid.blocks, b)).collect();
    let vertices = number_vertices(&mut cuts)?;

    let mut positions = vec![[0.0; 3]; vertices];
    let slices = split_by_block(&mut positions, &cuts);
    slices.into_par_iter().for_each(|(b, out)| write_vertices(grid, iso, b, cuts[b].as_deref(), out));

    let cells = Cells { blocks: &grid.blocks, bits: &bits, cuts: &cuts, table: &TABLE };
    let triangles: Vec<Vec<[u32; 3]>> = (0..bits.len()).into_par_iter().map(|b| cells.triangles(b)).collect();
    let mut mesh = TriMesh { positions, triangles: triangles.concat() };
    if bits.iter().any(|b| b.has_unknown) {
        // An edge between two known corners may lie on unknown cells only.
        mesh.drop_unused_vertices();
    }
    Ok(mesh)
}

/// Where the surface crosses an edge whose ends have the values `a` and `b`, in edges from `a`.
#[inline]
pub(crate) fn crossing(a: f32, b: f32, iso: f32) -> f32 {
    // `max` and `min` instead of `clamp`: they also settle inf/inf, which opposite huge values give.
    #[allow(clippy::manual_clamp)]
    ((iso - a) / (b - a)).max(EDGE_MARGIN).min(1.0 - EDGE_MARGIN)
}

/// The corners of a block as bit rows, bit x = corner x.
struct BlockBits {
    inside: [u16; ROWS],
    known: [u16; ROWS],
    has_unknown: bool,
    /// Both inside and outside corners occur.
    mixed: bool,
}

impl BlockBits {
    fn new(values: &[f32], iso: f32) -> Self {
        let mut bits = Self { inside: [0; ROWS], known: [0; ROWS], has_unknown: false, mixed: false };
        let (mut any, mut all) = (0, 0x1ff);
        for (row, values) in values.chunks_exact(CORNERS).enumerate() {
            let (mut inside, mut known) = (0u16, 0u16);
            for (x, &v) in values.iter().enumerate() {
                inside |= u16::from(v > iso) << x;
                known |= u16::from(!v.is_nan()) << x;
            }
            bits.inside[row] = inside;
            bits.known[row] = known;
            bits.has_unknown |= known != 0x1ff;
            any |= inside;
            all &= inside;
        }
        bits.mixed = any != 0 && all != 0x1ff;
        bits
    }
}

/// The cut edges that a block owns, and their vertices' numbers.
struct CutEdges {
    /// Number of the block's first vertex.
    first: u32,
    count: u16,
    /// Per axis and row: bit x = the edge that starts at corner x is cut and owned.
    rows: [[u16; ROWS]; 3],
    /// Per axis and row: vertices of the block before this row.
    before: [[u16; ROWS]; 3],
}

impl CutEdges {
    fn new(bits: &BlockBits, blocks: &BlockSet, b: usize) -> Option<Box<Self>> {
        if !bits.mixed {
            return None;
        }
        let mut cuts = Box::new(Self { first: 0, count: 0, rows: [[0; ROWS]; 3], before: [[0; ROWS]; 3] });
        for axis in 0..3 {
            for row in 0..ROWS {
                let (y, z) = (row % CORNERS, row / CORNERS);
                let owned = blocks.owned_edges(b, axis, y, z);
                cuts.before[axis][row] = cuts.count;
                if owned == 0 {
                    continue;
                }
                let (inside, known) = match axis {
                    0 => (bits.inside[row] >> 1, bits.known[row] >> 1),
                    1 => (bits.inside[row + 1], bits.known[row + 1]),
                    _ => (bits.inside[row + CORNERS], bits.known[row + CORNERS]),
                };
                let cut = (bits.inside[row] ^ inside) & bits.known[row] & known & owned;
                cuts.rows[axis][row] = cut;
                cuts.count += cut.count_ones() as u16;
            }
        }
        Some(cuts)
    }

    #[inline]
    fn vertex(&self, axis: usize, p: [usize; 3]) -> u32 {
        let row = p[2] * CORNERS + p[1];
        let before_in_row = (self.rows[axis][row] & ((1 << p[0]) - 1)).count_ones();
        self.first + u32::from(self.before[axis][row]) + before_in_row
    }
}

/// Gives every block the number of its first vertex; returns the number of vertices.
fn number_vertices(cuts: &mut [Option<Box<CutEdges>>]) -> Result<usize, ExtractError> {
    let mut total = 0usize;
    for cuts in cuts.iter_mut().flatten() {
        cuts.first = total as u32;
        total += usize::from(cuts.count);
    }
    check_vertex_count(total)?;
    Ok(total)
}

/// # Errors
/// `TooLarge` where vertex numbers would not fit u32.
pub(crate) fn check_vertex_count(total: usize) -> Result<(), ExtractError> {
    if total <= u32::MAX as usize {
        return Ok(());
    }
    let mb = |n: usize| (n as u64 * 12) / 1_000_000;
    Err(ExtractError::TooLarge { what: "the mesh", needed_mb: mb(total), limit_mb: mb(u32::MAX as usize) })
}

/// Splits the vertex array into the blocks' own parts.
fn split_by_block<'a>(
    mut rest: &'a mut [[f32; 3]],
    cuts: &[Option<Box<CutEdges>>],
) -> Vec<(usize, &'a mut [[f32; 3]])> {
    let mut slices = Vec::new();
    for (b, cuts) in cuts.iter().enumerate() {
        let Some(cuts) = cuts else { continue };
        let (head, tail) = rest.split_at_mut(usize::from(cuts.count));
        slices.push((b, head));
        rest = tail;
    }
    slices
}

fn write_vertices(grid: &SparseGrid, iso: f32, b: usize, cuts: Option<&CutEdges>, out: &mut [[f32; 3]]) {
    let Some(cuts) = cuts else { return };
    let values = &grid.values[b * POINTS..(b + 1) * POINTS];
    let first = grid.blocks.coords()[b].map(|c| c as usize * CELLS);
    let mut out = out.iter_mut();
    for axis in 0..3 {
        let step = [1, CORNERS, ROWS][axis];
        for (row, &cut) in cuts.rows[axis].iter().enumerate() {
            for x in set_bits(cut) {
                let i = row * CORNERS + x;
                let mut p = [x, row % CORNERS, row / CORNERS];
                let t = crossing(values[i], values[i + step], iso);
                for a in 0..3 {
                    p[a] += first[a];
                }
                if let Some(out) = out.next() {
                    *out = vertex_position(p, axis, t, grid.spec.voxel);
                }
            }
        }
    }
}

/// The point at `t` along the edge that starts at corner `p` and runs along `axis`.
#[inline]
pub(crate) fn vertex_position(p: [usize; 3], axis: usize, t: f32, voxel: f64) -> [f32; 3] {
    let mut at = p.map(|c| c as f64);
    at[axis] += f64::from(t);
    at.map(|c| (c * voxel) as f32)
}

/// Positions of the set bits, lowest first.
#[inline]
fn set_bits(mut bits: u16) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let x = bits.trailing_zeros();
        bits &= bits.checked_sub(1)?;
        Some(x as usize)
    })
}

/// What the second pass looks at.
struct Cells<'a> {
    blocks: &'a BlockSet,
    bits: &'a [BlockBits],
    cuts: &'a [Option<Box<CutEdges>>],
    table: &'a McTable,
}

impl Cells<'_> {
    fn triangles(&self, b: usize) -> Vec<[u32; 3]> {
        let bits = &self.bits[b];
        let mut out = Vec::new();
        if !bits.mixed {
            return out;
        }
        for z in 0..CELLS {
            for y in 0..CELLS {
                let rows = [0, 1, CORNERS, CORNERS + 1].map(|r| z * CORNERS + y + r);
                let inside = rows.map(|r| bits.inside[r]);
                let any = inside.iter().fold(0, |m, r| m | r | r >> 1);
                let all = inside.iter().fold(0xff, |m, r| m & r & r >> 1);
                let known = rows.iter().fold(0xff, |m, &r| m & bits.known[r] & bits.known[r] >> 1);
                for x in set_bits(any & !all & known) {
                    let pair = |r: usize| (inside[r] >> x & 3) as u8;
                    let case = pair(0) | pair(1) << 2 | pair(2) << 4 | pair(3) << 6;
                    let triangles = self.table.triangles(case);
                    out.extend(triangles.iter().map(|t| t.map(|e| self.vertex(b, [x, y, z], e))));
                }
            }
        }
        out
    }

    /// Number of the vertex on edge `e` of cell `cell` of block `b`.
    #[inline]
    fn vertex(&self, b: usize, cell: [usize; 3], e: u8) -> u32 {
        let (axis, offset) = EDGES[usize::from(e)];
        let p = std::array::from_fn(|a| cell[a] + offset[a]);
        let (owner, p) = self.blocks.owner(b, p, Some(axis));
        // A cut edge has a cut in its owner too, because both store the same corners.
        self.cuts[owner].as_deref().map_or(u32::MAX, |cuts| cuts.vertex(axis, p))
    }
}
