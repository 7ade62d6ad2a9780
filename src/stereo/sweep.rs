//! Plane sweep: how well a frame's surroundings match its neighbours' at each depth.

use glam::{Mat3, Vec2, Vec3};

use super::aggregate::{self, CostVolume, WORST};
use super::rig::WorkView;

/// Half the side of the window that is compared, px.
pub(super) const RADIUS: usize = 2;

/// Most frames that one frame is compared with.
pub(super) const MOST_NEIGHBOURS: usize = 16;

/// Variance of grey (0–255) in a window below which there is nothing to match.
const NOISE: f32 = 12.0;

/// Depths that are tried: evenly spaced in inverse depth.
pub(super) struct Planes {
    first: f32,
    step: f32,
    pub count: usize,
}

impl Planes {
    /// `count` planes from `far` to `near`.
    pub fn new(near: f32, far: f32, count: usize) -> Self {
        let first = 1.0 / far;
        Self { first, step: (1.0 / near - first) / (count - 1) as f32, count }
    }

    /// Inverse depth of plane number `n`, which may lie between two.
    pub fn inverse(&self, n: f32) -> f32 {
        self.first + n * self.step
    }

    /// Inverse depth at a fraction of the range.
    pub fn inverse_at(&self, fraction: f32) -> f32 {
        self.inverse(fraction * (self.count - 1) as f32)
    }
}

/// Inverse depth of every pixel of view `n`; 0 where its neighbours see nothing of it.
pub(super) fn inverse_depth(views: &[WorkView], n: usize, neighbours: &[usize], planes: &Planes) -> Vec<f32> {
    let view = &views[n];
    if neighbours.is_empty() {
        return vec![0.0; view.grey.len()];
    }
    let cost = pulp::Arch::new().dispatch(Matching { view, views, neighbours, planes });
    let best = aggregate::best_planes(&cost, view.width, &view.grey);
    best.into_iter().map(|p| if p < 0.0 { 0.0 } else { planes.inverse(p) }).collect()
}

struct Matching<'a> {
    view: &'a WorkView,
    views: &'a [WorkView],
    neighbours: &'a [usize],
    planes: &'a Planes,
}

impl pulp::WithSimd for Matching<'_> {
    type Output = CostVolume;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _simd: S) -> CostVolume {
        let Self { view, views, neighbours, planes } = self;
        let pixels = view.grey.len();
        let mut window = Window::new(view.width, view.height);
        let reference = window.mean_and_variance(&view.grey);
        let mut volume = CostVolume::new(pixels, planes.count);
        let mut warped = vec![0.0; pixels];
        let mut costs = vec![vec![0.0f32; pixels]; neighbours.len()];
        for plane in 0..planes.count {
            for (cost, m) in costs.iter_mut().zip(neighbours) {
                warp(view, &views[*m], planes.inverse(plane as f32), &mut warped);
                window.cost(&view.grey, &reference, &warped, cost);
            }
            for pixel in 0..pixels {
                volume.set(pixel, plane, best_half(costs.iter().map(|c| c[pixel])));
            }
        }
        volume
    }
}

/// Mean of the better half of what the neighbours say (the others may not see the point); [`WORST`] if none does.
#[inline(always)]
fn best_half(costs: impl Iterator<Item = f32>) -> f32 {
    let mut seen = [0.0f32; MOST_NEIGHBOURS];
    let mut count = 0;
    for c in costs.filter(|c| *c >= 0.0).take(MOST_NEIGHBOURS) {
        // Insertion keeps the few numbers sorted.
        let mut k = count;
        while k > 0 && seen[k - 1] > c {
            seen[k] = seen[k - 1];
            k -= 1;
        }
        seen[k] = c;
        count += 1;
    }
    let half = count.div_ceil(2);
    if half == 0 { WORST } else { seen[..half].iter().sum::<f32>() / half as f32 }
}

