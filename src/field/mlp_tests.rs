//! The network kernels against plain f64 loops, and the vector widths against each other.

use pulp::{Simd, WithSimd};

use super::mlp::{Activations, Arithmetic, Mlp};
use crate::rng::Rng;
use crate::simd::matrix::Unit;
use crate::simd::{AlignedVec, TILE};

/// Tiles of a chunk.
const TILES: usize = 3;

/// A network: its widths, and the layer that sees the input again.
type Shape = (&'static [usize], Option<usize>);

/// Networks of odd widths, one to four layers; some see their input again, in the middle, at the end or after the first
/// layer; and one as wide as the paper's.
const SHAPES: [Shape; 8] = [
    (&[1, 1], None),
    (&[5, 7, 3], None),
    (&[13, 6, 9, 4], None),
    (&[33, 18, 1, 17, 2], None),
    (&[9, 5, 11, 3], Some(1)),
    (&[13, 6, 9, 10, 4], Some(2)),
    (&[35, 7, 5], Some(1)),
    (&[64, 256, 256, 256, 16], Some(2)),
];

/// Networks that are compared with f64.
const SEEDS: usize = 100;

/// A network, inputs and output gradients, all random.
struct Case {
    net: Mlp,
    params: Vec<f32>,
    /// Activations with the inputs filled in.
    tiles: AlignedVec,
    /// Gradients with the outputs filled in.
    grads: AlignedVec,
}

/// What the kernels make of a case: outputs `[tile][output][TILE]`, gradients of the inputs, and of the parameters.
struct Outcome {
    values: Vec<f32>,
    gradients: Vec<f32>,
    params: Vec<f32>,
}

struct Pass<'a>(&'a Case, Arithmetic, Unit);

impl WithSimd for Pass<'_> {
    type Output = Outcome;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Outcome {
        let Self(case, arithmetic, unit) = self;
        let Case { net, params, tiles, grads } = case;
        let packed = net.pack_for(params, arithmetic);
        let (rows, input, output) = (net.rows() * TILE, net.input() * TILE, net.output_row() * TILE);
        let mut a = Activations::default();
        net.reserve(&packed, TILES, &mut a);
        let (mut values, mut sums) = (Vec::new(), vec![0.0; net.parameters()]);
        for n in 0..TILES {
            a.input(n).copy_from_slice(&tiles[n * rows..][..input]);
            net.forward(simd, &unit, &packed, &mut a, n);
            values.extend_from_slice(a.output(n));
        }
        let mut gradients = Vec::new();
        net.reserve_backward::<S>(TILES, &mut a);
        for n in 0..TILES {
            a.output_grad().copy_from_slice(&grads[n * rows + output..(n + 1) * rows]);
            net.backward(simd, &unit, &packed, &mut a, n);
            gradients.extend_from_slice(a.input_grad());
        }
        net.finish(simd, &packed, &mut a, &mut sums);
        Outcome { values, gradients, params: sums }
    }
}

impl Case {
    fn new((widths, skip): Shape, seed: u64) -> Self {
        let net = Mlp::with_skip(widths, skip);
        let mut rng = Rng::new(seed, 0, 0);
        let mut number = move || 2.0 * rng.uniform() - 1.0;
        // Wide layers have weights so small that what comes out is about as large as what goes in.
        let mut params = Vec::new();
        for [n_in, n_out] in net.shapes() {
            let size = if n_in > 36 { (3.0 / n_in as f32).sqrt() } else { 1.0 };
            params.extend((0..(n_in + 1) * n_out).map(|_| size * number()));
        }
        let (rows, input, output) = (net.rows(), net.input(), net.output_row());
        let mut tiles = AlignedVec::zeros(TILES * rows * TILE);
        let mut grads = AlignedVec::zeros(TILES * rows * TILE);
        for n in 0..TILES {
            tiles[n * rows * TILE..][..input * TILE].fill_with(&mut number);
            grads[(n * rows + output) * TILE..(n + 1) * rows * TILE].fill_with(&mut number);
        }
        Self { net, params, tiles, grads }
    }

