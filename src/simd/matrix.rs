//! Products of bf16 matrices with f32 sums: by the CPU's matrix units where it has them, else by plain loops.
//!
//! Both round nothing but the sums, each in its own order, so that they agree to a few parts in 10⁷ of the sum of the
//! terms' sizes. Operands are laid out as the matrix units read them: the left one in rows of 32 numbers along the
//! inner dimension, the right one in rows of *pairs* of neighbours along the inner dimension.

#[cfg(target_arch = "x86_64")]
use super::machine::amx::{self, Tiles};

/// Rows of one tile.
pub const TILE_ROWS: usize = 16;

/// Numbers along the inner dimension that one tile holds.
pub const TILE_DEPTH: usize = 32;

/// Columns of a panel: the samples of one tile of the field's kernels.
pub const PANEL: usize = super::TILE;

/// Two bf16, the first in the low half: rows 2n and 2n + 1 of a right operand.
pub type Pairs = u32;

/// Which numbers [`Unit::narrow`] keeps; the others become 0.
#[derive(Clone, Copy)]
pub enum Keep<'a> {
    /// Every number.
    All,
    /// What is not negative; what is not a number is kept, too.
    Positive,
    /// Where these rows are not 0.
    Where([&'a [u16; PANEL]; 2]),
}

/// Where [`Unit::narrow`] writes.
pub struct Narrowed<'a> {
    /// The two rows as pairs.
    pub pairs: &'a mut [Pairs; PANEL],
    /// The two rows.
    pub rows: [&'a mut [u16; PANEL]; 2],
}

/// Who multiplies.
pub enum Unit {
    /// The CPU's matrix units.
    #[cfg(target_arch = "x86_64")]
    Tiles(Tiles),
    /// Plain loops, with the same rounding of the operands.
    Portable,
}

/// Whether this CPU has matrix units that we may use.
pub fn available() -> bool {
    #[cfg(target_arch = "x86_64")]
    return amx::available();
    #[cfg(not(target_arch = "x86_64"))]
    false
}

impl Unit {
    /// The matrix units where there are any, configured for this thread.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if let Some(tiles) = Tiles::new() {
            return Self::Tiles(tiles);
        }
        Self::Portable
    }

    /// c = A B with 16 rows of A and 48 columns of B.
    ///
    /// `a` is `[block][16][32]`, `b` `[block * 16][48]` pairs; writes `c` `[16][48]`.
    #[inline(always)]
    pub fn panel(&self, a: &[u16], b: &[Pairs], c: &mut [f32]) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Tiles(tiles) => tiles.panel(a, b, c),
            Self::Portable => panel(a, b, c),
        }
    }

    /// c = A B with 32 rows of A and 32 columns of B over a long inner dimension.
    ///
    /// `a` is `[32][a_stride]`, of which `blocks * 32` columns count; `b` two halves of 16 columns,
    /// `[blocks * 16][16]` pairs each; writes `c` `[row half, column half][16][16]`.
    #[inline(always)]
    pub fn outer(
        &self,
        a: &[u16],
        a_stride: usize,
        b: [&[Pairs]; 2],
        blocks: usize,
        c: &mut [[f32; 256]; 4],
    ) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Tiles(tiles) => tiles.outer(a, a_stride, b, blocks, c),
            Self::Portable => outer(a, a_stride, b, blocks, c),
        }
    }

    /// Rounds two rows, after adding a number to each, to bf16: as rows and as pairs.
    #[inline(always)]
    pub fn narrow(&self, rows: &[f32; 2 * PANEL], bias: [f32; 2], keep: Keep, out: Narrowed) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Tiles(tiles) => tiles.narrow(rows, bias, keep, out),
            Self::Portable => narrow_rows(rows, bias, keep, out),
        }
    }

    /// Transposes 16 × 16 pairs: `out[16 * column + row] = rows[stride * row + column]`.
    #[inline(always)]
    pub fn transpose(&self, rows: &[Pairs], stride: usize, out: &mut [Pairs; 256]) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Tiles(tiles) => tiles.transpose(rows, stride, out),
            Self::Portable => transpose(rows, stride, out),
        }
    }
}

