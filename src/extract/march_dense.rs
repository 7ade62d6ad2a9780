//! Marching cubes on a dense grid, for grids that are all there.
//!
//! The same surface as [`super::march`] makes, from rows of 64-bit masks: one bit per corner, so that 64
//! cells are dismissed with a few instructions and only cells on the surface cost anything.

use rayon::prelude::*;

use super::march::{check_vertex_count, crossing};
use super::mc_table::{EDGES, TABLE};
use super::{ExtractError, TriMesh};

/// Extracts the surface `value = iso` (greater is inside) of a dense grid, in units of a cell.
///
/// `values` `[dims[0] * dims[1] * dims[2]]` at the corners, x fastest. The surface is open where it leaves
/// the grid.
///
/// # Errors
/// `Length` where `values` does not fit `dims`, `NonFinite` ("march_dense") with the index of the value.
pub fn march_dense(values: &[f32], dims: [usize; 3], iso: f32) -> Result<TriMesh, ExtractError> {
    ExtractError::require(iso.is_finite(), "iso", iso, "finite")?;
    let count = dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).unwrap_or(usize::MAX);
    ExtractError::same_length(|| format!("a dense grid of {dims:?}"), count, values.len())?;
    if dims.iter().any(|&d| d < 2) {
        return Ok(TriMesh::default());
    }
    let volume = Volume::new(values, dims, iso)?;
    let (first, vertices) = volume.number_vertices()?;

    let mut positions = vec![[0.0; 3]; vertices];
    let slices = split_by_layer(&mut positions, &first, volume.layer_words());
    slices.into_par_iter().enumerate().for_each(|(z, out)| volume.write_vertices(z, out));

    let layers: Vec<Vec<[u32; 3]>> =
        (0..dims[2] - 1).into_par_iter().map(|z| volume.triangles(z, &first)).collect();
    Ok(TriMesh { positions, triangles: layers.concat() })
}

/// Cut-edge masks of 64 corners along a row, per axis.
type Cuts = [u64; 3];

/// A dense grid and its inside bits.
struct Volume<'a> {
    values: &'a [f32],
    dims: [usize; 3],
    iso: f32,
    /// Words per row of corners.
    words: usize,
    /// `[dims[2] * dims[1] * words]`, bit x % 64 of word x / 64.
    inside: Vec<u64>,
}

impl<'a> Volume<'a> {
    fn new(values: &'a [f32], dims: [usize; 3], iso: f32) -> Result<Self, ExtractError> {
        let words = dims[0].div_ceil(64);
        let mut inside = vec![0u64; words * dims[1] * dims[2]];
        let layer = dims[0] * dims[1];
        let bad = inside
            .par_chunks_mut(words * dims[1])
            .zip(values.par_chunks(layer))
            .enumerate()
            .filter_map(|(z, (bits, values))| {
                let mut huge = false;
                for (bits, row) in bits.chunks_exact_mut(words).zip(values.chunks_exact(dims[0])) {
                    for (word, chunk) in bits.iter_mut().zip(row.chunks(64)) {
                        *word = inside_word(chunk, iso);
                        huge |= not_finite(chunk);
                    }
                }
                let first_bad = || values.iter().position(|v| !v.is_finite());
                if huge { first_bad().map(|i| z * layer + i) } else { None }
            })
            .min();
        match bad {
            Some(index) => Err(ExtractError::NonFinite { stage: "march_dense", index }),
            None => Ok(Self { values, dims, iso, words, inside }),
        }
    }

    fn layer_words(&self) -> usize {
        self.words * self.dims[1]
    }

    #[inline]
    fn row(&self, y: usize, z: usize) -> &[u64] {
        let start = (z * self.dims[1] + y) * self.words;
        &self.inside[start..start + self.words]
    }

    /// Cut edges that start at the corners of word `w` of row (y, z).
    #[inline]
    fn cuts(&self, w: usize, y: usize, z: usize) -> Cuts {
        let row = self.row(y, z);
        let here = row[w];
        // The last corner of a row starts no edge along x; bits past the row's end are all zero.
        let in_x = low_bits((self.dims[0] - 1).saturating_sub(w * 64));
        let along_y = if y + 1 < self.dims[1] { here ^ self.row(y + 1, z)[w] } else { 0 };
        let along_z = if z + 1 < self.dims[2] { here ^ self.row(y, z + 1)[w] } else { 0 };
        [(here ^ shifted(row, w)) & in_x, along_y, along_z]
    }

    /// For every word of corners, the number of its first vertex; and the number of vertices.
    fn number_vertices(&self) -> Result<(Vec<u32>, usize), ExtractError> {
        let mut first = vec![0u32; self.inside.len()];
        let layer_words = self.layer_words();
        let counts: Vec<usize> = first
            .par_chunks_mut(layer_words)
            .enumerate()
            .map(|(z, first)| {
                let mut count = 0;
                for (i, first) in first.iter_mut().enumerate() {
                    *first = count;
                    let cuts = self.cuts(i % self.words, i / self.words, z);
                    if cuts != [0; 3] {
                        count += cuts.iter().map(|c| c.count_ones()).sum::<u32>();
                    }
                }
                count as usize
            })
            .collect();
        let mut total = 0usize;
        let mut starts = Vec::with_capacity(counts.len());
        for count in counts {
            starts.push(total as u32);
            total += count;
        }
        check_vertex_count(total)?;
        first.par_chunks_mut(layer_words).zip(starts).for_each(|(first, start)| {
            first.iter_mut().for_each(|f| *f += start);
        });
        Ok((first, total))
    }

