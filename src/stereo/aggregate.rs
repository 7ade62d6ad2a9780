//! Semi-global matching (Hirschmüller 2008): the depth that fits best and changes least along eight directions.

/// Largest cost of one pixel at one plane.
pub(super) const WORST: f32 = 1.0;

/// Cost 1 in stored steps.
const SCALE: f32 = 200.0;

/// Pixels that are transposed together.
const BLOCK: usize = 64;

/// Price of going to a neighbouring plane from one pixel to the next.
const SMALL_STEP: u16 = 10;

/// Price of going to any other plane where the image is smooth, and the least price at its edges.
const LARGE_STEP: f32 = 80.0;
const LEAST_LARGE_STEP: f32 = 24.0;

/// Difference in grey (0–255) at which the price of a large step is halved.
const EDGE: f32 = 12.0;

/// A pixel's plane must beat what lies beyond its neighbouring planes by this factor: else the match is not unique.
const UNIQUE: f32 = 1.02;

/// Directions from which costs are gathered.
const DIRECTIONS: [(isize, isize); 8] =
    [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)];

/// Matching cost of every pixel at every plane, `[pixel][plane]`.
pub(super) struct CostVolume {
    planes: usize,
    cost: Vec<u16>,
}

impl CostVolume {
    /// From costs of 0 to [`WORST`], `[plane][pixel]`.
    pub fn new(costs: &[f32], planes: usize) -> Self {
        let pixels = costs.len() / planes;
        let mut cost = vec![0; costs.len()];
        // A few lines of every plane at a time: what is read and what is written then both stay in the cache.
        for (n, out) in cost.chunks_mut(BLOCK * planes).enumerate() {
            for (plane, costs) in costs.chunks_exact(pixels).enumerate() {
                for (pixel, c) in costs[n * BLOCK..].iter().take(BLOCK).enumerate() {
                    out[pixel * planes + plane] = (c * SCALE) as u16;
                }
            }
        }
        Self { planes, cost }
    }
}

/// The best plane of each pixel to a fraction of a plane; negative where no plane stands out.
pub(super) fn best_planes(cost: &CostVolume, width: usize, grey: &[f32]) -> Vec<f32> {
    let total = pulp::Arch::new().dispatch(Aggregation { cost, width, grey });
    total.chunks_exact(cost.planes).map(best_plane).collect()
}

struct Aggregation<'a> {
    cost: &'a CostVolume,
    width: usize,
    grey: &'a [f32],
}

impl pulp::WithSimd for Aggregation<'_> {
    type Output = Vec<u16>;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _simd: S) -> Vec<u16> {
        let Self { cost: CostVolume { planes, cost }, width, grey } = self;
        let (n, height) = (*planes, grey.len() / width);
        let mut total = vec![0u16; cost.len()];
        let mut path = vec![0u16; cost.len()];
        let mut before = vec![u16::MAX; n + 2];
        for (dx, dy) in DIRECTIONS {
            for row in 0..height {
                let y = if dy >= 0 { row } else { height - 1 - row };
                for column in 0..width {
                    let x = if dx >= 0 { column } else { width - 1 - column };
                    let pixel = y * width + x;
                    let here = pixel * n..(pixel + 1) * n;
                    let (px, py) = (x as isize - dx, y as isize - dy);
                    let inside = px >= 0 && py >= 0 && px < width as isize && py < height as isize;
                    if !inside {
                        path[here.clone()].copy_from_slice(&cost[here.clone()]);
                    } else {
                        let from = py as usize * width + px as usize;
                        let step = large_step(grey[pixel], grey[from]);
                        before[1..=n].copy_from_slice(&path[from * n..(from + 1) * n]);
                        advance(&before, step, &cost[here.clone()], &mut path[here.clone()]);
                    }
                    for (t, p) in total[here.clone()].iter_mut().zip(&path[here]) {
                        *t += p;
                    }
                }
            }
        }
        total
    }
}

fn large_step(a: f32, b: f32) -> u16 {
    (LARGE_STEP / (1.0 + (a - b).abs() / EDGE)).max(LEAST_LARGE_STEP) as u16
}

/// One step along a path; `before` has a border of one on each side.
#[inline(always)]
fn advance(before: &[u16], large_step: u16, cost: &[u16], out: &mut [u16]) {
    let n = cost.len();
    let mut least = u16::MAX;
    for b in &before[1..=n] {
        least = least.min(*b);
    }
    let jump = least + large_step;
    let (below, same, above) = (&before[..n], &before[1..=n], &before[2..n + 2]);
    for k in 0..n {
        let step = below[k].min(above[k]).saturating_add(SMALL_STEP);
        out[k] = cost[k] + same[k].min(step).min(jump) - least;
    }
}

/// The plane of least cost, between planes by a parabola through its neighbours.
fn best_plane(total: &[u16]) -> f32 {
    let best = (0..total.len()).min_by_key(|k| total[*k]).unwrap_or(0);
    if best == 0 || best + 1 >= total.len() {
        return -1.0;
    }
    let others = total.iter().enumerate().filter(|(k, _)| k.abs_diff(best) > 2).map(|(_, t)| *t).min();
    if others.is_some_and(|o| f32::from(o) < UNIQUE * f32::from(total[best])) {
        return -1.0;
    }
    let [a, b, c] = [total[best - 1], total[best], total[best + 1]].map(f32::from);
    let bend = a - 2.0 * b + c;
    best as f32 + if bend > 0.0 { 0.5 * (a - c) / bend } else { 0.0 }
}
