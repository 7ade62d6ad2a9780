//! Depth maps to a surface: truncated signed distance fusion (Curless and Levoy 1996) on sparse blocks.
//!
//! First every frame marks the blocks that its depth passes within the truncation distance. Then every block
//! looks at all frames, in order: blocks share nothing, so there are no races and the sums are the same for
//! any number of threads. The fused value is positive inside, so the surface is [`super::march()`] at 0;
//! corners that were seen too little stay unknown and the surface stays open there.

use std::sync::atomic::{AtomicU32, Ordering};

use glam::{DVec2, DVec3, Vec3A};
use rayon::prelude::*;

use super::blocks::{BlockSet, CELLS, CORNERS, POINTS, point_index};
use super::view::{View, smooth_depth};
use super::{ExtractError, GridSpec, SparseGrid, TriMesh, march};
use crate::scene::{Camera, Pose};

/// Pixels along the side of the tiles whose largest depth is kept for culling.
const TILE: usize = 16;

/// One posed depth map.
#[derive(Clone, Copy, Debug)]
pub struct DepthFrame<'a> {
    /// Intrinsics; the depth map has their width and height.
    pub camera: Camera,
    /// Camera-to-world, world units.
    pub c2w: Pose,
    /// Depth along the camera's z axis, `[height * width]`, world units; 0 where there is none.
    pub depth: &'a [f32],
    /// How much each pixel counts, `[height * width]`, ≥ 0; 1 everywhere if absent.
    pub confidence: Option<&'a [f32]>,
    /// sRGB, `[height * width * 3]`; fused where all frames have it.
    pub rgb: Option<&'a [u8]>,
}

/// How the fusion weighs what it sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TsdfOptions {
    /// Distance from the surface at which the signed distance is cut off, world units; 3 to 5 voxels.
    pub truncation: f64,
    /// Smallest weight of a corner that counts as seen. One view at the mean depth with confidence 1 weighs
    /// 1; a view from twice as far a quarter.
    pub min_weight: f32,
    /// Depth beyond which pixels are ignored, world units.
    pub max_depth: f32,
}

impl TsdfOptions {
    /// Truncation of four voxels, two good views, no depth limit.
    pub fn for_voxel(voxel: f64) -> Self {
        Self { truncation: 4.0 * voxel, min_weight: 2.0, max_depth: f32::INFINITY }
    }
}

/// The fused depth: signed distance (positive inside, in truncation distances), weight and colour on sparse
/// blocks.
#[derive(Clone, Debug)]
pub struct TsdfVolume {
    grid: SparseGrid,
    weights: Vec<f32>,
    colors: Vec<[f32; 3]>,
}

impl TsdfVolume {
    /// Fuses the frames into the grid.
    ///
    /// # Errors
    /// `Length` where a map does not fit its camera, `NonFinite` ("depth map", "depth confidence": index over
    /// all pixels of all frames in order; "camera": index of the frame; "fused depth": index of the corner over
    /// all blocks that are near the depth), `Invalid` and `TooLarge` as the grid.
    pub fn fuse(spec: &GridSpec, frames: &[DepthFrame], options: &TsdfOptions) -> Result<Self, ExtractError> {
        Self::fuse_in(spec, frames, options, || mark_blocks(spec, frames, options))
    }

