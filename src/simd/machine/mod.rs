//! Single instructions that no safe interface has: the one module of this crate with `unsafe` code.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
pub mod amx;
#[cfg(target_arch = "x86_64")]
mod lanes;
#[cfg(target_arch = "x86_64")]
mod products;

use super::TILE;
use super::lanes::Layout;

/// Asks for the cache line `bytes` behind `value` before it is needed; on other processors than x86-64, their own
/// prediction has to do.
#[inline(always)]
pub fn prefetch<T>(value: &T, bytes: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let at = std::ptr::from_ref(value).cast::<i8>().wrapping_add(bytes);
        // SAFETY: a hint; whatever the address, nothing is read that the program would see, and nothing faults.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(at) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (value, bytes);
}

/// Adds the sum of each of four rows of `lanes` numbers to every fourth number of `out`, and so on for the next four: how it is
/// divided among them depends on the machine.
#[inline(always)]
pub fn add_quarter_sums(rows: &[f32], lanes: usize, out: &mut [[f32; 16]]) {
    #[cfg(target_arch = "x86_64")]
    match lanes {
        // SAFETY: this processor has the instructions.
        16 if is_x86_feature_detected!("avx512f") => return unsafe { lanes::add_quarter_sums(rows, out) },
        // SAFETY: likewise.
        8 if is_x86_feature_detected!("avx") => return unsafe { lanes::add_half_sums(rows, out) },
        _ => {}
    }
    for (out, rows) in out.iter_mut().zip(rows.chunks_exact(4 * lanes)) {
        out.iter_mut().zip(rows.chunks_exact(lanes)).for_each(|(out, row)| *out += row.iter().sum::<f32>());
    }
}

/// Samples of a tile for which [`add_products`] multiplies at a time.
pub const PRODUCT_WIDTH: usize = TILE / 2;

/// Adds the sum over inputs k of `w[k][j] x[k * TILE + n]` to `sums[j][n]`, for a number of inputs that four divides, with a
/// fused multiply-add an input.
#[inline(always)]
pub fn add_products(w: &[[f32; 4]], x: &[f32], sums: &mut [[f32; PRODUCT_WIDTH]; 4]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx") && is_x86_feature_detected!("fma") {
        // SAFETY: this processor has the instructions.
        return unsafe { products::add_products(w, x, sums) };
    }
    add_products_one_by_one(w, x, sums);
}

fn add_products_one_by_one(w: &[[f32; 4]], x: &[f32], sums: &mut [[f32; PRODUCT_WIDTH]; 4]) {
    for (w, x) in w.iter().zip(x.chunks(TILE)) {
        for (sums, w) in sums.iter_mut().zip(w) {
            sums.iter_mut().zip(x).for_each(|(sum, x)| *sum = w.mul_add(*x, *sum));
        }
    }
}

/// As [`super::lanes::keep`], from number `first` of those kept on and without the zeros; false, and nothing is done, where there
/// are no instructions for it.
#[inline]
pub fn keep_lanes(values: &mut [f32], layout: Layout, kept: &[u32], first: usize) -> bool {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: this processor has the instructions.
        unsafe { lanes::keep(values, layout, kept, first) };
        return true;
    } else if is_x86_feature_detected!("avx2") {
        // SAFETY: likewise.
        unsafe { lanes::keep_eights(values, layout, kept, first) };
        return true;
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (values, layout, kept, first);
    false
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn products_are_those_of_one_number_after_the_other() {
        for inputs in [0, 4, 8, 64] {
            let mut rng = Rng::new(inputs as u64, 0, 0);
            let mut number = move || rng.uniform() - 0.5;
            let w: Vec<[f32; 4]> = (0..inputs).map(|_| std::array::from_fn(|_| number())).collect();
            for first in [0, PRODUCT_WIDTH] {
                let x: Vec<f32> = (0..inputs * TILE + first).map(|_| number()).collect();
                let mut fast = [[0.25; PRODUCT_WIDTH]; 4];
                let mut slow = fast;
                add_products(&w, &x[first..], &mut fast);
                add_products_one_by_one(&w, &x[first..], &mut slow);
                assert_eq!(fast, slow);
            }
        }
    }
}
