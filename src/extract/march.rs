//! Marching cubes on a sparse grid: crack-free across blocks, each vertex made once.
//!
//! Two passes over the blocks, both in parallel and without any map from edges to vertices. First every block
//! turns its corners into bit rows (inside or not), and the cut edges that it owns into bit rows as well; running
//! counts give every block the number of its first vertex and the place of its first triangle. Then every block
//! writes its own vertices and its cells' triangles where they stay: it numbers its own edges one after the other,
//! and an edge that it shares is its owner's first number, plus the count before that row, plus the cut edges before
//! it in the row (a population count).
//!
//! The surface is watertight and edge-manifold wherever all cells are known and is open at the border of the
//! unknown.

use std::sync::LazyLock;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::blocks::{BlockSet, CELLS, CORNERS, POINTS, point_index};
use super::march_dense::bits::{LANES, inside_word};
use super::mc_table::{EDGES, TABLE};
use super::{ExtractError, SparseGrid, TriMesh};
use crate::simd::prefetch;

/// Rows of corners in a block.
const ROWS: usize = CORNERS * CORNERS;
/// Corners of a row as bits.
const ALL_CORNERS: u16 = 0x1ff;
/// Words that hold a bit for each corner of a block, and one more to read on into.
const WORDS: usize = POINTS.div_ceil(64) + 1;
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
    let (arch, cases) = (Arch::new(), &*CASES);
    let mark = |(b, values)| arch.dispatch(MarkBlock { values, iso, blocks: &grid.blocks, cases, b });
    let mut marks: Vec<Option<Mark>> = grid.values.par_chunks(POINTS).enumerate().map(mark).collect();
    let [vertices, triangles] = number(&mut marks)?;

    // Zeroed by the system, page by page, when a thread first writes there.
    let mut mesh = TriMesh { positions: vec![[0.0; 3]; vertices], triangles: vec![[0; 3]; triangles] };
    let marked = || marks.iter().flatten();
    let positions = split(&mut mesh.positions, marked().map(|m| usize::from(m.vertices)));
    let triangles = split(&mut mesh.triangles, marked().map(|m| usize::from(m.triangles)));
    let blocks: Vec<usize> = (0..marks.len()).filter(|&b| marks[b].is_some()).collect();
    let parts = blocks.par_iter().enumerate().zip(positions).zip(triangles);
    parts.for_each_init(Edges::default, |edges, (((n, &b), positions), triangles)| {
        let next = blocks.get(n + 1).copied();
        arch.dispatch(WriteBlock { grid, iso, marks: &marks, cases, b, next, positions, triangles, edges });
    });
    if marked().any(|m| m.known.is_some()) {
        // An edge between two known corners may lie on unknown cells only.
        mesh.drop_unused_vertices();
    }
    Ok(mesh)
}

/// Where the surface crosses an edge whose ends have the values `a` and `b`, in edges from `a`.
#[inline(always)]
pub(crate) fn crossing(a: f32, b: f32, iso: f32) -> f32 {
    // `max` and `min` instead of `clamp`: they also settle inf/inf, which opposite huge values give.
    #[allow(clippy::manual_clamp)]
    ((iso - a) / (b - a)).max(EDGE_MARGIN).min(1.0 - EDGE_MARGIN)
}

/// Bits of the corners of a block: bit x of row z · [`CORNERS`] + y.
type Rows = [u16; ROWS];

/// A block with a surface: what it counts of it, side by side with what others count, and where that is.
struct Mark {
    rows: Box<MarkRows>,
    /// Corners that are known; `None`: all are.
    known: Option<Box<Rows>>,
    /// Number of the block's first vertex.
    first: u32,
    vertices: u16,
    triangles: u16,
}

/// Where a block has a surface.
struct MarkRows {
    inside: Rows,
    /// Per axis: the edges that start at these corners are cut, and the block's own.
    own: [Rows; 3],
    /// Per axis and row: the block's vertices before this row.
    before: [[u16; ROWS]; 3],
}

impl Mark {
    /// Bits of the edges along `axis` from corners of a row that are cut, between known corners.
    #[inline(always)]
    fn cut(&self, axis: usize, row: usize) -> u16 {
        // A row of corners has one edge less along itself.
        let mask = if axis == 0 { ALL_CORNERS >> 1 } else { ALL_CORNERS };
        let [a, b] = ends(&self.rows.inside, axis, row);
        let Some(known) = &self.known else { return (a ^ b) & mask };
        let [here, there] = ends(known, axis, row);
        (a ^ b) & here & there & mask
    }

