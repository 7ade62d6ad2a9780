//! Small fully connected networks on tiles of samples, forward and backward.
//!
//! A tile's inputs, outputs and their gradients are f32, feature-major `[features][TILE]`. What lies between is the
//! business of the arithmetic: `vector` computes in f32; `rounded` and `matrix` multiply in bf16 and sum in f32, one for dot products of
//! pairs, the other for matrix units. All keep a chunk's activations together, so that the weight gradients are products over many of its
//! samples.

mod gradient;
mod matrix;
mod rounded;
mod vector;

use bytemuck::{cast_slice, cast_slice_mut};
use pulp::Simd;
use serde::{Deserialize, Serialize};

use self::gradient::{Strip, Sums, TileView};
use crate::simd::floats::{ColumnMut, Floats};
use crate::simd::lanes::{self, Layout};
use crate::simd::matrix::{Unit, available as matrix_units};
use crate::simd::{AlignedVec, TILE, dots};

/// Widths are multiples of this.
const BLOCK: usize = 4;

/// Smaller gradients of an output count as none.
///
/// Light that is all but stopped leaves gradients down to the smallest denormal number, and CPUs take a hundred times
/// longer for a product with one. This is a thousandth of Adam's ε and its square is still a normal number, after any
/// network's weights have made it smaller.
const LEAST_GRADIENT: f32 = 1e-18;

/// Whether vectors are those of AVX2: eight numbers, in sixteen registers.
#[inline(always)]
fn is_like_avx2<S: Simd>() -> bool {
    cfg!(target_arch = "x86_64") && S::F32_LANES == 8
}

/// What the networks are multiplied in. Weights, sums, gradients and everything else are f32 in any case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// bf16 on CPUs with instructions for it (Intel AMX, AVX512-BF16), else f32.
    #[default]
    Auto,
    /// f32.
    F32,
    /// bf16; slow on CPUs without such instructions.
    Bf16,
}

impl Precision {
    /// Whether this CPU multiplies in bf16.
    pub fn is_bf16(self) -> bool {
        self == Self::Bf16 || self == Self::Auto && (matrix_units() || dots::available())
    }

    /// What that is done with on this CPU.
    fn arithmetic(self) -> Arithmetic {
        match self.is_bf16() {
            false => Arithmetic::Single,
            true if matrix_units() => Arithmetic::Matrix,
            true => Arithmetic::Rounded,
        }
    }
}

/// How networks are multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arithmetic {
    /// In f32.
    Single,
    /// In bf16, by dot products of pairs.
    Rounded,
    /// In bf16, by matrix units.
    Matrix,
}

/// The shape of a network with ReLU between its layers and none after the last.
///
/// Parameters are one flat slice: for each layer the weights `[out][in]`, then the biases `[out]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mlp {
    /// Widths: input, hidden ..., output. All multiples of 4.
    widths: Vec<usize>,
    layers: Vec<Layer>,
    /// Rows of the input from the first on whose gradient is asked for.
    asked: usize,
}

impl Mlp {
    /// A network of the given widths (input, hidden ..., output), each rounded up to a multiple of 4.
    pub fn new(widths: &[usize]) -> Self {
        Self::with_skip(widths, None)
    }

    /// As [`Self::new`]; layer number `skip`, from 0, if there is one, sees what comes out of the layer before it and then the network's
    /// input once more.
    pub fn with_skip(widths: &[usize], skip: Option<usize>) -> Self {
        assert!(widths.len() >= 2, "a network has an input and an output");
        assert!(skip != Some(0), "the first layer sees the input anyway");
        let widths: Vec<usize> = widths.iter().map(|w| w.next_multiple_of(BLOCK)).collect();
        let mut at = Layer::default();
        let layers = widths.windows(2).enumerate().map(|(n, w)| {
            let again = if skip == Some(n) { widths[0] } else { 0 };
            let layer = Layer { n_in: w[0] + again, n_out: w[1], again, ..at };
            at.row += layer.n_in;
            at.param += layer.weights() + w[1];
            at.weight += layer.weights();
            at.bias += w[1];
            layer
        });
        Self { layers: layers.collect(), asked: widths[0], widths }
    }

    /// The same network, of whose inputs the last `given` (at most all) have nothing that could learn: nobody asks for their gradient, and
    /// it need not be computed.
    ///
    /// # Panics
    /// If there are not as many inputs, or a layer sees them again.
    pub fn with_given(self, given: usize) -> Self {
        assert!(given <= self.widths[0], "{given} of {} inputs", self.widths[0]);
        assert!(
            self.layers.iter().all(|layer| layer.again == 0),
            "an input that is seen twice learns as a whole"
        );
        Self { asked: (self.widths[0] - given).next_multiple_of(BLOCK), ..self }
    }

