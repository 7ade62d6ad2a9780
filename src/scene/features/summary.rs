//! What features a scene has, for `divff inspect`.

use std::fmt;

use rayon::prelude::*;
use serde::Serialize;

use super::{Descriptors, FeatureError, FeatureStore, Folder, FrameFeatures, MAX_SCALES, Space};
use crate::scene::Frame;

/// One kind of feature.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FeatureKind {
    /// What it is, for people.
    pub name: String,
    /// Frames that have it; for text, phrases.
    pub count: usize,
    /// Numbers per descriptor; `None` for hotspots, or where no file could be read.
    pub dim: Option<usize>,
    /// The model that made it, where `meta.json` says so.
    pub model: Option<String>,
}

impl fmt::Display for FeatureKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of = if self.name.starts_with("text") { "phrases" } else { "frames" };
        write!(f, "{}: {} {of}", self.name, self.count)?;
        if let Some(dim) = self.dim {
            write!(f, ", {dim} numbers")?;
        }
        match &self.model {
            Some(model) => write!(f, ", by {model}"),
            None => Ok(()),
        }
    }
}

/// The features of a scene at a glance.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FeatureSummary {
    /// What there is.
    pub kinds: Vec<FeatureKind>,
    /// What is odd but can be worked with.
    pub warnings: Vec<String>,
    /// What will fail.
    pub problems: Vec<String>,
}

pub(super) fn summarise(store: &FeatureStore, frames: &[Frame], deep: bool) -> FeatureSummary {
    let mut summary = FeatureSummary { kinds: kinds(store, frames), ..FeatureSummary::default() };
    let check =
        |frame| if deep { check_deep(&store.frame(frame)) } else { check_headers(&store.frame(frame)) };
    // In frame order, whatever the number of threads.
    let found: Vec<Found> = frames.par_iter().map(check).collect();
    for found in found {
        summary.warnings.extend(found.warnings);
        summary.problems.extend(found.problems.into_iter().map(|e| e.to_string()));
    }
    for space in Space::ALL {
        match store.text(space) {
            Ok(None) => {}
            Ok(Some(text)) => {
                summary.kinds.push(FeatureKind {
                    name: format!("text, {}", space.name()),
                    count: text.phrases.len(),
                    dim: Some(text.embeddings.dim),
                    model: None,
                });
                let missing: Vec<&str> = (space.canonical_phrases().iter())
                    .filter(|p| text.find(p).is_none())
                    .map(|p| &**p)
                    .collect();
                if !missing.is_empty() {
                    summary.warnings.push(format!(
                        "text/{}.txt lacks the canonical phrases {missing:?}: queries need them from there or from a \
                         text encoder",
                        space.name()
                    ));
                }
            }
            Err(error) => summary.problems.push(error.to_string()),
        }
    }
    summary.warnings.extend(assumed_layouts(store, frames));
    summary
}

fn kinds(store: &FeatureStore, frames: &[Frame]) -> Vec<FeatureKind> {
    let mut kinds = Vec::new();
    let mut add = |name: &str, folder: &Folder, part: &str, extension: &str| {
        let count = frames.iter().filter(|f| folder.file(&f.stem, part, extension).is_some()).count();
        if count > 0 {
            let dim = (extension == "npy").then(|| folder.width.as_ref().map(|w| w.0)).flatten();
            kinds.push(FeatureKind { name: name.into(), count, dim, model: folder.meta.model.clone() });
        }
    };
    add("image masks", &store.language, "_f", "npy");
    add("image boxes", &store.language, "_b", "npy");
    for scale in 0..MAX_SCALES {
        add(&format!("image patches {scale}"), &store.language, &format!("_p{scale}"), "npy");
    }
    add("video patches", &store.video, "_p", "npy");
    add("video clips", &store.video, "_g", "npy");
    add("part features", &store.dino, "", "npy");
    add("hotspots", &store.hotspots, "", "png");
    kinds
}

/// Patches whose place is not written down.
fn assumed_layouts(store: &FeatureStore, frames: &[Frame]) -> Vec<String> {
    let scales = (0..MAX_SCALES).map(|k| (&store.language, format!("_p{k}")));
    let all = scales.chain([(&store.video, "_p".to_owned())]);
    all.filter(|(folder, part)| {
        let has = frames.iter().any(|f| folder.file(&f.stem, part, "npy").is_some());
        has && !folder.meta.knows(&part[1..])
    })
    .map(|(folder, part)| {
        format!(
            "{}: no size and stride of the patches `{part}`; they are taken to cover the image and overlap by half",
            folder.meta.path.display()
        )
    })
    .collect()
}

#[derive(Default)]
struct Found {
    warnings: Vec<String>,
    problems: Vec<FeatureError>,
}

impl Found {
    fn take<T>(&mut self, result: Result<Option<T>, FeatureError>, tables: impl Fn(&T) -> Vec<&Descriptors>) {
        match result {
            Ok(Some(value)) => {
                self.warnings.extend(tables(&value).into_iter().filter_map(Descriptors::warning))
            }
            Ok(None) => {}
            Err(error) => self.problems.push(error),
        }
    }
}

/// Reads everything of a frame.
fn check_deep(frame: &FrameFeatures) -> Found {
    let mut found = Found::default();
    found.take(frame.masks(), |m| std::iter::once(&m.masks).chain(&m.boxes).collect());
    for scale in frame.patch_scales() {
        found.take(frame.patches(scale), |p| vec![&p.descriptors]);
    }
    found.take(frame.video_patches(), |p| vec![&p.descriptors]);
    found.take(frame.video_clip(), |c| vec![c]);
    found.take(frame.dino(), |c| vec![&c.descriptors]);
    found.take(frame.hotspot(), |_| Vec::new());
    found
}

/// Compares types, shapes and lengths of a frame's files.
fn check_headers(frame: &FrameFeatures) -> Found {
    let (store, stem) = (frame.store, &frame.frame.stem);
    let mut found = Found::default();
    let mut check = |folder: &Folder, part: &str, dimensions: &[&str]| {
        let header = folder.file(stem, part, "npy").map(|path| folder.check(&path, dimensions)).transpose();
        let rows = header.as_ref().ok().and_then(|h| h.as_ref()).and_then(|h| h.shape.first().copied());
        found.problems.extend(header.err());
        rows
    };
    let masks = check(&store.language, "_f", &["N", "D"]);
    let boxes = check(&store.language, "_b", &["N", "D"]);
    for scale in frame.patch_scales() {
        check(&store.language, &format!("_p{scale}"), &["rows", "cols", "D"]);
    }
    check(&store.video, "_p", &["rows", "cols", "D"]);
    check(&store.video, "_g", &["D"]);
    check(&store.dino, "", &["rows", "cols", "D"]);
    if let (Some(masks), Some(boxes)) = (masks, boxes)
        && masks != boxes
        && let Some(path) = store.language.file(stem, "_b", "npy")
    {
        found.problems.push(super::count_differs(&path, boxes, masks));
    }
    let map = frame.mask_files().and_then(|files| {
        let Some([s, _]) = files else { return Ok(()) };
        frame.check_map(&s, &divff_exporters::read_npy_header(&s)?).map(drop)
    });
    found.problems.extend(map.err());
    found
}
