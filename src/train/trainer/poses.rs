//! Where the frames are, and the depth that follows from it: how far the poses are trusted, alignment, stereo.

use std::time::{Duration, Instant};

use super::Trainer;
use crate::config::Config;
use crate::field::Stream;
use crate::render::forward::Model;
use crate::stereo::Search;
use crate::train::align;
use crate::train::checkpoint::Trained;

/// Frames by which poses are judged, and those of them that are looked at first.
const JUDGED_FRAMES: [usize; 2] = [4, 12];

/// Share of a time budget that stereo may take where nothing moves: in a short one, that many more steps are worth more,
/// for the picture and for the surface.
const STEREO_SHARE: f64 = 0.1;

/// Share of their pixels of which stereo finds the depth, from where poses need no refinement.
const WELL_POSED: f64 = 0.2;

/// Where the first few frames have less, more of them would not change the verdict.
const ILL_POSED: f64 = 0.1;

impl Trainer {
    /// Registers all training frames to what the field shows from where they are.
    pub(super) fn align(&mut self) {
        self.settle();
        let model = Model::new(&self.trained.field, &self.trained.grids, self.streams);
        let correction = align::align(&model, &self.pixels, &self.config.train.look_sampling());
        correction.apply(&mut self.trained.field);
        let a = correction.report;
        tracing::info!(a.frames, a.rotation, a.translation, lens = ?a.lens, "frames aligned");
    }

    /// Asks stereo, before the first step, whether the poses as given are good enough to find depth from; then they are
    /// not refined, and that depth is there from the start.
    ///
    /// Refinement follows a field that is not sharp yet. It mends poses that jitter by pixels, and makes exact ones worse.
    pub(super) fn judge_poses(&mut self) {
        let Config { train, stereo, .. } = &self.config;
        if train.stereo_at >= 1.0 {
            return;
        }
        let refined = !train.align_at.is_empty() || train.pose_rate > 0.0 || train.rig_rate > 0.0;
        let start = Instant::now();
        let search = self.pixels.stereo_search(&self.trained.field, stereo);
        let given = refined.then(|| self.judge(&search));
        // Frames are judged together with those that they are compared with.
        let (frames, judged) = (self.pixels.frames.len(), given.map_or(0, |(_, judged)| judged));
        let looked_at = (judged * (1 + stereo.neighbours)).min(frames).max(1);
        // Refined poses are judged once more.
        let times = 1.0 + frames as f64 / looked_at as f64;
        self.stereo_cost = refined.then(|| start.elapsed().as_secs_f64() * times);
        let progress = &mut self.trained.progress;
        (progress.given_coverage, progress.judged) = given.unzip();
        progress.trusts_poses = progress.given_coverage.is_none_or(|share| share >= WELL_POSED);
        if progress.trusts_poses {
            self.find_depth(Some(search));
        }
    }

    /// Share of some frames' pixels whose depth is found, and how many those frames are at most: few if they tell enough.
    fn judge(&self, search: &Search) -> (f64, usize) {
        let [few, more] = JUDGED_FRAMES;
        let share = search.coverage(&self.judged_frames(few));
        if share < ILL_POSED { (share, few) } else { (search.coverage(&self.judged_frames(more)), more) }
    }

    /// A few training frames, `count` at most, evenly over the video.
    fn judged_frames(&self, count: usize) -> Vec<usize> {
        let frames = self.pixels.frames.len();
        (0..frames).step_by(frames.div_ceil(count).max(1)).collect()
    }

    /// Whether depth by stereo has to wait, because it takes too much of a time budget: until it is known whether anything
    /// moves, which stereo would find.
    pub(super) fn stereo_waits(&self, budget: Option<Duration>) -> bool {
        !self.trained.progress.streams_settled && self.stereo_too_long(budget).is_some()
    }

    /// Leaves stereo out for good where it takes too much of a time budget and nothing moves.
    pub(super) fn leave_out_stereo(&mut self, budget: Option<Duration>) {
        if !self.trained.field.shape.streams[Stream::Dynamic as usize] {
            self.trained.progress.stereo_left_out = self.stereo_too_long(budget);
        }
    }

    /// Seconds that stereo would take, where they are too many of a time budget. Without one, results must not depend on
    /// the clock.
    fn stereo_too_long(&self, budget: Option<Duration>) -> Option<f64> {
        let most = STEREO_SHARE * budget?.as_secs_f64();
        self.stereo_cost.filter(|cost| !self.trained.progress.trusts_poses && *cost > most)
    }

    /// Finds the depth of the training frames by stereo, unless that is done or not wanted: from where they are by now
    /// or from where they were given, whichever finds more; or from where they were when a training that goes on did so.
    pub(super) fn look_at_depth(&mut self) {
        self.find_depth(None);
    }

    /// [`Self::look_at_depth`]; `search` if one was begun with the field as it is.
    fn find_depth(&mut self, mut search: Option<Search>) {
        let unwanted = self.config.train.stereo_at >= 1.0 || self.trained.progress.stereo_left_out.is_some();
        if unwanted || !self.pixels.stereo.is_empty() {
            return;
        }
        if self.trained.progress.stereo_from.is_none() {
            search = search.or_else(|| self.settle_poses());
        }
        let Trained { field, progress, .. } = &mut self.trained;
        let refinement = field.layout.refinement();
        let now = field.weights[refinement.clone()].to_vec();
        let then = progress.stereo_from.get_or_insert_with(|| now.clone());
        field.weights[refinement.clone()].copy_from_slice(then);
        let search = search.unwrap_or_else(|| self.pixels.stereo_search(field, &self.config.stereo));
        self.pixels.take_depth(field, &search, progress.trusts_poses);
        if field.shape.streams[Stream::Dynamic as usize] && self.config.loss.moving > 0.0 {
            self.pixels.look_for_movement(field, self.masks.take().as_ref());
        }
        field.weights[refinement].copy_from_slice(&now);
    }

    /// Undoes the refinement of the poses if stereo finds less from them than from the poses as they were given; the search
    /// that goes on, which is none where poses have nothing to be compared with.
    ///
    /// Where poses are bad stereo finds little, and by chance: in a few frames less than before is no proof, and all of them
    /// are asked.
    pub(super) fn settle_poses(&mut self) -> Option<Search> {
        let progress = &self.trained.progress;
        let given = progress.given_coverage.filter(|_| !progress.trusts_poses)?;
        let judged = self.judged_frames(progress.judged.unwrap_or(JUDGED_FRAMES[1]));
        let Self { trained: Trained { field, progress, .. }, pixels, config, .. } = self;
        let search = pixels.stereo_search(field, &config.stereo);
        let refined = search.coverage(&judged);
        tracing::info!(given, refined, "depth by stereo from poses as given and as refined");
        if refined >= given {
            return Some(search);
        }
        let refinement = &mut field.weights[field.layout.refinement()];
        let weights = refinement.to_vec();
        refinement.fill(0.0);
        let as_given = pixels.stereo_search(field, &config.stereo);
        let all: Vec<usize> = (0..pixels.frames.len()).collect();
        let [given, refined] = [&as_given, &search].map(|search| search.coverage(&all));
        tracing::info!(given, refined, "the same of all frames");
        if refined >= given {
            field.weights[field.layout.refinement()].copy_from_slice(&weights);
            return Some(search);
        }
        progress.trusts_poses = true;
        Some(as_given)
    }
}
