//! What this machine can do at most: the units of the floors that benchmarks print beside times.
//!
//! Measured on the spot, since floors of another machine say nothing.

use std::hint::black_box;
use std::time::Instant;

use divff::field::hashgrid::Row;
use divff::simd::{Finish, Product, TILE, dots, matrix};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// Rounds of which the fastest counts.
const ROUNDS: usize = 5;

/// Rows of a table of 2 MiB, as most levels have.
pub const LEVEL_ROWS: usize = 1 << 17;

/// Rows of the smallest and of the largest table that is measured, powers of two: 1 KiB and 16 MiB.
const ROWS: [usize; 2] = [1 << 6, 1 << 20];

/// Rates of some threads together.
pub struct Machine {
    /// Floating-point operations a second in f32, a fused multiply-add being two.
    pub flops: f64,
    /// The same in bf16: on matrix units 2600 GFLOP/s a thread, which is not measured, unless `DIVFF_BF16_GFLOPS` says otherwise; else
    /// what products in the nearest cache reach.
    pub bf16_flops: f64,
    /// Rows of 16 bytes read a second from tables of [`ROWS`], twice as many, and so on, one table a thread: in pairs of neighbours
    /// at random places.
    read: Vec<f64>,
    /// Rows added to a second there: read, and written back.
    added: Vec<f64>,
    /// Bytes a second read from wherever they are kept and written back.
    pub bytes: f64,
}

impl Machine {
    /// Measures `threads` threads, of which `state` bytes are read and written in turn: on many machines a cache holds those of
    /// all tables.
    pub fn measure(threads: usize, state: usize) -> Self {
        let pool =
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started");
        let told = std::env::var("DIVFF_BF16_GFLOPS").ok().and_then(|v| v.parse::<f64>().ok());
        let bf16_flops = || match (told, matrix::available()) {
            (None, false) => best(|| together(&mut vec![(); threads], |()| bf16_products())),
            (told, _) => 1e9 * told.unwrap_or(2600.0) * threads as f64,
        };
        let flops =
            || best(|| together(&mut vec![(); threads], |()| pulp::Arch::new().dispatch(MultiplyAdds)));
        pool.install(|| {
            // Before and after all else, since it takes so little time that a neighbour can be there for all of it.
            let before = flops();
            let read = tables(threads, |table| pulp::Arch::new().dispatch(Reads(table)));
            let added = tables(threads, |table| pulp::Arch::new().dispatch(Adds(table)));
            let bytes = bytes(threads, state);
            Self { flops: flops().max(before), bf16_flops: bf16_flops(), read, added, bytes }
        })
    }

    /// Rows read and rows added to a second, of a table that is not smaller than the one for which this was measured.
    pub fn rows(&self, table: usize) -> [f64; 2] {
        let n = (table.clamp(ROWS[0], ROWS[1]) / ROWS[0]).ilog2() as usize;
        [self.read[n], self.added[n]]
    }
}

/// Best rates of what is done with a table of a thread's own, of all sizes.
fn tables(threads: usize, work: impl Fn(&mut [Row]) -> f64 + Sync) -> Vec<f64> {
    let [least, most] = ROWS.map(usize::ilog2);
    let mut tables = vec![vec![Row::ONE; ROWS[1]]; threads];
    (least..=most).map(|log2| best(|| together(&mut tables, |table| work(&mut table[..1 << log2])))).collect()
}

fn best(mut rate: impl FnMut() -> f64) -> f64 {
    (0..ROUNDS).map(|_| rate()).fold(0.0, f64::max)
}

/// What all threads do a second when each does `work` on one of `states`, which says how much that was.
fn together<T: Send>(states: &mut [T], work: impl Fn(&mut T) -> f64 + Sync) -> f64 {
    let start = Instant::now();
    let done: f64 = states.par_iter_mut().map(&work).sum();
    done / start.elapsed().as_secs_f64()
}

