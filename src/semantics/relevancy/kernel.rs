//! Products of many points with a few phrases, and the scores that follow.
//!
//! For short features lanes are phrases: a point's numbers are broadcast one after the other and multiplied with the
//! phrases' numbers of that dimension. So points stay as they are stored, and there is no sum across lanes but the
//! point's own length. For long ones and few phrases lanes are dimensions: half of the lanes would have no phrase, and
//! sums across lanes are few beside the products.

use half::f16;
use pulp::{Arch, Simd, WithSimd};

use super::{Points, Queries};
use crate::simd;

/// Points together: as many independent sums hide the latency of a multiply-add on two ports.
const TOGETHER: usize = 8;
/// Points whose products are kept before they become scores.
const BLOCK: usize = 64;
/// Phrases of a panel, which are multiplied with a point together: one AVX-512 vector.
const PANEL: usize = 16;
/// Dimensions between two checks of where a loop ends.
const UNROLLED: usize = 4;

/// Features from this length on are long; a multiple of the lanes' number is needed as well.
const LONG: usize = 128;
/// Phrases that are held against long features together.
const FEW: usize = 8;
/// Points that share a phrase's numbers then.
const PAIR: usize = 2;
/// Bytes of features that are asked for before they are needed: the processor's own prediction stops at pages.
const AHEAD: usize = 4096;
/// Numbers that are asked for together: a cache line of 64 bytes.
const LINE: usize = 16;

/// Below this share of its summands, a squared length in f32 has lost digits; the point is computed again in f64.
const CANCELLED: f32 = 0.05;
/// Below this share, it is rounding in f64 of numbers that were stored as f32: the feature has vanished.
const VANISHED: f64 = 1e-12;

/// What a point is multiplied with, phrases and the norm's linear part, in the order in which the kernel reads it.
pub(super) struct Packed {
    /// `[panels, dim, PANEL]`: of each dimension, the numbers of a panel's phrases.
    panels: Vec<f32>,
    /// `[FEW, dim]`: the same phrase by phrase, if features are long and phrases few; else empty.
    rows: Vec<f32>,
    /// `[panels, PANEL]`: what products start from.
    offsets: Vec<f32>,
    dim: usize,
    /// Columns of the panels that are in use; the last one is the norm's.
    used: usize,
}

impl Packed {
    pub(super) fn new(queries: &Queries) -> Self {
        let dim = queries.norm.linear.len();
        let twice: Vec<f32> = queries.norm.linear.iter().map(|v| 2.0 * v).collect();
        let norm = (&twice[..], queries.norm.constant);
        let columns: Vec<(&[f32], f32)> =
            queries.phrases.iter().map(|p| (&p.direction[..], p.offset)).chain([norm]).collect();
        let used = columns.len();
        let offsets =
            (0..used.next_multiple_of(PANEL)).map(|n| columns.get(n).map_or(0.0, |c| c.1)).collect();
        let mut panels = Vec::with_capacity(used.next_multiple_of(PANEL) * dim);
        for panel in columns.chunks(PANEL) {
            for k in 0..dim {
                panels.extend((0..PANEL).map(|n| panel.get(n).map_or(0.0, |c| c.0[k])));
            }
        }
        let mut rows = Vec::new();
        if dim >= LONG && dim.is_multiple_of(PANEL) && used <= FEW {
            columns.iter().for_each(|column| rows.extend_from_slice(column.0));
            rows.resize(FEW * dim, 0.0);
        }
        Self { panels, rows, offsets, dim, used }
    }
}

/// Scores of the points of a chunk; returns the first point that is not finite, whose score is then undefined.
pub(super) fn run(
    queries: &Queries,
    packed: &Packed,
    points: Points,
    scores: &mut [&mut [f32]],
    coverage: &mut [f32],
) -> Option<usize> {
    Arch::new().dispatch(Run { queries, packed, points, scores, coverage })
}

/// Copies points as f32.
#[inline(always)]
pub(super) fn widen(points: Points, out: &mut [f32]) {
    match points {
        Points::F32(values) => out.copy_from_slice(values),
        Points::F16(values) => simd::widen(values, out),
    }
}

