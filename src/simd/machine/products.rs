//! Products of small matrices with as many sums as AVX2 has registers for, of which compilers keep some in memory.

use std::arch::asm;
use std::arch::x86_64::{__m256, _mm256_loadu_ps, _mm256_storeu_ps};

use super::{PRODUCT_WIDTH, TILE};

/// Numbers of a vector.
const LANES: usize = 8;

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

/// As [`super::add_products`], for a number of inputs that four divides.
#[inline]
#[target_feature(enable = "avx,fma")]
pub fn add_products(w: &[[f32; 4]], x: &[f32], sums: &mut [[f32; PRODUCT_WIDTH]; 4]) {
    const { assert!(TILE * size_of::<f32>() == 192 && PRODUCT_WIDTH == 3 * LANES) };
    let rounds = w.len() / 4;
    if rounds == 0 {
        return;
    }
    assert!(x.len() >= (4 * rounds - 1) * TILE + PRODUCT_WIDTH);
    let [
        [mut a0, mut a1, mut a2],
        [mut b0, mut b1, mut b2],
        [mut c0, mut c1, mut c2],
        [mut d0, mut d1, mut d2],
    ] = [load(&sums[0]), load(&sums[1]), load(&sums[2]), load(&sums[3])];
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
    store([a0, a1, a2], &mut sums[0]);
    store([b0, b1, b2], &mut sums[1]);
    store([c0, c1, c2], &mut sums[2]);
    store([d0, d1, d2], &mut sums[3]);
}

#[inline]
#[target_feature(enable = "avx")]
fn load(row: &[f32; PRODUCT_WIDTH]) -> [__m256; 3] {
    let at = row.as_ptr();
    // SAFETY: as many floats as are read.
    unsafe { [_mm256_loadu_ps(at), _mm256_loadu_ps(at.add(LANES)), _mm256_loadu_ps(at.add(2 * LANES))] }
}

#[inline]
#[target_feature(enable = "avx")]
fn store(vectors: [__m256; 3], row: &mut [f32; PRODUCT_WIDTH]) {
    let at = row.as_mut_ptr();
    // SAFETY: as many floats as are written.
    unsafe {
        _mm256_storeu_ps(at, vectors[0]);
        _mm256_storeu_ps(at.add(LANES), vectors[1]);
        _mm256_storeu_ps(at.add(2 * LANES), vectors[2]);
    }
}
