//! What is damaged, and what then reads it.

use std::path::Path;

use divff::pipeline::RunFolder;
use divff::pipeline::log;
use divff::scene::Scene;
use divff::scene::features::{FeatureStore, Space};
use divff::train::Trained;

/// What a reader says: nothing, or its error's message.
pub type Outcome = Result<(), String>;

/// A valid file, the folder around it, and a reader that reads it.
pub struct Subject {
    /// Path inside the folder.
    pub file: String,
    /// Fills a folder.
    pub make: fn(&Path),
    /// Reads the file in the folder.
    pub read: fn(&Path) -> Outcome,
}

impl Subject {
    pub fn new(file: &str, make: fn(&Path), read: fn(&Path) -> Outcome) -> Self {
        Self { file: file.to_owned(), make, read }
    }
}

fn said<T>(result: Result<T, impl std::fmt::Display>) -> Result<T, String> {
    result.map_err(|e| e.to_string())
}

fn open(folder: &Path) -> Result<Scene, String> {
    let scene = said(Scene::open(folder))?;
    // What the type promises to those who use it.
    assert!(!scene.frames.is_empty());
    assert!(scene.bounds.min.is_finite() && scene.bounds.max.is_finite());
    assert!(scene.bounds.min.cmplt(scene.bounds.max).all());
    assert!(scene.points.iter().all(|p| p.is_finite()));
    for frame in &scene.frames {
        let c = &frame.camera;
        assert!(frame.c2w.is_finite() && (0.0..=1.0).contains(&frame.time), "{frame:?}");
        assert!([c.fx, c.fy, c.cx, c.cy].iter().chain(&c.distortion).all(|v| v.is_finite()), "{frame:?}");
        assert!(c.width > 0 && c.height > 0 && c.fx > 0.0 && c.fy > 0.0, "{frame:?}");
    }
    Ok(scene)
}

/// Opens a scene.
pub fn scene(folder: &Path) -> Outcome {
    open(folder).map(drop)
}

/// Decodes all that frames hold.
pub fn pixels(folder: &Path) -> Outcome {
    let scene = open(folder)?;
    for frame in &scene.frames {
        let pixels = frame.camera.width as usize * frame.camera.height as usize;
        assert_eq!(said(frame.load_rgb())?.pixels.len(), pixels);
        let depth = said(frame.load_depth(scene.depth_unit))?;
        assert!(depth.is_none_or(|d| d.len() == pixels && d.iter().all(|v| v.is_finite())));
        assert!(said(frame.load_mask())?.is_none_or(|m| m.len() == pixels));
    }
    Ok(())
}

/// Reads all features.
pub fn features(folder: &Path) -> Outcome {
    let scene = open(folder)?;
    let store = said(FeatureStore::open(&scene))?;
    for frame in &scene.frames {
        let features = store.frame(frame);
        if let Some(masks) = said(features.masks())? {
            let rows = masks.masks.rows();
            assert!(
                masks
                    .index
                    .iter()
                    .all(|i| usize::from(*i) < rows || *i == divff::scene::features::Masks::NONE)
            );
        }
        for scale in features.patch_scales() {
            said(features.patches(scale))?;
        }
        said(features.video_patches())?;
        let clip = said(features.video_clip())?;
        assert!(clip.is_none_or(|c| c.values.iter().all(|v| v.is_finite())));
        said(features.dino())?;
        said(features.hotspot())?;
    }
    said(store.text(Space::Clip))?;
    // The inspection reads the same files its own way, and reports what is wrong instead of failing.
    store.summary(&scene.frames, true);
    Ok(())
}

/// Reads a field with and without the state of its training.
pub fn checkpoint(run: &Path) -> Outcome {
    said(Trained::load(run))?;
    said(Trained::resume(run)).map(drop)
}

/// Reads the settings of a run.
pub fn config(run: &Path) -> Outcome {
    said(RunFolder::new(run).config()).map(drop)
}

/// Reads what a run was trained on.
pub fn record(run: &Path) -> Outcome {
    said(RunFolder::new(run).record()).map(drop)
}

/// Reads the log of a run, which leaves out what it cannot read.
pub fn log(run: &Path) -> Outcome {
    match log::read(&RunFolder::new(run).log_path()) {
        // Not UTF-8.
        Err(e) => Err(e.to_string()),
        Ok(_) => Ok(()),
    }
}
