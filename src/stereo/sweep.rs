//! Plane sweep: how well a frame's surroundings match its neighbours' at each depth.

use glam::{Mat3, Vec2, Vec3};

use super::aggregate::{self, CostVolume, WORST};
use super::rig::WorkView;
use crate::simd::floor_within;

/// Half the side of the window that is compared, px.
pub(super) const RADIUS: usize = 2;

/// Most frames that one frame is compared with.
pub(super) const MOST_NEIGHBOURS: usize = 16;

/// Variance of grey (0–255) in a window below which there is nothing to match.
const NOISE: f32 = 12.0;

/// Stands for the cost of what a neighbour does not show: larger than any cost.
const UNSEEN: f32 = 2.0 * WORST;

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
        let mut correlation = Correlation::new(view);
        let (mut places, mut warped) = (Places::new(view.width), vec![0.0; pixels]);
        let mut costs = vec![vec![0.0f32; pixels]; neighbours.len()];
        let mut half = BetterHalf::new(pixels);
        let mut cost = vec![0.0f32; pixels * planes.count];
        for (plane, out) in cost.chunks_exact_mut(pixels).enumerate() {
            for (cost, m) in costs.iter_mut().zip(neighbours) {
                warp(view, &views[*m], planes.inverse(plane as f32), &mut places, &mut warped);
                correlation.cost(&warped, cost);
            }
            half.mean(&mut costs, out);
        }
        CostVolume::new(&cost, planes.count)
    }
}

/// The mean of the better half of what a pixel's neighbours say: the others may not see the point.
struct BetterHalf {
    /// How many neighbours say something about each pixel.
    seen: Vec<f32>,
}

impl BetterHalf {
    fn new(pixels: usize) -> Self {
        Self { seen: vec![0.0; pixels] }
    }

    /// Of every pixel's `costs`, a list a neighbour, [`UNSEEN`] where that shows nothing; [`WORST`] where none does. Sorts
    /// them.
    #[inline(always)]
    fn mean(&mut self, costs: &mut [Vec<f32>], out: &mut [f32]) {
        // Insertion, with what does not depend on the numbers: all pixels at once.
        for sorted in 1..costs.len() {
            for k in (0..sorted).rev() {
                let (low, high) = costs.split_at_mut(k + 1);
                for (a, b) in low[k].iter_mut().zip(&mut high[0]) {
                    (*a, *b) = (if *b < *a { *b } else { *a }, if *b < *a { *a } else { *b });
                }
            }
        }
        self.seen.fill(0.0);
        for cost in costs.iter() {
            for (seen, c) in self.seen.iter_mut().zip(cost) {
                *seen += if *c < UNSEEN { 1.0 } else { 0.0 };
            }
        }
        out.fill(0.0);
        for (k, cost) in costs.iter().enumerate() {
            let below = 2.0 * k as f32;
            for ((o, c), seen) in out.iter_mut().zip(cost).zip(&self.seen) {
                *o += if below < *seen { *c } else { 0.0 };
            }
        }
        for (o, seen) in out.iter_mut().zip(&self.seen) {
            *o = if *seen > 0.0 { *o / (0.5 * seen).ceil() } else { WORST };
        }
    }
}

/// What `source` shows at each pixel of `view` if everything were at one inverse depth; negative where it shows
/// nothing.
#[inline(always)]
fn warp(view: &WorkView, source: &WorkView, inverse: f32, places: &mut Places, out: &mut [f32]) {
    if source.width < 2 || source.height < 2 {
        return out.fill(-1.0);
    }
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
    for (y, row) in out.chunks_exact_mut(view.width).enumerate() {
        places.find(base + along_y * y as f32, along_x, source);
        places.show(source, row);
    }
}

/// Where the pixels of one row are in a source: arithmetic apart from look-ups, so that the former vectorises.
struct Places {
    /// Number of the source's pixel above and to the left.
    pixel: Vec<u32>,
    /// How far right and below of it, 0–1; negative where the source shows nothing.
    right: Vec<f32>,
    below: Vec<f32>,
}

impl Places {
    fn new(width: usize) -> Self {
        Self { pixel: vec![0; width], right: vec![0.0; width], below: vec![0.0; width] }
    }