    /// Widths of input, hidden layers and output, as rounded up.
    pub fn widths(&self) -> &[usize] {
        &self.widths
    }

    /// Width of the input, as rounded up.
    pub fn input(&self) -> usize {
        self.widths[0]
    }

    /// Width of the output, as rounded up.
    pub fn output(&self) -> usize {
        self.widths[self.widths.len() - 1]
    }

    /// Inputs and outputs of each layer, as rounded up.
    pub fn shapes(&self) -> impl Iterator<Item = [usize; 2]> + '_ {
        self.layers.iter().map(|l| [l.n_in, l.n_out])
    }

    /// Rows of one tile: every layer's input, and the output.
    pub fn rows(&self) -> usize {
        self.shapes().map(|[n_in, _]| n_in).sum::<usize>() + self.output()
    }

    /// First row of the output within a tile.
    pub fn output_row(&self) -> usize {
        self.rows() - self.output()
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        parameters(&self.layers)
    }

    /// Multiply-adds of one sample's forward pass.
    pub fn multiply_adds(&self) -> usize {
        self.layers.iter().map(|l| l.weights()).sum()
    }

    /// Multiply-adds of one sample's way back: the gradients of all inputs that are asked for, and of the weights.
    pub fn multiply_adds_backward(&self) -> usize {
        let given = self.layers.first().map_or(0, |first| (self.widths[0] - self.asked) * first.n_out);
        2 * self.multiply_adds() - given
    }

    /// Kaiming-uniform weights and zero biases, from a stream of uniform numbers in [0, 1).
    pub fn init(&self, mut uniform: impl FnMut() -> f32) -> Vec<f32> {
        let mut params = Vec::with_capacity(self.parameters());
        for layer in &self.layers {
            let bound = (6.0 / layer.n_in as f32).sqrt();
            params.extend((0..layer.weights()).map(|_| (2.0 * uniform() - 1.0) * bound));
            params.extend(std::iter::repeat_n(0.0, layer.n_out));
        }
        params
    }

    /// The weights as the kernels read them; made once per step.
    pub fn pack(&self, params: &[f32], precision: Precision) -> Packed {
        self.pack_for(params, precision.arithmetic())
    }

    /// As [`Self::pack`], for an arithmetic that this CPU need not have instructions for.
    pub(crate) fn pack_for(&self, params: &[f32], arithmetic: Arithmetic) -> Packed {
        match arithmetic {
            Arithmetic::Single => Packed::Vector(vector::Packed::new(&self.layers, params)),
            Arithmetic::Rounded => Packed::Rounded(rounded::Packed::new(&self.layers, params)),
            Arithmetic::Matrix => Packed::Matrix(matrix::Packed::new(&self.layers, params)),
        }
    }

    /// Makes room for the activations of `tiles` tiles.
    pub fn reserve(&self, packed: &Packed, tiles: usize, a: &mut Activations) {
        (a.input, a.asked, a.output) = (self.input() * TILE, self.asked * TILE, self.output() * TILE);
        a.rounded = matches!(packed, Packed::Rounded(_));
        let floats = match packed {
            Packed::Vector(_) => {
                a.stride = self.rows() * TILE;
                a.stride * (a.waiting + tiles)
            }
            Packed::Rounded(_) => {
                a.stride = (self.output_row() / 2 + self.output()) * TILE;
                a.rows.reserve_len(a.input);
                a.row_grads.reserve_len(2 * a.input + a.output);
                a.stride * (a.waiting + tiles)
            }
            Packed::Matrix(packed) => {
                a.stride = 0;
                packed.reserve(&self.layers, tiles, &mut a.saved);
                a.input + a.output
            }
        };
        a.end = if a.stride > 0 { a.stride } else { floats };
        a.first = a.waiting;
        a.values.reserve_len(floats);
    }

    /// Makes room for the way back through the first `tiles` of the evaluated tiles.
    pub fn reserve_backward<S: Simd>(&self, tiles: usize, a: &mut Activations) {
        a.tiles = tiles;
        // As many in every strip, since the sums at the end of one take time.
        let all = a.waiting + tiles;
        let strip = gradient::strip::<S>(a.rounded);
        a.strip = if all < strip { strip } else { all.div_ceil(all.div_ceil(strip)) };
        let kept = a.strip.min(all).max(a.waiting + 1);
        a.grads.reserve_len((kept * a.stride).max(a.end));
    }

    /// From the input rows of tile `n` to its output rows.
    #[inline(always)]
    pub fn forward<S: Simd>(&self, simd: S, unit: &Unit, packed: &Packed, a: &mut Activations, n: usize) {
        self.forward_first(simd, unit, packed, a, n, self.output());
    }

    /// As [`Self::forward`], but of the output only the first `outputs` rows need be filled.
    #[inline(always)]
    pub fn forward_first<S: Simd>(
        &self,
        simd: S,
        unit: &Unit,
        packed: &Packed,
        a: &mut Activations,
        n: usize,
        outputs: usize,
    ) {
        let at = a.first + n;
        let ahead = a.to_next(at);
        let (tile, outputs) = (&mut a.values[at * a.stride..][..a.end], outputs.next_multiple_of(BLOCK));
        match packed {
            Packed::Vector(packed) => packed.forward(simd, &self.layers, tile, outputs, ahead),
            Packed::Rounded(packed) => {
                let (tile, output) = tile.split_at_mut(a.end - a.output);
                let output = &mut output[..outputs * TILE];
                packed.forward(&self.layers, &a.rows[..a.input], cast_slice_mut(tile), output, ahead);
            }
            Packed::Matrix(packed) => packed.forward(unit, &self.layers, tile, &mut a.saved, n),
        }
    }

    /// Leaves the samples `kept`, in increasing order, of evaluated tiles, as if there had been nothing else; only where
    /// [`Packed::keeps_tiles`].
    pub fn retain(&self, a: &mut Activations, kept: &[u32]) {
        let values = &mut a.values[a.first * a.stride..];
        lanes::keep(values, Layout { rows: a.stride / TILE, stride: a.stride }, kept);
    }

    /// From the gradient of the output rows of tile `n` to that of its input rows, tile after tile; the parameters' gradients
    /// are kept until [`Self::finish`].
    #[inline(always)]
    pub fn backward<S: Simd>(&self, simd: S, unit: &Unit, packed: &Packed, a: &mut Activations, n: usize) {
        let last = n + 1 == a.tiles;
        a.latest = a.waiting;
        let at = a.first + n;
        let ahead = a.to_next(at);
        let floats = a.output;
        let mut output = ColumnMut::new(simd, a.output_grad());
        let [none, one, least] = [0.0, 1.0, LEAST_GRADIENT].map(|x| Floats::new(simd, x));
        for v in 0..floats / S::F32_LANES {
            let g = output.at(v);
            // A factor, since compilers make a masked store of a choice, which takes tens of cycles with AVX2.
            output.set(v, none.where_greater(least, g.abs(), one) * g);
        }
        let (tile, grad) = (&a.values[at * a.stride..], &mut a.grads[a.waiting * a.stride..][..a.end]);
        match packed {
            Packed::Vector(packed) => {
                packed.backward(simd, &self.layers, &tile[..a.end], grad, self.asked, ahead);
            }
            Packed::Rounded(packed) => {
                let (tile, grad) = (cast_slice(&tile[..a.end]), cast_slice_mut(grad));
                let (output, inputs) = a.row_grads.split_at_mut(a.output);
                let (input, again) = inputs[..2 * a.input].split_at_mut(a.input);
                packed.backward(&self.layers, tile, grad, output, [&mut input[..a.asked], again], ahead);
            }
            Packed::Matrix(packed) => {
                packed.backward(unit, &self.layers, grad, &mut a.saved, n);
                if last {
                    let sums = a.sums.of(self.parameters());
                    packed.accumulate(unit, &self.layers, &mut a.saved, a.tiles, sums);
                }
                return;
            }
        }
        a.waiting += 1;
        // Those of a chunk that begins a strip may wait for the next chunk; others are not where it will be.
        if a.waiting >= a.strip || last && a.waiting <= n {
            self.sum(simd, a, at + 1 - a.waiting);
        }
    }

    /// Sums the gradients of the tiles that wait for it, the first of which is number `first` of those kept.
    #[inline(always)]
    fn sum<S: Simd>(&self, simd: S, a: &mut Activations, first: usize) {
        let (values, grads, stride) = (&a.values[first * a.stride..], &*a.grads, a.stride);
        let count = std::mem::take(&mut a.waiting);
        if a.rounded {
            let view = |data| TileView { data: cast_slice(data), stride, offset: 0 };
            a.sums.add_rounded(&self.layers, Strip { values: view(values), grads: view(grads), count });
        } else {
            let view = |data| TileView { data, stride, offset: 0 };
            a.sums.add(simd, &self.layers, Strip { values: view(values), grads: view(grads), count });
        }
    }

    /// Adds the parameter gradients of all tiles that have gone [`Self::backward`] to `out`, in the order of the parameters.
    #[inline(always)]
    pub fn finish<S: Simd>(&self, simd: S, packed: &Packed, a: &mut Activations, out: &mut [f32]) {
        if a.waiting > 0 {
            self.sum(simd, a, 0);
        }
        match packed {
            Packed::Vector(_) | Packed::Rounded(_) => a.sums.unpack::<S>(&self.layers, a.rounded, out),
            Packed::Matrix(_) => a.sums.add_to(out),
        }
    }
}

