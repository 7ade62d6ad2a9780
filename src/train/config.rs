//! Settings of the training loop.

use serde::{Deserialize, Serialize};

use crate::field::mlp::Precision;

/// Which streams are trained.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StreamChoice {
    /// Dynamic and actor streams where the persistent one alone leaves moving things unexplained.
    #[default]
    Auto,
    /// All three.
    All,
    /// The persistent stream alone.
    Static,
}

/// Settings of the training loop. Rates are the ones before cosine annealing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Steps of the whole schedule.
    pub steps: u64,
    /// Rays per step; rounded up to whole chunks.
    pub rays: usize,
    /// Rays come in squares of this many pixels a side (1, 2 or 4).
    pub patch: u32,
    /// Intervals per ray while training.
    pub samples: usize,
    /// Intervals per ray while rendering.
    pub render_samples: usize,
    /// Which streams are trained.
    pub streams: StreamChoice,
    /// Fraction of the schedule that trains the persistent stream alone.
    pub static_until: f64,
    /// Share of the rays that go where few frames look; the others are drawn evenly from all pixels.
    pub novelty: f64,
    /// How far from its own time a frame teaches what moves, as a share of the way to the middle between its neighbours
    /// and it: what is between two frames is then as in the nearer one, and not what nobody has looked at.
    pub time_spread: f32,
    /// Learning rate of the hash tables.
    pub table_rate: f32,
    /// Learning rate of networks and codes.
    pub network_rate: f32,
    /// The same with `field.encoding = "frequency"`, whose networks are deeper; the paper's.
    pub frequency_rate: f32,
    /// Learning rate of per-frame exposure.
    pub exposure_rate: f32,
    /// Learning rate of per-frame poses (rad and units); 0 trusts the poses.
    pub pose_rate: f32,
    /// Learning rate of what all frames share: camera offset, rotation and focal length; 0 trusts them.
    pub rig_rate: f32,
    /// Fraction of the schedule after which poses and rig are refined.
    pub refine_from: f64,
    /// Fraction of the schedule after which depth is looked for by stereo; 1: never.
    pub stereo_at: f64,
    /// Fractions of the schedule after which all frames are registered to the field; none trusts the poses.
    pub align_at: Vec<f64>,
    /// Steps before which the field is too foggy for that.
    pub align_after: u64,
    /// Cells of the density grids along the longest side of the box.
    pub grid_cells: f32,
    /// How fast the density grids follow, per sample.
    pub grid_rate: f32,
    /// The density grids' densities times this place the samples; below 1 looks behind what may be fog.
    pub sharpness: f32,
    /// The same for training once it is known that nothing moves, so that nothing is to be found behind what stands. Twice as
    /// sharp is better for pictures of a short training, and worse for the surface of a long one.
    pub still_sharpness: f32,
    /// Fraction of the schedule after which a stream is not evaluated where its grid is empty.
    pub skip_from: f64,
    /// Steps before which everything is fog, which no grid takes for something.
    pub skip_after: u64,
    /// Share of its pixel's light below which nothing is learned from what a stream is at a sample, nor its colour looked at,
    /// from then on, unless `loss.transient` weighs more than that; 0: everything counts.
    pub faint: f32,
    /// Share of a ray's samples spread evenly at the start, and at the end of the schedule.
    pub explore: [f32; 2],
    /// What the networks are multiplied in while training.
    pub precision: Precision,
    /// Seconds between checkpoints.
    pub checkpoint_seconds: f64,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 5000,
            rays: 4096,
            patch: 4,
            samples: 20,
            render_samples: 32,
            streams: StreamChoice::Auto,
            static_until: 0.15,
            novelty: 0.3,
            time_spread: 1.0,
            table_rate: 3e-2,
            network_rate: 2e-3,
            frequency_rate: 5e-4,
            exposure_rate: 1e-3,
            pose_rate: 1e-4,
            rig_rate: 1e-4,
            refine_from: 0.1,
            stereo_at: 0.2,
            align_at: vec![0.1, 0.14, 0.18, 0.3, 0.4, 0.5, 0.6],
            align_after: 250,
            grid_cells: 128.0,
            grid_rate: 0.05,
            sharpness: 0.3,
            still_sharpness: 0.3,
            skip_from: 0.1,
            skip_after: 100,
            faint: 1e-4,
            explore: [0.5, 0.1],
            precision: Precision::Auto,
            checkpoint_seconds: 60.0,
        }
    }
}