    /// As [`Self::fuse`], in these blocks alone.
    pub(super) fn fuse_in(
        spec: &GridSpec,
        frames: &[DepthFrame],
        options: &TsdfOptions,
        blocks: impl FnOnce() -> BlockSet,
    ) -> Result<Self, ExtractError> {
        spec.validate()?;
        let positive = options.truncation.is_finite() && options.truncation > 0.0;
        ExtractError::require(positive, "truncation", options.truncation, "a positive length")?;
        let weight_ok = options.min_weight.is_finite() && options.min_weight >= 0.0;
        ExtractError::require(weight_ok, "min_weight", options.min_weight, "a number from 0")?;
        ExtractError::require(options.max_depth > 0.0, "max_depth", options.max_depth, "positive")?;
        check_frames(frames)?;
        let maps = Map::all(spec, frames, options)?;
        let mut grid = SparseGrid::unknown(spec, blocks())?;
        let colored = !frames.is_empty() && frames.iter().all(|f| f.rgb.is_some());
        let count = grid.values.len();
        let color_bytes = if colored { 12 } else { 0 };
        spec.check_bytes("the fused volume", count as u128 * (8 + color_bytes))?;
        let mut weights = vec![0.0; count];
        let mut colors = vec![[0.0; 3]; if colored { count } else { 0 }];

        let blocks = &grid.blocks;
        let parts = grid.values.par_chunks_mut(POINTS).zip(weights.par_chunks_mut(POINTS));
        let sums = |b: usize| integrate(spec, blocks, b, &maps, options);
        let diverged: Vec<Option<usize>> = if colored {
            let parts = parts.zip(colors.par_chunks_mut(POINTS)).enumerate();
            parts.map(|(b, ((v, w), colors))| sums(b).store(options, v, w, Some(colors))).collect()
        } else {
            parts.enumerate().map(|(b, (v, w))| sums(b).store(options, v, w, None)).collect()
        };
        if let Some((b, i)) = diverged.into_iter().enumerate().find_map(|(b, i)| Some((b, i?))) {
            return Err(ExtractError::NonFinite { stage: "fused depth", index: b * POINTS + i });
        }
        grid.blocks.share_borders(&mut grid.values);
        grid.blocks.share_borders(&mut weights);
        if colored {
            grid.blocks.share_borders(&mut colors);
        }
        Ok(Self { grid, weights, colors })
    }

    /// The signed distance on its grid: positive inside, ±1 at the truncation distance, unknown where not
    /// seen.
    pub fn grid(&self) -> &SparseGrid {
        &self.grid
    }

    /// The surface, in the grid's relative coordinates.
    ///
    /// # Errors
    /// As [`march()`].
    pub fn mesh(&self) -> Result<TriMesh, ExtractError> {
        march(&self.grid, 0.0)
    }

    /// The fused colours at points on the surface; `None` if not all frames had one. Grey where nothing was
    /// seen.
    pub fn colors_at(&self, positions: &[[f32; 3]]) -> Option<Vec<[u8; 3]>> {
        if self.colors.is_empty() {
            return None;
        }
        Some(positions.par_iter().map(|p| self.color_at(*p).unwrap_or([128; 3])).collect())
    }

    fn color_at(&self, p: [f32; 3]) -> Option<[u8; 3]> {
        // A vertex on a face between blocks may round to either side of it, and only one side may exist.
        let q = p.map(|c| f64::from(c) / self.grid.spec.voxel);
        (0..8).find_map(|i| {
            let nudge = [i & 1, i >> 1 & 1, i >> 2].map(|b| if b == 0 { 1e-3 } else { -1e-3 });
            let cell: [i64; 3] = std::array::from_fn(|a| (q[a] + nudge[a]).floor() as i64);
            let block = self.grid.blocks.find(cell.map(|c| c.div_euclid(CELLS as i64)))?;
            let local = cell.map(|c| c.rem_euclid(CELLS as i64) as usize);
            let t = std::array::from_fn(|a| (q[a] - cell[a] as f64).clamp(0.0, 1.0) as f32);
            self.trilinear_color(block, local, t)
        })
    }

    fn trilinear_color(&self, block: usize, cell: [usize; 3], t: [f32; 3]) -> Option<[u8; 3]> {
        let (mut sum, mut total) = (Vec3A::ZERO, 0.0);
        for i in 0..8 {
            let high = [i & 1, i >> 1 & 1, i >> 2];
            let at = block * POINTS + point_index(std::array::from_fn(|a| cell[a] + high[a]));
            let color = self.colors[at];
            if self.weights[at] > 0.0 && color[0] >= 0.0 {
                let w: f32 = (0..3).map(|a| if high[a] == 1 { t[a] } else { 1.0 - t[a] }).product();
                sum += w * Vec3A::from_array(color);
                total += w;
            }
        }
        (total > 1e-6).then(|| (sum / total).to_array().map(|c| (c + 0.5) as u8))
    }
}