    /// Projects `start + x * along` to the source for all columns x.
    #[inline(always)]
    fn find(&mut self, start: Vec3, along: Vec3, source: &WorkView) {
        let width = source.width as u32;
        let (last_x, last_y) = ((source.width - 1) as f32, (source.height - 1) as f32);
        let places = self.pixel.iter_mut().zip(&mut self.right).zip(&mut self.below);
        for (x, ((pixel, right), below)) in places.enumerate() {
            let x = x as u32 as f32;
            let z = start.z + along.z * x;
            let (u, v) = ((start.x + along.x * x) / z - 0.5, (start.y + along.y * x) / z - 0.5);
            let inside = (z > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < last_x) & (v < last_y);
            let (column, left) = floor_within(u, last_x - 1.0);
            let (line, above) = floor_within(v, last_y - 1.0);
            *pixel = line * width + column;
            *right = if inside { u - left } else { -1.0 };
            *below = v - above;
        }
    }

    /// What the source shows there.
    #[inline(always)]
    fn show(&self, source: &WorkView, out: &mut [f32]) {
        let width = source.width;
        for (((o, pixel), right), below) in out.iter_mut().zip(&self.pixel).zip(&self.right).zip(&self.below)
        {
            let at = &source.grey[*pixel as usize..][..width + 2];
            let top = at[0] + (at[1] - at[0]) * right;
            let bottom = at[width] + (at[width + 1] - at[width]) * right;
            *o = if *right >= 0.0 { top + (bottom - top) * below } else { -1.0 };
        }
    }
}

/// Means over the windows around all pixels of an image, cut off at its border.
///
/// Sums are written out for [`RADIUS`] = 2: one pass along rows, between two zeros on each side, and one across them.
struct Window {
    /// 1 / number of columns in the window around each column.
    shares: Vec<f32>,
    padded: Vec<f32>,
    zeros: Vec<f32>,
    rows: Vec<f32>,
}

impl Window {
    fn new(width: usize, height: usize) -> Self {
        Self {
            shares: (0..width).map(|x| share(x, width)).collect(),
            padded: vec![0.0; width + 2 * RADIUS],
            zeros: vec![0.0; width],
            rows: vec![0.0; width * height],
        }
    }

    /// Means of the products of `a` and `b`, or of `a` alone.
    #[inline(always)]
    fn means(&mut self, a: &[f32], b: Option<&[f32]>, out: &mut [f32]) {
        let Self { shares, padded, zeros, rows } = self;
        let (width, height) = (shares.len(), a.len() / shares.len());
        for (y, row) in rows.chunks_exact_mut(width).enumerate() {
            let (line, middle) = (y * width..(y + 1) * width, &mut padded[RADIUS..RADIUS + width]);
            middle.copy_from_slice(&a[line.clone()]);
            if let Some(b) = b {
                for (m, b) in middle.iter_mut().zip(&b[line]) {
                    *m *= b;
                }
            }
            let (p, q, r) = (&padded[..], &padded[1..], &padded[2..]);
            let (s, t) = (&padded[3..], &padded[4..]);
            let window = p.iter().zip(q).zip(r).zip(s).zip(t);
            for ((o, share), ((((p, q), r), s), t)) in row.iter_mut().zip(shares.iter()).zip(window) {
                *o = ((((r + q) + s) + p) + t) * share;
            }
        }
        for (y, out) in out.chunks_exact_mut(width).enumerate() {
            let line = |k: usize| match (y + k).checked_sub(RADIUS) {
                Some(y) if y < height => &rows[y * width..(y + 1) * width],
                _ => &zeros[..],
            };
            let [p, q, r, s, t] = [line(0), line(1), line(2), line(3), line(4)];
            let share = share(y, height);
            let window = p.iter().zip(q).zip(r).zip(s).zip(t);
            for (o, ((((p, q), r), s), t)) in out.iter_mut().zip(window) {
                *o = ((((p + q) + r) + s) + t) * share;
            }
        }
    }

    #[inline(always)]
    fn mean_and_variance(&mut self, grey: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut mean, mut variance) = (vec![0.0; grey.len()], vec![0.0; grey.len()]);
        self.means(grey, None, &mut mean);
        self.means(grey, Some(grey), &mut variance);
        for (v, m) in variance.iter_mut().zip(&mean) {
            *v = (*v - m * m).max(0.0);
        }
        (mean, variance)
    }
}

/// 1 / number of the pixels of a line that a window around number `at` of `length` holds.
fn share(at: usize, length: usize) -> f32 {
    1.0 / ((at + RADIUS).min(length - 1) - at.saturating_sub(RADIUS) + 1) as f32
}

/// How well images match around each pixel: 1 − normalised cross-correlation.
struct Correlation<'a> {
    window: Window,
    grey: &'a [f32],
    mean: Vec<f32>,
    variance: Vec<f32>,
    /// Means of a warped image, its square and its product with the grey one.
    sums: [Vec<f32>; 3],
}

