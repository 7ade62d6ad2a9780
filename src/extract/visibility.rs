//! Which cameras saw a vertex, and what colour it had there.
//!
//! A view counts where the vertex projects into the image, is not hidden (its depth is at most the rendered
//! depth plus a tolerance) and faces the camera. Colours are robust against the views that saw something else
//! in passing: the mean over the views that agree with the weighted median.

use glam::Vec3A;
use rayon::prelude::*;

use super::ExtractError;
use super::view::{View, bilinear};
use crate::scene::{Camera, Pose};

/// Largest difference from the median, in any channel, of a view that counts for the colour (8-bit levels).
const INLIER_LEVELS: f32 = 40.0;

/// One posed view: the depth rendered (or measured) there, and its picture.
#[derive(Clone, Copy, Debug)]
pub struct ViewFrame<'a> {
    /// Intrinsics; depth and picture have their width and height.
    pub camera: Camera,
    /// Camera-to-world, world units.
    pub c2w: Pose,
    /// Depth along the camera's z axis, `[height * width]`, world units; 0 = unknown, sees nothing.
    pub depth: &'a [f32],
    /// sRGB, `[height * width * 3]`.
    pub rgb: Option<&'a [u8]>,
}

/// When a vertex counts as seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisibilityOptions {
    /// A vertex may lie this far behind the rendered depth, world units; one or two voxels.
    pub tolerance: f32,
    /// ... plus this fraction of its depth.
    pub relative_tolerance: f32,
    /// Smallest cosine between the normal and the direction to the camera.
    pub min_cos: f32,
}

impl VisibilityOptions {
    /// Two voxels plus 1 % of the depth; up to 80° off the normal.
    pub fn for_voxel(voxel: f32) -> Self {
        Self { tolerance: 2.0 * voxel, relative_tolerance: 0.01, min_cos: 0.17 }
    }
}

/// What the views say about each vertex; all columns are `[vertices]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VertexViews {
    /// Views that saw the vertex.
    pub observations: Vec<u32>,
    /// Mean distance to the cameras that saw it, world units; 0 where none did.
    pub mean_distance: Vec<f32>,
    /// n / (n + 2) with n the sum of the viewing cosines: 0 unseen, towards 1 with many frontal views.
    pub confidence: Vec<f32>,
    /// sRGB; `None` where no view with a picture saw it.
    pub colors: Vec<Option<[u8; 3]>>,
}

/// Looks at every vertex from every view. `positions` are relative to `origin` (world), `normals` are unit
/// vectors towards the outside.
///
/// # Errors
/// `Length` where columns or maps do not fit, `NonFinite` ("camera": index of the view; "vertex": its index).
pub fn look(
    positions: &[[f32; 3]],
    normals: &[[f32; 3]],
    origin: [f64; 3],
    views: &[ViewFrame],
    options: &VisibilityOptions,
) -> Result<VertexViews, ExtractError> {
    ExtractError::same_length(|| "the normals".into(), positions.len(), normals.len())?;
    let finite = |(p, n): (&[f32; 3], &[f32; 3])| p.iter().chain(n).all(|v| v.is_finite());
    if let Some(index) = positions.iter().zip(normals).position(|v| !finite(v)) {
        return Err(ExtractError::NonFinite { stage: "vertex", index });
    }
    let prepared: Vec<Prepared> =
        views.iter().enumerate().map(|(i, v)| Prepared::new(v, origin, i)).collect::<Result<_, _>>()?;
    let seen: Vec<Seen> = positions
        .par_iter()
        .zip(normals)
        .map_init(Vec::new, |samples, (&p, &n)| {
            gather(Vec3A::from_array(p), Vec3A::from_array(n), &prepared, options, samples)
        })
        .collect();
    Ok(VertexViews {
        observations: seen.iter().map(|s| s.observations).collect(),
        mean_distance: seen.iter().map(|s| s.mean_distance).collect(),
        confidence: seen.iter().map(|s| s.confidence).collect(),
        colors: seen.iter().map(|s| s.color).collect(),
    })
}

struct Prepared<'a> {
    frame: &'a ViewFrame<'a>,
    view: View,
}