    /// Marks the block's own cut edges and counts them.
    #[inline(always)]
    fn mark_own(&mut self, blocks: &BlockSet, b: usize) {
        for axis in 0..3 {
            // Ownership only changes at the sides.
            let mut owned = [[0; 3]; 3];
            for (z, owned) in [0, 1, CELLS].into_iter().zip(&mut owned) {
                for (y, owned) in [0, 1, CELLS].into_iter().zip(owned) {
                    *owned = blocks.owned_edges(b, axis, y, z);
                }
            }
            for z in 0..edge_rows(axis, 2) {
                for y in 0..edge_rows(axis, 1) {
                    let row = z * CORNERS + y;
                    let own = self.cut(axis, row) & owned[side(z)][side(y)];
                    self.rows.own[axis][row] = own;
                    self.rows.before[axis][row] = self.vertices;
                    self.vertices += own.count_ones() as u16;
                }
            }
        }
    }

    /// Number of the vertex on the own edge along `axis` from corner `p`.
    #[inline(always)]
    fn vertex(&self, axis: usize, p: [usize; 3]) -> u32 {
        let row = row_of(p);
        let before_in_row = (self.rows.own[axis][row] & ((1 << p[0]) - 1)).count_ones();
        self.first + u32::from(self.rows.before[axis][row]) + before_in_row
    }

    /// The cells between row `row` and its neighbours along y and z.
    // No closures here and where it is called: they may be compiled without the caller's vector features.
    #[inline(always)]
    fn cells(&self, row: usize) -> Cells {
        let rows = around(&self.rows.inside, row);
        let (some, every) = (rows[0] | rows[1] | rows[2] | rows[3], rows[0] & rows[1] & rows[2] & rows[3]);
        let mut active = (some | some >> 1) & !(every & every >> 1) & 0xff;
        if let (Some(known), true) = (&self.known, active != 0) {
            let [a, b, c, d] = around(known, row);
            let known = a & b & c & d;
            active &= known & known >> 1;
        }
        Cells { rows, active }
    }
}

/// The row of corner `p`.
#[inline(always)]
fn row_of(p: [usize; 3]) -> usize {
    p[2] * CORNERS + p[1]
}

/// The rows at both ends of the edges along `axis` from a row's corners.
#[inline(always)]
fn ends(rows: &Rows, axis: usize, row: usize) -> [u16; 2] {
    match axis {
        0 => [rows[row], rows[row] >> 1],
        1 => [rows[row], rows[row + 1]],
        _ => [rows[row], rows[row + CORNERS]],
    }
}

/// A row of corners, and the next ones along y, z and both.
#[inline(always)]
fn around(rows: &Rows, row: usize) -> [u32; 4] {
    [rows[row].into(), rows[row + 1].into(), rows[row + CORNERS].into(), rows[row + CORNERS + 1].into()]
}

/// A row of cells: those that are left of the known ones on the surface.
struct Cells {
    rows: [u32; 4],
    active: u32,
}

impl Cells {
    /// Place along the row and case of the next cell.
    #[inline(always)]
    fn next(&mut self) -> Option<(usize, usize)> {
        if self.active == 0 {
            return None;
        }
        let x = self.active.trailing_zeros();
        self.active &= self.active - 1;
        let [a, b, c, d] = self.rows;
        let case = (a >> x & 3) | (b >> x & 3) << 2 | (c >> x & 3) << 4 | (d >> x & 3) << 6;
        Some((x as usize, case as usize))
    }
}

/// Rows of corners from which cells start.
#[inline(always)]
fn cell_rows() -> impl Iterator<Item = usize> {
    (0..CELLS * CELLS).map(|n| n / CELLS * CORNERS + n % CELLS)
}

/// Rows of corners along y (1) or z (2) from which edges along `axis` start.
#[inline(always)]
fn edge_rows(axis: usize, along: usize) -> usize {
    if axis == along { CELLS } else { CORNERS }
}

/// 0 on the low side of a block, 2 on the high side, 1 between.
#[inline(always)]
fn side(v: usize) -> usize {
    usize::from(v != 0) + usize::from(v == CELLS)
}

/// Turns a block's values into bits and counts its part of the surface; `None` where it has none.
struct MarkBlock<'a> {
    values: &'a [f32],
    iso: f32,
    blocks: &'a BlockSet,
    cases: &'a [Case; 256],
    b: usize,
}