struct Run<'a, 'b> {
    queries: &'a Queries,
    packed: &'a Packed,
    points: Points<'a>,
    scores: &'a mut [&'b mut [f32]],
    coverage: &'a mut [f32],
}

impl WithSimd for Run<'_, '_> {
    type Output = Option<usize>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Option<usize> {
        let Run { queries, packed, points, scores, coverage } = self;
        let dim = packed.dim;
        let mut wide = Vec::new();
        let mut products = vec![[[0.0; PANEL]; BLOCK]; packed.used.div_ceil(PANEL)];
        let mut squares = [0.0; BLOCK];
        let mut judged = Judged::new(packed);
        let mut first_bad = None;
        for start in (0..coverage.len()).step_by(BLOCK) {
            let count = BLOCK.min(coverage.len() - start);
            let rows: &[f32] = match points {
                Points::F32(values) if count == BLOCK => &values[start * dim..(start + BLOCK) * dim],
                // Half precision, or a block that is not full: the kernel wants whole groups of f32.
                part => {
                    wide.resize(BLOCK * dim, 0.0);
                    widen(part_of(part, start * dim, (start + count) * dim), &mut wide[..count * dim]);
                    wide[count * dim..].fill(0.0);
                    &wide
                }
            };
            if packed.rows.is_empty() {
                let panels = packed.panels.chunks_exact(dim * PANEL).zip(packed.offsets.as_chunks().0);
                for ((columns, offsets), out) in panels.zip(&mut products) {
                    let out = out.as_chunks_mut::<TOGETHER>().0.iter_mut();
                    for (out, rows) in out.zip(rows.chunks_exact(TOGETHER * dim)) {
                        // What has been widened is in the cache already.
                        if matches!(points, Points::F32(_)) {
                            for line in rows.chunks(LINE) {
                                simd::prefetch(&line[0], AHEAD);
                            }
                        }
                        multiply(simd, columns, offsets, rows, out);
                    }
                }
                for (square, row) in squares.iter_mut().zip(rows.chunks_exact(dim)) {
                    *square = squared(simd, row);
                }
            } else {
                let pairs =
                    products[0].as_chunks_mut::<PAIR>().0.iter_mut().zip(squares.as_chunks_mut::<PAIR>().0);
                for ((products, squares), rows) in pairs.zip(rows.chunks_exact(PAIR * dim)) {
                    multiply_long(simd, packed, rows, products, squares);
                }
            }
            judge(queries, packed, &products, &squares, &mut judged);
            coverage[start..start + count].fill(1.0);
            // Margins for now; scores are made of them below.
            for (scores, products) in scores.iter_mut().zip(judged.columns.as_chunks::<BLOCK>().0) {
                let margins = products.iter().zip(&judged.nearest).zip(&judged.scale);
                for (score, ((product, nearest), scale)) in
                    scores[start..start + count].iter_mut().zip(margins)
                {
                    *score = (product - nearest) * scale;
                }
            }
            for n in (0..count).filter(|n| !judged.sound[*n]) {
                let at = start + n;
                match judge_in_f64(queries, &rows[n * dim..][..dim]) {
                    Rare::Margins(margins) => {
                        scores.iter_mut().zip(margins).for_each(|(scores, margin)| scores[at] = margin);
                    }
                    Rare::Nothing => {
                        coverage[at] = 0.0;
                        scores.iter_mut().for_each(|scores| scores[at] = 0.0);
                    }
                    Rare::NonFinite => first_bad = first_bad.or(Some(at)),
                }
            }
            for scores in scores.iter_mut() {
                let covered = &coverage[start..start + count];
                for (score, covered) in scores[start..start + count].iter_mut().zip(covered) {
                    *score = covered * simd::sigmoid(*score);
                }
            }
        }
        first_bad
    }
}

