//! Masks complete what is seen through to things, and find the same things elsewhere.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::{Evidence, Opinion, THICKNESS, Volume};
use crate::scene::Frame;
use crate::scene::features::{FeatureError, FeatureStore, Masks, normalise};
use crate::simd;
use crate::stereo::Plane;

/// Evidence from which a surface is seen through: more than a mask's edge collects from false matches.
const EVIDENCE: i32 = 6;

/// Share of a thing's surface that must be seen through. Things have places where nothing looks through them: of those of
/// a thing that moves once, usually one.
const SHARE: f64 = 0.15;

/// Masks show the same thing if their descriptors, less the mean over all, are at least this similar (cosine).
const SAME: f32 = 0.6;

/// Masks that all are compared with, at most.
const COMPARED: usize = 2048;

/// Masks with fewer pixels of known depth tell neither what moves nor where they are.
const LEAST_KNOWN: u32 = 8;

/// The masks of the training frames, where there are any.
pub struct FrameMasks(Vec<Option<Masks>>);

impl FrameMasks {
    /// Reads the masks of `frames`.
    ///
    /// # Errors
    /// [`FeatureError`] of the first frame, in order, whose files cannot be used.
    pub fn load(store: &FeatureStore, frames: &[Frame]) -> Result<Self, FeatureError> {
        let read: Vec<Result<_, FeatureError>> = frames.par_iter().map(|f| store.frame(f).masks()).collect();
        Ok(Self(read.into_iter().collect::<Result<_, _>>()?))
    }

    /// Numbers of the frames that have masks.
    pub fn frames(&self) -> Vec<usize> {
        (0..self.0.len()).filter(|n| self.0[*n].is_some()).collect()
    }
}

/// Where the things are that move: `evidence` is that of [`FrameMasks::frames`], in their order.
pub fn volume(extent: Vec3, masks: &FrameMasks, evidence: &[Evidence]) -> Volume {
    let with_masks: Vec<&Masks> = masks.0.iter().flatten().collect();
    let tallies: Vec<Vec<Tally>> =
        with_masks.par_iter().zip(evidence).map(|(masks, evidence)| tally(masks, evidence)).collect();
    let moves = judge(&tallies.iter().flatten().collect::<Vec<_>>());
    let empty = Volume::new(extent);
    let mut rest = &moves[..];
    let opinions = with_masks.iter().zip(evidence).zip(&tallies).map(|((masks, evidence), tallies)| {
        let (of_frame, after) = rest.split_at(tallies.len());
        rest = after;
        opinion(&empty, masks, evidence, of_frame)
    });
    let volume = empty.clone().agreed(opinions);
    let moving = moves.iter().filter(|m| **m).count();
    tracing::info!(masks = moves.len(), moving, cells = volume.len(), "things that move");
    volume
}

/// What is known of one mask.
struct Tally {
    /// Pixels of known depth.
    known: u32,
    /// Those that are seen through.
    through: u32,
    descriptor: Vec<f32>,
}

fn image_px(frame: &Frame) -> [f64; 2] {
    [frame.camera.width, frame.camera.height].map(f64::from)
}