/// Number of parameters of some layers.
fn parameters(layers: &[Layer]) -> usize {
    layers.iter().map(|l| l.weights() + l.n_out).sum()
}

/// Where one layer's numbers are.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Layer {
    n_in: usize,
    n_out: usize,
    /// Rows at the end of its input that are the network's input again.
    again: usize,
    /// First activation row of its input.
    row: usize,
    /// Offset in the flat parameters.
    param: usize,
    /// Offset among all weights.
    weight: usize,
    /// Offset among all biases.
    bias: usize,
}

impl Layer {
    fn weights(&self) -> usize {
        self.n_in * self.n_out
    }

    /// Rows of its input that the layer before it (or the network's caller) has made.
    fn fresh(&self) -> usize {
        self.n_in - self.again
    }
}

/// Weights in the orders that the kernels stream through.
pub enum Packed {
    /// For `Arithmetic::Single`.
    Vector(vector::Packed),
    /// For `Arithmetic::Rounded`.
    Rounded(rounded::Packed),
    /// For `Arithmetic::Matrix`.
    Matrix(matrix::Packed),
}

impl Packed {
    /// Whether every tile's inputs and outputs stay after others have been evaluated.
    pub fn keeps_tiles(&self) -> bool {
        !matches!(self, Self::Matrix(_))
    }
}

