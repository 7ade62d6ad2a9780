//! Image-language targets φ_GT.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::table::TargetTable;
use super::{centre, gathered};
use crate::scene::Frame;
use crate::scene::features::{
    Blend, Descriptors, FeatureError, FeatureStore, FrameFeatures, Interpolation, Masks, PatchGrid, normalise,
};
use crate::simd;

/// What a pixel's image-language feature is learned from: the paper's ablations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum ImageMode {
    /// Patches around the pixel, all scales alike ("CLIP in patches").
    #[serde(rename = "patches")]
    Patches,
    /// Patches whose scale is an input of the field, as in LERF.
    #[serde(rename = "scaled-patches")]
    ScaledPatches,
    /// The mask that the pixel is in ("CLIP in SAM masks").
    #[serde(rename = "masks")]
    Masks,
    /// That mask, mixed with its bounding box (the full model).
    #[default]
    #[serde(rename = "masks+boxes")]
    MasksAndBoxes,
}

/// How image-language targets are made.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImageTargetConfig {
    /// From what.
    pub mode: ImageMode,
    /// Weight of the bounding box in `masks+boxes`, 0 to 1; the mask has the rest.
    pub box_weight: f32,
    /// Whether a box weighs less where it shows other things than its mask; without, as in the paper, all weigh alike.
    pub box_agreement: bool,
    /// Between patches.
    pub interpolation: Interpolation,
}

impl Default for ImageTargetConfig {
    fn default() -> Self {
        Self {
            mode: ImageMode::default(),
            box_weight: 0.25,
            box_agreement: true,
            interpolation: Interpolation::default(),
        }
    }
}

/// Image-language targets of a list of frames.
#[derive(Clone, Debug)]
pub struct ImageTargets {
    /// All descriptors that pixels may have.
    pub table: TargetTable,
    /// What is odd but was worked with.
    pub warnings: Vec<String>,
    config: ImageTargetConfig,
    frames: Vec<Option<Source>>,
    image_px: Vec<[f64; 2]>,
}

/// Where the targets of a frame come from; rows of its tables start at `first` in the common one.
#[derive(Clone, Debug)]
enum Source {
    Masks { first: u32, masks: Masks },
    Patches(Vec<(u32, PatchGrid)>),
}

impl ImageTargets {
    /// Reads what the chosen mode needs for all frames; frames without it are normal and have no targets.
    ///
    /// `None` if no frame has any.
    ///
    /// # Errors
    /// [`FeatureError`] of the first frame, in order, whose files cannot be used.
    pub fn load(
        store: &FeatureStore,
        frames: &[Frame],
        config: ImageTargetConfig,
    ) -> Result<Option<Self>, FeatureError> {
        let Some(dim) = store.language_dim() else { return Ok(None) };
        let read = |frame: &Frame| match config.mode {
            ImageMode::Masks | ImageMode::MasksAndBoxes => read_masks(&store.frame(frame), &config),
            ImageMode::Patches | ImageMode::ScaledPatches => read_patches(&store.frame(frame)),
        };
        let read: Vec<Result<_, FeatureError>> = frames.par_iter().map(read).collect();
        let (mut table, mut warnings, mut sources) = (TargetTable::new(dim), Vec::new(), Vec::new());
        for found in read {
            let (mut source, odd) = found?;
            warnings.extend(odd);
            if let Some(source) = &mut source {
                source.move_into(&mut table);
            }
            sources.push(source);
        }
        let image_px = frames.iter().map(|f| store.frame(f).image_px()).collect();
        let targets = Self { table, warnings: gathered(warnings), config, frames: sources, image_px };
        Ok((!targets.table.is_empty()).then_some(targets))
    }

