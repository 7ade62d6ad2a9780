//! What phrases found in held-out frames, and features as colours.

use divff_exporters::{ExrImage, Geometry, read_exr};

use super::html::Figure;
use super::{ReportError, channel, embed};
use crate::eval::{PhraseTruth, Task};
use crate::pipeline::RunFolder;
use crate::scene::{Frame, Scene, Split};
use crate::semantics::overlay::{FROM, overlay};
use crate::semantics::slug;

/// Phrases that are shown.
const MOST: usize = 12;

/// Colours of a mask: found, and the truth.
const FOUND: [u8; 3] = [255, 159, 28];
const TRUTH: [u8; 3] = [92, 200, 120];

/// A row of pictures for each phrase that the views hold scores of: the frame where the truth, or else what was found,
/// is largest.
pub fn queries(run: &RunFolder, scene: &Scene) -> Result<Vec<Vec<Figure>>, ReportError> {
    let truth = PhraseTruth::read(scene).map_err(Box::new)?;
    let path = |f: &Frame| run.views().join(format!("{}.exr", f.stem));
    let there = |f: &&Frame| f.split == Split::Test && path(f).is_file();
    let frames: Vec<&Frame> = scene.frames.iter().filter(there).collect();
    let mut phrases: Vec<(Task, String)> = Vec::new();
    for task in Task::ALL {
        phrases.extend(truth.phrases(task).into_iter().map(|p| (task, p)));
    }
    if phrases.is_empty() || frames.is_empty() {
        return Ok(Vec::new());
    }
    let views: Vec<ExrImage> = frames.iter().map(|f| read_exr(&path(f))).collect::<Result<_, _>>()?;
    let mut rows = Vec::new();
    for (task, phrase) in phrases {
        let name = format!("relevancy_{}.Y", slug(&phrase));
        let mut best: Option<(usize, Shown)> = None;
        for (frame, view) in frames.iter().zip(&views) {
            let Some(scores) = channel(view, &name) else { continue };
            let mask = truth.mask(frame, task, &phrase).map_err(Box::new)?;
            let size = match &mask {
                Some(mask) => mask.iter().filter(|m| **m).count(),
                None => scores.iter().filter(|s| **s > FROM).count(),
            };
            if best.as_ref().is_none_or(|b| size > b.0) {
                best = Some((size, Shown { frame, scores, mask }));
            }
        }
        if let Some((_, shown)) = best {
            rows.push(shown.figures(&phrase)?);
        }
        if rows.len() == MOST {
            break;
        }
    }
    Ok(rows)
}

/// One phrase in one frame.
struct Shown<'a> {
    frame: &'a Frame,
    scores: Vec<f32>,
    mask: Option<Vec<bool>>,
}

impl Shown<'_> {
    fn figures(&self, phrase: &str) -> Result<Vec<Figure>, ReportError> {
        let image = self.frame.load_rgb().map_err(Box::new)?;
        let size = (image.width as usize, image.height as usize);
        let figure = |pixels: &[[u8; 3]], caption: String| {
            let address = embed::png_address(pixels, size.0, size.1)
                .map_err(|source| ReportError::Picture { path: self.frame.image_path.clone(), source })?;
            Ok::<_, ReportError>(Figure::new(address, caption))
        };
        let best = self.scores.iter().copied().fold(0.0, f32::max);
        let found: Vec<bool> = self.scores.iter().map(|s| *s > FROM).collect();
        let mut row = vec![
            figure(&image.pixels, format!("“{phrase}” in frame {}", self.frame.stem))?,
            figure(&overlay(&image.pixels, &self.scores), format!("score, {FROM} to {best:.2}"))?,
            figure(&marked(&image.pixels, &found, FOUND), format!("score above {FROM}"))?,
        ];
        if let Some(mask) = &self.mask {
            row.push(figure(&marked(&image.pixels, mask, TRUTH), "truth".into())?);
        }
        Ok(row)
    }
}

/// A picture in grey with what is inside a mask in one colour.
fn marked(pixels: &[[u8; 3]], mask: &[bool], colour: [u8; 3]) -> Vec<[u8; 3]> {
    let one = |(pixel, inside): (&[u8; 3], &bool)| {
        let grey = pixel.iter().map(|c| u16::from(*c)).sum::<u16>() / 3;
        match inside {
            true => colour.map(|c| ((grey + 2 * u16::from(c)) / 3) as u8),
            false => [(grey * 2 / 3) as u8; 3],
        }
    };
    pixels.iter().zip(mask).map(one).collect()
}

/// A geometry with the first three components of its features as colours; `None` without such features.
///
/// Compressed features are ordered by variance, so these are the three that tell most.
pub fn coloured_by(geometry: &Geometry, name: &str) -> Option<Geometry> {
    let features = geometry.features.iter().find(|f| f.name == name && f.dim >= 3)?;
    let rows = || features.values.chunks_exact(features.dim);
    let ranges: Vec<[f32; 2]> = (0..3)
        .map(|k| {
            let mut values: Vec<f32> = rows().map(|f| f[k]).collect();
            values.sort_by(f32::total_cmp);
            let last = values.len().saturating_sub(1);
            let at = |n: usize| values.get(n).copied().unwrap_or(0.0);
            // Outliers must not flatten the rest.
            [at(last / 50), at(last - last / 50)]
        })
        .collect();
    let level = |v: f32, [low, high]: [f32; 2]| {
        (((v - low) / (high - low).max(1e-6)).clamp(0.0, 1.0) * 225.0 + 30.0) as u8
    };
    let colors = rows().map(|f| std::array::from_fn(|k| level(f[k], ranges[k]))).collect();
    Some(Geometry { colors, ..geometry.clone() })
}

/// For messages about a run's map.
pub fn features_of(geometry: &Geometry) -> Vec<(&'static str, String)> {
    let kinds = [("clip_pca", "image-language features"), ("egovideo_pca", "video-language features")];
    let there = |k: &&(&str, &str)| geometry.features.iter().any(|f| f.name == k.0);
    kinds
        .iter()
        .filter(there)
        .map(|(name, what)| (*name, format!("{what}, first three components")))
        .collect()
}

#[cfg(test)]
mod tests {
    use divff_exporters::Features;

    use super::*;

    #[test]
    fn features_become_colours_over_their_range() {
        let values = (0..100).flat_map(|n| [n as f32, -(n as f32), 5.0, 9.0]).collect();
        let features = vec![Features { name: "clip_pca".into(), dim: 4, values }];
        let geometry = Geometry { positions: vec![[0.0; 3]; 100], features, ..Geometry::default() };
        let coloured = coloured_by(&geometry, "clip_pca").unwrap();
        let (first, last) = (coloured.colors[0], coloured.colors[99]);
        assert!(first[0] < 40 && first[1] > 240 && last[0] > 240 && last[1] < 40, "{first:?} {last:?}");
        assert!(coloured_by(&geometry, "egovideo_pca").is_none());
        assert_eq!(features_of(&geometry).len(), 1);
    }

    #[test]
    fn masks_are_marked_in_colour_and_the_rest_is_grey() {
        let out = marked(&[[90, 60, 30]; 2], &[true, false], [255, 0, 0]);
        assert_eq!(out, [[190, 20, 20], [40; 3]]);
    }
}
