//! Row by row: how much there is of the surface, and the surface.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::bits::Inside;
use super::cells::{CASES, Numbers, Rows, Word};
use crate::extract::march::crossing;
use crate::simd::prefetch;

/// Where each row's vertices are.
///
/// The vertices of a row come by the axis of their edge, each along the row, rows and layers one after the other.
pub(super) struct Layout {
    /// `[layers * rows]`, per axis of the edge: the number of the row's first vertex within its layer.
    first: Vec<[u32; 3]>,
    /// The number of each layer's first vertex.
    layers: Vec<u32>,
}

impl Layout {
    /// The layout, and of each layer how many vertices and triangles it has.
    pub(super) fn new(arch: Arch, inside: &Inside) -> (Self, Vec<[usize; 2]>) {
        let [_, rows, layers] = inside.dims;
        let mut first = vec![[0; 3]; rows * layers];
        let counted = first.par_chunks_mut(rows).enumerate();
        let sizes: Vec<[usize; 2]> =
            counted.map(|(z, first)| arch.dispatch(CountLayer { inside, z, first })).collect();
        let starts = sizes.iter().scan(0usize, |total, size| {
            let start = *total;
            *total += size[0];
            Some(start as u32)
        });
        (Self { first, layers: starts.collect() }, sizes)
    }

    #[inline(always)]
    fn row(&self, rows: usize, y: usize, z: usize) -> [u32; 3] {
        self.first[z * rows + y].map(|n| n.wrapping_add(self.layers[z]))
    }
}

/// The rows round the cells at (y, z). A row that is not there is replaced by its neighbour, which cuts nothing.
#[inline(always)]
fn rows_at(inside: &Inside, y: usize, z: usize) -> Rows<'_> {
    let (up, on) = ((y + 1).min(inside.dims[1] - 1), (z + 1).min(inside.dims[2] - 1));
    [inside.row(y, z), inside.row(up, z), inside.row(y, on), inside.row(up, on)]
}

/// Whether there are cells at (y, z), and not only the last corners.
#[inline(always)]
fn has_cells(inside: &Inside, y: usize, z: usize) -> bool {
    y + 1 < inside.dims[1] && z + 1 < inside.dims[2]
}

/// Counts a layer's vertices and triangles.
pub(super) struct CountLayer<'a> {
    inside: &'a Inside,
    z: usize,
    first: &'a mut [[u32; 3]],
}

impl WithSimd for CountLayer<'_> {
    type Output = [usize; 2];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [usize; 2] {
        let Self { inside, z, first } = self;
        let (cases, cells) = (&*CASES, inside.dims[0] - 1);
        let (mut vertices, mut triangles) = (0usize, 0);
        for (y, first) in first.iter_mut().enumerate() {
            let rows = rows_at(inside, y, z);
            let with_cells = has_cells(inside, y, z);
            let mut counts = [0; 3];
            for w in 0..rows[0].len() {
                let word = Word::new(&rows, w, cells);
                for axis in 0..3 {
                    counts[axis] += word.cuts[Word::OWN[axis]].count_ones() as usize;
                }
                if with_cells && word.active != 0 {
                    triangles += word.count_triangles(cases);
                }
            }
            for axis in 0..3 {
                // Too many are refused before any number is used.
                first[axis] = vertices as u32;
                vertices += counts[axis];
            }
        }
        [vertices, triangles]
    }
}

/// Writes a layer's vertices, and the triangles between it and the next.
pub(super) struct WriteLayer<'a> {
    pub(super) values: &'a [f32],
    pub(super) iso: f32,
    pub(super) inside: &'a Inside,
    pub(super) layout: &'a Layout,
    pub(super) z: usize,
    pub(super) positions: &'a mut [[f32; 3]],
    pub(super) triangles: &'a mut [[u32; 3]],
}

impl WithSimd for WriteLayer<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { values, iso, inside, layout, z, positions, mut triangles } = self;
        let [width, height, _] = inside.dims;
        let (cases, cells) = (&*CASES, width - 1);
        for y in 0..height {
            let rows = rows_at(inside, y, z);
            let with_cells = has_cells(inside, y, z);
            let mut next = layout.first[z * height + y];
            let mut numbers = Numbers([0; 8]);
            if with_cells {
                let [a, b, c, d] =
                    [(y, z), (y + 1, z), (y, z + 1), (y + 1, z + 1)].map(|(y, z)| layout.row(height, y, z));
                numbers = Numbers([a[0], b[0], c[0], d[0], a[1], c[1], a[2], b[2]]);
            }
            for w in 0..rows[0].len() {
                let word = Word::new(&rows, w, cells);
                if word.active != 0 {
                    // The surface goes on near here; its other values were read with the layer before.
                    ask_for_values(values, inside.dims, [w * 64, y + 2, z + 1]);
                }
                for axis in 0..3 {
                    let mask = word.cuts[Word::OWN[axis]];
                    if mask != 0 {
                        let edges = Edges { values, iso, dims: inside.dims, axis };
                        edges.write_vertices(mask, [w * 64, y, z], positions, &mut next[axis]);
                    }
                }
                if with_cells && word.active != 0 {
                    numbers.write_triangles(&word, cases, &mut triangles);
                }
            }
        }
    }
}

/// Asks for the 64 values from a corner on before they are needed, where the processor does not foresee it.
#[inline(always)]
fn ask_for_values(values: &[f32], [width, height, _]: [usize; 3], [x, y, z]: [usize; 3]) {
    if let Some(value) = values.get((z * height + y) * width + x) {
        for line in 0..4 {
            prefetch(value, line * 64);
        }
    }
}

/// The edges of a grid along an axis.
struct Edges<'a> {
    values: &'a [f32],
    iso: f32,
    dims: [usize; 3],
    axis: usize,
}

impl Edges<'_> {
    /// Writes the vertices of the edges at the set bits of `mask`, bit 0 at corner `at`, from place `next` on.
    #[inline(always)]
    fn write_vertices(&self, mut mask: u64, at: [usize; 3], out: &mut [[f32; 3]], next: &mut u32) {
        let [width, height, _] = self.dims;
        let step = [1, width, width * height][self.axis];
        let start = (at[2] * height + at[1]) * width + at[0];
        let [x0, y, z] = at.map(|c| c as f32);
        while mask != 0 {
            let bit = mask.trailing_zeros();
            mask &= mask - 1;
            let i = start + bit as usize;
            let t = crossing(self.values[i], self.values[i + step], self.iso);
            // Both terms are whole numbers below 2^24, or a grid that no memory holds.
            let mut position = [x0 + bit as f32, y, z];
            position[self.axis] += t;
            if let Some(out) = out.get_mut(*next as usize) {
                *out = position;
            }
            *next += 1;
        }
    }
}