fn check_frames(frames: &[DepthFrame]) -> Result<(), ExtractError> {
    let mut before = 0;
    for (i, f) in frames.iter().enumerate() {
        let pixels = f.camera.width as usize * f.camera.height as usize;
        ExtractError::same_length(|| format!("the depth map of frame {i}"), pixels, f.depth.len())?;
        if let Some(bad) = f.depth.iter().position(|d| !d.is_finite()) {
            return Err(ExtractError::NonFinite { stage: "depth map", index: before + bad });
        }
        if let Some(c) = f.confidence {
            ExtractError::same_length(|| format!("the confidence of frame {i}"), pixels, c.len())?;
            if let Some(bad) = c.iter().position(|c| !c.is_finite()) {
                return Err(ExtractError::NonFinite { stage: "depth confidence", index: before + bad });
            }
        }
        if let Some(rgb) = f.rgb {
            ExtractError::same_length(|| format!("the image of frame {i}"), pixels * 3, rgb.len())?;
        }
        before += pixels;
    }
    Ok(())
}

/// A frame prepared for integration.
struct Map<'a> {
    frame: &'a DepthFrame<'a>,
    view: View,
    /// Largest depth of any pixel, per tile.
    tiles: Vec<f32>,
    tiles_x: usize,
    /// Mean depth over all frames: the depth at which a view weighs 1.
    reference: f32,
}

impl<'a> Map<'a> {
    fn all(spec: &GridSpec, frames: &'a [DepthFrame], o: &TsdfOptions) -> Result<Vec<Self>, ExtractError> {
        let usable = |d: f32| d > 0.0 && d <= o.max_depth;
        let sums: Vec<(f64, u64)> = frames
            .par_iter()
            .map(|f| {
                let usable = f.depth.iter().filter(|&&d| usable(d));
                usable.fold((0.0, 0), |(sum, n), &d| (sum + f64::from(d), n + 1))
            })
            .collect();
        let (sum, n) = sums.iter().fold((0.0, 0), |(s, n), x| (s + x.0, n + x.1));
        let reference = (sum / n.max(1) as f64) as f32;
        let map = |(i, frame): (usize, &'a DepthFrame)| {
            let view = View::new(&frame.camera, &frame.c2w, spec.origin, i)?;
            let (tiles_x, tiles_y) = (view.width.div_ceil(TILE), view.height.div_ceil(TILE));
            let mut tiles = vec![0f32; tiles_x * tiles_y];
            for (p, &d) in frame.depth.iter().enumerate().filter(|(_, d)| usable(**d)) {
                let tile = &mut tiles[p / view.width / TILE * tiles_x + p % view.width / TILE];
                *tile = tile.max(d);
            }
            Ok(Self { frame, view, tiles, tiles_x, reference })
        };
        frames.par_iter().enumerate().map(map).collect()
    }

    /// Whether a ball (camera coordinates) can be seen or lie within `truncation` behind what is seen.
    fn touches(&self, center: Vec3A, radius: f32, truncation: f32) -> bool {
        if !self.view.may_see(center, radius) {
            return false;
        }
        let near = center.z - radius - truncation;
        let Some(uv) = self.view.project(center) else { return true };
        if near <= 0.0 {
            return true;
        }
        // The ball's image lies within this many pixels of its centre's (a generous bound off the axis).
        let focal = self.frame.camera.fx.abs().max(self.frame.camera.fy.abs()) as f32;
        let slope = (center.x.abs().max(center.y.abs()) + radius) / (center.z - radius);
        let reach = focal * radius / (center.z - radius) * (1.0 + slope) * 1.2 + 1.0;
        let tile = |c: f32, n: usize| (c.max(0.0) as usize).min(n - 1) / TILE;
        let columns = tile(uv[0] - reach, self.view.width)..=tile(uv[0] + reach, self.view.width);
        let mut rows = tile(uv[1] - reach, self.view.height)..=tile(uv[1] + reach, self.view.height);
        rows.any(|y| columns.clone().any(|x| self.tiles[y * self.tiles_x + x] >= near))
    }
}

