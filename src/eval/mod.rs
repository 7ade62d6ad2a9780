//! How good a result is: every measure of `metrics.json` that needs a scene's ground truth.
//!
//! [`evaluate()`] goes through the test frames and the meshes of a map; the parts stand by themselves:
//! [`ImageSums`] (PSNR, depth, stream IoU), [`ssim()`], [`surface::compare`] (accuracy, completeness,
//! F-score). What has no truth to compare with is absent from [`Metrics`], with the reason in
//! [`Metrics::absent`].

pub mod detections;
mod error;
mod evaluate;
mod images;
mod moved;
mod scores;
mod ssim;
pub mod surface;
mod truth;

use std::collections::BTreeMap;

pub use detections::{DetectionError, Detections};
pub use error::EvalError;
pub use evaluate::{evaluate, evaluate_geometry, evaluate_images};
pub use images::{ImageSums, RenderedView};
pub use moved::MovedObjects;
pub(crate) use scores::NOTHING;
pub use scores::{PhraseTruth, ScoreSums, THRESHOLD, Task};
use serde::{Deserialize, Serialize};
pub use ssim::ssim;

/// Measures of one run, with the names that `metrics.json` uses everywhere. `None` is left out of the file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Test frames of the scene.
    pub test_frames: usize,
    /// Test frames for which there was no rendering.
    pub missing_frames: usize,
    /// dB over all test pixels, sRGB 0–1, all streams: −10 log10 of the pooled mean squared error.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// `psnr` over the pixels whose true stream is persistent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psnr_persistent: Option<f64>,
    /// Mean over the test frames of [`ssim()`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// Median of |z − z_true| over all test pixels with a true depth, world units.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_median_abs_m: Option<f64>,
    /// Mean IoU of the persistent pixels, over the frames where the truth covers 50 px or more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stream_iou_persistent: Option<f64>,
    /// Mean IoU of the dynamic pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stream_iou_dynamic: Option<f64>,
    /// Mean IoU of the actor's pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stream_iou_actor: Option<f64>,
    /// Mean of the stream IoUs that there are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stream_miou: Option<f64>,
    /// Mean IoU of the dynamic objects that move, found by their phrases (image-language, score above 0.5), over the
    /// test frames where the truth covers 50 px or more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub object_miou: Option<f64>,
    /// Likewise of the affordances' regions (video-language).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub affordance_miou: Option<f64>,
    /// Share of the views of objects that move (one object in one test frame) in which its phrase finds it where it is
    /// at that time and at none of the places where it is at other times, as far as the frame shows them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moved_objects_found: Option<f64>,
    /// How many such views there are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moved_objects_scored: Option<usize>,
    /// Mean cosine between rendered image-language descriptors and the scene's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub feature_cosine_clip: Option<f64>,
    /// Mean cosine between rendered video-language descriptors and the scene's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub feature_cosine_egovideo: Option<f64>,
    /// The persistent surface against `gt/mesh/persistent.ply`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub persistent: Option<surface::SurfaceMetrics>,
    /// The dynamic surfaces against `gt/mesh/dynamic_<frame>.ply`, averaged over `times`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dynamic: Option<surface::SurfaceMetrics>,
    /// The actor's surfaces against `gt/mesh/actor_<frame>.ply`, averaged over `times`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actor: Option<surface::SurfaceMetrics>,
    /// Why a measure is missing or covers less than it could: measure or file name to reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub absent: BTreeMap<String, String>,
}
