//! One ray composited by itself, forward and backward, for tests here and for those of the whole crate, which import what this
//! needs under the same names.

use pulp::{Simd, WithSimd};

use super::{ColumnMut, Floats, Interval, Intervals, LANES, Weights, backward};

/// Composites one ray, in the first lane, and goes back from the gradient `g` with respect to its weights and `d_left` with
/// respect to the light that is left.
struct OneRay<'a> {
    intervals: &'a [Interval],
    g: &'a [[f32; 3]],
    d_left: f32,
}

/// Weights, light that is left, and the gradient with respect to σ.
type Passed = (Vec<[f32; 3]>, f32, Vec<[f32; 3]>);

impl WithSimd for OneRay<'_> {
    type Output = Passed;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Passed {
        let Self { intervals, g, d_left } = self;
        let columns = Intervals::of_ray(intervals);
        let mut weights = Weights::default();
        weights.find(simd, &columns);
        let mut gradient: Vec<_> = g.iter().map(|g| g.map(|g| Floats::new(simd, g))).collect();
        backward(simd, &columns, &weights, 0, &mut gradient, Floats::new(simd, d_left));
        let first = |values: Floats<S>| {
            let mut lanes = [0.0; LANES];
            ColumnMut::new(simd, &mut lanes).set(0, values);
            lanes[0]
        };
        let gradient = gradient.into_iter().map(|g| g.map(first)).collect();
        (columns.layout.of_ray(0).map(|n| weights.at(n)).collect(), weights.left[0], gradient)
    }
}

/// Weights of the intervals of a ray, front to back, and the light that is left.
pub fn composited(intervals: &[Interval]) -> (Vec<[f32; 3]>, f32) {
    let (weights, left, _) = pulp::Arch::new().dispatch(OneRay { intervals, g: &[], d_left: 0.0 });
    (weights, left)
}

/// Gradient with respect to the σ of the intervals of a ray of Σ `g` w + `d_left` T.
pub fn gradient_of(intervals: &[Interval], g: &[[f32; 3]], d_left: f32) -> Vec<[f32; 3]> {
    pulp::Arch::new().dispatch(OneRay { intervals, g, d_left }).2
}