    /// The same with one of its tiles as the first.
    fn tile(&self, tile: usize) -> Self {
        let floats = self.net.rows() * TILE;
        let first = |all: &AlignedVec| {
            let mut moved = AlignedVec::zeros(all.len());
            moved[..floats].copy_from_slice(&all[tile * floats..][..floats]);
            moved
        };
        Self {
            net: self.net.clone(),
            params: self.params.clone(),
            tiles: first(&self.tiles),
            grads: first(&self.grads),
        }
    }

    /// Activations and gradients of one sample in f64; adds its parameter gradients to `sums`.
    fn naive(&self, tile: usize, lane: usize, sums: &mut [f64]) -> (Vec<f64>, Vec<f64>) {
        let shapes: Vec<[usize; 2]> = self.net.shapes().collect();
        let (rows, first) = (self.net.rows(), self.net.input());
        let at = |data: &[f32], row: usize| f64::from(data[(tile * rows + row) * TILE + lane]);
        let mut values: Vec<Vec<f64>> = vec![(0..first).map(|i| at(&self.tiles, i)).collect()];
        let mut starts = vec![0];
        let w = |n: usize| f64::from(self.params[n]);
        for (n, &[n_in, n_out]) in shapes.iter().enumerate() {
            let start = starts[n];
            if values[n].len() < n_in {
                let input = values[0].clone();
                values[n].extend(input);
            }
            let x = &values[n];
            let y = (0..n_out).map(|o| {
                let sum: f64 = (0..n_in).map(|i| w(start + o * n_in + i) * x[i]).sum();
                let y = sum + w(start + n_in * n_out + o);
                if n + 1 < shapes.len() { y.max(0.0) } else { y }
            });
            let y = y.collect();
            values.push(y);
            starts.push(start + n_in * n_out + n_out);
        }
        let mut grads = vec![(self.net.output_row()..rows).map(|o| at(&self.grads, o)).collect::<Vec<_>>()];
        let mut again = vec![0.0; first];
        for (n, &[n_in, n_out]) in shapes.iter().enumerate().rev() {
            let (x, dy) = (&values[n], &grads[0]);
            for o in 0..n_out {
                for i in 0..n_in {
                    sums[starts[n] + o * n_in + i] += dy[o] * x[i];
                }
                sums[starts[n] + n_in * n_out + o] += dy[o];
            }
            let dx = (0..n_in).map(|i| {
                let sum = (0..n_out).map(|o| w(starts[n] + o * n_in + i) * dy[o]).sum();
                let stopped = n > 0 && i < shapes[n - 1][1] && x[i] <= 0.0;
                if stopped { 0.0 } else { sum }
            });
            let mut dx: Vec<f64> = dx.collect();
            let fresh = if n > 0 { shapes[n - 1][1] } else { n_in };
            again.iter_mut().zip(dx.drain(fresh..)).for_each(|(sum, g)| *sum += g);
            grads.insert(0, dx);
        }
        grads[0].iter_mut().zip(&again).for_each(|(g, again)| *g += again);
        (values.concat(), grads.concat())
    }
}

/// Products of up to 36 numbers below 1 summed over up to four layers: a hundred roundings of sums below 100. Wider layers
/// have smaller sums of more and smaller products.
fn close(a: f32, b: f64, what: &str) {
    assert!((f64::from(a) - b).abs() < 2e-5 * (1.0 + b.abs()), "{what}: {a} is not {b}");
}

#[test]
fn networks_match_f64_loops_forward_and_backward() {
    for (n, shape) in SHAPES.into_iter().cycle().take(SEEDS).enumerate() {
        let case = Case::new(shape, n as u64);
        let out = pulp::Arch::new().dispatch(Pass(&case, Arithmetic::Single, Unit::Portable));
        let mut sums = vec![0.0; case.net.parameters()];
        for tile in 0..TILES {
            for lane in 0..TILE {
                let (values, grads) = case.naive(tile, lane, &mut sums);
                let (output, input) = (case.net.output(), case.net.input());
                for row in 0..output {
                    let k = (tile * output + row) * TILE + lane;
                    close(out.values[k], values[values.len() - output + row], "output");
                }
                for row in 0..input {
                    close(out.gradients[(tile * input + row) * TILE + lane], grads[row], "gradient");
                }
            }
        }
        for (a, b) in out.params.iter().zip(&sums) {
            close(*a, *b, "parameter gradient");
        }
    }
}