fn bytes(threads: usize, state: usize) -> f64 {
    let mut floats = vec![1f32; (state / size_of::<f32>()).max(threads)];
    let chunk = floats.len().div_ceil(threads);
    let round = || {
        let start = Instant::now();
        floats.par_chunks_mut(chunk).for_each(|c| pulp::Arch::new().dispatch(Rewrites(c)));
        // Read, and written.
        2.0 * state as f64 / start.elapsed().as_secs_f64()
    };
    let fastest = best(round);
    black_box(&floats);
    fastest
}

/// Operations of products of pairs of bf16 that stay in the nearest cache.
fn bf16_products() -> f64 {
    const INPUTS: usize = 64;
    const OUTPUTS: usize = 64;
    const TIMES: usize = 4_000;
    let (w, x) = (vec![0; OUTPUTS * INPUTS / 2], vec![0; INPUTS / 2 * TILE]);
    let mut y = vec![0.0; OUTPUTS * TILE];
    for _ in 0..TIMES {
        let product = Product { w: &w, bias: &[], x: &x, finish: Finish::Plain, ahead: std::ptr::null() };
        dots::multiply(black_box(product), &mut y);
        black_box(&mut y);
    }
    (2 * TIMES * OUTPUTS * INPUTS * TILE) as f64
}

/// Numbers that are read and written back.
struct Rewrites<'a>(&'a mut [f32]);

impl WithSimd for Rewrites<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for v in self.0 {
            *v *= 0.999;
        }
    }
}

/// As many sums as hide the latency of a fused multiply-add.
struct MultiplyAdds;

impl WithSimd for MultiplyAdds {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        const SUMS: usize = 12;
        const TIMES: usize = 4_000_000;
        let (a, b) = (simd.splat_f32s(black_box(0.5)), simd.splat_f32s(black_box(1.0)));
        let mut sums = [simd.splat_f32s(0.0); SUMS];
        for _ in 0..TIMES {
            for sum in &mut sums {
                *sum = simd.mul_add_f32s(a, *sum, b);
            }
        }
        for sum in sums {
            black_box(simd.reduce_sum_f32s(sum));
        }
        (2 * SUMS * TIMES * S::F32_LANES) as f64
    }
}

/// Times that [`LANES`] pairs of rows are read or added to.
const TIMES: usize = 1 << 17;

/// Sequences of random rows that do not wait for one another.
const LANES: usize = 16;

/// Random numbers of rows, as many of a table as a power of two.
struct Places {
    states: [u32; LANES],
    /// Bits that are not of the number.
    shift: u32,
}

impl Places {
    fn new(rows: usize) -> Self {
        Self { states: std::array::from_fn(|n| 2 * n as u32 + 1), shift: u32::BITS - rows.ilog2() }
    }

    #[inline(always)]
    fn next(&mut self) -> [usize; LANES] {
        let mut places = [0; LANES];
        for (state, place) in self.states.iter_mut().zip(&mut places) {
            *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *place = (*state >> self.shift) as usize;
        }
        places
    }
}

/// Reads of rows.
struct Reads<'a>(&'a [Row]);

impl WithSimd for Reads<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> f64 {
        let (mut places, mut sums) = (Places::new(self.0.len()), [Row::ZERO; 4]);
        for _ in 0..TIMES {
            for (n, row) in places.next().into_iter().enumerate() {
                sums[n % 4] += self.0[row] + self.0[row ^ 1];
            }
        }
        black_box(sums);
        (2 * LANES * TIMES) as f64
    }
}

/// Rows that something is added to.
struct Adds<'a>(&'a mut [Row]);

impl WithSimd for Adds<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) -> f64 {
        let mut places = Places::new(self.0.len());
        for _ in 0..TIMES {
            for row in places.next() {
                self.0[row] += Row::ONE;
                self.0[row ^ 1] += Row::ONE;
            }
        }
        black_box(self.0);
        (2 * LANES * TIMES) as f64
    }
}
