//! Scale as an input of the fields (LERF, Kerr et al. 2023, 3.2 and 3.3).
//!
//! A patch that covers the share s of the image's height shows, at z-depth z, a piece of the world that is s z h/f high
//! (h: height of the image, f: focal length, px). That size is the input, so that near and far views of a thing ask
//! for the same feature. While training, the share is drawn at random for each ray of each step; afterwards sizes are
//! asked for directly. All sources of a ray have the size at the mean depth of them (in LERF each has its own): they
//! differ where a ray's light comes from surfaces far apart, and there the descriptor is of none of them.

use half::f16;

use super::HeadShape;
use super::step::RayTargets;
use super::train::{Pixel, gather};
use crate::field::hashgrid::FEATURES;
use crate::rng::Rng;
use crate::scene::Frame;
use crate::semantics::targets::{EncodedTable, ImageTargets};
use crate::simd::TILE;

/// Most scales that targets are kept at.
const MAX_KNOTS: usize = 8;

/// Share of the rays whose sizes may lie beyond either end of the range that networks tell apart: a few very near or
/// very far ones would take most of it.
const BEYOND: f32 = 0.02;

/// Targets of rays at several scales.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pyramid {
    /// Scales that targets are given at, ascending, as shares of the image's height; at least one.
    pub knots: Vec<f32>,
    /// Smallest and largest scale of the patches that each ray is taught by.
    pub shares: Vec<[f32; 2]>,
    /// Height of the whole image at the depth of what each ray sees, units.
    pub heights: Vec<f32>,
}

impl Pyramid {
    /// A scale for ray `ray`, as a share of the image's height.
    pub(super) fn draw(&self, ray: usize, rng: &mut Rng) -> f32 {
        let [low, high] = self.shares[ray];
        low + (high - low) * rng.uniform()
    }

