//! Lanes of which some stay, and sums over lanes, sixteen at a time (AVX-512).

use std::arch::x86_64::{
    __m512, _mm512_add_ps, _mm512_castpd_ps, _mm512_castps_pd, _mm512_loadu_ps, _mm512_mask_storeu_ps,
    _mm512_maskz_compress_ps, _mm512_setzero_ps, _mm512_shuffle_f32x4, _mm512_storeu_ps, _mm512_unpackhi_pd,
    _mm512_unpackhi_ps, _mm512_unpacklo_pd, _mm512_unpacklo_ps,
};

use crate::simd::TILE;
use crate::simd::lanes::Layout;

/// Lanes of a register.
const LANES: usize = 16;

/// As [`crate::simd::lanes::keep`], but for the zeros, from the lanes around number `first` of those kept.
#[target_feature(enable = "avx512f")]
pub fn keep(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) {
    // The lanes that are at their places among the sixteen of the first that is not move nowhere.
    let mut to = first - first % LANES;
    while to < kept.len() {
        let group = kept[to] as usize / LANES;
        let from = layout.place(group * LANES);
        let end = to + kept[to..].partition_point(|lane| *lane as usize / LANES == group);
        // What does not fit into the tile begins the next.
        let part = end.min((to / TILE + 1) * TILE);
        let places = [to, part].map(|n| layout.place(n));
        let masks = [&kept[to..part], &kept[part..end]].map(lanes);
        let last = (layout.rows - 1) * TILE;
        assert!(from + last + LANES <= values.len(), "lanes that are kept are in some tile");
        assert!(places[0] + last + (part - to) <= values.len());
        assert!(part == end || places[1] + last + (end - part) <= values.len());
        for row in 0..layout.rows {
            let at = values.as_mut_ptr().wrapping_add(row * TILE);
            // Read before anything is written, which may be in part where it was read.
            // SAFETY: within the values, by the first assertion.
            let x = unsafe { _mm512_loadu_ps(at.wrapping_add(from)) };
            // SAFETY: as many lanes as the mask has are within the values, by the other assertions.
            unsafe { store(at.wrapping_add(places[0]), masks[0], x) };
            if part < end {
                // SAFETY: likewise.
                unsafe { store(at.wrapping_add(places[1]), masks[1], x) };
            }
        }
        to = end;
    }
}

/// The lanes of a register as a mask.
fn lanes(kept: &[u32]) -> u16 {
    kept.iter().fold(0, |mask, lane| mask | 1 << (*lane as usize % LANES))
}

/// Writes the lanes `mask` of `x` one after the other to `to`.
///
/// # Safety
///
/// As many floats as the mask has ones can be written there.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn store(to: *mut f32, mask: u16, x: __m512) {
    let written = ((1u32 << mask.count_ones()) - 1) as u16;
    // SAFETY: the caller's promise; lanes that are not written are not touched.
    unsafe { _mm512_mask_storeu_ps(to, written, _mm512_maskz_compress_ps(mask, x)) };
}

/// As [`super::row_sums`]: halves of two rows are added until a register holds a part of sixteen.
#[inline]
#[target_feature(enable = "avx512f")]
pub fn row_sums(rows: &[[f32; LANES]; LANES]) -> [f32; LANES] {
    let mut quarters = [_mm512_setzero_ps(); 4];
    for (rows, quarter) in rows.as_chunks::<4>().0.iter().zip(&mut quarters) {
        let a = _mm512_castps_pd(add_halves(load(&rows[0]), load(&rows[1])));
        let b = _mm512_castps_pd(add_halves(load(&rows[2]), load(&rows[3])));
        *quarter = _mm512_add_ps(
            _mm512_castpd_ps(_mm512_unpacklo_pd(a, b)),
            _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)),
        );
    }
    // Every quarter of these registers has a part of four rows: now the quarters.
    let [a, b, c, d] = quarters;
    let all = add_quarters(add_quarters(a, b), add_quarters(c, d));
    let mut sums = [0.0; LANES];
    // SAFETY: as many floats as are written.
    unsafe { _mm512_storeu_ps(sums.as_mut_ptr(), all) };
    sums
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load(row: &[f32; LANES]) -> __m512 {
    // SAFETY: as many floats as are read.
    unsafe { _mm512_loadu_ps(row.as_ptr()) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn add_halves(a: __m512, b: __m512) -> __m512 {
    _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b))
}

#[inline]
#[target_feature(enable = "avx512f")]
fn add_quarters(a: __m512, b: __m512) -> __m512 {
    _mm512_add_ps(_mm512_shuffle_f32x4::<0x88>(a, b), _mm512_shuffle_f32x4::<0xdd>(a, b))
}