impl<'a> Correlation<'a> {
    #[inline(always)]
    fn new(view: &'a WorkView) -> Self {
        let mut window = Window::new(view.width, view.height);
        let (mean, variance) = window.mean_and_variance(&view.grey);
        let sums = std::array::from_fn(|_| vec![0.0; view.grey.len()]);
        Self { window, grey: &view.grey, mean, variance, sums }
    }

    /// The cost of `warped` at each pixel, at most [`WORST`]; [`UNSEEN`] where it shows nothing.
    #[inline(always)]
    fn cost(&mut self, warped: &[f32], out: &mut [f32]) {
        let Self { window, grey, mean, variance, sums: [sum, square, cross] } = self;
        window.means(warped, None, sum);
        window.means(warped, Some(warped), square);
        window.means(warped, Some(grey), cross);
        for k in 0..out.len() {
            let source = (square[k] - sum[k] * sum[k]).max(0.0);
            let covariance = cross[k] - mean[k] * sum[k];
            let correlation = covariance / ((variance[k] + NOISE) * (source + NOISE)).sqrt();
            out[k] = if warped[k] < 0.0 { UNSEEN } else { (1.0 - correlation).min(WORST) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    /// The mean of the better half, pixel by pixel.
    fn better_half(costs: &[f32]) -> f32 {
        let mut seen: Vec<f32> = costs.iter().copied().filter(|c| *c < UNSEEN).collect();
        seen.sort_by(f32::total_cmp);
        let half = seen.len().div_ceil(2);
        if half == 0 { WORST } else { seen[..half].iter().sum::<f32>() / half as f32 }
    }

    #[test]
    fn the_better_half_is_that_of_those_who_see_a_pixel() {
        let mut rng = Rng::new(5, 0, 0);
        for neighbours in 0..=MOST_NEIGHBOURS {
            let cost = |rng: &mut Rng| if rng.uniform() < 0.3 { UNSEEN } else { rng.uniform() };
            let costs: Vec<Vec<f32>> =
                (0..neighbours).map(|_| (0..64).map(|_| cost(&mut rng)).collect()).collect();
            let mut found = vec![0.0; 64];
            BetterHalf::new(64).mean(&mut costs.clone(), &mut found);
            for (pixel, found) in found.iter().enumerate() {
                let expected = better_half(&costs.iter().map(|c| c[pixel]).collect::<Vec<_>>());
                assert!((found - expected).abs() < 1e-6, "{neighbours}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn means_are_those_of_windows_cut_off_at_the_border() {
        let mut rng = Rng::new(6, 0, 0);
        for (width, height) in [(1, 1), (1, 4), (2, 2), (3, 9), (17, 5)] {
            let image: Vec<f32> = (0..width * height).map(|_| rng.uniform()).collect();
            let mut found = vec![0.0; width * height];
            Window::new(width, height).means(&image, Some(&image), &mut found);
            for (k, found) in found.iter().enumerate() {
                let near = |n: &usize| {
                    (n % width).abs_diff(k % width) <= RADIUS && (n / width).abs_diff(k / width) <= RADIUS
                };
                let window: Vec<usize> = (0..width * height).filter(near).collect();
                let expected = window.iter().map(|n| image[*n].powi(2)).sum::<f32>() / window.len() as f32;
                assert!(
                    (found - expected).abs() < 1e-5,
                    "{width} × {height}, {k}: {found} is not {expected}"
                );
            }
        }
    }

    #[test]
    fn a_source_shows_a_view_of_the_same_place_as_it_is_and_a_single_line_nothing() {
        let view = |width: usize, height: usize| WorkView {
            width,
            height,
            focal: Vec2::splat(4.0),
            principal: Vec2::new(width as f32, height as f32) / 2.0,
            rotation: Mat3::IDENTITY,
            centre: Vec3::ZERO,
            grey: (0..width * height).map(|k| k as f32).collect(),
        };
        let (source, mut places, mut out) = (view(6, 5), Places::new(6), vec![0.0; 30]);
        warp(&source, &source, 1.0, &mut places, &mut out);
        // The last line and column have no neighbours to be mixed with.
        for (k, shown) in out.iter().enumerate() {
            let expected = if k % 6 < 5 && k / 6 < 4 { k as f32 } else { -1.0 };
            assert!((shown - expected).abs() < 1e-3, "{k}: {shown}");
        }
        for line in [view(6, 1), view(1, 6), view(1, 1)] {
            out.fill(0.0);
            warp(&source, &line, 1.0, &mut places, &mut out);
            assert!(out.iter().all(|shown| *shown == -1.0));
        }
    }
}
