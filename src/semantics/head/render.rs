//! Features of whole frames.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::HeadModel;
use super::cache::Sources;
use crate::field::batch::StreamBatch;
use crate::render::forward::{Model, RayInput};
use crate::render::rays::{View, pixel_directions};
use crate::render::sampler::Sampling;
use crate::scene::Frame;

use super::PointPass;

/// Below this opacity a pixel shows nothing, and has no feature.
const NOTHING: f32 = 0.02;

/// Rays that one task evaluates.
const TASK_RAYS: usize = 512;

/// Rendered features of one space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FeatureImage {
    /// `[height * width, dim]`, compressed; zeros where nothing is seen.
    pub values: Vec<f32>,
    /// Numbers per pixel.
    pub dim: usize,
}

/// Where the light of every pixel of a frame comes from.
pub fn trace_frame(model: &Model, frame: &Frame, sampling: &Sampling, keep: usize) -> Sources {
    let pixels = frame.camera.width as usize * frame.camera.height as usize;
    trace_pixels(model, frame, 0..pixels, sampling, keep)
}

/// Where the light of some pixels of a frame comes from.
pub fn trace_pixels(
    model: &Model,
    frame: &Frame,
    pixels: impl Iterator<Item = usize>,
    sampling: &Sampling,
    keep: usize,
) -> Sources {
    let (view, directions) = (View::new(model.field, frame), pixel_directions(&frame.camera));
    let rays: Vec<RayInput> = pixels.map(|n| pixel_ray(frame, &directions, 0, n)).collect();
    Sources::trace(model, &[view], &rays, sampling, keep)
}

/// The ray of pixel number `pixel` of a frame that is view number `view`.
pub(super) fn pixel_ray(frame: &Frame, directions: &[Vec3], view: u32, pixel: usize) -> RayInput {
    let (width, height) = (frame.camera.width, frame.camera.height);
    let (x, y) = (pixel as u32 % width, pixel as u32 / width);
    let uv = Vec2::new((x as f32 + 0.5) / width as f32, (y as f32 + 0.5) / height as f32);
    RayInput { view, dir_cam: directions[pixel], uv, jitter: 0.5 }
}

/// Σ w f over the sources of each ray, at `time`; `size` of a ray, units, matters to fields with scales alone.
pub fn render_features(
    heads: &HeadModel,
    sources: &Sources,
    time: f32,
    size: impl Fn(usize) -> f32 + Sync,
) -> FeatureImage {
    let dim = heads.heads.shape.dim;
    let mut values = vec![0.0; sources.len() * dim];
    values.par_chunks_mut(TASK_RAYS * dim).enumerate().for_each(|(task, out)| {
        let first = task * TASK_RAYS;
        for s in 0..3 {
            let (mut batch, mut shares) = (StreamBatch::default(), Vec::new());
            for ray in 0..out.len() / dim {
                if sources.opacity[first + ray] < NOTHING {
                    continue;
                }
                for source in sources.of(first + ray).iter().filter(|p| usize::from(p.stream) == s) {
                    batch.push(shares.len(), ray, source.position(), time);
                    shares.push((ray, source.share()));
                }
            }
            if shares.is_empty() {
                continue;
            }
            let mut points = vec![0.0; shares.len() * dim];
            let size = |sample: usize| size(first + shares[sample].0);
            let pass = PointPass { model: heads, stream: s, batch, size, out: &mut points };
            pulp::Arch::new().dispatch(pass);
            for ((ray, share), f) in shares.iter().zip(points.chunks_exact(dim)) {
                let out = &mut out[ray * dim..][..dim];
                out.iter_mut().zip(f).for_each(|(o, f)| *o += share * f);
            }
        }
    });
    FeatureImage { values, dim }
}