    fn write_vertices(&self, z: usize, out: &mut [[f32; 3]]) {
        let mut out = out.iter_mut();
        let steps = [1, self.dims[0], self.dims[0] * self.dims[1]];
        for y in 0..self.dims[1] {
            for w in 0..self.words {
                let cuts = self.cuts(w, y, z);
                for axis in 0..3 {
                    let mut mask = cuts[axis];
                    while mask != 0 {
                        let x = w * 64 + mask.trailing_zeros() as usize;
                        mask &= mask - 1;
                        let i = (z * self.dims[1] + y) * self.dims[0] + x;
                        let t = crossing(self.values[i], self.values[i + steps[axis]], self.iso);
                        let mut at = [x as f32, y as f32, z as f32];
                        at[axis] += t;
                        if let Some(out) = out.next() {
                            *out = at;
                        }
                    }
                }
            }
        }
    }

    /// Triangles of the cells between the layers z and z + 1.
    fn triangles(&self, z: usize, first: &[u32]) -> Vec<[u32; 3]> {
        let mut out = Vec::new();
        let table = &*TABLE;
        for y in 0..self.dims[1] - 1 {
            let rows = [(y, z), (y + 1, z), (y, z + 1), (y + 1, z + 1)].map(|(y, z)| self.row(y, z));
            for w in 0..self.words {
                let here = rows.map(|r| r[w]);
                let next = rows.map(|r| shifted(r, w));
                let any = here.iter().chain(&next).fold(0, |m, r| m | r);
                let all = here.iter().chain(&next).fold(u64::MAX, |m, r| m & r);
                let mut active = any & !all & low_bits((self.dims[0] - 1).saturating_sub(w * 64));
                if active == 0 {
                    continue;
                }
                let numbers = Numbers::new(self, first, w, y, z);
                while active != 0 {
                    let x = active.trailing_zeros();
                    active &= active - 1;
                    let mut case = 0;
                    for r in 0..4 {
                        case |= ((here[r] >> x & 1) | (next[r] >> x & 1) << 1) << (2 * r);
                    }
                    let triangles = table.triangles(case as u8);
                    out.extend(triangles.iter().map(|t| t.map(|e| numbers.vertex(e, x))));
                }
            }
        }
        out
    }
}

/// Vertex numbers round one word of cells.
struct Numbers {
    /// Per row (y, z), (y+1, z), (y, z+1), (y+1, z+1) and for this word and the next: cut edges, number per
    /// axis.
    words: [[(Cuts, [u32; 3]); 2]; 4],
}

impl Numbers {
    fn new(volume: &Volume, first: &[u32], w: usize, y: usize, z: usize) -> Self {
        let word = |w: usize, y: usize, z: usize| {
            if w >= volume.words {
                return ([0; 3], [0; 3]);
            }
            let cuts = volume.cuts(w, y, z);
            let n = first[(z * volume.dims[1] + y) * volume.words + w];
            let along_y = n + cuts[0].count_ones();
            (cuts, [n, along_y, along_y + cuts[1].count_ones()])
        };
        let rows = [(y, z), (y + 1, z), (y, z + 1), (y + 1, z + 1)];
        Self { words: rows.map(|(y, z)| [word(w, y, z), word(w + 1, y, z)]) }
    }

    #[inline]
    fn vertex(&self, e: u8, x: u32) -> u32 {
        let (axis, [dx, dy, dz]) = EDGES[usize::from(e)];
        let x = x + dx as u32;
        let (cuts, numbers) = &self.words[dy + 2 * dz][(x >> 6) as usize & 1];
        let before = cuts[axis] & low_bits(x as usize & 63);
        numbers[axis] + before.count_ones()
    }
}

/// The row moved by one corner: bit x is corner 64 w + x + 1.
#[inline]
fn shifted(row: &[u64], w: usize) -> u64 {
    row[w] >> 1 | row.get(w + 1).map_or(0, |next| next << 63)
}

/// A mask of the lowest `n` bits; all for n ≥ 64.
#[inline]
fn low_bits(n: usize) -> u64 {
    if n >= 64 { u64::MAX } else { (1 << n) - 1 }
}

/// Bit x = value x is above `iso`, for up to 64 values.
#[inline]
fn inside_word(values: &[f32], iso: f32) -> u64 {
    let mut flags = [0u8; 64];
    for (flag, &v) in flags.iter_mut().zip(values) {
        *flag = u8::from(v > iso);
    }
    // Each multiplication gathers the low bits of eight bytes in the top byte.
    let mut word = 0;
    for (i, bytes) in flags.chunks_exact(8).enumerate() {
        let eight = bytes.iter().rev().fold(0u64, |m, &b| m << 8 | u64::from(b));
        word |= (eight.wrapping_mul(0x0102_0408_1020_4080) >> 56) << (8 * i);
    }
    word
}

/// Whether any value is NaN or infinite.
#[inline]
fn not_finite(values: &[f32]) -> bool {
    // The exponent of a non-finite number is all ones, so adding one to it carries into the sign bit.
    values.iter().fold(0u32, |m, v| m | ((v.to_bits() & 0x7fff_ffff) + 0x0080_0000)) >> 31 == 1
}

/// Splits the vertex array into the layers' own parts.
fn split_by_layer<'a>(
    mut rest: &'a mut [[f32; 3]],
    first: &[u32],
    layer_words: usize,
) -> Vec<&'a mut [[f32; 3]]> {
    let starts: Vec<usize> = first.iter().step_by(layer_words).map(|&f| f as usize).collect();
    let ends = starts[1..].iter().copied().chain([rest.len()]);
    let mut slices = Vec::with_capacity(starts.len());
    for (start, end) in starts.iter().zip(ends) {
        let (head, tail) = rest.split_at_mut(end - start);
        slices.push(head);
        rest = tail;
    }
    slices
}
