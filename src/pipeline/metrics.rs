//! `metrics.json`: how good the result is, and what it took.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::eval::Metrics;
use crate::field::hashgrid::Row;
use crate::semantics::agreement::Compression;
use crate::train::checkpoint::TrainingState;
use crate::work::Work;

/// Everything in `metrics.json`; what was not measured is left out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunMetrics {
    /// How good the result is.
    #[serde(flatten)]
    pub quality: Metrics,
    /// What it took.
    #[serde(flatten)]
    pub cost: Cost,
    /// What compressing the descriptors of each space loses.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub compression: BTreeMap<String, Compression>,
    /// What was skipped and the work that it saved.
    #[serde(default)]
    pub skipped: BTreeMap<String, serde_json::Value>,
}

/// What a run took.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Cost {
    /// Seconds of training, over all sessions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_seconds: Option<f64>,
    /// Seconds of training the fields of features.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feature_seconds: Option<f64>,
    /// Seconds from the field to geometry in memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub extract_seconds: Option<f64>,
    /// Seconds of writing the map.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub export_seconds: Option<f64>,
    /// Seconds of rendering and comparing the test frames and the meshes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub eval_seconds: Option<f64>,
    /// Work that the stages saved, by what saved it: `skipped.work` in the file.
    #[serde(skip)]
    pub saved: BTreeMap<String, Work>,
    /// Most memory that the program held at once, MB; unknown where the system does not tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peak_rss_mb: Option<f64>,
    /// Training steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_steps: Option<u64>,
    /// Field evaluations, one stream each, per second of training; those of `skipped.work.faint_samples` of the density
    /// alone, the others forward and backward.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples_per_second: Option<f64>,
    /// Rays per second of training.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rays_per_second: Option<f64>,
}

impl RunMetrics {
    /// What the stages took and saved, for a stage that is done again.
    pub fn known_cost(&self) -> Cost {
        let saved = self.skipped.get("work").cloned().and_then(|work| serde_json::from_value(work).ok());
        Cost { saved: saved.unwrap_or_default(), ..self.cost.clone() }
    }
}

impl Cost {
    /// Notes work that was saved.
    pub fn save(&mut self, what: &str, work: Work) {
        *self.saved.entry(what.to_owned()).or_default() += work;
    }

    /// Fills in what training took.
    pub fn set_training(&mut self, state: &TrainingState) {
        let seconds = state.seconds.max(1e-9);
        self.train_seconds = Some(state.seconds);
        self.train_steps = Some(state.step);
        self.samples_per_second = Some(state.evaluations as f64 / seconds);
        self.rays_per_second = Some(state.rays as f64 / seconds);
    }
}

/// What empty-space skipping, settling the streams and exact poses saved while training.
pub fn skipped_in_training(state: &TrainingState, streams: [bool; 3]) -> BTreeMap<String, serde_json::Value> {
    let mut skipped = BTreeMap::new();
    let saved = state.candidates.saturating_sub(state.evaluations);
    skipped.insert("train_field_evaluations".to_owned(), saved.into());
    if state.candidates > 0 {
        let share = saved as f64 / state.candidates as f64;
        skipped.insert("train_field_evaluations_share".to_owned(), share.into());
    }
    let absent: Vec<&str> =
        crate::field::Stream::ALL.iter().filter(|s| !streams[**s as usize]).map(|s| s.name()).collect();
    skipped.insert("streams".to_owned(), absent.into());
    if let (true, Some(coverage)) = (state.trusts_poses, state.given_coverage) {
        let why =
            format!("stereo finds the depth of {:.0} % of pixels from the poses as given", 100.0 * coverage);
        skipped.insert("pose_refinement".to_owned(), why.into());
    }
    if let Some(seconds) = state.stereo_left_out {
        let why =
            format!("depth by stereo would have taken some {seconds:.0} s, too much of the time budget");
        skipped.insert("stereo".to_owned(), why.into());
    }
    skipped
}

/// The work that training saved: at points where the density grids say that a stream has nothing, or where it gives all but
/// no light (colours, and the way back), for streams that the scene does not have, behind what lets no light through, for poses
/// that were exact already, and for rows of tables that nobody saw.
pub fn saved_in_training(state: &TrainingState) -> [(&'static str, Work); 6] {
    // Values and two moments of a row, read and written.
    let row = 6 * size_of::<Row>() as u64;
    [
        ("faint_samples", Work::samples(state.faint)),
        ("empty_space", Work::samples(state.candidates.saturating_sub(state.evaluations))),
        ("absent_streams", Work::samples(state.absent)),
        ("saturated_rays", Work::samples(state.spared)),
        ("exact_poses", Work::samples(state.unrefined)),
        ("unseen_rows", Work::bytes(row * state.unseen)),
    ]
}

/// The metrics in a file, if there are any that can be read.
pub fn read(path: &Path) -> Option<RunMetrics> {
    serde_json::from_slice(&std::fs::read(path).ok()?).ok()
}

/// Most memory that this process held at once, MB: `VmHWM` of Linux; `None` elsewhere.
pub fn peak_rss_mb() -> Option<f64> {
    parse_peak(&std::fs::read_to_string("/proc/self/status").ok()?)
}

fn parse_peak(status: &str) -> Option<f64> {
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024.0 / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_read_from_the_status_file() {
        assert_eq!(parse_peak("Name:\tx\nVmHWM:\t   1000 kB\nVmRSS:\t 1 kB\n"), Some(1.024));
        assert_eq!(parse_peak("Name:\tx\n"), None);
        assert_eq!(parse_peak("VmHWM:\tmany kB\n"), None);
    }

    #[test]
    fn metrics_come_back_from_json() {
        let mut metrics = RunMetrics::default();
        metrics.quality.psnr = Some(21.5);
        metrics.cost.train_seconds = Some(12.0);
        metrics.skipped.insert("streams".into(), vec!["actor"].into());
        let json = serde_json::to_string(&metrics).unwrap();
        assert!(json.contains("\"psnr\":21.5,\"train_seconds\":12.0"), "{json}");
        assert_eq!(serde_json::from_str::<RunMetrics>(&json).unwrap(), metrics);
    }
}
