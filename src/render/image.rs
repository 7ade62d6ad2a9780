//! Whole frames: colour, depth and the streams' opacities.

use glam::Vec2;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::forward::{Chunk, Model, RayInput, Tracer};
use super::rays::{View, pixel_direction};
use super::sampler::Sampling;
use crate::scene::Frame;

/// Rays traced together.
const CHUNK_RAYS: usize = 32;

/// A rendered frame; all layers are `[height * width]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedFrame {
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// Display-referred sRGB colour, 0–1, exposed like the frame.
    pub rgb: Vec<[f32; 3]>,
    /// Median depth along the camera's z axis, world units.
    pub depth: Vec<f32>,
    /// Opacity of each stream.
    pub opacity: Vec<[f32; 3]>,
}

/// Renders the frame of a camera; every `stride`-th pixel in both directions.
pub fn render(model: &Model, frame: &Frame, sampling: &Sampling, stride: u32) -> RenderedFrame {
    let field = model.field;
    let view = View::new(field, frame);
    let camera = &frame.camera;
    let (width, height) = (camera.width.div_ceil(stride), camera.height.div_ceil(stride));
    let mut exposure = [0.0; 6];
    field.exposure.evaluate(&field.weights[field.layout.exposure.clone()], view.knots, &mut exposure);
    let inputs: Vec<RayInput> = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x * stride, y * stride)))
        .map(|(x, y)| RayInput {
            view: 0,
            dir_cam: pixel_direction(camera, x, y),
            uv: Vec2::new((x as f32 + 0.5) / camera.width as f32, (y as f32 + 0.5) / camera.height as f32),
            jitter: 0.5,
        })
        .collect();
    let views = [view];
    let arch = pulp::Arch::new();
    let rows: Vec<Vec<Pixel>> = inputs
        .par_chunks(CHUNK_RAYS * 16)
        .map(|inputs| arch.dispatch(RenderPass { model, views: &views, inputs, sampling, exposure }))
        .collect();
    let pixels = rows.concat();
    RenderedFrame {
        width,
        height,
        rgb: pixels.iter().map(|p| p.rgb).collect(),
        depth: pixels.iter().map(|p| (f64::from(p.depth) * field.normalisation.scale) as f32).collect(),
        opacity: pixels.iter().map(|p| p.opacity).collect(),
    }
}

#[derive(Clone, Copy)]
struct Pixel {
    rgb: [f32; 3],
    depth: f32,
    opacity: [f32; 3],
}

struct RenderPass<'a> {
    model: &'a Model<'a>,
    views: &'a [View],
    inputs: &'a [RayInput],
    sampling: &'a Sampling,
    exposure: [f32; 6],
}

impl WithSimd for RenderPass<'_> {
    type Output = Vec<Pixel>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<Pixel> {
        let Self { model, views, inputs, sampling, exposure } = self;
        let (mut chunk, mut tracer) = (Chunk::default(), Tracer::default());
        let mut out = Vec::with_capacity(inputs.len());
        for inputs in inputs.chunks(CHUNK_RAYS) {
            chunk.forward(simd, &mut tracer, model, views, inputs, sampling);
            for r in 0..inputs.len() {
                out.push(pixel(&chunk, r, model, exposure));
            }
        }
        out
    }
}

fn pixel(chunk: &Chunk, r: usize, model: &Model, exposure: [f32; 6]) -> Pixel {
    let mut opacity = [0.0; 3];
    for w in chunk.intervals.layout.of_ray(r).map(|n| chunk.weights.at(n)) {
        for s in 0..3 {
            opacity[s] += w[s];
        }
    }
    let rgb = std::array::from_fn(|c| {
        let raw = chunk.rgb[c][r] + chunk.weights.left[r] * model.field.background[c];
        (exposure[c].exp() * raw + exposure[3 + c]).clamp(0.0, 1.0)
    });
    let depth = median_depth(chunk, r) * chunk.rays[r].ray.refined_cam.z;
    Pixel { rgb, depth, opacity }
}

/// Distance at which half of the ray's own opacity has been met, linear inside the interval.
fn median_depth(chunk: &Chunk, r: usize) -> f32 {
    let half = 0.5 * (1.0 - chunk.weights.left[r]);
    let mut sum = 0.0;
    for n in chunk.intervals.layout.of_ray(r) {
        let w = chunk.weights.total(n);
        if sum + w >= half && w > 0.0 {
            let i = chunk.intervals.at(n);
            return i.t + i.delta * ((half - sum) / w - 0.5);
        }
        sum += w;
    }
    0.0
}