    /// The knot below `share`, and how much the next one counts.
    fn between(&self, share: f32) -> (usize, f32) {
        let above = self.knots.partition_point(|k| *k < share).min(self.knots.len() - 1);
        let below = above.saturating_sub(1);
        let (low, high) = (self.knots[below], self.knots[above]);
        (below, if high > low { ((share - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 })
    }

    /// Sizes that the pyramids of `rays` span, units: positive and ascending.
    pub(super) fn sizes(&self, rays: &[u32]) -> [f32; 2] {
        let end = |side: usize, quantile: f32| {
            let size = |ray: &u32| self.shares[*ray as usize][side] * self.heights[*ray as usize];
            let mut sizes: Vec<f32> = rays.iter().map(size).filter(|s| *s > 0.0).collect();
            sizes.sort_unstable_by(f32::total_cmp);
            let last = sizes.len().saturating_sub(1);
            sizes.get((quantile * last as f32) as usize).copied().unwrap_or(1.0)
        };
        let low = end(0, BEYOND);
        // Rays of one size still need a range.
        [low, end(1, 1.0 - BEYOND).max(1.01 * low)]
    }
}

/// Targets at all scales that patches have; `depth` is that of each pixel, units.
///
/// Between its own scales a frame's targets are linear, so what is kept at the scales of all frames is exact.
pub(super) fn pyramid_targets(
    image: &ImageTargets,
    encoded: &EncodedTable,
    pixels: &[Pixel],
    frames: &[Frame],
    depth: &[f32],
) -> RayTargets {
    let (dim, knots) = (encoded.dim, image.all_scales(MAX_KNOTS));
    let of = |p: &Pixel| {
        let frame = p.frame as usize;
        let all = image.at(frame, p.x, p.y)?;
        let mut z = vec![0.0; knots.len() * dim];
        for (z, knot) in z.chunks_exact_mut(dim).zip(&knots) {
            // Where a scale has no usable patch here, the others tell.
            encoded.blend(&image.at_scale(frame, p.x, p.y, *knot).unwrap_or(all), z);
        }
        Some((z, [1.0, 0.0]))
    };
    let targets = gather(pixels, frames, knots.len() * dim, dim, of);
    let height = |(p, z): (&Pixel, &f32)| {
        let camera = &frames[p.frame as usize].camera;
        z * (f64::from(camera.height) / camera.fy) as f32
    };
    let pyramid = Pyramid {
        shares: pixels.iter().map(|p| image.scales(p.frame as usize).unwrap_or_default()).collect(),
        heights: pixels.iter().zip(depth).map(height).collect(),
        knots,
    };
    RayTargets { width: dim, pyramid: Some(pyramid), ..targets }
}

impl RayTargets {
    /// What ray `ray` should look like, in `out` `[width]`; at scale `share`, if that matters.
    pub(super) fn value(&self, ray: usize, share: f32, out: &mut Vec<f32>) {
        let row = |n: usize| &self.values[n * self.width..][..self.width];
        out.clear();
        let Some(pyramid) = &self.pyramid else { return out.extend(row(ray).iter().map(|v| v.to_f32())) };
        let (knot, t) = pyramid.between(share);
        let first = ray * pyramid.knots.len() + knot;
        let mixed = |(a, b): (&f16, &f16)| (1.0 - t) * a.to_f32() + t * b.to_f32();
        out.extend(row(first).iter().zip(row(first + usize::from(t > 0.0))).map(mixed));
    }
}

impl HeadShape {
    /// The size that stands for all where one must do, units; of no meaning to fields without scales.
    pub fn middle_size(&self) -> f32 {
        self.scales.map_or(0.0, |[low, high]| (low * high).sqrt())
    }

    /// Sizes to be tried for a phrase beside [`Self::middle_size`], which with them are `count` over the whole range,
    /// each larger than the one before by the same factor. None for fields without scales.
    pub fn other_sizes(&self, count: usize) -> Vec<f32> {
        let Some([low, high]) = self.scales else { return Vec::new() };
        let last = count.max(2) - 1;
        let others = (0..count).filter(|n| count > 1 && 2 * n != last);
        others.map(|n| low * (high / low).powf(n as f32 / last as f32)).collect()
    }
}

/// Writes what networks see of sizes to the rows of one tile: `FEATURES` rows of lanes.
#[inline(always)]
pub(super) fn write_tile(range: [f32; 2], size: impl Fn(usize) -> f32, lanes: usize, out: &mut [f32]) {
    for lane in 0..lanes {
        for (k, v) in encode(range, size(lane)).into_iter().enumerate() {
            out[k * TILE + lane] = v;
        }
    }
}

/// cos(kπu), k = 1, 2, ...: u goes from 0 to 1 over the logarithms of `range` and stays there beyond.
fn encode([low, high]: [f32; 2], size: f32) -> [f32; FEATURES] {
    let u = ((size / low).ln() / (high / low).ln()).clamp(0.0, 1.0);
    let cosine = (std::f32::consts::PI * u).cos();
    let (mut before, mut now) = (1.0, cosine);
    std::array::from_fn(|_| {
        let this = now;
        // cos((k+1)a) = 2 cos(a) cos(ka) − cos((k−1)a)
        (before, now) = (now, 2.0 * cosine * now - before);
        this
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_told_apart_over_the_range_and_not_beyond() {
        let range = [0.1, 1.6];
        let middle = encode(range, 0.4);
        for (found, expected) in middle.into_iter().zip([0.0, -1.0, 0.0, 1.0]) {
            assert!((found - expected).abs() < 1e-5, "{middle:?}");
        }
        assert_eq!(encode(range, 0.1), encode(range, 0.0));
        assert_eq!(encode(range, 1.6), encode(range, 9.0));
        assert_ne!(encode(range, 0.1), encode(range, 1.6));
    }

    #[test]
    fn targets_between_knots_take_from_both() {
        let pyramid = Pyramid { knots: vec![0.1, 0.3, 0.5], ..Pyramid::default() };
        let values = [0.0, 0.0, 0.0, 1.0, 2.0, 4.0].map(f16::from_f32).to_vec();
        let targets =
            RayTargets { width: 1, dim: 1, values, pyramid: Some(pyramid), ..RayTargets::default() };
        let mut out = Vec::new();
        for (share, expected) in [(0.05, 1.0), (0.1, 1.0), (0.2, 1.5), (0.3, 2.0), (0.45, 3.5), (0.9, 4.0)] {
            targets.value(1, share, &mut out);
            assert!((out[0] - expected).abs() < 1e-5, "{share}: {out:?}");
        }
    }

    #[test]
    fn the_range_of_sizes_leaves_out_rare_rays() {
        let mut pyramid =
            Pyramid { knots: vec![0.2], shares: vec![[0.2, 0.5]; 1000], heights: vec![2.0; 1000] };
        (pyramid.heights[0], pyramid.heights[1], pyramid.heights[2]) = (1e-3, 1e3, 0.0);
        let rays: Vec<u32> = (0..1000).collect();
        assert_eq!(pyramid.sizes(&rays), [0.4, 1.0]);
        let [low, high] = pyramid.sizes(&[]);
        assert!(low > 0.0 && high > low);
    }
}
