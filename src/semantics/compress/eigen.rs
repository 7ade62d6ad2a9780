//! All eigenvalues and eigenvectors of a symmetric matrix, in f64.
//!
//! Householder reduction to tridiagonal form, then QL steps with implicit shifts: `tred2` and `tql2` of EISPACK
//! (Bowdler, Martin, Reinsch & Wilkinson 1968), by way of JAMA. Vectors are rows here, so that every inner loop walks
//! memory in order.

/// Largest number of QL steps per eigenvalue. A handful is usual; EISPACK gives up after 30.
const MAX_STEPS: usize = 60;

/// Eigenvalues in falling order, and the unit eigenvector of each as a row of an `[n, n]` matrix.
///
/// `matrix` `[n, n]` must be symmetric and finite.
pub(super) fn symmetric_eigen(matrix: &[f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    debug_assert_eq!(matrix.len(), n * n);
    // Products of three elements appear below: near 1 they neither overflow nor underflow.
    let scale = matrix.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    if n == 0 || scale == 0.0 {
        let identity = (0..n * n).map(|i| f64::from(u8::from(i % (n + 1) == 0))).collect();
        return (vec![0.0; n], identity);
    }
    let mut v = Rows { data: matrix.iter().map(|x| x / scale).collect(), n };
    let (mut d, mut e) = reduce(&mut v);
    diagonalise(&mut v, &mut d, &mut e);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| d[*b].total_cmp(&d[*a]));
    let vectors = order.iter().flat_map(|&i| v.row(i).iter().copied()).collect();
    (order.iter().map(|&i| d[i] * scale).collect(), vectors)
}

/// The transposed matrix of the textbook: `row(j)[i]` is its element (i, j).
struct Rows {
    data: Vec<f64>,
    n: usize,
}

impl Rows {
    fn row(&self, j: usize) -> &[f64] {
        &self.data[j * self.n..(j + 1) * self.n]
    }

    fn row_mut(&mut self, j: usize) -> &mut [f64] {
        &mut self.data[j * self.n..(j + 1) * self.n]
    }

