//! Surfaces are flat where pictures are.
//!
//! The inverse z-depth of a plane is affine in the pixel, so three pixels in a row of a patch that see one plane have
//! disparities on a line. What bends it costs up to a bounded price, since surfaces do end; where the picture changes, too,
//! less (Heise et al. 2013, "PM-Huber", and the edge-aware terms of self-supervised depth). It carries depth
//! from the borders of a door or a wall into its middle, where nothing else tells it.

use pulp::Simd;

use super::RayTarget;
use crate::render::forward::{Chunk, RayInput};
use crate::simd::AlignedVec;
use crate::simd::floats::{Column, ColumnMut, Floats};

/// Relative bend up to which the price grows with its square.
pub const SMALL: f32 = 0.002;

/// Relative bend at which half of the price is reached.
pub const LARGE: f32 = 0.02;

/// Contrast between neighbours (sRGB 0–1) at which a bend costs 1/e as much.
const CONTRAST: f32 = 0.06;

/// Three rays of a chunk through pixels in a row, equally far apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bend {
    /// Their numbers in the chunk.
    pub rays: [usize; 3],
    /// How little the picture changes between them, 0 to 1.
    pub weight: f32,
}

/// The rows and columns of three in the patches (`side`² rays each) that a chunk consists of.
pub fn find(rays: &[RayInput], targets: &[RayTarget], side: usize, out: &mut Vec<Bend>) {
    out.clear();
    for first in (0..rays.len() / (side * side)).map(|n| n * side * side) {
        for (line, at) in (0..side).flat_map(|l| (0..side.saturating_sub(2)).map(move |a| (l, a))) {
            let across = std::array::from_fn(|k| first + line * side + at + k);
            let down = std::array::from_fn(|k| first + (at + k) * side + line);
            for triple in [across, down] {
                if is_straight(triple.map(|r| &rays[r])) {
                    out.push(Bend { rays: triple, weight: evenness(triple.map(|r| &targets[r])) });
                }
            }
        }
    }
}

/// Patches are cut off at borders and masks; what is left of a row there may not be one.
fn is_straight([a, b, c]: [&RayInput; 3]) -> bool {
    let off = a.uv + c.uv - 2.0 * b.uv;
    a.view == c.view && a.uv != b.uv && off.abs().max_element() < 1e-5
}

fn evenness([a, b, c]: [&RayTarget; 3]) -> f32 {
    let step = |a: &RayTarget, b: &RayTarget| (0..3).map(|k| (a.rgb[k] - b.rgb[k]).abs()).fold(0.0, f32::max);
    (-step(a, b).max(step(b, c)) / CONTRAST).exp()
}

/// Price of all bends, summed; writes its gradient (times `scale`) with respect to the disparity of each ray.
///
/// The disparity by which a bend is measured is taken as a constant.
#[inline(always)]
pub fn backward<S: Simd>(
    simd: S,
    price: f32,
    chunk: &Chunk,
    bends: &[Bend],
    scale: f32,
    grad: &mut AlignedVec,
) -> f32 {
    grad.zero(chunk.intervals.layout.width());
    if price == 0.0 {
        return 0.0;
    }
    let disparity = disparities(simd, chunk);
    let mut sum = 0.0;
    for bend in bends {
        let [a, b, c] = bend.rays.map(|r| disparity[r]);
        let level = level([a, b, c]);
        let relative = (a - 2.0 * b + c) / level;
        let size = (relative * relative + SMALL * SMALL).sqrt();
        let weight = price * bend.weight;
        sum += weight * (size - SMALL) / (size + LARGE);
        let d = scale * weight * (SMALL + LARGE) / (size + LARGE).powi(2) * relative / (size * level);
        for (r, share) in bend.rays.into_iter().zip([1.0, -2.0, 1.0]) {
            grad[r] += share * d;
        }
    }
    sum
}

/// Expected inverse z-depth of every ray, 1/units; what passes the box is at infinity.
#[inline(always)]
pub fn disparities<S: Simd>(simd: S, chunk: &Chunk) -> AlignedVec {
    let layout = chunk.intervals.layout;
    let t = Column::new(simd, &chunk.intervals.t);
    let weight = chunk.weights.weight.each_ref().map(|column| Column::new(simd, column));
    let mut disparities = AlignedVec::zeros(layout.width());
    let mut out = ColumnMut::new(simd, &mut disparities);
    for rays in 0..layout.vectors::<S>() {
        let mut sum = Floats::new(simd, 0.0);
        for at in layout.of_vector::<S>(rays) {
            sum += (weight[0].at(at) + weight[1].at(at) + weight[2].at(at)) * inverse(t.at(at));
        }
        out.set(rays, sum);
    }
    disparities.iter_mut().zip(&chunk.rays).for_each(|(d, ray)| *d /= ray.ray.refined_cam.z);
    disparities
}

/// 1/t, bounded: a ray that misses the box has its samples at 0.
#[inline(always)]
pub fn inverse<S: Simd>(t: Floats<S>) -> Floats<S> {
    1.0 / t.clamp(1e-6, f32::MAX)
}

/// What a bend is measured by: the mean disparity of its rays.
pub fn level(disparities: [f32; 3]) -> f32 {
    disparities.iter().sum::<f32>() / 3.0 + 1e-3
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};

    use super::*;

    /// A patch of `side`² rays, `step` apart in the image, all of one colour.
    fn patch(side: usize, step: f32) -> (Vec<RayInput>, Vec<RayTarget>) {
        let ray = |k: usize| RayInput {
            view: 0,
            dir_cam: Vec3::Z,
            uv: Vec2::new(0.3 + step * (k % side) as f32, 0.4 + step * (k / side) as f32),
            jitter: 0.5,
        };
        let target = RayTarget { rgb: [0.5; 3], background: [0.0; 3], exposure: [0.0; 6], depth: 0.0 };
        ((0..side * side).map(ray).collect(), vec![target; side * side])
    }

    fn bends(rays: &[RayInput], targets: &[RayTarget], side: usize) -> Vec<Bend> {
        let mut out = Vec::new();
        find(rays, targets, side, &mut out);
        out
    }

    #[test]
    fn every_row_and_column_of_three_is_found() {
        let (rays, targets) = patch(4, 0.01);
        let found = bends(&rays, &targets, 4);
        assert_eq!(found.len(), 16);
        assert!(found.iter().all(|b| b.weight == 1.0));
        assert!(found.iter().any(|b| b.rays == [1, 5, 9]) && found.iter().any(|b| b.rays == [13, 14, 15]));
        for side in [1, 2] {
            let (rays, targets) = patch(side, 0.01);
            assert_eq!(bends(&rays, &targets, side), []);
        }
    }

    #[test]
    fn pixels_that_were_moved_are_no_row_and_contrast_takes_weight() {
        let (mut rays, mut targets) = patch(3, 0.01);
        rays[4].uv = rays[0].uv;
        targets[0].rgb[1] += CONTRAST;
        let found = bends(&rays, &targets, 3);
        let rows: Vec<_> = found.iter().map(|b| b.rays).collect();
        assert_eq!(rows, [[0, 1, 2], [0, 3, 6], [6, 7, 8], [2, 5, 8]]);
        let e = (-1.0f32).exp();
        for (b, weight) in found.iter().zip([e, e, 1.0, 1.0]) {
            assert!((b.weight - weight).abs() < 1e-5, "{b:?}");
        }
    }
}