impl WithSimd for MarkBlock<'_> {
    type Output = Option<Mark>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        let Self { values, iso, blocks, cases, b } = self;
        let (mut words, mut exponents) = ([0; WORDS], [0; LANES]);
        let (whole, rest) = values.as_chunks::<64>();
        for (word, values) in words.iter_mut().zip(whole) {
            *word = inside_word(values, iso, &mut exponents);
        }
        // A value at the iso-level is outside.
        let mut last = [iso; 64];
        last[..rest.len()].copy_from_slice(rest);
        words[whole.len()] = inside_word(&last, iso, &mut exponents);
        let inside = words.iter().map(|w| w.count_ones() as usize).sum::<usize>();
        if inside == 0 || inside == POINTS {
            return None;
        }
        let not_finite = exponents.iter().fold(0, |all, e| all | e) >> 31 != 0;
        let known = not_finite.then(|| Box::new(known_rows(values)));
        let rows = MarkRows { inside: rows_of(&words), own: [[0; ROWS]; 3], before: [[0; ROWS]; 3] };
        let known = known.filter(|rows| rows.iter().any(|row| *row != ALL_CORNERS));
        let mut mark = Mark { rows: Box::new(rows), known, first: 0, vertices: 0, triangles: 0 };
        mark.mark_own(blocks, b);
        for row in cell_rows() {
            let mut cells = mark.cells(row);
            while let Some((_, case)) = cells.next() {
                mark.triangles += u16::from(cases[case].count);
            }
        }
        Some(mark)
    }
}

/// Cuts a stream of bits into rows.
#[inline(always)]
fn rows_of(words: &[u64; WORDS]) -> Rows {
    let mut rows = [0; ROWS];
    for (r, row) in rows.iter_mut().enumerate() {
        let (word, bit) = (r * CORNERS / 64, r * CORNERS % 64);
        let both = u128::from(words[word]) | u128::from(words[word + 1]) << 64;
        *row = (both >> bit) as u16 & ALL_CORNERS;
    }
    rows
}

fn known_rows(values: &[f32]) -> Rows {
    let mut rows = [0; ROWS];
    for (row, values) in rows.iter_mut().zip(values.chunks_exact(CORNERS)) {
        *row = values.iter().enumerate().fold(0, |row, (x, v)| row | u16::from(!v.is_nan()) << x);
    }
    rows
}

/// Gives every block the number of its first vertex; returns the numbers of vertices and triangles.
fn number(marks: &mut [Option<Mark>]) -> Result<[usize; 2], ExtractError> {
    let [mut vertices, mut triangles] = [0usize; 2];
    for mark in marks.iter_mut().flatten() {
        mark.first = vertices as u32;
        vertices += usize::from(mark.vertices);
        triangles += usize::from(mark.triangles);
    }
    check_vertex_count(vertices)?;
    Ok([vertices, triangles])
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

/// Splits an array into parts of these lengths.
pub(crate) fn split<T>(mut rest: &mut [T], lengths: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
    let next = |length| rest.split_off_mut(..length).unwrap_or_default();
    lengths.map(next).collect()
}

/// An edge of a block whose vertex another block numbers.
struct Shared {
    /// Its place in the block, by axis and first corner.
    place: usize,
    axis: usize,
    owner: usize,
    /// Its first corner in the owner.
    p: [usize; 3],
}

/// Buffers of one worker.
struct Edges {
    /// Numbers of the vertices on edges, by axis and first corner; of edges that are not cut nobody asks.
    numbers: Box<[u32; 3 * POINTS]>,
    shared: Vec<Shared>,
}

impl Default for Edges {
    fn default() -> Self {
        Self { numbers: Box::new([0; 3 * POINTS]), shared: Vec::new() }
    }
}

/// Writes a block's vertices and triangles.
struct WriteBlock<'a> {
    grid: &'a SparseGrid,
    iso: f32,
    marks: &'a [Option<Mark>],
    cases: &'a [Case; 256],
    b: usize,
    /// The block that is written after it.
    next: Option<usize>,
    positions: &'a mut [[f32; 3]],
    triangles: &'a mut [[u32; 3]],
    edges: &'a mut Edges,
}

