//! The training pixels, in memory.

use glam::DAffine3;
use rayon::prelude::*;

use super::moving::masks::FrameMasks;
use super::moving::{self, Evidence, Volume};
use super::novelty::Novelty;
use crate::field::Field;
use crate::render::rays::{PixelDirections, View, pixel_directions};
use crate::render::refined::refined_camera;
use crate::rng::Rng;
use crate::scene::{Camera, Frame, SceneError};
use crate::simd::prefetch;
use crate::stereo::{self, SeenFrame, StereoConfig, StereoDepth, StereoFrame};

/// Frames with their pixels and the directions of their cameras' pixels.
pub struct PixelSet {
    /// The frames.
    pub frames: Vec<Frame>,
    /// sRGB, row-major, per frame.
    pub images: Vec<Vec<[u8; 3]>>,
    /// Depth of the frames where their neighbours tell it; empty before it was looked for.
    pub stereo: Vec<StereoDepth>,
    /// Where things are that move; nothing before that was looked for.
    pub moving: Volume,
    /// Which pixels are usable where a frame has a mask.
    usable: Vec<Option<Vec<bool>>>,
    /// Where rays go.
    novelty: Novelty,
    /// Half-way to the frames before and after each frame.
    spans: Vec<[f64; 2]>,
    cameras: Vec<(Camera, PixelDirections)>,
    camera_of: Vec<usize>,
}

impl PixelSet {
    /// Loads all pixels and masks of `frames`; `novelty` of the rays go where few frames look, in a scene of some `size`
    /// (world units).
    ///
    /// # Errors
    /// A file that cannot be read or does not fit its frame.
    pub fn load(frames: Vec<Frame>, size: f64, novelty: f64) -> Result<Self, SceneError> {
        let loaded: Vec<_> = frames
            .par_iter()
            .map(|f| Ok((f.load_rgb()?.pixels, f.load_mask()?)))
            .collect::<Result<_, SceneError>>()?;
        let (images, usable) = loaded.into_iter().unzip();
        let mut cameras: Vec<(Camera, PixelDirections)> = Vec::new();
        let camera_of = frames
            .iter()
            .map(|f| {
                cameras.iter().position(|(c, _)| *c == f.camera).unwrap_or_else(|| {
                    cameras.push((f.camera, pixel_directions(&f.camera)));
                    cameras.len() - 1
                })
            })
            .collect();
        let (spans, novelty) = (spans(&frames), Novelty::new(&frames, size, novelty));
        let (stereo, moving) = (Vec::new(), Volume::default());
        Ok(Self { frames, images, stereo, moving, usable, novelty, spans, cameras, camera_of })
    }

    /// Directions of all pixels of frame `n` in camera axes.
    pub fn directions(&self, n: usize) -> &[glam::Vec3] {
        &self.cameras[self.camera_of[n]].1
    }

    /// Asks for what [`Self::directions`] and images say about a pixel of frame `n` before it is needed.
    pub fn fetch(&self, n: usize, pixel: usize) {
        prefetch(&self.images[n][pixel], 0);
        prefetch(&self.directions(n)[pixel], 0);
    }

    /// Asks for what [`Self::stereo_distance`] says about a pixel of frame `n`, after [`Self::fetch`].
    pub fn fetch_depth(&self, n: usize, pixel: usize) {
        if let Some(stereo) = self.stereo.get(n) {
            stereo.fetch(self.directions(n)[pixel]);
        }
    }

    /// A time near that of frame `n`: from half-way to the frame before it (`u` = 0) to half-way to the one after it
    /// (`u` = 1), with the differences times `spread`.
    pub fn time_near(&self, n: usize, spread: f32, u: f32) -> f32 {
        let [from, to] = self.spans[n];
        let time = self.frames[n].time;
        (time + f64::from(spread) * (from + f64::from(u) * (to - from) - time)) as f32
    }

    /// A search for the depth of the frames by stereo, from where the field says that they are, in units.
    pub fn stereo_search(&self, field: &Field, config: &StereoConfig) -> stereo::Search {
        let cameras = self.refined_cameras(field);
        stereo::Search::new(&self.stereo_frames(&cameras), field.normalisation.extent.length(), config)
    }

    /// Takes the depth that `search` finds, which was made with this field; `exact` if the frames are where it says.
    pub fn take_depth(&mut self, field: &Field, search: &stereo::Search, exact: bool) {
        self.stereo = search.depths(exact);
        for (depth, frame) in self.stereo.iter_mut().zip(&self.frames) {
            // Asked by the directions that the scene's own intrinsics give.
            depth.refine(View::new(field, frame).lens);
        }
        let coverage = self.stereo.iter().map(StereoDepth::coverage).sum::<f64>();
        tracing::info!(coverage = coverage / self.frames.len().max(1) as f64, "depth by stereo");
    }