/// Lanes are samples and every lane is computed with the same fused multiply-adds, so that the activations and their
/// gradients are equal to the last bit; only sums over samples are taken in another order.
#[test]
fn all_fused_vector_widths_give_the_same_bits_per_sample() {
    for (n, shape) in SHAPES.into_iter().enumerate() {
        let case = Case::new(shape, n as u64);
        let narrow = pulp::Scalar128b.vectorize(Pass(&case, Arithmetic::Single, Unit::Portable));
        let wide = [
            pulp::Scalar256b.vectorize(Pass(&case, Arithmetic::Single, Unit::Portable)),
            pulp::Scalar512b.vectorize(Pass(&case, Arithmetic::Single, Unit::Portable)),
        ];
        for out in &wide {
            assert_eq!(bits(&out.values), bits(&narrow.values));
            assert_eq!(bits(&out.gradients), bits(&narrow.gradients));
            for (a, b) in out.params.iter().zip(&narrow.params) {
                close(*a, f64::from(*b), "parameter gradient");
            }
        }
    }
}

/// The host's instructions and the plain fallback, which does not fuse: equal up to rounding.
#[test]
fn the_scalar_fallback_matches_the_hosts_instructions() {
    for (n, shape) in SHAPES.into_iter().enumerate() {
        let case = Case::new(shape, n as u64);
        let host = pulp::Arch::new().dispatch(Pass(&case, Arithmetic::Single, Unit::Portable));
        let plain = pulp::Scalar.vectorize(Pass(&case, Arithmetic::Single, Unit::Portable));
        for (a, b) in host.values.iter().zip(&plain.values) {
            close(*a, f64::from(*b), "activation");
        }
        for (a, b) in host.params.iter().zip(&plain.params) {
            close(*a, f64::from(*b), "parameter gradient");
        }
    }
}

/// Chunks of some tiles, gone through one after the other before their parameter gradients are asked for.
struct Chunks<'a>(&'a Case, Arithmetic, &'a [usize]);

impl WithSimd for Chunks<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<f32> {
        let Self(case, arithmetic, chunks) = self;
        let Case { net, params, tiles, grads } = case;
        let (packed, unit) = (net.pack_for(params, arithmetic), Unit::Portable);
        let (rows, input, output) = (net.rows() * TILE, net.input() * TILE, net.output_row() * TILE);
        let (mut a, mut sums) = (Activations::default(), vec![0.0; net.parameters()]);
        for &count in chunks {
            net.reserve(&packed, count, &mut a);
            for n in 0..count {
                a.input(n).copy_from_slice(&tiles[n % TILES * rows..][..input]);
                net.forward(simd, &unit, &packed, &mut a, n);
            }
            net.reserve_backward::<S>(count, &mut a);
            for n in 0..count {
                a.output_grad().copy_from_slice(&grads[n % TILES * rows + output..][..rows - output]);
                net.backward(simd, &unit, &packed, &mut a, n);
            }
        }
        net.finish(simd, &packed, &mut a, &mut sums);
        sums
    }
}

/// However many tiles chunks have, and whether or not their gradients wait for one another, they are those of the tiles.
#[test]
fn gradients_of_chunks_add_up() {
    // Below and above a strip, at its end, and what is left over.
    let chunks = [2, 3, 12, 1, 30, 25, 5, 11, 4];
    for arithmetic in [Arithmetic::Single, Arithmetic::Rounded, Arithmetic::Matrix] {
        let case = Case::new(SHAPES[2], 7);
        let together = pulp::Arch::new().dispatch(Chunks(&case, arithmetic, &chunks));
        let mut alone = vec![0.0f64; case.net.parameters()];
        for tile in chunks.into_iter().flat_map(|count| 0..count) {
            let case = case.tile(tile % TILES);
            let one = pulp::Arch::new().dispatch(Chunks(&case, arithmetic, &[1]));
            alone.iter_mut().zip(one).for_each(|(sum, g)| *sum += f64::from(g));
        }
        let size = alone.iter().map(|g| g * g).sum::<f64>().sqrt();
        let error = together.iter().zip(&alone).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum::<f64>().sqrt();
        assert!(error < 1e-5 * size, "{arithmetic:?}: off by {error} of {size}");
    }
}

