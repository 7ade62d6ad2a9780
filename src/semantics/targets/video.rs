//! Video-language targets ψ_GT, and the part features that regularise them.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::table::TargetTable;
use super::{centre, gathered};
use crate::scene::Frame;
use crate::scene::features::{
    Blend, CellGrid, FeatureError, FeatureStore, Hotspot, Interpolation, PatchGrid, cell,
};

/// Which terms of the video loss there are: L_V = |ψ̂ − ψ(V_p)|² + M_IH |ψ̂ − ψ(V)|².
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VideoTargetConfig {
    /// The patch V_p at the pixel.
    pub patches: bool,
    /// The whole clip V inside the interaction hotspot M_IH.
    pub hotspots: bool,
    /// Between patches; the paper does not say, LERF is bilinear.
    pub interpolation: Interpolation,
}

impl Default for VideoTargetConfig {
    fn default() -> Self {
        Self { patches: true, hotspots: true, interpolation: Interpolation::Bilinear }
    }
}

/// What a pixel's video-language feature should look like; either part may be missing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VideoTarget {
    /// The patch at the pixel.
    pub patch: Option<Blend>,
    /// The whole clip, where the pixel is in the hotspot.
    pub clip: Option<u32>,
}

/// Video-language targets of a list of frames.
#[derive(Clone, Debug)]
pub struct VideoTargets {
    /// All descriptors that pixels may have.
    pub table: TargetTable,
    /// What is odd but was worked with.
    pub warnings: Vec<String>,
    config: VideoTargetConfig,
    frames: Vec<FrameVideo>,
    image_px: Vec<[f64; 2]>,
}

#[derive(Clone, Debug, Default)]
struct FrameVideo {
    patches: Option<(u32, PatchGrid)>,
    /// Row of the clip, and where it counts.
    clip: Option<(u32, Hotspot)>,
}

impl VideoTargets {
    /// Reads the video features of all frames; `None` if there are none that the chosen terms can use.
    ///
    /// The clip of a frame without a hotspot picture, or with an empty one, is not used: nothing says where.
    ///
    /// # Errors
    /// [`FeatureError`] of the first frame, in order, whose files cannot be used.
    pub fn load(
        store: &FeatureStore,
        frames: &[Frame],
        config: VideoTargetConfig,
    ) -> Result<Option<Self>, FeatureError> {
        let Some(dim) = store.video_dim() else { return Ok(None) };
        let read = |frame: &Frame| {
            let frame = store.frame(frame);
            let patches = if config.patches { frame.video_patches()? } else { None };
            let hotspot = if config.hotspots { frame.hotspot()? } else { None };
            let hotspot = hotspot.filter(|h| h.inside.contains(&true));
            let clip = if hotspot.is_some() { frame.video_clip()? } else { None };
            Ok((patches, clip.zip(hotspot)))
        };
        let read: Vec<Result<_, FeatureError>> = frames.par_iter().map(read).collect();
        let (mut table, mut warnings, mut all) = (TargetTable::new(dim), Vec::new(), Vec::new());
        for found in read {
            let (patches, clip) = found?;
            warnings.extend(patches.iter().filter_map(|p| p.descriptors.warning()));
            warnings.extend(clip.iter().filter_map(|(c, _)| c.warning()));
            let patches = patches.map(|mut grid| {
                let first = table.append(&grid.descriptors);
                grid.descriptors.values = Vec::new();
                (first, grid)
            });
            let clip = clip.filter(|(clip, _)| clip.is_usable(0));
            let clip = clip.map(|(clip, hotspot)| (table.append(&clip), hotspot));
            all.push(FrameVideo { patches, clip });
        }
        let image_px = frames.iter().map(|f| store.frame(f).image_px()).collect();
        let targets = Self { table, warnings: gathered(warnings), config, frames: all, image_px };
        Ok((!targets.table.is_empty()).then_some(targets))
    }

    /// Frames with targets, as numbers of the list.
    pub fn frames(&self) -> impl Iterator<Item = usize> + '_ {
        let has = |n: &usize| self.frames[*n].patches.is_some() || self.frames[*n].clip.is_some();
        (0..self.frames.len()).filter(has)
    }

    /// The patches of a frame: left, top, right and bottom, px, and row of the table.
    pub fn patches(&self, frame: usize) -> Vec<([f64; 4], u32)> {
        let Some((first, grid)) = &self.frames[frame].patches else { return Vec::new() };
        let area = |n: usize| {
            let area = grid.area(n / grid.cols, n % grid.cols, self.image_px[frame])?;
            Some((area, first + n as u32))
        };
        (0..grid.rows * grid.cols).filter_map(area).collect()
    }

    /// What the pixel in column `x`, row `y` of frame `frame` should look like.
    pub fn at(&self, frame: usize, x: u32, y: u32) -> VideoTarget {
        let (position, image_px) = (centre(x, y), self.image_px[frame]);
        let of = &self.frames[frame];
        let patch = of.patches.as_ref().and_then(|(first, grid)| {
            Some(grid.at(position, image_px, self.config.interpolation)?.shifted(*first))
        });
        let clip = of.clip.as_ref().filter(|(_, hotspot)| {
            let col = cell(position[0], image_px[0], hotspot.width);
            let row = cell(position[1], image_px[1], hotspot.height);
            hotspot.inside[row * hotspot.width + col]
        });
        VideoTarget { patch, clip: clip.map(|c| c.0) }
    }
}

/// Part (DINO) targets of a list of frames.
#[derive(Clone, Debug)]
pub struct PartTargets {
    /// All descriptors that pixels may have.
    pub table: TargetTable,
    /// What is odd but was worked with.
    pub warnings: Vec<String>,
    frames: Vec<Option<(u32, CellGrid)>>,
    image_px: Vec<[f64; 2]>,
}

impl PartTargets {
    /// Reads the part features of all frames; `None` if there are none.
    ///
    /// # Errors
    /// [`FeatureError`] of the first frame, in order, whose files cannot be used.
    pub fn load(store: &FeatureStore, frames: &[Frame]) -> Result<Option<Self>, FeatureError> {
        let Some(dim) = store.dino_dim() else { return Ok(None) };
        let read: Vec<Result<_, FeatureError>> = frames.par_iter().map(|f| store.frame(f).dino()).collect();
        let (mut table, mut warnings, mut all) = (TargetTable::new(dim), Vec::new(), Vec::new());
        for found in read {
            let cells = found?.map(|mut cells| {
                warnings.extend(cells.descriptors.warning());
                let first = table.append(&cells.descriptors);
                cells.descriptors.values = Vec::new();
                (first, cells)
            });
            all.push(cells);
        }
        let image_px = frames.iter().map(|f| store.frame(f).image_px()).collect();
        let targets = Self { table, warnings: gathered(warnings), frames: all, image_px };
        Ok((!targets.table.is_empty()).then_some(targets))
    }

    /// Frames with targets, as numbers of the list.
    pub fn frames(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.frames.len()).filter(|n| self.frames[*n].is_some())
    }

    /// Row of the table for the cell that the pixel in column `x`, row `y` of frame `frame` is in.
    pub fn at(&self, frame: usize, x: u32, y: u32) -> Option<u32> {
        let (first, cells) = self.frames[frame].as_ref()?;
        Some(first + cells.at(centre(x, y), self.image_px[frame])?)
    }
}