impl<'a> Prepared<'a> {
    fn new(frame: &'a ViewFrame, origin: [f64; 3], i: usize) -> Result<Self, ExtractError> {
        let view = View::new(&frame.camera, &frame.c2w, origin, i)?;
        let pixels = view.width * view.height;
        ExtractError::same_length(|| format!("the depth map of view {i}"), pixels, frame.depth.len())?;
        if let Some(rgb) = frame.rgb {
            ExtractError::same_length(|| format!("the image of view {i}"), pixels * 3, rgb.len())?;
        }
        Ok(Self { frame, view })
    }

    fn color(&self, uv: [f32; 2]) -> Option<[f32; 3]> {
        let rgb = self.frame.rgb?;
        let mut sum = [0.0; 3];
        for (i, w) in bilinear(uv, self.view.width, self.view.height) {
            for c in 0..3 {
                sum[c] += w * f32::from(rgb[3 * i + c]);
            }
        }
        Some(sum)
    }
}

struct Seen {
    observations: u32,
    mean_distance: f32,
    confidence: f32,
    color: Option<[u8; 3]>,
}

/// A colour and its weight.
type Sample = ([f32; 3], f32);

fn gather(
    p: Vec3A,
    normal: Vec3A,
    views: &[Prepared],
    o: &VisibilityOptions,
    samples: &mut Vec<Sample>,
) -> Seen {
    samples.clear();
    let (mut observations, mut distances, mut cosines) = (0u32, 0f64, 0f64);
    for v in views {
        let at = v.view.to_camera(p);
        let Some(uv) = v.view.project(at) else { continue };
        let pixel =
            (uv[1] as usize).min(v.view.height - 1) * v.view.width + (uv[0] as usize).min(v.view.width - 1);
        let depth = v.frame.depth[pixel];
        // Written so that a NaN or absent depth sees nothing.
        let visible = depth > 0.0 && at.z <= depth + o.tolerance + o.relative_tolerance * at.z;
        let to_camera = v.view.center - p;
        let distance = to_camera.length();
        let cos = normal.dot(to_camera) / distance;
        if !visible || cos.is_nan() || cos < o.min_cos {
            continue;
        }
        observations += 1;
        distances += f64::from(distance);
        cosines += f64::from(cos);
        // Views from near see finer detail: their pixels cover less of the surface.
        samples.extend(v.color(uv).map(|color| (color, cos / (distance * distance))));
    }
    Seen {
        observations,
        mean_distance: if observations > 0 { (distances / f64::from(observations)) as f32 } else { 0.0 },
        confidence: (cosines / (cosines + 2.0)) as f32,
        color: robust_mean(samples),
    }
}

/// Weighted mean of the samples near the weighted median; the median itself where none is.
fn robust_mean(samples: &mut [Sample]) -> Option<[u8; 3]> {
    if samples.is_empty() {
        return None;
    }
    let median = [0, 1, 2].map(|c| weighted_median(samples, c));
    let near = |s: &&Sample| (0..3).all(|c| (s.0[c] - median[c]).abs() <= INLIER_LEVELS);
    let (mut sum, mut total) = ([0.0; 3], 0.0);
    for (color, w) in samples.iter().filter(near) {
        (0..3).for_each(|c| sum[c] += w * color[c]);
        total += w;
    }
    let mean = if total > 0.0 { sum.map(|s| s / total) } else { median };
    Some(mean.map(|c| (c + 0.5) as u8))
}

