//! Depth of posed frames by comparing them with their neighbours: plane sweep, semi-global aggregation and a check
//! of the frames against each other.
//!
//! Colour alone leaves a field free to put fog in front of what it cannot tell apart; two views of the same texture
//! do not. The depth found here is coarse and has holes where nothing moves against the background or nothing is
//! textured, but where it is, it is right: training starts from it ([`crate::train::loss`]).

mod aggregate;
mod consistency;
mod fill;
mod plane;
mod rig;
mod see_through;
mod sweep;
#[cfg(test)]
mod tests;

use std::sync::OnceLock;

use glam::{DAffine3, Vec2, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use self::plane::{Plane, Point};
use self::rig::WorkView;
pub use self::see_through::{SeenFrame, seen_through};
use crate::config::ConfigError;
use crate::scene::Camera;
use crate::simd::prefetch;

/// Settings of the stereo depth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StereoConfig {
    /// Longest side of the images that are compared, px; larger ones are reduced.
    pub size: u32,
    /// Depths that are tried, evenly spaced in inverse depth.
    pub depths: usize,
    /// Closest depth that is tried, as a fraction of the farthest.
    pub nearest: f32,
    /// Frames that each frame is compared with.
    pub neighbours: usize,
    /// Two frames agree on a point if its inverse depths differ by less than this fraction.
    pub tolerance: f32,
    /// Frames that must agree with a frame's depth of a pixel.
    pub agreeing: usize,
}

impl Default for StereoConfig {
    fn default() -> Self {
        Self { size: 160, depths: 96, nearest: 0.06, neighbours: 4, tolerance: 0.02, agreeing: 2 }
    }
}

impl StereoConfig {
    /// Checks every number's range.
    ///
    /// # Errors
    /// [`ConfigError::Range`] names the first setting that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let range = |key, value: String, ok: bool, remedy| match ok {
            true => Ok(()),
            false => Err(ConfigError::Range { key, value, remedy }),
        };
        range("stereo.size", self.size.to_string(), (16..=1024).contains(&self.size), "must be 16 to 1024")?;
        let depths = (8..=512).contains(&self.depths);
        range("stereo.depths", self.depths.to_string(), depths, "must be 8 to 512")?;
        let nearest = self.nearest > 0.0 && self.nearest < 1.0;
        range("stereo.nearest", self.nearest.to_string(), nearest, "must lie between 0 and 1")?;
        let neighbours = (1..=sweep::MOST_NEIGHBOURS).contains(&self.neighbours);
        range("stereo.neighbours", self.neighbours.to_string(), neighbours, "must be 1 to 16")?;
        let tolerance = self.tolerance > 0.0 && self.tolerance.is_finite();
        range("stereo.tolerance", self.tolerance.to_string(), tolerance, "must be positive")
    }
}

/// What is compared: one frame's pixels and where they were taken from.
#[derive(Clone, Copy)]
pub struct StereoFrame<'a> {
    /// Intrinsics of the image.
    pub camera: &'a Camera,
    /// Camera to a common frame; its length unit is the one of all depths here.
    pub c2w: DAffine3,
    /// sRGB, row-major.
    pub rgb: &'a [[u8; 3]],
}

/// Depth of one frame on a reduced, undistorted image.
#[derive(Clone, Debug, PartialEq)]
pub struct StereoDepth {
    width: usize,
    height: usize,
    focal: Vec2,
    principal: Vec2,
    /// Refinement of the lens that the directions asked for do not have yet.
    lens: [f32; 2],
    /// Depth along the camera's axis; 0 where it is not known. `[height * width]`.
    pub depth: Vec<f32>,
}

impl StereoDepth {
    /// The same depth at every pixel of a pinhole.
    #[cfg(test)]
    pub(crate) fn flat(camera: &Camera, depth: f32) -> Self {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let focal = Vec2::new(camera.fx as f32, camera.fy as f32);
        let principal = Vec2::new(camera.cx as f32, camera.cy as f32);
        Self { width, height, focal, principal, lens: [0.0; 2], depth: vec![depth; width * height] }
    }

    /// Depth along the camera's axis in the direction `dir` (camera axes); `None` where it is not known.
    pub fn at(&self, dir: Vec3) -> Option<f32> {
        let depth = self.depth[self.seen(dir)?];
        (depth > 0.0).then_some(depth)
    }

    /// Asks for what [`Self::at`] says before it is needed.
    pub fn fetch(&self, dir: Vec3) {
        if let Some(pixel) = self.seen(dir) {
            prefetch(&self.depth[pixel], 0);
        }
    }

    /// Number of the pixel in the direction `dir` (camera axes) as a frame's own lens has it; `None` outside.
    pub fn seen(&self, dir: Vec3) -> Option<usize> {
        if dir.z <= 0.0 {
            return None;
        }
        let slope = dir.truncate() / dir.z;
        let [focal, radial] = self.lens;
        self.pixel((slope * (1.0 + focal + radial * slope.length_squared())).extend(1.0))
    }

