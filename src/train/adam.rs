//! Adam (Kingma & Ba 2015) over flat weights and over hash-table rows.

use pulp::{Scalar, Simd};

use crate::field::hashgrid::{FEATURES, Row};
use crate::simd::floats::{ColumnMut, Floats};
use crate::simd::prefetch;

/// Decay rates and the guard against division by zero; instant-ngp's values.
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.99;
const EPSILON: f32 = 1e-15;

/// First and second moments of a flat weight vector.
#[derive(Clone, Debug)]
pub struct Moments {
    /// Running mean of the gradient.
    pub first: Vec<f32>,
    /// Running mean of its square.
    pub second: Vec<f32>,
}

impl Moments {
    /// Zeros.
    pub fn new(n: usize) -> Self {
        Self { first: vec![0.0; n], second: vec![0.0; n] }
    }
}

/// Step sizes with the bias corrections of step `step` (from 1) folded in.
#[derive(Clone, Copy, Debug)]
pub struct StepSize {
    rate: f32,
    correction: f32,
}

impl StepSize {
    /// The learning rate `rate` at step `step` (from 1).
    pub fn new(rate: f32, step: u64) -> Self {
        let step = step.min(i32::MAX as u64) as i32;
        let rate = f64::from(rate) / (1.0 - f64::from(BETA1).powi(step));
        let correction = 1.0 / (1.0 - f64::from(BETA2).powi(step));
        Self { rate: rate as f32, correction: correction as f32 }
    }
}

/// One update of a range of flat weights.
pub fn update(weights: &mut [f32], grads: &[f32], first: &mut [f32], second: &mut [f32], step: StepSize) {
    for (((w, g), m), v) in weights.iter_mut().zip(grads).zip(first).zip(second) {
        *m += (1.0 - BETA1) * (g - *m);
        *v += (1.0 - BETA2) * (g * g - *v);
        *w -= step.rate * *m / ((*v * step.correction).sqrt() + EPSILON);
    }
}

/// Moments of one hash table during training.
#[derive(Clone, Debug)]
pub struct TableState {
    /// Running mean of the gradient.
    pub first: Vec<Row>,
    /// Running mean of its square.
    pub second: Vec<Row>,
}

impl TableState {
    /// Zeros for `rows` rows.
    pub fn new(rows: usize) -> Self {
        let zeros = vec![Row::ZERO; rows];
        Self { first: zeros.clone(), second: zeros }
    }

    /// Updates what has a gradient in this step and clears the gradients; returns the rows of all cache lines that hold any, and which
    /// alone are read and written. In `room` their numbers are noted.
    ///
    /// Numbers without a gradient keep their moments: they were not seen, which is no evidence.
    #[inline(always)]
    pub fn update<S: Simd>(
        &mut self,
        simd: S,
        table: &mut [Row],
        gradient: &mut [Row],
        step: StepSize,
        room: &mut Vec<u32>,
    ) -> usize {
        let columns = [table, gradient, &mut self.first, &mut self.second];
        let [w, g, m, v] = columns.map(bytemuck::cast_slice_mut::<Row, f32>);
        let seen = seen_lines(g, room);
        let mut updated = 0;
        for (n, line) in seen.iter().enumerate() {
            // Lines that are far apart are none that the processor foresees.
            if let Some(ahead) = seen.get(n + AHEAD) {
                for column in [&*w, &*g, &*m, &*v] {
                    prefetch(&column[*ahead as usize * LINE], 0);
                }
            }
            let start = *line as usize * LINE;
            let line = start..g.len().min(start + LINE);
            updated += line.len();
            let of_line = [&mut w[line.clone()], &mut g[line.clone()], &mut m[line.clone()], &mut v[line]];
            update_seen(simd, of_line, step);
        }
        updated / FEATURES
    }
}

/// Numbers of a cache line.
const LINE: usize = 16;

/// Lines that are seen from one that is updated to the one that is asked for.
const AHEAD: usize = 8;

/// The numbers of the cache lines that have a number that is not zero, and of the last if it is not whole.
#[inline(always)]
fn seen_lines<'a>(gradient: &[f32], room: &'a mut Vec<u32>) -> &'a [u32] {
    let (lines, rest) = gradient.as_chunks::<LINE>();
    // What an earlier, larger table has left behind is of no one's concern.
    if room.len() <= lines.len() {
        room.resize(lines.len() + 1, 0);
    }
    let mut count = 0;
    for (number, line) in lines.iter().enumerate() {
        // Whether one is seen is nothing that a processor could foresee.
        room[count] = number as u32;
        count += usize::from(line.iter().fold(false, |any, g| any | (*g != 0.0)));
    }
    room[count] = lines.len() as u32;
    &room[..count + usize::from(!rest.is_empty())]
}