/// The tallies of the masks of a frame.
fn tally(masks: &Masks, evidence: &Evidence) -> Vec<Tally> {
    let of = |n: usize| Tally { known: 0, through: 0, descriptor: masks.masks.row(n).to_vec() };
    let mut tallies: Vec<Tally> = (0..masks.masks.rows()).map(of).collect();
    let (width, size) = (evidence.frame.camera.width as usize, image_px(evidence.frame));
    for pixel in 0..evidence.directions.len() {
        let Some((seen, _)) = evidence.depth_at(pixel) else { continue };
        let at = [(pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5];
        for mask in masks.at(at, size) {
            tallies[mask].known += 1;
            tallies[mask].through += u32::from(evidence.seen_through[seen] >= EVIDENCE);
        }
    }
    tallies
}

/// Where the pixels of the masks that move end, and all others. In a mask, where depth is not known, or is that of something behind the
/// mask's edge, it is that of the plane through what is known of the mask: inverse depth is affine in the pixel.
fn opinion(volume: &Volume, masks: &Masks, evidence: &Evidence, moves: &[bool]) -> Opinion {
    let (width, size) = (evidence.frame.camera.width as usize, image_px(evidence.frame));
    let mut opinion = Opinion::default();
    let mut pixels: Vec<Vec<usize>> = vec![Vec::new(); moves.len()];
    for pixel in 0..evidence.directions.len() {
        let at = [(pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5];
        let mut rests = true;
        for mask in masks.at(at, size).filter(|m| moves[*m]) {
            pixels[mask].push(pixel);
            rests = false;
        }
        if let (true, Some((_, z))) = (rests, evidence.depth_at(pixel)) {
            evidence.surface(volume, pixel, z, 0, &mut opinion.resting);
        }
    }
    for pixels in pixels {
        let slope = |pixel: usize| {
            let d = evidence.directions[pixel].as_dvec3();
            DVec3::new(d.x / d.z, d.y / d.z, 1.0)
        };
        let inverse = |pixel: usize| Some(1.0 / f64::from(evidence.depth_at(pixel)?.1));
        let known: Vec<(DVec3, f64)> =
            pixels.iter().filter_map(|p| Some((slope(*p), inverse(*p)?))).collect();
        let Some(plane) = Plane::through(&known) else { continue };
        for pixel in pixels {
            let expected = plane.at(slope(pixel));
            let found = inverse(pixel).filter(|found| plane.fits(expected, *found)).unwrap_or(expected);
            evidence.surface(volume, pixel, (1.0 / found) as f32, THICKNESS, &mut opinion.moving);
        }
    }
    opinion
}

/// Which masks show things that move: those of which enough is seen through, all masks of the same thing taken together.
fn judge(tallies: &[&Tally]) -> Vec<bool> {
    let dim = tallies.first().map_or(0, |t| t.descriptor.len());
    let centred = centred(tallies, dim);
    let row = |n: usize| &centred[n * dim..(n + 1) * dim];
    let told: Vec<usize> = (0..tallies.len()).filter(|n| tallies[*n].known >= LEAST_KNOWN).collect();
    let told: Vec<usize> = told.iter().copied().step_by(told.len().div_ceil(COMPARED).max(1)).collect();
    (0..tallies.len())
        .into_par_iter()
        .map(|n| {
            let (mut known, mut through) = (0u64, 0u64);
            for other in told.iter().filter(|m| simd::dot(row(n), row(**m)) > SAME) {
                known += u64::from(tallies[*other].known);
                through += u64::from(tallies[*other].through);
            }
            known > 0 && through as f64 > SHARE * known as f64
        })
        .collect()
}

/// Unit descriptors less their mean, to unit length again: what all images have in common says nothing. Zeros stay.
fn centred(tallies: &[&Tally], dim: usize) -> Vec<f32> {
    let mut rows: Vec<f32> = Vec::with_capacity(tallies.len() * dim);
    for tally in tallies {
        rows.extend(&tally.descriptor);
        let start = rows.len() - dim;
        normalise(&mut rows[start..]);
    }
    let mut mean = vec![0.0f64; dim];
    for row in rows.chunks_exact(dim.max(1)) {
        mean.iter_mut().zip(row).for_each(|(m, v)| *m += f64::from(*v) / tallies.len() as f64);
    }
    for row in rows.chunks_exact_mut(dim.max(1)) {
        if row.iter().any(|v| *v != 0.0) {
            row.iter_mut().zip(&mean).for_each(|(v, m)| *v -= *m as f32);
            normalise(row);
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mask of thing number `thing` of four, whose descriptors share most of their length.
    fn mask(thing: usize, known: u32, through: u32) -> Tally {
        let mut descriptor = vec![0.0; 6];
        descriptor[thing] = 1.0;
        descriptor[4] = 2.0;
        // No two alike.
        descriptor[5] = 0.1 * (known % 3) as f32;
        Tally { known, through, descriptor }
    }

    #[test]
    fn a_thing_moves_in_all_its_masks_if_enough_of_it_is_seen_through() {
        let tallies = [
            // In its first place nothing looks through thing 0, in the second much does.
            mask(0, 100, 0),
            mask(0, 101, 60),
            // Thing 1 has wrong edges.
            mask(1, 100, 10),
            mask(1, 201, 20),
            mask(2, 302, 0),
            mask(3, 99, 40),
            // Too small to say anything, but told by the others.
            mask(3, 2, 0),
        ];
        assert_eq!(judge(&tallies.each_ref()), [true, true, false, false, false, true, true]);
        assert_eq!(judge(&[]), [false; 0]);
    }

    #[test]
    fn descriptors_without_direction_say_nothing() {
        let zero = || Tally { known: 50, through: 50, descriptor: vec![0.0; 6] };
        assert_eq!(judge(&[&zero(), &mask(1, 100, 0)]), [false, false]);
    }
}
