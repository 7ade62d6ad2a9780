//! Rows of tables two at a time, which compilers would take one by one, and without asking of each whether it is there.

use std::arch::x86_64::*;

use glam::Vec4;

use super::super::rows::Corners;
use super::TILE;

/// As [`super::interpolate`], which has asserted that all rows are in the table and all points in the tile.
#[target_feature(enable = "avx")]
pub unsafe fn interpolate(table: &[Vec4], corners: &Corners, ahead: Option<&Corners>, out: &mut [Vec4]) {
    let frac = &corners.frac;
    for (lane, out) in out.iter_mut().enumerate().take(TILE) {
        fetch(table, ahead, lane);
        // SAFETY: all of these rows are in the table.
        let [a, b, c, d] = unsafe {
            match corners.edges {
                Some([a, b, c, d]) => {
                    let first = corners.rows[0][lane];
                    [
                        next_to_another(table, first + a),
                        next_to_another(table, first + b),
                        next_to_another(table, first + c),
                        next_to_another(table, first + d),
                    ]
                }
                None => {
                    let [a0, a1, b0, b1, c0, c1, d0, d1] = &corners.rows;
                    [
                        two_rows(table, a0[lane], a1[lane]),
                        two_rows(table, b0[lane], b1[lane]),
                        two_rows(table, c0[lane], c1[lane]),
                        two_rows(table, d0[lane], d1[lane]),
                    ]
                }
            }
        };
        let (fy, fz) = (_mm256_set1_ps(frac[1][lane]), _mm256_set1_ps(frac[2][lane]));
        let face = between(between(a, b, fy), between(c, d, fy), fz);
        let (low, high) = (_mm256_castps256_ps128(face), _mm256_extractf128_ps::<1>(face));
        let along_x = _mm_mul_ps(_mm_sub_ps(high, low), _mm_set1_ps(frac[0][lane]));
        *out = Vec4::from(_mm_add_ps(low, along_x));
    }
}

/// As [`super::scatter`], which has asserted likewise.
#[target_feature(enable = "avx")]
pub unsafe fn scatter(table: &mut [Vec4], corners: &Corners, ahead: Option<&Corners>, g: &[Vec4]) {
    let frac = &corners.frac;
    let (one, ones) = (_mm_set1_ps(1.0), _mm256_set1_ps(1.0));
    for (lane, g) in g.iter().enumerate().take(TILE) {
        fetch(table, ahead, lane);
        let g = __m128::from(*g);
        let fx = _mm_set1_ps(frac[0][lane]);
        let g = _mm256_set_m128(_mm_mul_ps(g, fx), _mm_mul_ps(g, _mm_sub_ps(one, fx)));
        let (fy, fz) = (_mm256_set1_ps(frac[1][lane]), _mm256_set1_ps(frac[2][lane]));
        let (near, far) = (_mm256_mul_ps(g, _mm256_sub_ps(ones, fz)), _mm256_mul_ps(g, fz));
        let to_y = _mm256_sub_ps(ones, fy);
        let of_edges = [
            _mm256_mul_ps(near, to_y),
            _mm256_mul_ps(near, fy),
            _mm256_mul_ps(far, to_y),
            _mm256_mul_ps(far, fy),
        ];
        for (edge, g) in of_edges.into_iter().enumerate() {
            let (low, high) = match corners.edges {
                Some(edges) => (corners.rows[0][lane] + edges[edge], corners.rows[0][lane] + edges[edge] + 1),
                None => (corners.rows[2 * edge][lane], corners.rows[2 * edge + 1][lane]),
            };
            // One by one: what reads two rows that were written with others has to wait until they are.
            // SAFETY: both rows are in the table.
            unsafe {
                add_to_row(table, low, _mm256_castps256_ps128(g));
                add_to_row(table, high, _mm256_extractf128_ps::<1>(g));
            }
        }
    }
}

/// Rows `low` and `high` of a table that has them.
#[target_feature(enable = "avx")]
unsafe fn two_rows(table: &[Vec4], low: u32, high: u32) -> __m256 {
    // SAFETY: as above.
    let [low, high] = unsafe { [table.get_unchecked(low as usize), table.get_unchecked(high as usize)] };
    _mm256_set_m128(__m128::from(*high), __m128::from(*low))
}

/// Row `number` of a table that has it and one behind it, and that.
#[target_feature(enable = "avx")]
unsafe fn next_to_another(table: &[Vec4], number: u32) -> __m256 {
    // SAFETY: as above.
    unsafe { _mm256_loadu_ps(table.as_ptr().add(number as usize).cast()) }
}

/// Adds `g` to row `number` of a table that has it.
#[target_feature(enable = "avx")]
unsafe fn add_to_row(table: &mut [Vec4], number: u32, g: __m128) {
    // SAFETY: as above.
    let row = unsafe { table.get_unchecked_mut(number as usize) };
    *row = Vec4::from(_mm_add_ps(__m128::from(*row), g));
}

/// From `a` to `b` by the fraction `f`.
#[target_feature(enable = "avx")]
fn between(a: __m256, b: __m256, f: __m256) -> __m256 {
    _mm256_add_ps(a, _mm256_mul_ps(_mm256_sub_ps(b, a), f))
}

/// Asks for the rows of a table around the point of lane `lane`.
#[target_feature(enable = "avx")]
fn fetch(table: &[Vec4], corners: Option<&Corners>, lane: usize) {
    let Some(Corners { rows, edges, .. }) = corners else { return };
    let ask = |row: u32| _mm_prefetch::<_MM_HINT_T0>(table.as_ptr().wrapping_add(row as usize).cast());
    match edges {
        // Three of four pairs of rows are on one line.
        Some(edges) => edges.iter().for_each(|edge| ask(rows[0][lane].wrapping_add(*edge))),
        None => rows.iter().for_each(|rows| ask(rows[lane])),
    }
}
