//! Depth of one stream alone, through whatever is in front of it, and how sure of it a ray is.

use glam::Vec2;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::composite::{Intervals, Weights};
use super::forward::{Chunk, Model, RayInput, Tracer};
use super::rays::{View, pixel_directions};
use super::refined::{reduced, refined_camera};
use super::sampler::Sampling;
use crate::field::Stream;
use crate::scene::{Camera, Frame, Pose};

/// Rays traced together.
const CHUNK_RAYS: usize = 32;

/// One stream's surface as one frame sees it; layers are `[height * width]` of `camera`.
#[derive(Clone, Debug)]
pub struct DepthMap {
    /// Refined intrinsics at this map's resolution.
    pub camera: Camera,
    /// Refined camera-to-world, world units.
    pub c2w: Pose,
    /// Median depth along `c2w`'s z axis, world units; 0 where the ray meets nothing.
    pub depth: Vec<f32>,
    /// Share of the ray's light that ends within `spread` of that depth, 0–1: small in fog, across discontinuities
    /// and where nothing is.
    pub confidence: Vec<f32>,
    /// Share of the light that each stream takes when all are there, 0–1.
    pub shares: Vec<[f32; 3]>,
}

/// Traces the frame's rays, one per square of `stride` pixels, as things are at `time`, and finds where `stream` alone
/// stops half of what it stops of the light. `spread` is in world units.
pub fn stream_depth(
    model: &Model,
    stream: Stream,
    frame: &Frame,
    time: f32,
    sampling: &Sampling,
    stride: u32,
    spread: f64,
) -> DepthMap {
    let field = model.field;
    let (camera, c2w) = refined_camera(field, frame);
    let camera = reduced(&camera, stride);
    let small = reduced(&frame.camera, stride);
    let size = Vec2::new(frame.camera.width as f32, frame.camera.height as f32);
    let inputs: Vec<RayInput> = pixel_directions(&small)
        .into_iter()
        .enumerate()
        .map(|(n, dir_cam)| {
            let at = Vec2::new((n as u32 % small.width) as f32, (n as u32 / small.width) as f32);
            RayInput { view: 0, dir_cam, uv: (at + 0.5) * stride as f32 / size, jitter: 0.5 }
        })
        .collect();
    let views = [View::new(field, frame).at_time(field, time)];
    let spread = (spread / field.normalisation.scale) as f32;
    let arch = pulp::Arch::new();
    let rows: Vec<Vec<Traced>> = inputs
        .par_chunks(CHUNK_RAYS * 16)
        .map(|inputs| arch.dispatch(DepthPass { model, stream, views: &views, inputs, sampling, spread }))
        .collect();
    let rays = rows.concat();
    let to_world = |t: f32| (f64::from(t) * field.normalisation.scale) as f32;
    DepthMap {
        camera,
        c2w,
        depth: rays.iter().zip(&inputs).map(|(r, i)| to_world(r.median * i.dir_cam.z)).collect(),
        confidence: rays.iter().map(|r| r.confidence).collect(),
        shares: rays.iter().map(|r| r.shares).collect(),
    }
}

#[derive(Clone, Copy)]
struct Traced {
    median: f32,
    confidence: f32,
    shares: [f32; 3],
}

struct DepthPass<'a> {
    model: &'a Model<'a>,
    stream: Stream,
    views: &'a [View],
    inputs: &'a [RayInput],
    sampling: &'a Sampling,
    spread: f32,
}

impl WithSimd for DepthPass<'_> {
    type Output = Vec<Traced>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<Traced> {
        let Self { model, stream, views, inputs, sampling, spread } = self;
        let (mut chunk, mut tracer, mut alone) = (Chunk::default(), Tracer::default(), Weights::default());
        let mut out = Vec::with_capacity(inputs.len());
        for inputs in inputs.chunks(CHUNK_RAYS) {
            chunk.densities(simd, &mut tracer, model, views, inputs, sampling);
            chunk.intervals.keep_stream(stream as usize);
            alone.find(simd, &chunk.intervals);
            for r in 0..inputs.len() {
                out.push(trace(&chunk.intervals, &chunk.weights, &alone, r, stream as usize, spread));
            }
        }
        out
    }
}

/// Ray number `r`, by its weights with all streams there and with stream `s` alone.
#[inline(always)]
fn trace(intervals: &Intervals, mixed: &Weights, alone: &Weights, r: usize, s: usize, spread: f32) -> Traced {
    let samples = || intervals.layout.of_ray(r);
    let mut shares = [0.0; 3];
    for w in samples().map(|n| mixed.at(n)) {
        (0..3).for_each(|k| shares[k] += w[k]);
    }
    let median = median(intervals, alone, r, s);
    let confidence = samples().map(|n| {
        let i = intervals.at(n);
        let (from, to) = (i.t - 0.5 * i.delta, i.t + 0.5 * i.delta);
        let inside = (to.min(median + spread) - from.max(median - spread)).max(0.0);
        if i.delta > 0.0 { alone.weight[s][n] * (inside / i.delta).min(1.0) } else { 0.0 }
    });
    Traced { median, confidence: confidence.sum(), shares }
}

/// Distance at which the weights first add up to half of what the ray loses, linear inside the interval; 0 if there is no weight.
#[inline(always)]
fn median(intervals: &Intervals, weights: &Weights, r: usize, s: usize) -> f32 {
    let half = 0.5 * (1.0 - weights.left[r]);
    let mut sum = 0.0;
    for n in intervals.layout.of_ray(r) {
        let w = weights.weight[s][n];
        if w > 0.0 && sum + w >= half {
            let i = intervals.at(n);
            return i.t + i.delta * ((half - sum) / w - 0.5);
        }
        sum += w;
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::composite::Interval;

    fn wall(sigma: impl Fn(usize) -> [f32; 3]) -> Vec<Interval> {
        (0..10).map(|k| Interval { sigma: sigma(k), delta: 0.1, t: 0.05 + 0.1 * k as f32 }).collect()
    }

    fn run(intervals: Vec<Interval>) -> Traced {
        let mut intervals = Intervals::of_ray(&intervals);
        let [mut mixed, mut alone] = [(); 2].map(|()| Weights::default());
        mixed.find(pulp::Scalar::new(), &intervals);
        intervals.keep_stream(0);
        alone.find(pulp::Scalar::new(), &intervals);
        trace(&intervals, &mixed, &alone, 0, 0, 0.1)
    }

    #[test]
    fn the_wall_behind_a_hand_is_found_and_known_to_be_obstructed() {
        let t =
            run(wall(
                |k| if k == 2 { [0.0, 0.0, 500.0] } else { [if k >= 7 { 500.0 } else { 0.0 }, 0.0, 0.0] },
            ));
        assert!((0.7..0.8).contains(&t.median), "{}", t.median);
        assert!(t.confidence > 0.99 && t.shares[2] > 0.99, "{} {:?}", t.confidence, t.shares);
    }

    #[test]
    fn fog_and_emptiness_are_not_trusted() {
        let fog = run(wall(|_| [2.0, 0.0, 0.0]));
        assert!(fog.confidence < 0.4, "{}", fog.confidence);
        let nothing = run(wall(|_| [0.0; 3]));
        assert_eq!((nothing.median, nothing.confidence, nothing.shares), (0.0, 0.0, [0.0; 3]));
    }
}