/// The first value (in order) at which half of the weight is reached.
fn weighted_median(samples: &mut [Sample], channel: usize) -> f32 {
    samples.sort_by(|a, b| a.0[channel].total_cmp(&b.0[channel]));
    let half = 0.5 * samples.iter().map(|s| s.1).sum::<f32>();
    let mut sum = 0.0;
    let reached = samples.iter().find(|s| {
        sum += s.1;
        sum >= half
    });
    reached.or(samples.last()).map_or(0.0, |s| s.0[channel])
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec3};

    use super::*;

    const SIZE: usize = 32;

    fn camera() -> Camera {
        let n = SIZE as u32;
        Camera { width: n, height: n, fx: 32.0, fy: 32.0, cx: 16.0, cy: 16.0, distortion: [0.0; 4] }
    }

    fn view<'a>(z: f64, depth: &'a [f32], rgb: &'a [u8]) -> ViewFrame<'a> {
        // Looks along +z from (1000, 0, z): far from the world's origin.
        let c2w = DAffine3::from_translation(DVec3::new(1000.0, 0.0, z));
        ViewFrame { camera: camera(), c2w, depth, rgb: Some(rgb) }
    }

    const OPTIONS: VisibilityOptions =
        VisibilityOptions { tolerance: 0.05, relative_tolerance: 0.0, min_cos: 0.1 };
    const ORIGIN: [f64; 3] = [1000.0, 0.0, 0.0];
    const TO_CAMERA: [f32; 3] = [0.0, 0.0, -1.0];

    #[test]
    fn counts_views_that_are_not_hidden_behind_out_of_frame_or_backfacing() {
        let (wall, near, grey) =
            (vec![2.0f32; SIZE * SIZE], vec![1.0f32; SIZE * SIZE], vec![99u8; SIZE * SIZE * 3]);
        let views = [view(0.0, &wall, &grey), view(0.0, &near, &grey), view(1.0, &near, &grey)];
        let positions =
            [[0.0, 0.0, 2.0], [0.0, 0.0, 2.2], [5.0, 0.0, 2.0], [0.0, 0.0, -1.0], [0.0, 0.0, 2.0]];
        let mut normals = [TO_CAMERA; 5];
        normals[4] = [0.0, 0.0, 1.0];
        let seen = look(&positions, &normals, ORIGIN, &views, &OPTIONS).unwrap();
        assert_eq!(seen.observations, [2, 0, 0, 0, 0]);
        assert!((seen.mean_distance[0] - 1.5).abs() < 1e-5);
        assert!((seen.confidence[0] - 0.5).abs() < 1e-5);
        assert_eq!(seen.colors, [Some([99; 3]), None, None, None, None]);
    }

    #[test]
    fn one_view_of_something_else_does_not_tint_the_colour() {
        let wall = vec![2.0f32; SIZE * SIZE];
        let images: Vec<Vec<u8>> =
            [98u8, 100, 102, 100, 255].iter().map(|&c| vec![c; SIZE * SIZE * 3]).collect();
        let views: Vec<ViewFrame> = images.iter().map(|rgb| view(0.0, &wall, rgb)).collect();
        let seen = look(&[[0.0, 0.0, 2.0]], &[TO_CAMERA], ORIGIN, &views, &OPTIONS).unwrap();
        assert_eq!(seen.colors[0], Some([100; 3]));
    }

    #[test]
    fn colours_are_bilinear_at_pixel_centres() {
        let wall = vec![2.0f32; SIZE * SIZE];
        let ramp: Vec<u8> = (0..SIZE * SIZE * 3).map(|i| (i / 3 % SIZE * 4) as u8).collect();
        // x = (u - 16) / 32 * 2; the ramp is 4 (u - 0.5).
        let at = |u: f32| [(u - 16.0) / 16.0, 0.0, 2.0];
        let seen =
            look(&[at(10.5), at(10.75)], &[TO_CAMERA; 2], ORIGIN, &[view(0.0, &wall, &ramp)], &OPTIONS)
                .unwrap();
        assert_eq!(seen.colors, [Some([40; 3]), Some([41; 3])]);
    }

    #[test]
    fn bad_input_is_named() {
        let (wall, grey) = (vec![2.0f32; SIZE * SIZE], vec![99u8; SIZE * SIZE * 3]);
        let run = |p: [f32; 3], v: ViewFrame| look(&[p], &[TO_CAMERA], ORIGIN, &[v], &OPTIONS);
        let good = view(0.0, &wall, &grey);
        assert!(run([0.0; 3], good).is_ok());
        let error = run([f32::NAN, 0.0, 0.0], good).unwrap_err();
        assert_eq!(error, ExtractError::NonFinite { stage: "vertex", index: 0 });
        assert!(run([0.0; 3], ViewFrame { depth: &wall[1..], ..good }).is_err());
        let c2w = DAffine3::from_translation(DVec3::new(f64::NAN, 0.0, 0.0));
        let error = run([0.0; 3], ViewFrame { c2w, ..good }).unwrap_err();
        assert_eq!(error, ExtractError::NonFinite { stage: "camera", index: 0 });
    }
}