/// What `source` shows at each pixel of `view` if everything were at one inverse depth; negative where it shows
/// nothing.
#[inline(always)]
fn warp(view: &WorkView, source: &WorkView, inverse: f32, out: &mut [f32]) {
    // Homography of the plane: K' (R + t n^T / z) K^-1, applied as base + x * along_x + y * along_y.
    let to_source = source.rotation.transpose();
    let rotation = to_source * view.rotation;
    let shift = to_source * (view.centre - source.centre) * inverse;
    let scale = Mat3::from_cols(
        Vec3::new(source.focal.x, 0.0, 0.0),
        Vec3::new(0.0, source.focal.y, 0.0),
        source.principal.extend(1.0),
    );
    let along_x = scale * (rotation * Vec3::X) / view.focal.x;
    let along_y = scale * (rotation * Vec3::Y) / view.focal.y;
    let corner = (Vec2::splat(0.5) - view.principal) / view.focal;
    let base = scale * (rotation * corner.extend(1.0) + shift);
    let (w, h) = (source.width, source.height);
    let (last_x, last_y) = ((w - 1) as f32, (h - 1) as f32);
    for (y, row) in out.chunks_exact_mut(view.width).enumerate() {
        let start = base + along_y * y as f32;
        for (x, o) in row.iter_mut().enumerate() {
            let p = start + along_x * x as f32;
            let (u, v) = (p.x / p.z - 0.5, p.y / p.z - 0.5);
            let inside = p.z > 0.0 && u >= 0.0 && v >= 0.0 && u < last_x && v < last_y;
            *o = if inside {
                let (iu, iv) = (u as usize, v as usize);
                let (fu, fv) = (u - iu as f32, v - iv as f32);
                let at = &source.grey[iv * w + iu..];
                let top = at[0] + (at[1] - at[0]) * fu;
                let bottom = at[w] + (at[w + 1] - at[w]) * fu;
                top + (bottom - top) * fv
            } else {
                -1.0
            };
        }
    }
}

/// Sums over windows by running sums, so that a window's size costs nothing.
struct Window {
    /// 1 / number of columns in the window around each column.
    shares: Vec<f32>,
    rows: Vec<f32>,
    sums: [Vec<f32>; 3],
    product: Vec<f32>,
}

impl Window {
    fn new(width: usize, height: usize) -> Self {
        let zeros = vec![0.0; width * height];
        Self {
            shares: (0..width)
                .map(|x| 1.0 / ((x + RADIUS).min(width - 1) - x.saturating_sub(RADIUS) + 1) as f32)
                .collect(),
            rows: zeros.clone(),
            sums: std::array::from_fn(|_| zeros.clone()),
            product: zeros,
        }
    }

    /// Mean over the window around each pixel (windows are cut off at the border).
    #[inline(always)]
    fn means(shares: &[f32], rows: &mut [f32], values: &[f32], out: &mut [f32]) {
        let (width, height) = (shares.len(), values.len() / shares.len());
        for (row, out) in values.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
            out.copy_from_slice(row);
            for shift in 1..=RADIUS.min(width - 1) {
                for (o, v) in out[shift..].iter_mut().zip(row) {
                    *o += v;
                }
                for (o, v) in out.iter_mut().zip(&row[shift..]) {
                    *o += v;
                }
            }
            for (o, share) in out.iter_mut().zip(shares) {
                *o *= share;
            }
        }
        for (y, out) in out.chunks_exact_mut(width).enumerate() {
            let (a, b) = (y.saturating_sub(RADIUS), (y + RADIUS).min(height - 1));
            out.fill(0.0);
            for k in a..=b {
                for (o, r) in out.iter_mut().zip(&rows[k * width..(k + 1) * width]) {
                    *o += r;
                }
            }
            let share = 1.0 / (b - a + 1) as f32;
            for o in out {
                *o *= share;
            }
        }
    }

    #[inline(always)]
    fn mean_and_variance(&mut self, grey: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut mean, mut variance) = (vec![0.0; grey.len()], vec![0.0; grey.len()]);
        Self::means(&self.shares, &mut self.rows, grey, &mut mean);
        for (p, g) in self.product.iter_mut().zip(grey) {
            *p = g * g;
        }
        Self::means(&self.shares, &mut self.rows, &self.product, &mut variance);
        for (v, m) in variance.iter_mut().zip(&mean) {
            *v = (*v - m * m).max(0.0);
        }
        (mean, variance)
    }

    /// 1 − normalised cross-correlation of `grey` and `warped` around each pixel, at most [`WORST`]; negative where
    /// `warped` shows nothing.
    #[inline(always)]
    fn cost(&mut self, grey: &[f32], reference: &(Vec<f32>, Vec<f32>), warped: &[f32], out: &mut [f32]) {
        let Self { shares, rows, sums, product } = self;
        let (mean, variance) = reference;
        let [sum, square, cross] = sums;
        Self::means(shares, rows, warped, sum);
        for (p, w) in product.iter_mut().zip(warped) {
            *p = w * w;
        }
        Self::means(shares, rows, product, square);
        for ((p, w), g) in product.iter_mut().zip(warped).zip(grey) {
            *p = w * g;
        }
        Self::means(shares, rows, product, cross);
        for k in 0..out.len() {
            let source = (square[k] - sum[k] * sum[k]).max(0.0);
            let covariance = cross[k] - mean[k] * sum[k];
            let correlation = covariance / ((variance[k] + NOISE) * (source + NOISE)).sqrt();
            out[k] = if warped[k] < 0.0 { -1.0 } else { (1.0 - correlation).min(WORST) };
        }
    }
}