#[inline(always)]
fn part_of(points: Points<'_>, start: usize, end: usize) -> Points<'_> {
    match points {
        Points::F32(values) => Points::F32(&values[start..end]),
        Points::F16(values) => Points::F16(&values[start..end] as &[f16]),
    }
}

/// Products of eight points `[8, dim]` with a panel `[dim, PANEL]`.
#[inline(always)]
fn multiply<S: Simd>(
    simd: S,
    panel: &[f32],
    offsets: &[f32; PANEL],
    rows: &[f32],
    out: &mut [[f32; PANEL]; TOGETHER],
) {
    let dim = panel.len() / PANEL;
    let (panel, offsets) = (S::as_simd_f32s(panel).0, S::as_simd_f32s(offsets).0);
    let vectors = offsets.len();
    let (panel, panel_rest) = panel.split_at(dim / UNROLLED * UNROLLED * vectors);
    let rows: [&[f32]; TOGETHER] = std::array::from_fn(|p| &rows[p * dim..(p + 1) * dim]);
    let rests = rows.map(|row| row.as_chunks::<UNROLLED>().1);
    let [a, b, c, d, e, f, g, h] = rows.map(|row| row.as_chunks::<UNROLLED>().0);
    for (v, offset) in offsets.iter().enumerate() {
        let mut sums = [*offset; TOGETHER];
        // Zipped, since an index into each row would be checked for every number.
        let rows = a.iter().zip(b).zip(c).zip(d).zip(e).zip(f).zip(g).zip(h);
        for (columns, (((((((a, b), c), d), e), f), g), h)) in
            panel.chunks_exact(UNROLLED * vectors).zip(rows)
        {
            let values = [a, b, c, d, e, f, g, h];
            for k in 0..UNROLLED {
                let column = columns[k * vectors + v];
                for p in 0..TOGETHER {
                    sums[p] = simd.mul_add_e_f32s(simd.splat_f32s(values[p][k]), column, sums[p]);
                }
            }
        }
        for (k, columns) in panel_rest.chunks_exact(vectors).enumerate() {
            for p in 0..TOGETHER {
                sums[p] = simd.mul_add_e_f32s(simd.splat_f32s(rests[p][k]), columns[v], sums[p]);
            }
        }
        for p in 0..TOGETHER {
            S::as_mut_simd_f32s(&mut out[p]).0[v] = sums[p];
        }
    }
}

/// Products of two long points `[2, dim]` with all rows, and their |z|².
#[inline(always)]
fn multiply_long<S: Simd>(
    simd: S,
    packed: &Packed,
    rows: &[f32],
    out: &mut [[f32; PANEL]; PAIR],
    squares: &mut [f32; PAIR],
) {
    let dim = packed.dim;
    let phrases: [&[S::f32s]; FEW] =
        std::array::from_fn(|n| S::as_simd_f32s(&packed.rows[n * dim..(n + 1) * dim]).0);
    let [x, y] = [0, 1].map(|p| S::as_simd_f32s(&rows[p * dim..(p + 1) * dim]).0);
    let zero = simd.splat_f32s(0.0);
    let (mut sums, mut lengths) = ([[zero; FEW]; PAIR], [zero; PAIR]);
    let [a, b, c, d, e, f, g, h] = phrases;
    let phrases = a.iter().zip(b).zip(c).zip(d).zip(e).zip(f).zip(g).zip(h);
    for ((x, y), (((((((a, b), c), d), e), f), g), h)) in x.iter().zip(y).zip(phrases) {
        let phrases = [a, b, c, d, e, f, g, h];
        for (p, point) in [x, y].into_iter().enumerate() {
            simd::prefetch(point, AHEAD);
            lengths[p] = simd.mul_add_e_f32s(*point, *point, lengths[p]);
            for n in 0..FEW {
                sums[p][n] = simd.mul_add_e_f32s(*point, *phrases[n], sums[p][n]);
            }
        }
    }
    for p in 0..PAIR {
        squares[p] = simd.reduce_sum_f32s(lengths[p]);
        for n in 0..packed.used {
            out[p][n] = packed.offsets[n] + simd.reduce_sum_f32s(sums[p][n]);
        }
    }
}

/// |z|².
#[inline(always)]
fn squared<S: Simd>(simd: S, row: &[f32]) -> f32 {
    let (vectors, rest) = S::as_simd_f32s(row);
    let mut sums = [simd.splat_f32s(0.0); 4];
    let (quads, single) = vectors.as_chunks::<4>();
    for quad in quads {
        for i in 0..4 {
            sums[i] = simd.mul_add_e_f32s(quad[i], quad[i], sums[i]);
        }
    }
    for (i, v) in single.iter().enumerate() {
        sums[i] = simd.mul_add_e_f32s(*v, *v, sums[i]);
    }
    let sum = simd.add_f32s(simd.add_f32s(sums[0], sums[1]), simd.add_f32s(sums[2], sums[3]));
    let mut total = simd.reduce_sum_f32s(sum);
    for v in rest {
        total += v * v;
    }
    total
}

/// What turns the products of a block into margins, `(product - nearest) * scale`.
struct Judged {
    /// `[used, BLOCK]`: the products, phrase by phrase, so that what follows goes over many points at once.
    columns: Vec<f32>,
    nearest: [f32; BLOCK],
    scale: [f32; BLOCK],
    /// Where f32 is enough.
    sound: [bool; BLOCK],
}

impl Judged {
    fn new(packed: &Packed) -> Self {
        let columns = vec![0.0; packed.used * BLOCK];
        Self { columns, nearest: [0.0; BLOCK], scale: [0.0; BLOCK], sound: [false; BLOCK] }
    }
}

/// Judges the products and squared lengths of a block.
#[inline(always)]
fn judge(
    queries: &Queries,
    packed: &Packed,
    products: &[[[f32; PANEL]; BLOCK]],
    squares: &[f32; BLOCK],
    out: &mut Judged,
) {
    for (n, column) in out.columns.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        for (value, products) in column.iter_mut().zip(&products[n / PANEL]) {
            *value = products[n % PANEL];
        }
    }
    let (phrases, linear) = out.columns.as_chunks::<BLOCK>().0.split_at(packed.used - 1);
    out.nearest = [f32::NEG_INFINITY; BLOCK];
    for canonical in &phrases[queries.wanted..] {
        for (nearest, product) in out.nearest.iter_mut().zip(canonical) {
            *nearest = if *product > *nearest { *product } else { *nearest };
        }
    }
    let constant = queries.norm.constant;
    for p in 0..BLOCK {
        let (square, norm2) = (squares[p], linear[0][p] + squares[p]);
        // False for NaN and infinities too, and where squares underflow.
        out.sound[p] = norm2 > CANCELLED * (constant + square) && square > 1e-30 && square < 1e30;
        out.scale[p] = queries.temperature / norm2.sqrt();
    }
}

enum Rare {
    Margins(Vec<f32>),
    Nothing,
    NonFinite,
}

/// The rare cases: zeros, numbers whose squares leave the range of f32, features that nearly vanish.
#[cold]
#[inline(never)]
fn judge_in_f64(queries: &Queries, row: &[f32]) -> Rare {
    if row.iter().any(|v| !v.is_finite()) {
        return Rare::NonFinite;
    }
    if row.iter().all(|v| *v == 0.0) {
        return Rare::Nothing;
    }
    let dot = |a: &[f32]| -> f64 { a.iter().zip(row).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let square: f64 = dot(row);
    let constant = f64::from(queries.norm.constant);
    let norm2 = constant + 2.0 * dot(&queries.norm.linear) + square;
    if norm2 <= VANISHED * (constant + square) {
        return Rare::Nothing;
    }
    let products: Vec<f64> =
        queries.phrases.iter().map(|p| f64::from(p.offset) + dot(&p.direction)).collect();
    let (wanted, canonical) = products.split_at(queries.wanted);
    let nearest = canonical.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let scale = f64::from(queries.temperature) / norm2.sqrt();
    Rare::Margins(wanted.iter().map(|p| ((p - nearest) * scale) as f32).collect())
}