impl WithSimd for WriteBlock<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let Some(mark) = &self.marks[self.b] else { return };
        self.fetch_next();
        self.number_own_edges(mark);
        self.number_shared_edges();
        let (numbers, mut next) = (&self.edges.numbers, 0);
        for row in cell_rows() {
            let mut cells = mark.cells(row);
            while let Some((x, case)) = cells.next() {
                let (case, first) = (&self.cases[case & 255], row * CORNERS + x);
                let count = usize::from(case.count);
                let Some(out) = self.triangles.get_mut(next..next + count) else { return };
                for (to, places) in out.iter_mut().zip(&case.places) {
                    for k in 0..3 {
                        to[k] = numbers[first + usize::from(places[k])];
                    }
                }
                next += count;
            }
        }
    }
}

impl WriteBlock<'_> {
    /// Asks for what the next block reads: few of its values, here and there, which the processor does not foresee.
    #[inline(always)]
    fn fetch_next(&self) {
        let Some(next) = self.next else { return };
        let values = &self.grid.values[next * POINTS..][..POINTS];
        for n in (0..POINTS).step_by(16) {
            prefetch(&values[n], 0);
        }
    }

    /// Writes the vertices of the block's own edges, numbers them, and notes the cut edges that are others'.
    #[inline(always)]
    fn number_own_edges(&mut self, mark: &Mark) {
        let Self { grid, iso, marks, b, .. } = *self;
        let Edges { numbers, shared } = &mut *self.edges;
        shared.clear();
        let values = &grid.values[b * POINTS..(b + 1) * POINTS];
        let first = grid.blocks.coords()[b].map(|c| c as usize * CELLS);
        let along = |axis: usize| std::array::from_fn(|n| position(first[axis] + n, 0.0, grid.spec.voxel));
        let corners: [[f32; CORNERS]; 3] = [along(0), along(1), along(2)];
        let mut next = mark.first;
        let mut out = self.positions.iter_mut();
        for axis in 0..3 {
            let step = [1, CORNERS, ROWS][axis];
            for z in 0..edge_rows(axis, 2) {
                for y in 0..edge_rows(axis, 1) {
                    let row = z * CORNERS + y;
                    let mut own = mark.rows.own[axis][row];
                    let mut others = mark.cut(axis, row) & !own;
                    while own != 0 {
                        let x = own.trailing_zeros() as usize;
                        own &= own - 1;
                        let i = row * CORNERS + x;
                        numbers[axis * POINTS + i] = next;
                        next += 1;
                        let t = crossing(values[i], values[i + step], iso);
                        if let Some(out) = out.next() {
                            *out = [corners[0][x], corners[1][y], corners[2][z]];
                            out[axis] = position(first[axis] + [x, y, z][axis], t, grid.spec.voxel);
                        }
                    }
                    while others != 0 {
                        let x = others.trailing_zeros() as usize;
                        others &= others - 1;
                        let (owner, p) = grid.blocks.owner(b, [x, y, z], Some(axis));
                        // Asked for now and read when all others are known.
                        if let Some(owner) = &marks[owner] {
                            prefetch(&owner.rows.own[axis][row_of(p)], 0);
                            prefetch(&owner.rows.before[axis][row_of(p)], 0);
                        }
                        shared.push(Shared { place: axis * POINTS + row * CORNERS + x, axis, owner, p });
                    }
                }
            }
        }
    }

    /// Finds the numbers of the edges that are others'.
    #[inline(always)]
    fn number_shared_edges(&mut self) {
        let Edges { numbers, shared } = &mut *self.edges;
        for Shared { place, axis, owner, p } in &*shared {
            // A cut edge has a cut in its owner too, because both store the same corners.
            let number = self.marks[*owner].as_ref().map_or(u32::MAX, |owner| owner.vertex(*axis, *p));
            numbers[*place] = number;
        }
    }
}

/// Where `t` of the way from corner `p` to the next one is along its axis.
#[inline(always)]
fn position(p: usize, t: f32, voxel: f64) -> f32 {
    ((p as f64 + f64::from(t)) * voxel) as f32
}

/// The triangles of a case of marching cubes.
#[derive(Clone, Copy, Default)]
struct Case {
    count: u8,
    /// Corners of the triangles: an edge's place by axis and first corner, relative to the cell's first corner.
    places: [[u16; 3]; 5],
}

static CASES: LazyLock<[Case; 256]> = LazyLock::new(|| {
    std::array::from_fn(|case| {
        let triangles = TABLE.triangles(case as u8);
        let mut found = Case { count: triangles.len() as u8, ..Case::default() };
        let place = |e: u8| {
            let (axis, offset) = EDGES[usize::from(e)];
            (axis * POINTS + point_index(offset)) as u16
        };
        for (places, edges) in found.places.iter_mut().zip(triangles) {
            *places = edges.map(place);
        }
        found
    })
});
