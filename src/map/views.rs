//! What the training frames see: depth of the persistent surface, and the picture at the same resolution.

use super::build::{Builder, Context, Stage};
use super::error::MapError;
use crate::extract::tsdf::DepthFrame;
use crate::extract::visibility::ViewFrame;
use crate::field::Stream;
use crate::render::depth::{DepthMap, stream_depth};
use crate::scene::{Camera, Frame, Split};

/// More than this share of a pixel's light taken away in front of the persistent surface hides it.
const HIDDEN: f32 = 0.5;

/// A frame as the extraction needs it, at reduced resolution.
pub(super) struct SeenFrame {
    pub(super) map: DepthMap,
    /// The persistent depth where nothing moves in front of it, else 0.
    free_depth: Vec<f32>,
    /// sRGB, `[height * width * 3]`.
    rgb: Vec<u8>,
}

impl SeenFrame {
    /// For the persistent surface's visibility and colours.
    pub(super) fn persistent_view(&self) -> ViewFrame<'_> {
        ViewFrame {
            camera: self.map.camera,
            c2w: self.map.c2w,
            depth: &self.free_depth,
            rgb: Some(&self.rgb),
        }
    }

    /// For the visibility of what moves in front of the persistent surface.
    pub(super) fn moving_view(&self) -> ViewFrame<'_> {
        ViewFrame { camera: self.map.camera, c2w: self.map.c2w, depth: &self.map.depth, rgb: None }
    }
}

/// For the fusion: depth with its confidence.
pub(super) fn depth_frame(map: &DepthMap) -> DepthFrame<'_> {
    let DepthMap { camera, c2w, depth, confidence, .. } = map;
    DepthFrame { camera: *camera, c2w: *c2w, depth, confidence: Some(confidence), rgb: None }
}

/// Looks from all training frames, at a resolution that keeps to the number of rays allowed.
pub(super) fn look_from_all(b: &mut Builder) -> Result<Vec<SeenFrame>, MapError> {
    let frames: Vec<&Frame> = b.cx.scene.frames.iter().filter(|f| f.split == Split::Train).collect();
    let stride = stride(&frames, b.cx.config.depth_rays);
    let mut seen = Vec::with_capacity(frames.len());
    for (n, frame) in frames.iter().enumerate() {
        b.report(Stage::Depth, n, frames.len());
        seen.push(look(&b.cx, frame, stride)?);
    }
    b.report(Stage::Depth, frames.len(), frames.len());
    Ok(seen)
}

/// Looks from one frame.
pub(super) fn look(cx: &Context, frame: &Frame, stride: u32) -> Result<SeenFrame, MapError> {
    let spread = cx.config.truncation_voxels * cx.voxel;
    let mut map =
        stream_depth(&cx.model, Stream::Persistent, frame, frame.time as f32, &cx.sampling, stride, spread);
    let rgb = shrink(&frame.load_rgb()?.pixels, &frame.camera, stride);
    let mut obstruction: Vec<f32> = map.shares.iter().map(|s| (s[1] + s[2]).min(1.0)).collect();
    for (c, o) in map.confidence.iter_mut().zip(&obstruction) {
        // What was hidden in this frame was not trained on in it; other frames know better.
        *c *= 1.0 - o;
    }
    if let Some(mask) = frame.load_mask()? {
        let usable = shrink_mask(&mask, &frame.camera, stride);
        for (n, _) in usable.iter().enumerate().filter(|(_, usable)| !**usable) {
            map.confidence[n] = 0.0;
            obstruction[n] = 1.0;
        }
    }
    let free = |(d, o): (&f32, &f32)| if *o < HIDDEN { *d } else { 0.0 };
    let free_depth = map.depth.iter().zip(&obstruction).map(free).collect();
    Ok(SeenFrame { map, free_depth, rgb })
}

/// The smallest reduction with which all frames together have at most `rays` pixels.
pub(super) fn stride(frames: &[&Frame], rays: usize) -> u32 {
    (1..64).find(|&s| pixels(frames, s) <= rays as u64).unwrap_or(64)
}

/// Pixels of all frames, reduced by `stride`.
pub(super) fn pixels(frames: &[&Frame], stride: u32) -> u64 {
    let of = |f: &&Frame| {
        u64::from((f.camera.width / stride).max(1)) * u64::from((f.camera.height / stride).max(1))
    };
    frames.iter().map(of).sum()
}

/// Means over squares of `stride` pixels, in sRGB like every other mean over what the video shows.
fn shrink(pixels: &[[u8; 3]], camera: &Camera, stride: u32) -> Vec<u8> {
    let squares = Squares::new(camera, stride);
    let mean = |n: usize, c: usize| {
        let (mut sum, mut count) = (0u32, 0u32);
        for p in squares.pixels(n) {
            sum += u32::from(pixels[p][c]);
            count += 1;
        }
        ((sum + count / 2) / count.max(1)) as u8
    };
    (0..squares.count()).flat_map(|n| [mean(n, 0), mean(n, 1), mean(n, 2)]).collect()
}

/// A square is usable if all of its pixels are.
fn shrink_mask(mask: &[bool], camera: &Camera, stride: u32) -> Vec<bool> {
    let squares = Squares::new(camera, stride);
    (0..squares.count()).map(|n| squares.pixels(n).all(|p| mask[p])).collect()
}

/// The squares of pixels of a reduced image.
struct Squares {
    stride: usize,
    size: [usize; 2],
    small: [usize; 2],
}

impl Squares {
    fn new(camera: &Camera, stride: u32) -> Self {
        let small = crate::render::refined::reduced(camera, stride);
        Self {
            stride: stride as usize,
            size: [camera.width as usize, camera.height as usize],
            small: [small.width as usize, small.height as usize],
        }
    }

    fn count(&self) -> usize {
        self.small[0] * self.small[1]
    }

    fn pixels(&self, n: usize) -> impl Iterator<Item = usize> + '_ {
        let [x, y] = [n % self.small[0] * self.stride, n / self.small[0] * self.stride];
        let rows = y..(y + self.stride).min(self.size[1]);
        rows.flat_map(move |y| (x..(x + self.stride).min(self.size[0])).map(move |x| y * self.size[0] + x))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_shrink_by_means_and_masks_by_all() {
        let camera = Camera { width: 5, height: 4, fx: 4.0, fy: 4.0, cx: 2.5, cy: 2.0, distortion: [0.0; 4] };
        let pixels: Vec<[u8; 3]> = (0..20).map(|n| [n as u8 * 10, 7, 255]).collect();
        let small = shrink(&pixels, &camera, 2);
        assert_eq!(small.len(), 2 * 2 * 3);
        assert_eq!(small[..6], [30, 7, 255, 50, 7, 255], "means of 0 10 50 60 and of 20 30 70 80");
        let mask: Vec<bool> = (0..20).map(|n| n != 6).collect();
        assert_eq!(shrink_mask(&mask, &camera, 2), [false, true, true, true]);
    }
}