#[inline(always)]
fn panel(a: &[u16], b: &[Pairs], c: &mut [f32]) {
    for (row, c) in c.as_chunks_mut::<PANEL>().0.iter_mut().take(TILE_ROWS).enumerate() {
        *c = [0.0; PANEL];
        for (a, b) in a.chunks_exact(TILE_ROWS * TILE_DEPTH).zip(b.chunks_exact(TILE_ROWS * PANEL)) {
            add_pairs(&a[row * TILE_DEPTH..][..TILE_DEPTH], b.as_chunks().0, c);
        }
    }
}

#[inline(always)]
fn outer(a: &[u16], a_stride: usize, b: [&[Pairs]; 2], blocks: usize, c: &mut [[f32; 256]; 4]) {
    for (n, c) in c.iter_mut().enumerate() {
        for (row, c) in c.as_chunks_mut::<TILE_ROWS>().0.iter_mut().enumerate() {
            *c = [0.0; TILE_ROWS];
            let a = &a[(n / 2 * TILE_ROWS + row) * a_stride..][..blocks * TILE_DEPTH];
            add_pairs(a, b[n % 2].as_chunks().0, c);
        }
    }
}

/// Adds the product of a row of the left operand and rows of pairs of the right one to `c`.
#[inline(always)]
fn add_pairs<const COLUMNS: usize>(a: &[u16], b: &[[Pairs; COLUMNS]], c: &mut [f32; COLUMNS]) {
    // A copy stays in registers.
    let mut sums = *c;
    for (a, b) in a.as_chunks::<2>().0.iter().zip(b) {
        let a = a.map(widen);
        for n in 0..COLUMNS {
            sums[n] += a[0] * widen(b[n] as u16) + a[1] * widen((b[n] >> 16) as u16);
        }
    }
    *c = sums;
}

#[inline(always)]
fn narrow_rows(rows: &[f32; 2 * PANEL], bias: [f32; 2], keep: Keep, out: Narrowed) {
    let Narrowed { pairs, rows: to } = out;
    for lane in 0..PANEL {
        for half in 0..2 {
            let v = rows[half * PANEL + lane] + bias[half];
            let keep = match keep {
                Keep::All => true,
                Keep::Positive => v >= 0.0 || v.is_nan(),
                Keep::Where(x) => x[half][lane] != 0,
            };
            to[half][lane] = if keep { narrow(v) } else { 0 };
        }
        pairs[lane] = u32::from(to[0][lane]) | u32::from(to[1][lane]) << 16;
    }
}

/// The nearest bf16, ties to even.
///
/// NaNs stay NaN unless their upper mantissa bits are all set, which no operation produces.
#[inline(always)]
pub fn narrow(x: f32) -> u16 {
    let bits = x.to_bits();
    (bits.wrapping_add(0x7fff).wrapping_add((bits >> 16) & 1) >> 16) as u16
}

/// A bf16 as f32, exactly.
#[inline(always)]
pub fn widen(x: u16) -> f32 {
    f32::from_bits(u32::from(x) << 16)
}