/// The blocks within the truncation distance of any pixel's depth, along its ray.
fn mark_blocks(spec: &GridSpec, frames: &[DepthFrame], o: &TsdfOptions) -> BlockSet {
    let dims = spec.block_dims();
    let marks: Vec<AtomicU32> =
        (0..BlockSet::slot_count(dims).div_ceil(32)).map(|_| AtomicU32::new(0)).collect();
    let side = CELLS as f64 * spec.voxel;
    frames.par_iter().for_each(|f| {
        let origin = f.c2w.translation - DVec3::from_array(spec.origin);
        for (uv, d) in strided_pixels(f, spec.voxel, o.max_depth) {
            let ray = f.c2w.matrix3 * f.camera.unproject(uv);
            let steps = (4.0 * o.truncation * ray.length() / side).ceil().max(1.0) as usize;
            for s in 0..=steps {
                let z = d + o.truncation * (2.0 * s as f64 / steps as f64 - 1.0);
                let p = (origin + ray * z.max(0.0)) / side;
                let inside = (0..3).all(|a| p[a] >= 0.0 && p[a] < f64::from(dims[a]));
                if inside {
                    let [x, y, z] = p.to_array().map(|c| c as usize);
                    let slot = (z * dims[1] as usize + y) * dims[0] as usize + x;
                    // A set union: the order in which bits arrive does not matter.
                    let bit = 1 << (slot % 32);
                    if marks[slot / 32].load(Ordering::Relaxed) & bit == 0 {
                        marks[slot / 32].fetch_or(bit, Ordering::Relaxed);
                    }
                }
            }
        }
    });
    let (nx, ny) = (dims[0] as usize, dims[1] as usize);
    let marked = (0..BlockSet::slot_count(dims))
        .filter(|slot| marks[slot / 32].load(Ordering::Relaxed) >> (slot % 32) & 1 == 1)
        .map(|s| [s % nx, s / nx % ny, s / (nx * ny)].map(|c| c as u32));
    BlockSet::new(dims, marked.collect())
}

/// Pixels of a frame with their depth, as dense as blocks need: neighbours are two voxels apart at most.
fn strided_pixels<'a>(
    f: &'a DepthFrame,
    voxel: f64,
    max_depth: f32,
) -> impl Iterator<Item = (DVec2, f64)> + 'a {
    let usable = move |d: f32| d > 0.0 && d <= max_depth;
    let farthest = f.depth.iter().copied().filter(|&d| usable(d)).fold(0f32, f32::max);
    let pixel = f64::from(farthest) / f.camera.fx.abs().min(f.camera.fy.abs());
    let stride = (2.0 * voxel / pixel).clamp(1.0, 16.0) as usize;
    let (width, height) = (f.camera.width as usize, f.camera.height as usize);
    let pixels =
        (0..height).step_by(stride).flat_map(move |y| (0..width).step_by(stride).map(move |x| (x, y)));
    pixels.filter_map(move |(x, y)| {
        let d = f.depth[y * width + x];
        usable(d).then(|| (DVec2::new(x as f64 + 0.5, y as f64 + 0.5), f64::from(d)))
    })
}

/// Running sums of one block.
struct Sums {
    weight: [f32; POINTS],
    distance: [f32; POINTS],
    color_weight: [f32; POINTS],
    color: [[f32; 3]; POINTS],
}

