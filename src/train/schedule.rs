//! What each step does, from how far the schedule has come.

use super::config::TrainConfig;
use super::step::StepPlan;
use crate::field::EncodingKind;
use crate::render::sampler::Sampling;

/// Steps over which the learning rates rise to their full size.
const WARM_UP: f32 = 50.0;

/// Smallest learning rate at the end of the cosine, as a share of the largest.
const FINAL_RATE: f32 = 0.02;

/// Share of the schedule over which exploration falls to its final value.
const EXPLORE_UNTIL: f32 = 0.125;

impl TrainConfig {
    /// The plan of step number `step` (from 1) at `progress` in [0, 1] of the schedule, for a field of that encoding.
    pub fn plan(&self, encoding: EncodingKind, step: u64, progress: f64, streams: [bool; 3]) -> StepPlan {
        let p = progress as f32;
        let cosine = 0.5 * (1.0 + (std::f32::consts::PI * p).cos());
        let rate = (FINAL_RATE + (1.0 - FINAL_RATE) * cosine) * (step as f32 / WARM_UP).min(1.0);
        let refine = if progress >= self.refine_from { rate } else { 0.0 };
        let network_rate = match encoding {
            EncodingKind::Hash | EncodingKind::Dense => self.network_rate,
            EncodingKind::Frequency => self.frequency_rate,
        };
        let settled = (p / EXPLORE_UNTIL).min(1.0);
        StepPlan {
            step,
            rays: self.rays,
            patch: self.patch,
            grid_rate: self.grid_rate,
            sampling: Sampling {
                count: self.samples,
                step: 1.0 / self.grid_cells,
                explore: self.explore[0] + (self.explore[1] - self.explore[0]) * settled,
                sharpness: self.sharpness,
            },
            // Before that the streams are fog, all of which has to be looked at.
            faint: if self.skips(step, progress) { self.faint } else { 0.0 },
            time_spread: self.time_spread,
            table_rate: self.table_rate * rate,
            network_rate: network_rate * rate,
            exposure_rate: self.exposure_rate * rate,
            pose_rate: self.pose_rate * refine,
            rig_rate: self.rig_rate * refine,
            streams,
            precision: self.precision,
        }
    }

    /// Whether step number `step` (from 1) leaves out what is empty or faint.
    pub fn skips(&self, step: u64, progress: f64) -> bool {
        progress >= self.skip_from && step > self.skip_after
    }

    /// Where samples go when training looks at whole frames, for which as many do as it learns from.
    pub fn look_sampling(&self) -> Sampling {
        Sampling { count: self.samples, ..self.render_sampling() }
    }

    /// Where samples go when a trained field is rendered.
    pub fn render_sampling(&self) -> Sampling {
        Sampling {
            count: self.render_samples,
            step: 1.0 / self.grid_cells,
            explore: 0.5 * self.explore[1],
            sharpness: self.sharpness,
        }
    }
}
