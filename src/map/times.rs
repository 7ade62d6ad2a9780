//! From the times that are asked for to frames and intervals.

use std::collections::BTreeSet;

use divff_exporters::Interval;

use super::config::{TimePoint, Times};
use super::error::MapError;
use crate::scene::{Frame, Scene};

/// Times that are extracted unless others are asked for and there is no ground truth.
const DEFAULT_COUNT: usize = 8;

/// A frame whose time is extracted, and the interval for which it stands.
pub(super) struct Moment<'a> {
    pub(super) frame: &'a Frame,
    pub(super) interval: Interval,
}

/// The frames in order of time, each once; neighbours' intervals meet half way and together cover the video.
pub(super) fn resolve<'a>(scene: &'a Scene, times: &Times) -> Result<Vec<Moment<'a>>, MapError> {
    let mut chosen = BTreeSet::new();
    match times {
        Times::All => chosen.extend(0..scene.frames.len()),
        Times::List(points) => {
            for point in points {
                chosen.insert(find(scene, *point)?);
            }
        }
        Times::Auto => {
            let truth = ground_truth(scene);
            chosen.extend((0..scene.frames.len()).filter(|&n| truth.contains(&scene.frames[n].frame_index)));
            if chosen.is_empty() {
                let last = scene.frames.len() - 1;
                chosen.extend((0..DEFAULT_COUNT).map(|k| (2 * k + 1) * last / (2 * DEFAULT_COUNT)));
            }
        }
    }
    let mut frames: Vec<&Frame> = chosen.into_iter().map(|n| &scene.frames[n]).collect();
    frames.dedup_by_key(|f| f.time);
    let border = |k: usize| 0.5 * (frames[k - 1].time + frames[k].time);
    let moment = |k: usize| Moment {
        frame: frames[k],
        interval: Interval {
            time_start: if k == 0 { 0.0 } else { border(k) },
            time_end: if k + 1 == frames.len() { 1.0 } else { border(k + 1) },
        },
    };
    Ok((0..frames.len()).map(moment).collect())
}

/// Position of the frame that a time means.
fn find(scene: &Scene, point: TimePoint) -> Result<usize, MapError> {
    let frames = &scene.frames;
    match point {
        TimePoint::Frame(index) => {
            let indices = || frames.iter().map(|f| f.frame_index);
            indices().position(|n| n == index).ok_or_else(|| MapError::NoSuchFrame {
                index,
                first: indices().min().unwrap_or(0),
                last: indices().max().unwrap_or(0),
            })
        }
        TimePoint::Time(time) => {
            let off = |n: &usize| (frames[*n].time - time).abs();
            let nearest = (0..frames.len()).min_by(|a, b| off(a).total_cmp(&off(b)));
            Ok(nearest.unwrap_or(0))
        }
    }
}

/// Frame indices of `gt/mesh/dynamic_<frame_index>.ply`.
fn ground_truth(scene: &Scene) -> BTreeSet<u32> {
    let Ok(entries) = std::fs::read_dir(scene.root.join("gt").join("mesh")) else { return BTreeSet::new() };
    let index = |name: &str| name.strip_prefix("dynamic_")?.strip_suffix(".ply")?.parse().ok();
    entries.filter_map(|e| index(&e.ok()?.file_name().to_string_lossy())).collect()
}