    fn stereo_frames<'a>(&'a self, cameras: &'a [(Camera, DAffine3)]) -> Vec<StereoFrame<'a>> {
        let frames = cameras.iter().zip(&self.images);
        frames.map(|((camera, c2w), rgb)| StereoFrame { camera, c2w: *c2w, rgb }).collect()
    }

    /// Looks for things that move where frames of known depth see through what others show, from where the field says that
    /// they are; with `masks` whole things, else what is clear by itself.
    pub fn look_for_movement(&mut self, field: &Field, masks: Option<&FrameMasks>) {
        let cameras = self.refined_cameras(field);
        let seen: Vec<SeenFrame> = (cameras.iter().zip(&self.stereo).zip(&self.frames))
            .map(|(((_, c2w), depth), frame)| SeenFrame { c2w: *c2w, depth, time: frame.time })
            .collect();
        let of = masks.map_or_else(|| (0..seen.len()).collect(), FrameMasks::frames);
        let through = stereo::seen_through(&seen, &of);
        let evidence: Vec<Evidence> = (of.iter().zip(through))
            .map(|(n, seen_through)| Evidence {
                frame: &self.frames[*n],
                c2w: cameras[*n].1,
                directions: self.directions(*n),
                depth: &self.stereo[*n],
                seen_through,
            })
            .collect();
        let extent = field.normalisation.extent;
        self.moving = match masks {
            Some(masks) => moving::masks::volume(extent, masks, &evidence),
            None => Volume::of_depths(extent, &evidence),
        };
    }

    /// The cameras of all frames, and where they are (camera to world, units from the box's corner).
    pub(super) fn refined_cameras(&self, field: &Field) -> Vec<(Camera, DAffine3)> {
        let n = field.normalisation;
        let refined = |frame: &Frame| {
            let (camera, c2w) = refined_camera(field, frame);
            let translation = (c2w.translation - n.origin) / n.scale;
            (camera, DAffine3 { translation, ..c2w })
        };
        self.frames.iter().map(refined).collect()
    }

    /// Distance along the ray of a pixel of frame `n` at which it ends according to stereo, in the unit of the
    /// depths there; 0 where that is not known.
    pub fn stereo_distance(&self, n: usize, pixel: usize) -> f32 {
        let Some(stereo) = self.stereo.get(n) else { return 0.0 };
        let dir = self.directions(n)[pixel];
        stereo.at(dir).map_or(0.0, |z| z / dir.z)
    }

    /// Mean colour of all images, sRGB 0–1.
    pub fn mean_colour(&self) -> [f32; 3] {
        let mut sum = [0u64; 3];
        for rgb in self.images.iter().flatten() {
            for c in 0..3 {
                sum[c] += u64::from(rgb[c]);
            }
        }
        let count = self.images.iter().map(Vec::len).sum::<usize>().max(1);
        sum.map(|s| (s as f64 / count as f64 / 255.0) as f32)
    }

    /// Whether the mask of frame `n` leaves pixel number `pixel`.
    pub fn is_usable(&self, n: usize, pixel: u32) -> bool {
        self.usable[n].as_ref().is_none_or(|mask| mask[pixel as usize])
    }

    /// Whether any frame has a usable pixel.
    pub fn has_usable(&self) -> bool {
        self.usable.iter().any(|mask| mask.as_ref().is_none_or(|mask| mask.contains(&true)))
    }

    /// Number of a frame and a usable pixel of it. There must be one.
    pub fn draw(&self, rng: &mut Rng) -> (usize, usize) {
        loop {
            let (frame, pixel) = self.novelty.draw(&self.frames, rng);
            if self.is_usable(frame, pixel as u32) {
                return (frame, pixel);
            }
        }
    }
}

/// For each frame the middles between its time and the next other times before and after it; its own where there is none.
fn spans(frames: &[Frame]) -> Vec<[f64; 2]> {
    let mut times: Vec<f64> = frames.iter().map(|f| f.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let span = |frame: &Frame| {
        let after = times.partition_point(|t| *t <= frame.time);
        let before = times.partition_point(|t| *t < frame.time);
        let middle = |other: Option<&f64>| other.map_or(frame.time, |t| 0.5 * (t + frame.time));
        [middle(before.checked_sub(1).and_then(|n| times.get(n))), middle(times.get(after))]
    };
    frames.iter().map(span).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::testing::frame;

    #[test]
    fn frames_span_the_time_to_half_way_between_them() {
        let frames: Vec<Frame> = [0.5, 0.0, 0.1, 0.1, 0.9].map(frame).into();
        let expected = [[0.3, 0.7], [0.0, 0.05], [0.05, 0.3], [0.05, 0.3], [0.7, 0.9]];
        for (span, expected) in spans(&frames).iter().zip(expected) {
            assert!((0..2).all(|k| (span[k] - expected[k]).abs() < 1e-12), "{span:?}");
        }
    }
}
