//! Lanes of which some stay, and sums over lanes, sixteen at a time (AVX-512).

use std::arch::x86_64::{
    __m512, _mm512_add_ps, _mm512_castpd_ps, _mm512_castps_pd, _mm512_loadu_epi32, _mm512_loadu_ps,
    _mm512_mask_permutexvar_ps, _mm512_setzero_ps, _mm512_storeu_ps, _mm512_unpackhi_pd, _mm512_unpackhi_ps,
    _mm512_unpacklo_pd, _mm512_unpacklo_ps,
};

use crate::simd::TILE;
use crate::simd::lanes::Layout;

/// Lanes of a register.
const LANES: usize = 16;

/// Lanes of one register that come from another.
#[derive(Clone, Copy)]
struct Part {
    /// Place of the register that they come from.
    from: usize,
    /// Those lanes.
    lanes: u16,
}

/// As [`crate::simd::lanes::keep`], but for the zeros, from the lanes around number `first` of those kept.
#[target_feature(enable = "avx512f")]
pub fn keep(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) {
    let last = (layout.rows - 1) * TILE;
    // The lanes that are at their places among the sixteen of the first that is not move nowhere.
    for (n, kept) in kept.chunks(LANES).enumerate().skip(first / LANES) {
        let to = layout.place(n * LANES);
        assert!(to + last + LANES <= values.len(), "places of lanes that are kept are in some tile");
        // Which lane of its register each of them is.
        let mut lanes = [0; LANES];
        let mut parts = [Part { from: to, lanes: 0 }; LANES];
        let (mut count, mut register) = (0, usize::MAX);
        for (n, lane) in kept.iter().map(|lane| *lane as usize).enumerate() {
            if lane / LANES != register {
                register = lane / LANES;
                parts[count].from = layout.place(register * LANES);
                assert!(
                    parts[count].from + last + LANES <= values.len(),
                    "lanes that are kept are in some tile"
                );
                count += 1;
            }
            lanes[n] = (lane % LANES) as i32;
            parts[count - 1].lanes |= 1 << n;
        }
        // SAFETY: as many numbers as are read.
        let lanes = unsafe { _mm512_loadu_epi32(lanes.as_ptr()) };
        for row in 0..layout.rows {
            let at = values.as_mut_ptr().wrapping_add(row * TILE);
            // All of them are read before anything is written, which may be where one was read. Few registers have lanes of more
            // than two.
            let mut sum = _mm512_setzero_ps();
            for part in &parts[..count.max(2)] {
                // SAFETY: within the values, by the assertions.
                let x = unsafe { _mm512_loadu_ps(at.wrapping_add(part.from)) };
                sum = _mm512_mask_permutexvar_ps(sum, part.lanes, lanes, x);
            }
            // SAFETY: likewise.
            unsafe { _mm512_storeu_ps(at.wrapping_add(to), sum) };
        }
    }
}

/// As [`super::add_quarter_sums`]: a quarter of a register has a part of four rows.
#[target_feature(enable = "avx512f")]
pub fn add_quarter_sums(rows: &[[[f32; LANES]; 4]], out: &mut [[f32; LANES]]) {
    for (out, [a, b, c, d]) in out.iter_mut().zip(rows) {
        let a = _mm512_castps_pd(add_halves(load(a), load(b)));
        let b = _mm512_castps_pd(add_halves(load(c), load(d)));
        let sums = _mm512_add_ps(
            _mm512_castpd_ps(_mm512_unpacklo_pd(a, b)),
            _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)),
        );
        // SAFETY: as many floats as are written.
        unsafe { _mm512_storeu_ps(out.as_mut_ptr(), _mm512_add_ps(load(out), sums)) };
    }
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
