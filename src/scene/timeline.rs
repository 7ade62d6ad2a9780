//! Times and frame indices of a video, where the file gives them only in part.

use std::collections::BTreeSet;
use std::path::Path;

use super::draft::{Draft, DraftFrame};
use super::error::{Place, SceneError};

/// Gives every frame a time in `[0, 1]` and a frame index.
///
/// Indices come from the file, else from the number at the end of the image names, else from the order in the
/// file. Times come from the file (stretched to `[0, 1]` if they are seconds or the like), else from the
/// indices.
pub(crate) fn complete(draft: &mut Draft, warnings: &mut Vec<String>) -> Result<(), SceneError> {
    let has_index = all_or_none(draft, "frame_index", |f| f.frame_index.is_some())?;
    let has_time = all_or_none(draft, "time", |f| f.time.is_some())?;
    if !has_index {
        let from_names = indices_from_names(&draft.frames);
        // Without numbers in the names, given times tell the order better than the file does.
        let mut order: Vec<usize> = (0..draft.frames.len()).collect();
        if has_time {
            order.sort_by(|&a, &b| time(&draft.frames[a]).total_cmp(&time(&draft.frames[b])));
        }
        for (position, &i) in order.iter().enumerate() {
            draft.frames[i].frame_index = Some(match &from_names {
                Some(indices) => indices[i],
                None => position as u32,
            });
        }
    }
    check_indices(draft)?;
    if !has_time {
        for frame in &mut draft.frames {
            frame.time = frame.frame_index.map(f64::from);
        }
    }
    let (first, last) = draft
        .frames
        .iter()
        .map(time)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)));
    if has_time && first >= 0.0 && last <= 1.0 {
        return Ok(());
    }
    if has_time {
        warnings.push(format!("times run from {first} to {last}; they are stretched to 0…1"));
    }
    let span = if last > first { last - first } else { 1.0 };
    if !span.is_finite() {
        return Err(SceneError::invalid(
            &draft.source,
            Place::Key("time".into()),
            format!("times run from {first:e} to {last:e}, which is more than can be divided"),
            "give times in seconds, or from 0 to 1",
        ));
    }
    for frame in &mut draft.frames {
        frame.time = Some((time(frame) - first) / span);
    }
    Ok(())
}

fn time(frame: &DraftFrame) -> f64 {
    frame.time.unwrap_or(0.0)
}

/// Whether all frames have a key; an error names the first frame without it if only some have.
fn all_or_none(draft: &Draft, key: &str, has: fn(&DraftFrame) -> bool) -> Result<bool, SceneError> {
    if !draft.frames.iter().any(has) {
        return Ok(false);
    }
    match draft.frames.iter().find(|f| !has(f)) {
        None => Ok(true),
        Some(without) => Err(SceneError::invalid(
            &draft.source,
            Place::FrameKey { frame: without.name.clone(), key: key.into() },
            "the key is missing, but other frames have it",
            "give it for all frames or for none",
        )),
    }
}

/// Two frames of one index would write the same output files.
fn check_indices(draft: &Draft) -> Result<(), SceneError> {
    let mut seen = BTreeSet::new();
    match draft.frames.iter().find(|f| !seen.insert(f.frame_index)) {
        None => Ok(()),
        Some(second) => Err(SceneError::invalid(
            &draft.source,
            Place::FrameKey { frame: second.name.clone(), key: "frame_index".into() },
            format!("index {} is used twice", second.frame_index.unwrap_or(0)),
            "number the frames as they are in the video",
        )),
    }
}

/// The numbers at the end of the stems (`frame_000123.jpg`), if all frames have one, all different, behind
/// one and the same prefix.
fn indices_from_names(frames: &[DraftFrame]) -> Option<Vec<u32>> {
    let mut prefixes = BTreeSet::new();
    let mut indices = Vec::with_capacity(frames.len());
    for frame in frames {
        let stem = Path::new(&frame.name).file_stem()?.to_str()?;
        let prefix = stem.trim_end_matches(|c: char| c.is_ascii_digit());
        prefixes.insert(prefix);
        indices.push(stem[prefix.len()..].parse().ok()?);
    }
    let distinct: BTreeSet<u32> = indices.iter().copied().collect();
    (prefixes.len() == 1 && distinct.len() == frames.len()).then_some(indices)
}