    fn two(&mut self, j: usize) -> (&mut [f64], &mut [f64]) {
        let (a, b) = self.data.split_at_mut((j + 1) * self.n);
        (&mut a[j * self.n..], &mut b[..self.n])
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    // Eight sums that do not wait for each other; always the same order.
    let mut sums = [0.0; 8];
    let (a8, a_rest) = a.as_chunks::<8>();
    let (b8, b_rest) = b[..a.len()].as_chunks::<8>();
    for (a, b) in a8.iter().zip(b8) {
        for i in 0..8 {
            sums[i] += a[i] * b[i];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

fn add_scaled(to: &mut [f64], from: &[f64], by: f64) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += by * from;
    }
}

/// Tridiagonal form: diagonal and subdiagonal (from index 1); `v` becomes the transformation.
fn reduce(v: &mut Rows) -> (Vec<f64>, Vec<f64>) {
    let n = v.n;
    let mut d: Vec<f64> = (0..n).map(|j| v.row(j)[n - 1]).collect();
    let mut e = vec![0.0; n];
    for i in (1..n).rev() {
        let scale: f64 = d[..i].iter().map(|x| x.abs()).sum();
        let mut h = 0.0;
        if scale == 0.0 {
            e[i] = d[i - 1];
            for j in 0..i {
                d[j] = v.row(j)[i - 1];
                v.row_mut(j)[i] = 0.0;
                v.row_mut(i)[j] = 0.0;
            }
        } else {
            d[..i].iter_mut().for_each(|x| *x /= scale);
            h = dot(&d[..i], &d[..i]);
            let f = d[i - 1];
            let g = if f > 0.0 { -h.sqrt() } else { h.sqrt() };
            e[i] = scale * g;
            h -= f * g;
            d[i - 1] = f - g;
            e[..i].fill(0.0);
            for j in 0..i {
                let f = d[j];
                v.row_mut(i)[j] = f;
                let below = &v.row(j)[j + 1..i];
                let g = v.row(j)[j] * f + dot(below, &d[j + 1..i]);
                add_scaled(&mut e[j + 1..i], below, f);
                e[j] += g;
            }
            e[..i].iter_mut().for_each(|x| *x /= h);
            let hh = dot(&e[..i], &d[..i]) / (h + h);
            add_scaled(&mut e[..i], &d[..i], -hh);
            for j in 0..i {
                let (f, g) = (d[j], e[j]);
                let row = v.row_mut(j);
                for k in j..i {
                    row[k] -= f * e[k] + g * d[k];
                }
                d[j] = row[i - 1];
                row[i] = 0.0;
            }
        }
        d[i] = h;
    }
    accumulate(v, &mut d);
    e[0] = 0.0;
    (d, e)
}

/// Multiplies the reflections together; `d` becomes the diagonal.
fn accumulate(v: &mut Rows, d: &mut [f64]) {
    let n = v.n;
    for i in 0..n - 1 {
        v.row_mut(i)[n - 1] = v.row(i)[i];
        v.row_mut(i)[i] = 1.0;
        let h = d[i + 1];
        if h != 0.0 {
            for k in 0..=i {
                d[k] = v.row(i + 1)[k] / h;
            }
            let reflection = v.row(i + 1)[..=i].to_vec();
            for j in 0..=i {
                let row = &mut v.row_mut(j)[..=i];
                let g = dot(&reflection, row);
                add_scaled(row, &d[..=i], -g);
            }
        }
        v.row_mut(i + 1)[..=i].fill(0.0);
    }
    for j in 0..n {
        d[j] = v.row(j)[n - 1];
        v.row_mut(j)[n - 1] = 0.0;
    }
    v.row_mut(n - 1)[n - 1] = 1.0;
}

/// QL steps until the subdiagonal is gone: `d` becomes the eigenvalues, rows of `v` the eigenvectors.
fn diagonalise(v: &mut Rows, d: &mut [f64], e: &mut [f64]) {
    let n = v.n;
    e.rotate_left(1);
    e[n - 1] = 0.0;
    let (mut shift, mut largest) = (0.0, 0.0f64);
    for l in 0..n {
        largest = largest.max(d[l].abs() + e[l].abs());
        let small = |x: f64| x.abs() <= f64::EPSILON * largest;
        let m = (l..n).find(|m| small(e[*m])).unwrap_or(n - 1);
        if m > l {
            for _ in 0..MAX_STEPS {
                shift += shift_by(d, e, l);
                rotate(v, d, e, l, m);
                if small(e[l]) {
                    break;
                }
            }
        }
        d[l] += shift;
        e[l] = 0.0;
    }
}

/// Takes an eigenvalue of the leading 2 × 2 block off the diagonal and returns it.
fn shift_by(d: &mut [f64], e: &[f64], l: usize) -> f64 {
    let g = d[l];
    let p = (d[l + 1] - g) / (2.0 * e[l]);
    let r = if p < 0.0 { -p.hypot(1.0) } else { p.hypot(1.0) };
    d[l] = e[l] / (p + r);
    d[l + 1] = e[l] * (p + r);
    let h = g - d[l];
    d[l + 2..].iter_mut().for_each(|x| *x -= h);
    h
}

/// One QL sweep from row `m` up to row `l`.
fn rotate(v: &mut Rows, d: &mut [f64], e: &mut [f64], l: usize, m: usize) {
    let mut p = d[m];
    let (mut c, mut c2, mut c3) = (1.0, 1.0, 1.0);
    let (mut s, mut s2) = (0.0, 0.0);
    let (next, el1) = (d[l + 1], e[l + 1]);
    for i in (l..m).rev() {
        (c3, c2, s2) = (c2, c, s);
        let g = c * e[i];
        let h = c * p;
        let r = p.hypot(e[i]);
        e[i + 1] = s * r;
        s = e[i] / r;
        c = p / r;
        p = c * d[i] - s * g;
        d[i + 1] = h + s * (c * g + s * d[i]);
        let (a, b) = v.two(i);
        for (a, b) in a.iter_mut().zip(b) {
            let h = *b;
            *b = s * *a + c * h;
            *a = c * *a - s * h;
        }
    }
    p = -s * s2 * c3 * el1 * e[l] / next;
    e[l] = s * p;
    d[l] = c * p;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    /// A symmetric matrix of the given rank.
    fn gram(n: usize, rank: usize, seed: u64) -> Vec<f64> {
        let mut rng = Rng::new(seed, 0, 0);
        let x: Vec<f64> = (0..rank * n).map(|_| f64::from(rng.uniform()) - 0.5).collect();
        let mut a = vec![0.0; n * n];
        for row in x.chunks_exact(n) {
            for i in 0..n {
                for j in 0..n {
                    a[i * n + j] += row[i] * row[j];
                }
            }
        }
        a
    }

    fn check(a: &[f64], n: usize) -> Vec<f64> {
        let (values, vectors) = symmetric_eigen(a, n);
        let size = a.iter().map(|x| x.abs()).fold(1e-300, f64::max) * n as f64;
        for i in 0..n {
            let v = &vectors[i * n..(i + 1) * n];
            for j in 0..n {
                let av = dot(&a[j * n..(j + 1) * n], v);
                assert!((av - values[i] * v[j]).abs() < 1e-13 * size, "A v ≠ λ v at {i}, {j}");
                let w = &vectors[j * n..(j + 1) * n];
                let expected = f64::from(u8::from(i == j));
                assert!((dot(v, w) - expected).abs() < 1e-13 * n as f64, "vectors {i}, {j}");
            }
        }
        assert!(values.windows(2).all(|w| w[0] >= w[1]), "not in falling order");
        values
    }

    #[test]
    fn vectors_are_orthonormal_and_solve_the_equation() {
        for n in [1, 2, 3, 5, 16, 67] {
            for rank in [1, n / 2, n, 3 * n] {
                check(&gram(n, rank, n as u64), n);
            }
        }
    }

    #[test]
    fn known_eigenvalues_are_found() {
        // The second difference: 2 - 2 cos(π k / (n + 1)).
        let n = 40;
        let mut a = vec![0.0; n * n];
        for i in 0..n {
            a[i * n + i] = 2.0;
            if i + 1 < n {
                a[i * n + i + 1] = -1.0;
                a[(i + 1) * n + i] = -1.0;
            }
        }
        for (k, value) in check(&a, n).iter().rev().enumerate() {
            let truth = 2.0 - 2.0 * (std::f64::consts::PI * (k + 1) as f64 / (n + 1) as f64).cos();
            assert!((value - truth).abs() < 1e-13, "{value} is not {truth}");
        }
    }

    #[test]
    fn zeros_identity_and_extreme_sizes_are_no_trouble() {
        assert_eq!(check(&[0.0; 25], 5), [0.0; 5]);
        let identity: Vec<f64> = (0..25).map(|i| f64::from(u8::from(i % 6 == 0))).collect();
        assert_eq!(check(&identity, 5), [1.0; 5]);
        for scale in [1e-200, 1e150] {
            check(&gram(12, 4, 3).iter().map(|x| x * scale).collect::<Vec<_>>(), 12);
        }
    }
}