    /// Number of the pixel in the direction `dir` (camera axes, z = 1, refined lens); `None` outside.
    fn pixel(&self, dir: Vec3) -> Option<usize> {
        let p = dir.truncate() * self.focal + self.principal;
        let inside =
            p.cmpge(Vec2::ZERO).all() && p.cmplt(Vec2::new(self.width as f32, self.height as f32)).all();
        inside.then_some(p.y as usize * self.width + p.x as usize)
    }

    /// Direction (camera axes, z = 1) of the middle of pixel number `k`.
    fn ray(&self, k: usize) -> Vec3 {
        let p = Vec2::new((k % self.width) as f32 + 0.5, (k / self.width) as f32 + 0.5);
        ((p - self.principal) / self.focal).extend(1.0)
    }

    /// From now on directions are given as they are before a field's refinement of the lens
    /// ([`crate::render::rays::View::lens`]).
    pub fn refine(&mut self, lens: [f32; 2]) {
        self.lens = lens;
    }

    /// Share of pixels with a depth.
    pub fn coverage(&self) -> f64 {
        let known = self.depth.iter().filter(|d| **d > 0.0).count();
        known as f64 / self.depth.len().max(1) as f64
    }
}

/// The search for depth in a set of frames, wherever they are taken to be: what was compared once is kept, whether it is
/// asked for to judge the poses or for good.
///
/// Deterministic, whatever the number of threads.
pub struct Search {
    views: Vec<WorkView>,
    planes: sweep::Planes,
    config: StereoConfig,
    /// Inverse depth of each frame by its own neighbours, when that was first needed.
    raw: Vec<OnceLock<Vec<f32>>>,
}

impl Search {
    /// A search for depths up to `farthest`.
    pub fn new(frames: &[StereoFrame], farthest: f32, config: &StereoConfig) -> Self {
        Self {
            views: frames.par_iter().map(|f| WorkView::new(f, config.size)).collect(),
            planes: sweep::Planes::new(config.nearest * farthest, farthest, config.depths),
            config: config.clone(),
            raw: (0..frames.len()).map(|_| OnceLock::new()).collect(),
        }
    }

    /// Depth of every frame; all zero for a frame that shares no view with another.
    ///
    /// With `continues` it is continued over even surfaces, which wants exact poses: one plane through what is wrong by
    /// some per cent is wrong everywhere.
    pub fn depths(&self, continues: bool) -> Vec<StereoDepth> {
        let all: Vec<usize> = (0..self.views.len()).collect();
        let known = self.matched(&all);
        if !continues {
            return all.into_iter().zip(known).map(|(n, known)| self.depth(n, known)).collect();
        }
        let views = &self.views;
        let continued: Vec<Vec<f32>> =
            all.par_iter().map(|n| fill::continued(&views[*n], *n, &known[*n])).collect();
        all.par_iter().map(|n| self.depth(*n, fill::checked(views, &known, &continued, *n))).collect()
    }

    /// Share of the pixels of the frames `of` whose depth is found by matching alone.
    pub fn coverage(&self, of: &[usize]) -> f64 {
        let depths = self.matched(of);
        let known = depths.iter().flatten().filter(|d| **d > 0.0).count();
        known as f64 / depths.iter().map(Vec::len).sum::<usize>().max(1) as f64
    }

    /// Depth of the frames `of` where enough of their neighbours agree; 0 elsewhere.
    fn matched(&self, of: &[usize]) -> Vec<Vec<f32>> {
        let Self { views, planes, config, raw } = self;
        let neighbours = |n: &usize| rig::neighbours(views, *n, planes, config);
        let asked: Vec<Vec<usize>> = of.par_iter().map(neighbours).collect();
        let mut needed: Vec<usize> = of.iter().chain(asked.iter().flatten()).copied().collect();
        needed.sort_unstable();
        needed.dedup();
        needed.into_par_iter().for_each(|n| {
            raw[n].get_or_init(|| sweep::inverse_depth(views, n, &neighbours(&n), planes));
        });
        let raw: Vec<&[f32]> = raw.iter().map(|raw| raw.get().map_or(&[][..], Vec::as_slice)).collect();
        let agreed = |(n, neighbours): (&usize, &Vec<usize>)| {
            let mut depth = consistency::keep_agreeing(views, &raw, *n, neighbours, config);
            consistency::drop_edges(raw[*n], views[*n].width, &mut depth);
            depth
        };
        of.par_iter().zip(&asked).map(agreed).collect()
    }

    fn depth(&self, n: usize, depth: Vec<f32>) -> StereoDepth {
        let WorkView { width, height, focal, principal, .. } = self.views[n];
        StereoDepth { width, height, focal, principal, lens: [0.0; 2], depth }
    }
}