/// Updates the numbers that have a gradient and clears the gradients, of values, gradients and both moments.
#[inline(always)]
fn update_seen<S: Simd>(simd: S, [w, g, m, v]: [&mut [f32]; 4], step: StepSize) {
    let whole = w.len() - w.len() % S::F32_LANES;
    let ((w, w_rest), (g, g_rest)) = (w.split_at_mut(whole), g.split_at_mut(whole));
    let ((m, m_rest), (v, v_rest)) = (m.split_at_mut(whole), v.split_at_mut(whole));
    update_vectors(simd, [w, g, m, v], step);
    update_vectors(Scalar::new(), [w_rest, g_rest, m_rest, v_rest], step);
}

/// [`update_seen`] of whole vectors.
///
/// A loop over numbers would be compiled to store some of a vector and not others, at which many processors are slow.
#[inline(always)]
fn update_vectors<S: Simd>(simd: S, [w, g, m, v]: [&mut [f32]; 4], step: StepSize) {
    let vectors = w.len() / S::F32_LANES;
    let (mut w, mut g) = (ColumnMut::new(simd, w), ColumnMut::new(simd, g));
    let (mut m, mut v) = (ColumnMut::new(simd, m), ColumnMut::new(simd, v));
    let none = Floats::new(simd, 0.0);
    let least = Floats::new(simd, f32::from_bits(1));
    for n in 0..vectors {
        let [w0, g0, m0, v0] = [w.at(n), g.at(n), m.at(n), v.at(n)];
        let (m1, v1) = (m0 + (1.0 - BETA1) * (g0 - m0), v0 + (1.0 - BETA2) * (g0 * g0 - v0));
        let w1 = w0 - step.rate * m1 / ((v1 * step.correction).sqrt() + EPSILON);
        // What is no number is not below the least one: it is seen.
        let size = g0.abs();
        w.set(n, w0.where_greater(least, size, w1));
        m.set(n, m0.where_greater(least, size, m1));
        v.set(n, v0.where_greater(least, size, v1));
        g.set(n, none);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    /// Rows that are on a line with others, alone on one, in a run of several lines, and behind the last whole line.
    const SEEN: [usize; 7] = [5, 6, 40, 44, 47, 48, 102];

    #[test]
    fn rows_that_nobody_saw_are_as_if_all_had_been_walked() {
        let mut rng = Rng::new(3, 0, 0);
        let mut rows = |n| (0..n).map(|_| Row::from_array([0; 4].map(|_| rng.uniform()))).collect::<Vec<_>>();
        let (mut table, seen) = (rows(103), rows(SEEN.len()));
        let mut state = TableState { first: rows(103), second: rows(103) };
        let mut gradient = vec![Row::ZERO; 103];
        SEEN.into_iter().zip(seen).for_each(|(n, g)| gradient[n] = g);
        // A number of a row that is seen may be zero.
        gradient[6].y = 0.0;
        let (mut all, mut all_table, mut all_gradient) = (state.clone(), table.clone(), gradient.clone());
        let step = StepSize::new(0.01, 5);
        let updated = state.update(Scalar::new(), &mut table, &mut gradient, step, &mut Vec::new());
        let [w, g, m, v] = [&mut all_table, &mut all_gradient, &mut all.first, &mut all.second]
            .map(|rows| bytemuck::cast_slice_mut(rows));
        update_seen(Scalar::new(), [w, g, m, v], step);
        assert_eq!((&table, &state.first, &state.second), (&all_table, &all.first, &all.second));
        assert!(gradient.iter().all(|g| *g == Row::ZERO));
        // Lines 4 to 7, 40 to 51, and what is left behind the last whole one.
        assert_eq!(updated, 4 + 12 + 3);
    }

    #[test]
    fn a_gradient_that_is_no_number_is_not_overlooked() {
        let mut table = vec![Row::ONE; 8];
        let mut gradient = vec![Row::ZERO; 8];
        gradient[5].z = f32::NAN;
        TableState::new(8).update(
            Scalar::new(),
            &mut table,
            &mut gradient,
            StepSize::new(0.01, 1),
            &mut Vec::new(),
        );
        assert!(table[5].z.is_nan() && table[5].x == 1.0 && table[0] == Row::ONE);
    }
}