/// Transposes 16 × 16 pairs.
#[inline(always)]
fn transpose(rows: &[Pairs], stride: usize, out: &mut [Pairs; 256]) {
    for (column, out) in out.chunks_exact_mut(16).enumerate() {
        for (row, out) in out.iter_mut().enumerate() {
            *out = rows[stride * row + column];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    fn numbers(rng: &mut Rng, n: usize) -> Vec<u16> {
        (0..n).map(|_| narrow(2.0 * rng.uniform() - 1.0)).collect()
    }

    fn pairs(rng: &mut Rng, n: usize) -> Vec<Pairs> {
        (0..n).map(|_| u32::from(narrow(rng.uniform())) | u32::from(narrow(-rng.uniform())) << 16).collect()
    }

    /// Sums of `terms` products below 1: every partial sum is rounded once, in whatever order.
    fn assert_close(a: &[f32], b: &[f32], terms: usize) {
        for (a, b) in a.iter().zip(b) {
            assert!((a - b).abs() <= 1e-7 * terms as f32 * (1.0 + b.abs()), "{a} and {b}");
        }
    }

    #[test]
    fn the_matrix_units_match_their_twin() {
        let unit = Unit::detect();
        if matches!(unit, Unit::Portable) {
            eprintln!("SKIPPED: this CPU has no matrix units");
            return;
        }
        let mut rng = Rng::new(1, 0, 0);
        for blocks in 1..4 {
            let (a, b) = (numbers(&mut rng, blocks * 512), pairs(&mut rng, blocks * 16 * PANEL));
            let (mut c, mut d) = (vec![1.0; 16 * PANEL], vec![2.0; 16 * PANEL]);
            unit.panel(&a, &b, &mut c);
            Unit::Portable.panel(&a, &b, &mut d);
            assert_close(&c, &d, blocks * 32);
            let stride = blocks * 32 + 8;
            let a = numbers(&mut rng, 32 * stride);
            let b = [0; 2].map(|_| pairs(&mut rng, blocks * 256));
            let (mut c, mut d) = ([[1.0; 256]; 4], [[2.0; 256]; 4]);
            unit.outer(&a, stride, [&b[0], &b[1]], blocks, &mut c);
            Unit::Portable.outer(&a, stride, [&b[0], &b[1]], blocks, &mut d);
            assert_close(c.as_flattened(), d.as_flattened(), blocks * 32);
        }
    }

    #[test]
    fn products_are_those_of_f64_loops() {
        let mut rng = Rng::new(2, 0, 0);
        let (a, b) = (numbers(&mut rng, 1024), pairs(&mut rng, 32 * PANEL));
        let mut c = vec![0.0; 16 * PANEL];
        Unit::detect().panel(&a, &b, &mut c);
        for row in 0..16 {
            for column in 0..PANEL {
                let sum: f64 = (0..64)
                    .map(|k| {
                        let a = widen(a[k / 32 * 512 + row * 32 + k % 32]);
                        let b = widen((b[k / 2 * PANEL + column] >> (k % 2 * 16)) as u16);
                        f64::from(a) * f64::from(b)
                    })
                    .sum();
                assert!((f64::from(c[row * PANEL + column]) - sum).abs() < 1e-5, "{row}, {column}");
            }
        }
    }

    #[test]
    fn rounding_is_to_nearest_even() {
        let mut rng = Rng::new(3, 0, 0);
        for n in 0..100_000u32 {
            let x = f32::from_bits((((rng.uniform() * 65536.0) as u32) << 16) | (n % 65536));
            if !x.is_nan() {
                assert_eq!(narrow(x), half::bf16::from_f32(x).to_bits(), "{x:e}");
            }
        }
        assert!(widen(narrow(f32::NAN)).is_nan() && widen(narrow(f32::INFINITY)).is_infinite());
    }

    #[test]
    fn rows_are_rounded_alike() {
        let mut rng = Rng::new(4, 0, 0);
        let mut rows = [0.0; 2 * PANEL];
        rows.fill_with(|| 2.0 * rng.uniform() - 1.0);
        rows[3] = f32::NAN;
        let x: [[u16; PANEL]; 2] = std::array::from_fn(|n| std::array::from_fn(|k| (k % (n + 2)) as u16));
        for keep in [Keep::All, Keep::Positive, Keep::Where([&x[0], &x[1]])] {
            let outcome = [Unit::detect(), Unit::Portable].map(|unit| {
                let (mut pairs, mut low, mut high) = ([1; PANEL], [1; PANEL], [1; PANEL]);
                let out = Narrowed { pairs: &mut pairs, rows: [&mut low, &mut high] };
                unit.narrow(&rows, [0.1, -0.2], keep, out);
                assert_eq!(pairs, std::array::from_fn(|k| u32::from(low[k]) | u32::from(high[k]) << 16));
                // A NaN may change its payload.
                [low, high].map(|row| row.map(|v| if widen(v).is_nan() { u16::MAX } else { v }))
            });
            assert_eq!(outcome[0], outcome[1]);
            assert!(matches!(keep, Keep::Where(_)) || outcome[0][0][3] == u16::MAX, "a NaN went unseen");
        }
    }

    #[test]
    fn transposing_swaps_rows_and_columns() {
        let rows: Vec<u32> = (0..16 * 20).collect();
        for unit in [Unit::detect(), Unit::Portable] {
            let mut out = [0; 256];
            unit.transpose(&rows, 20, &mut out);
            for (n, v) in out.iter().enumerate() {
                assert_eq!(*v, 20 * (n as u32 % 16) + n as u32 / 16);
            }
        }
    }
}
