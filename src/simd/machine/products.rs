//! Products of small matrices with as many sums as AVX2 has registers for, of which compilers keep some in memory.

use std::arch::asm;
use std::arch::x86_64::*;

use super::{Finish, TILE, prefetch_rows};

/// Numbers of a vector.
const LANES: usize = 8;

/// Samples of a tile that are multiplied at a time.
const WIDTH: usize = TILE / 2;

/// Adds to the three sums of output `j` of `{a0}` to `{d2}` its weight of input number `k` times the input's vectors.
macro_rules! output {
    ($k:literal, $j:literal, $sums:literal) => {
        concat!(
            concat!("vbroadcastss {f}, [{w} + 16 * ", $k, " + 4 * ", $j, "]\n"),
            concat!("vfmadd231ps {", $sums, "0}, {f}, {x0}\n"),
            concat!("vfmadd231ps {", $sums, "1}, {f}, {x1}\n"),
            concat!("vfmadd231ps {", $sums, "2}, {f}, {x2}\n"),
        )
    };
}

/// Input number `k` of a round. Twelve sums, three vectors and a weight are all sixteen registers.
macro_rules! input {
    ($k:literal) => {
        concat!(
            concat!("vmovups {x0}, [{x} + 192 * ", $k, "]\n"),
            concat!("vmovups {x1}, [{x} + 192 * ", $k, " + 32]\n"),
            concat!("vmovups {x2}, [{x} + 192 * ", $k, " + 64]\n"),
            output!($k, 0, "a"),
            output!($k, 1, "b"),
            output!($k, 2, "c"),
            output!($k, 3, "d"),
        )
    };
}

/// As [`super::multiply`], which has asserted that all lengths fit.
#[target_feature(enable = "avx,fma")]
pub fn multiply(w: &[[f32; 4]], bias: &[[f32; 4]], x: &[f32], finish: Finish, y: &mut [f32]) {
    let inputs = x.len() / TILE;
    for first in [0, WIDTH] {
        for (block, (w, y)) in w.chunks_exact(inputs).zip(y.chunks_exact_mut(4 * TILE)).enumerate() {
            let at = block * 4 * TILE + first;
            // There are more tiles in a chunk than a near cache holds.
            prefetch_rows::<[f32; WIDTH]>(y[first..].as_chunks().0, 0, TILE / WIDTH);
            let finish = match finish {
                Finish::Where(rows) => Finish::Where(&rows[at..]),
                other => other,
            };
            if let Finish::Where(rows) = finish {
                prefetch_rows::<[f32; WIDTH]>(rows.as_chunks().0, 0, TILE / WIDTH);
            }
            products(w, bias.get(block).copied().unwrap_or_default(), &x[first..], finish, &mut y[first..]);
        }
    }
}

/// Half a tile of four outputs.
#[inline]
#[target_feature(enable = "avx,fma")]
fn products(w: &[[f32; 4]], bias: [f32; 4], x: &[f32], finish: Finish, y: &mut [f32]) {
    const { assert!(TILE * size_of::<f32>() == 192 && WIDTH == 3 * LANES) };
    let rounds = w.len() / 4;
    assert!(rounds > 0 && x.len() >= (4 * rounds - 1) * TILE + WIDTH);
    let [mut a0, mut b0, mut c0, mut d0] = bias.map(|b| _mm256_set1_ps(b));
    let [[mut a1, mut b1, mut c1, mut d1], [mut a2, mut b2, mut c2, mut d2]] = [[a0, b0, c0, d0]; 2];
    // SAFETY: reads four weights of each of four inputs a round, and of each input as many numbers as have been asserted.
    unsafe {
        asm!(
            "2:",
            input!(0),
            input!(1),
            input!(2),
            input!(3),
            "add {x}, 768",
            "add {w}, 64",
            "cmp {w}, {end}",
            "jne 2b",
            x = inout(reg) x.as_ptr() => _,
            w = inout(reg) w.as_ptr() => _,
            end = in(reg) w.as_ptr().wrapping_add(4 * rounds),
            a0 = inout(ymm_reg) a0, a1 = inout(ymm_reg) a1, a2 = inout(ymm_reg) a2,
            b0 = inout(ymm_reg) b0, b1 = inout(ymm_reg) b1, b2 = inout(ymm_reg) b2,
            c0 = inout(ymm_reg) c0, c1 = inout(ymm_reg) c1, c2 = inout(ymm_reg) c2,
            d0 = inout(ymm_reg) d0, d1 = inout(ymm_reg) d1, d2 = inout(ymm_reg) d2,
            x0 = out(ymm_reg) _, x1 = out(ymm_reg) _, x2 = out(ymm_reg) _, f = out(ymm_reg) _,
            options(readonly, nostack),
        );
    }
    let sums = [[a0, a1, a2], [b0, b1, b2], [c0, c1, c2], [d0, d1, d2]];
    let zero = _mm256_setzero_ps();
    // One short path for each way to finish: all sums stay in registers.
    match finish {
        Finish::Plain => store(sums, y),
        Finish::Relu => store(sums.map(|row| row.map(|sum| _mm256_max_ps(sum, zero))), y),
        Finish::Where(rows) => {
            let mut kept = sums;
            for (n, row) in kept.iter_mut().enumerate() {
                for (sum, x) in row.iter_mut().zip(load(&rows[n * TILE..])) {
                    *sum = _mm256_and_ps(*sum, _mm256_cmp_ps::<_CMP_GT_OQ>(x, zero));
                }
            }
            store(kept, y);
        }
    }
}

#[inline]
#[target_feature(enable = "avx")]
fn load(row: &[f32]) -> [__m256; 3] {
    let at = row[..WIDTH].as_ptr();
    // SAFETY: as many floats as are read.
    unsafe { [_mm256_loadu_ps(at), _mm256_loadu_ps(at.add(LANES)), _mm256_loadu_ps(at.add(2 * LANES))] }
}

#[inline]
#[target_feature(enable = "avx")]
fn store(rows: [[__m256; 3]; 4], y: &mut [f32]) {
    for (n, row) in rows.into_iter().enumerate() {
        let at = y[n * TILE..][..WIDTH].as_mut_ptr();
        // SAFETY: as many floats as are written.
        unsafe {
            _mm256_storeu_ps(at, row[0]);
            _mm256_storeu_ps(at.add(LANES), row[1]);
            _mm256_storeu_ps(at.add(2 * LANES), row[2]);
        }
    }
}