    /// Frames with targets, as numbers of the list.
    pub fn frames(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.frames.len()).filter(|n| self.frames[*n].is_some())
    }

    /// What the pixel in column `x`, row `y` of frame `frame` should look like; `None` where nothing is known, as
    /// outside all masks.
    ///
    /// Levels of masks, or scales of patches, that the pixel has count alike.
    pub fn at(&self, frame: usize, x: u32, y: u32) -> Option<Blend> {
        match self.frames[frame].as_ref()? {
            Source::Masks { first, masks } => self.mask_at(*first, masks, frame, x, y),
            Source::Patches(grids) => {
                let parts = grids.iter().filter_map(|grid| self.patch_at(grid, frame, x, y));
                // More than four scales do not fit: of those, the patches that matter most.
                let mut parts: Vec<(u32, f32)> = parts.flat_map(|b| b.iter().collect::<Vec<_>>()).collect();
                if parts.len() > Blend::MAX {
                    parts.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
                }
                Blend::new(parts)
            }
        }
    }

    /// Smallest and largest scale of the patches of a frame (height as a share of the image's); `None` if it has none.
    pub fn scales(&self, frame: usize) -> Option<[f32; 2]> {
        let Some(Source::Patches(grids)) = self.frames[frame].as_ref() else { return None };
        Some([grids.first()?.1.layout.scale(), grids.last()?.1.layout.scale()])
    }

    /// Scales of the patches of all frames, ascending; evenly spread ones over the same range where there are more than
    /// `most`, as with pictures of many sizes.
    pub fn all_scales(&self, most: usize) -> Vec<f32> {
        let grids = self.frames.iter().flatten().flat_map(|source| match source {
            Source::Patches(grids) => &grids[..],
            Source::Masks { .. } => &[],
        });
        let mut scales: Vec<f32> = grids.map(|g| g.1.layout.scale()).collect();
        scales.sort_by(f32::total_cmp);
        scales.dedup_by(|a, b| *a - *b < 1e-3);
        if let (true, [low, .., high]) = (scales.len() > most, &scales[..]) {
            let step = (high - low) / (most - 1) as f32;
            scales = (0..most).map(|n| low + n as f32 * step).collect();
        }
        scales
    }

    /// [`Self::at`] for patches of one scale, between the two nearest scales that the frame has (LERF's pyramid).
    ///
    /// Outside their range the nearest one counts. Without patches, the same as [`Self::at`].
    pub fn at_scale(&self, frame: usize, x: u32, y: u32, scale: f32) -> Option<Blend> {
        let Source::Patches(grids) = self.frames[frame].as_ref()? else { return self.at(frame, x, y) };
        let above = grids.iter().position(|g| g.1.layout.scale() >= scale).unwrap_or(grids.len() - 1);
        let below = above.saturating_sub(1);
        let [low, high] = [below, above].map(|n| grids[n].1.layout.scale());
        let t = if high > low { ((scale - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 };
        let part = |n: usize, weight: f32| {
            let blend = self.patch_at(&grids[n], frame, x, y);
            blend.into_iter().flat_map(move |b| b.iter().map(|(r, w)| (r, w * weight)).collect::<Vec<_>>())
        };
        if below == above {
            return Blend::new(part(above, 1.0));
        }
        Blend::new(part(below, 1.0 - t).chain(part(above, t)))
    }

    fn mask_at(&self, first: u32, masks: &Masks, frame: usize, x: u32, y: u32) -> Option<Blend> {
        let usable = masks.at(centre(x, y), self.image_px[frame]).filter(|i| masks.masks.is_usable(*i));
        Blend::new(usable.map(|i| (first + i as u32, 1.0)))
    }

    fn patch_at(&self, (first, grid): &(u32, PatchGrid), frame: usize, x: u32, y: u32) -> Option<Blend> {
        let blend = grid.at(centre(x, y), self.image_px[frame], self.config.interpolation)?;
        Some(blend.shifted(*first))
    }
}

impl Source {
    /// Moves the descriptors into the common table.
    fn move_into(&mut self, table: &mut TargetTable) {
        let mut moved = |first: &mut u32, rows: &mut Descriptors| {
            *first = table.append(rows);
            rows.values = Vec::new();
        };
        match self {
            Self::Masks { first, masks } => {
                moved(first, &mut masks.masks);
                masks.boxes = None;
            }
            Self::Patches(grids) => {
                grids.iter_mut().for_each(|(first, grid)| moved(first, &mut grid.descriptors));
            }
        }
    }
}

type Read = Result<(Option<Source>, Vec<String>), FeatureError>;

fn read_masks(frame: &FrameFeatures, config: &ImageTargetConfig) -> Read {
    let Some(mut masks) = frame.masks()? else { return Ok((None, Vec::new())) };
    let mut warnings: Vec<String> = masks.masks.warning().into_iter().collect();
    if config.mode == ImageMode::MasksAndBoxes {
        match &masks.boxes {
            Some(boxes) => {
                warnings.extend(boxes.warning());
                mix(&mut masks.masks, boxes, config);
            }
            None => warnings.push(format!(
                "{}: no box descriptors (_b.npy) beside it; its masks stand alone",
                masks.masks.path.display()
            )),
        }
    }
    Ok((Some(Source::Masks { first: 0, masks }), warnings))
}

fn read_patches(frame: &FrameFeatures) -> Read {
    let mut grids = Vec::new();
    for scale in frame.patch_scales() {
        grids.extend(frame.patches(scale)?);
    }
    grids.sort_by(|a, b| a.layout.scale().total_cmp(&b.layout.scale()));
    let warnings = grids.iter().filter_map(|g| g.descriptors.warning()).collect();
    let source = (!grids.is_empty()).then(|| Source::Patches(grids.into_iter().map(|g| (0, g)).collect()));
    Ok((source, warnings))
}

/// φ = (1 − w) φ_mask + w φ_box of unit vectors, to unit length again (DIV-FF, 3.2; w = 0.25).
///
/// A mask whose box cannot be used, or cancels it, stands alone. With `box_agreement`, w is that times [`agreement`].
fn mix(masks: &mut Descriptors, boxes: &Descriptors, config: &ImageTargetConfig) {
    let dim = masks.dim;
    masks.values.chunks_exact_mut(dim).for_each(normalise);
    let mut units = boxes.values.clone();
    for (n, unit) in units.chunks_exact_mut(dim).enumerate() {
        if boxes.is_usable(n) { normalise(unit) } else { unit.fill(0.0) }
    }
    let agreement = config.box_agreement.then(|| agreement(&masks.values, &units, dim));
    for (n, (row, other)) in masks.values.chunks_exact_mut(dim).zip(units.chunks_exact(dim)).enumerate() {
        let weight = config.box_weight * agreement.as_ref().map_or(1.0, |a| a[n]);
        let mixed = |m: f32, b: f32| (1.0 - weight) * m + weight * b;
        if boxes.is_usable(n) && row.iter().zip(other).any(|(m, b)| mixed(*m, *b) != 0.0) {
            row.iter_mut().zip(other).for_each(|(m, b)| *m = mixed(*m, *b));
            normalise(row);
        }
    }
    // A mask that was left out stays out, even where its box is good: the box alone is mostly other things.
    for &(n, _) in &masks.left_out {
        masks.values[n * dim..(n + 1) * dim].fill(0.0);
    }
}

/// How much more each mask is like its own box than like the frame's other boxes: 1 where the box shows nothing else, 0
/// where it might be any of them. Of unit vectors, or zeros.
///
/// All descriptors of an encoder resemble one another, so that a cosine by itself says little. The box around something
/// small or thin shows mostly what is behind it.
fn agreement(masks: &[f32], boxes: &[f32], dim: usize) -> Vec<f32> {
    let used = boxes.chunks_exact(dim).filter(|b| b.iter().any(|v| *v != 0.0)).count();
    if used < 2 {
        // Nothing to be told from.
        return vec![1.0; masks.len() / dim];
    }
    let mut all = vec![0.0; dim];
    for row in boxes.chunks_exact(dim) {
        all.iter_mut().zip(row).for_each(|(a, b)| *a += b);
    }
    let pairs = masks.chunks_exact(dim).zip(boxes.chunks_exact(dim));
    pairs
        .map(|(mask, own)| {
            let cosine = simd::dot(mask, own);
            let others = (simd::dot(mask, &all) - cosine) / (used - 1) as f32;
            ((cosine - others) / (1.0 - others).max(f32::EPSILON)).clamp(0.0, 1.0)
        })
        .collect()
}