impl Sums {
    /// Writes the means; the first corner whose sums have left the range of f32, if there is one.
    fn store(
        &self,
        o: &TsdfOptions,
        values: &mut [f32],
        weights: &mut [f32],
        colors: Option<&mut [[f32; 3]]>,
    ) -> Option<usize> {
        for i in 0..POINTS {
            let w = self.weight[i];
            if w > 0.0 && w >= o.min_weight {
                values[i] = -self.distance[i] / w;
            }
            weights[i] = w;
        }
        if let Some(colors) = colors {
            for (i, out) in colors.iter_mut().enumerate() {
                let w = self.color_weight[i];
                // Negative marks "no colour": the corner was only seen as free space.
                *out = if w > 0.0 { self.color[i].map(|c| c / w) } else { [-1.0; 3] };
            }
        }
        (0..POINTS).find(|&i| !(self.weight[i].is_finite() && self.distance[i].is_finite()))
    }
}

/// Sums what all frames say about the corners that block `b` owns.
fn integrate(spec: &GridSpec, blocks: &BlockSet, b: usize, maps: &[Map], o: &TsdfOptions) -> Box<Sums> {
    let mut sums = Box::new(Sums {
        weight: [0.0; POINTS],
        distance: [0.0; POINTS],
        color_weight: [0.0; POINTS],
        color: [[0.0; 3]; POINTS],
    });
    let first = blocks.coords()[b].map(|c| c as usize * CELLS);
    let half = (CELLS as f64 / 2.0 * spec.voxel) as f32;
    let center = spec.corner(first) + half;
    for map in maps {
        let at = map.view.to_camera(center);
        if !map.touches(at, half * 3f32.sqrt(), o.truncation as f32) {
            continue;
        }
        let origin = map.view.to_camera(spec.corner(first));
        let step = [Vec3A::X, Vec3A::Y, Vec3A::Z].map(|a| map.view.rotation * (a * spec.voxel as f32));
        for z in 0..CORNERS {
            for y in 0..CORNERS {
                let row = origin + step[2] * z as f32 + step[1] * y as f32;
                let owned = blocks.owned_points(b, y, z);
                let inside = first[1] + y <= spec.dims[1] as usize && first[2] + z <= spec.dims[2] as usize;
                for x in (0..CORNERS).filter(|x| inside && owned >> x & 1 == 1) {
                    if first[0] + x <= spec.dims[0] as usize {
                        add_view(&mut sums, point_index([x, y, z]), map, row + step[0] * x as f32, o);
                    }
                }
            }
        }
    }
    sums
}

/// Adds what one frame says about corner `i`, which lies at `p` in its camera coordinates.
#[inline]
fn add_view(sums: &mut Sums, i: usize, map: &Map, p: Vec3A, o: &TsdfOptions) {
    let (w, h, truncation) = (map.view.width, map.view.height, o.truncation as f32);
    let Some(uv) = map.view.project(p) else { return };
    let pixel = (uv[1] as usize).min(h - 1) * w + (uv[0] as usize).min(w - 1);
    let mut depth = map.frame.depth[pixel];
    if depth <= 0.0 || depth > o.max_depth || depth - p.z < -2.0 * truncation {
        return;
    }
    // Far in front of the surface the exact depth does not matter: the distance is cut off.
    if depth - p.z < 2.0 * truncation {
        depth = smooth_depth(map.frame.depth, uv, w, h, truncation).unwrap_or(depth);
    }
    let distance = depth - p.z;
    if distance < -truncation {
        return;
    }
    let confidence = map.frame.confidence.map_or(1.0, |c| c[pixel].max(0.0));
    // Behind the surface a view knows less and less: full weight down to a quarter of the truncation
    // distance, then a ramp to none (Bylow et al. 2013). Thin parts seen from both sides survive so.
    let behind = ((truncation + distance) / (0.75 * truncation)).min(1.0);
    let weight = confidence * behind * (map.reference / depth).powi(2);
    sums.weight[i] += weight;
    sums.distance[i] += weight * (distance / truncation).min(1.0);
    if let (Some(rgb), true) = (map.frame.rgb, distance < truncation) {
        sums.color_weight[i] += weight;
        for c in 0..3 {
            sums.color[i][c] += weight * f32::from(rgb[pixel * 3 + c]);
        }
    }
}