/// Activations of a chunk of tiles, and their gradients.
#[derive(Default)]
pub struct Activations {
    /// Per tile `input | layer 1 | ... | output`, with the input again where a layer sees it; for matrix units all tiles share `input |
    /// output`.
    values: AlignedVec,
    grads: AlignedVec,
    /// Floats from one tile to the next, and of one tile.
    stride: usize,
    end: usize,
    /// Tiles to go back through, and how many of them have their gradients kept at a time.
    tiles: usize,
    strip: usize,
    /// Tiles whose gradients are kept and not yet summed, before the first of this chunk and by now.
    first: usize,
    waiting: usize,
    /// Place of the gradients of the tile that went backward last.
    latest: usize,
    /// The parameters' gradients.
    sums: Sums,
    /// Floats of a tile's input, of what is asked of its gradient, and of the output.
    input: usize,
    asked: usize,
    output: usize,
    saved: matrix::Saved,
    /// Whether all but the outputs of tiles is rounded to bf16, in pairs of rows.
    rounded: bool,
    /// Then, the f32 rows of the latest tile's input, and the gradients `output | input` with room for the input's again.
    rows: AlignedVec,
    row_grads: AlignedVec,
}

impl Activations {
    /// Input rows of tile `n`, to be filled right before it is evaluated.
    #[inline(always)]
    pub fn input(&mut self, n: usize) -> &mut [f32] {
        if self.rounded {
            return &mut self.rows[..self.input];
        }
        &mut self.values[(self.first + n) * self.stride..][..self.input]
    }

    /// Output rows of tile `n`; with matrix units only until the next tile is evaluated.
    #[inline(always)]
    pub fn output(&self, n: usize) -> &[f32] {
        &self.values[(self.first + n) * self.stride + self.end - self.output..][..self.output]
    }

    /// Gradient of the output rows of the tile that goes backward next, to be filled.
    #[inline(always)]
    pub fn output_grad(&mut self) -> &mut [f32] {
        if self.rounded {
            return &mut self.row_grads[..self.output];
        }
        &mut self.grads[self.waiting * self.stride + self.end - self.output..][..self.output]
    }

    /// Gradient of the input rows of the tile that went backward last, as many as are [asked for](Mlp::with_given).
    #[inline(always)]
    pub fn input_grad(&self) -> &[f32] {
        if self.rounded {
            return &self.row_grads[self.output..][..self.asked];
        }
        &self.grads[self.latest * self.stride..][..self.asked]
    }

    /// Floats from tile number `at` of those kept to the one behind it, if there is room for one.
    #[inline(always)]
    fn to_next(&self, at: usize) -> usize {
        if (at + 2) * self.stride <= self.values.len() { self.stride } else { 0 }
    }

    /// Forgets gradients that nobody has asked for.
    pub fn clear(&mut self) {
        (self.first, self.waiting) = (0, 0);
        self.sums.clear();
    }
}
