//! Products of small matrices with as many sums as AVX2 has registers for, of which compilers keep some in memory.

use std::arch::asm;
use std::arch::x86_64::__m256;

use super::{Finish, Product, TILE};

/// Samples of a tile that are multiplied at a time: three vectors of eight.
const WIDTH: usize = TILE / 2;

/// The three sums of output `j` of a block, `{a0}` to `{d2}`, begin with its bias.
macro_rules! begin {
    ($j:literal, $sums:literal) => {
        concat!(
            concat!("vbroadcastss {", $sums, "0}, [{bias} + 4 * ", $j, "]\n"),
            concat!("vmovaps {", $sums, "1}, {", $sums, "0}\n"),
            concat!("vmovaps {", $sums, "2}, {", $sums, "0}\n"),
        )
    };
}

/// Adds to the three sums of output `j` its weight of input number `k` of a round times the input's vectors.
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
            concat!("vmovups {x0}, [{at} + 192 * ", $k, "]\n"),
            concat!("vmovups {x1}, [{at} + 192 * ", $k, " + 32]\n"),
            concat!("vmovups {x2}, [{at} + 192 * ", $k, " + 64]\n"),
            output!($k, 0, "a"),
            output!($k, 1, "b"),
            output!($k, 2, "c"),
            output!($k, 3, "d"),
        )
    };
}

/// Asks for half of a block's rows at `{ahead}`, each of which is in two cache lines.
macro_rules! ask {
    ($row:literal) => {
        concat!(
            concat!("prefetcht0 [{ahead} + 192 * ", $row, "]\n"),
            concat!("prefetcht0 [{ahead} + 192 * ", $row, " + 64]\n"),
        )
    };
    () => {
        concat!(ask!(0), ask!(1), ask!(2), ask!(3), "add {ahead}, 768\n")
    };
}

/// Writes vector `v` of the sums of output `j`.
macro_rules! plain {
    ($j:literal, $sums:literal, $v:literal) => {
        concat!("vmovups [{y} + 192 * ", $j, " + 32 * ", $v, "], {", $sums, $v, "}\n")
    };
}

/// Likewise, negative ones as 0, which `{f}` is.
macro_rules! relu {
    ($j:literal, $sums:literal, $v:literal) => {
        concat!(concat!("vmaxps {", $sums, $v, "}, {", $sums, $v, "}, {f}\n"), plain!($j, $sums, $v),)
    };
}

/// Likewise, where 0 is less than `{rows}` (predicate 17).
macro_rules! masked {
    ($j:literal, $sums:literal, $v:literal) => {
        concat!(
            concat!("vcmpps {x", $v, "}, {f}, [{rows} + 192 * ", $j, " + 32 * ", $v, "], 17\n"),
            concat!("vandps {", $sums, $v, "}, {", $sums, $v, "}, {x", $v, "}\n"),
            plain!($j, $sums, $v),
        )
    };
}

/// Finishes the sums of output `j`.
macro_rules! finish {
    ($each:ident, $j:literal, $sums:literal) => {
        concat!($each!($j, $sums, 0), $each!($j, $sums, 1), $each!($j, $sums, 2))
    };
}

/// Half a tile of all blocks of outputs, finished by the macro `$each`; `$next` and `$rows` are for rows by which it does so.
macro_rules! half_tile {
    ($half:expr, $each:ident, $next:literal, $($rows:tt)*) => {{
        let Half { w, bias, x, y, rounds, blocks, ahead } = $half;
        asm!(
            "2:",
            begin!(0, "a"),
            begin!(1, "b"),
            begin!(2, "c"),
            begin!(3, "d"),
            ask!(),
            "mov {at}, {x}",
            "mov {left}, {rounds}",
            "3:",
            input!(0),
            input!(1),
            input!(2),
            input!(3),
            "add {at}, 768",
            "add {w}, 64",
            "dec {left}",
            "jne 3b",
            "vxorps {f}, {f}, {f}",
            finish!($each, 0, "a"),
            finish!($each, 1, "b"),
            finish!($each, 2, "c"),
            finish!($each, 3, "d"),
            "add {bias}, {bias_step}",
            "add {y}, 768",
            $next,
            "dec {blocks}",
            "jne 2b",
            $($rows)*
            w = inout(reg) w => _,
            x = in(reg) x,
            y = inout(reg) y => _,
            ahead = inout(reg) ahead => _,
            bias = inout(reg) bias.0 => _,
            bias_step = in(reg) bias.1,
            rounds = in(reg) rounds,
            blocks = inout(reg) blocks => _,
            at = out(reg) _,
            left = out(reg) _,
            a0 = out(ymm_reg) _, a1 = out(ymm_reg) _, a2 = out(ymm_reg) _,
            b0 = out(ymm_reg) _, b1 = out(ymm_reg) _, b2 = out(ymm_reg) _,
            c0 = out(ymm_reg) _, c1 = out(ymm_reg) _, c2 = out(ymm_reg) _,
            d0 = out(ymm_reg) _, d1 = out(ymm_reg) _, d2 = out(ymm_reg) _,
            x0 = out(ymm_reg) _, x1 = out(ymm_reg) _, x2 = out(ymm_reg) _, f = out(ymm_reg) _,
            options(nostack),
        );
    }};
}

/// What half a tile is made of.
struct Half {
    /// Weights, four of each input, block after block.
    w: *const f32,
    /// Biases of the first block, and bytes to those of the next.
    bias: (*const f32, usize),
    /// The half's first number of the first input, and of the first output.
    x: *const f32,
    y: *mut f32,
    /// Fours of inputs, and of outputs; at least one each.
    rounds: usize,
    blocks: usize,
    /// What is asked for, four rows a block.
    ahead: *const f32,
}

/// As [`super::multiply`], which has asserted that all lengths fit.
#[target_feature(enable = "avx,fma")]
pub fn multiply(Product { w, bias, x, finish, ahead }: Product, y: &mut [f32]) {
    const { assert!(TILE * size_of::<f32>() == 192 && WIDTH * size_of::<f32>() == 3 * size_of::<__m256>()) };
    static NO_BIAS: [f32; 4] = [0.0; 4];
    let (rounds, blocks) = (x.len() / TILE / 4, y.len() / TILE / 4);
    if blocks == 0 {
        return;
    }
    for first in [0, WIDTH] {
        let half = Half {
            w: w.as_ptr(),
            bias: if bias.is_empty() {
                (NO_BIAS.as_ptr(), 0)
            } else {
                (bias.as_ptr(), size_of_val(&NO_BIAS))
            },
            x: x[first..].as_ptr(),
            y: y[first..].as_mut_ptr(),
            rounds,
            blocks,
            ahead: ahead.wrapping_add(first),
        };
        // SAFETY: reads the weights of as many inputs and outputs as has been asserted, those inputs, and no or as many biases;
        // writes those outputs. What is asked for ahead may be anywhere.
        unsafe {
            match finish {
                Finish::Plain => half_tile!(half, plain, "",),
                Finish::Relu => half_tile!(half, relu, "",),
                Finish::Where(rows) => {
                    // As many rows as of the output.
                    let rows = rows[..y.len()][first..].as_ptr();
                    half_tile!(half, masked, "add {rows}, 768", rows = inout(reg) rows => _,);
                }
            }
        }
    }
}