fn bits(v: &[f32]) -> Vec<u32> {
    v.iter().map(|v| v.to_bits()).collect()
}

/// How far the outcome `b` is from `a`, at most `share` of its size.
fn assert_within(share: f32, a: &Outcome, b: &Outcome, what: &str) {
    let parts = [(&a.values, &b.values), (&a.gradients, &b.gradients), (&a.params, &b.params)];
    for (part, (a, b)) in parts.into_iter().enumerate() {
        let size = a.iter().map(|a| a * a).sum::<f32>().sqrt();
        let error = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
        assert!(error < share * size, "{what}, part {part}: off by {error} of {size}");
    }
}

/// bf16 rounds every factor by up to 2⁻⁹, and flips some ReLUs: some per cent after four layers, in the mean.
#[test]
fn bf16_products_match_f32_ones() {
    for (n, shape) in SHAPES.into_iter().enumerate() {
        let case = Case::new(shape, n as u64);
        let exact = pulp::Arch::new().dispatch(Pass(&case, Arithmetic::Single, Unit::Portable));
        for arithmetic in [Arithmetic::Rounded, Arithmetic::Matrix] {
            let rounded = pulp::Arch::new().dispatch(Pass(&case, arithmetic, Unit::detect()));
            assert_within(0.1, &exact, &rounded, &format!("{shape:?}, {arithmetic:?}"));
        }
    }
}

/// The matrix units, dot products of pairs and plain loops sum in another order each; what that changes is rounded away, or to the next
/// bf16.
#[test]
fn bf16_instructions_match_plain_loops() {
    for (n, shape) in SHAPES.into_iter().enumerate() {
        let case = Case::new(shape, n as u64);
        let plain = pulp::Arch::new().dispatch(Pass(&case, Arithmetic::Matrix, Unit::Portable));
        for arithmetic in [Arithmetic::Rounded, Arithmetic::Matrix] {
            let units = pulp::Arch::new().dispatch(Pass(&case, arithmetic, Unit::detect()));
            assert_within(1e-3, &plain, &units, &format!("{shape:?}, {arithmetic:?}"));
        }
    }
}

#[test]
fn inputs_that_nobody_asks_about_change_nothing_else() {
    for given in [3, 24, 40] {
        for arithmetic in [Arithmetic::Single, Arithmetic::Rounded, Arithmetic::Matrix] {
            let all = Case::new((&[40, 64, 4], None), given as u64);
            let part = Case { net: all.net.clone().with_given(given), ..all.tile(0) };
            let all = all.tile(0);
            let [all_out, part_out] =
                [&all, &part].map(|case| pulp::Arch::new().dispatch(Pass(case, arithmetic, Unit::Portable)));
            assert_eq!((&part_out.values, &part_out.params), (&all_out.values, &all_out.params));
            let asked = (40 - given).next_multiple_of(4) * TILE;
            let tiles = all_out.gradients.chunks(40 * TILE);
            let expected: Vec<f32> = tiles.flat_map(|tile| &tile[..asked]).copied().collect();
            assert_eq!(part_out.gradients, expected);
        }
    }
}

#[test]
fn the_way_back_takes_twice_as_much_but_for_what_nobody_asks_about() {
    let net = Mlp::new(&[40, 64, 4]);
    assert_eq!(net.multiply_adds_backward(), 2 * net.multiply_adds());
    assert_eq!(net.with_given(24).multiply_adds_backward(), 64 * (2 * 40 + 2 * 4 - 24));
}
