//! What a scene holds and what is suspicious about it, before hours are spent on it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;

use super::features::{FeatureKind, FeatureStore, FeatureSummary};
use super::{Frame, Scene, Split, bounds};

/// Optional folders of a scene, and whether their files are named after frames.
const FOLDERS: [(&str, bool); 6] = [
    ("language_features", true),
    ("video_features", true),
    ("dino_features", true),
    ("hotspots", true),
    ("text", false),
    ("gt", false),
];
/// A camera that moves this many times the median step, and a good part of the whole way, has probably
/// jumped.
const JUMP: f64 = 20.0;

/// Summary of a scene; what `divff inspect` prints.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    /// The scene folder.
    pub root: PathBuf,
    /// Number of frames that are used.
    pub frames: usize,
    /// Of these: trained on.
    pub train: usize,
    /// Of these: held out.
    pub test: usize,
    /// Image sizes and how many frames have them, largest share first.
    pub sizes: Vec<SizeCount>,
    /// Time of the first and the last frame.
    pub time: [f64; 2],
    /// Smallest and largest frame index.
    pub frame_index: [u32; 2],
    /// Length of the camera's way, world units.
    pub path_length: f64,
    /// Diagonal of the box around all camera positions, world units.
    pub baseline: f64,
    /// Smallest and largest corner of the box that is mapped, world units.
    pub bounds: [[f64; 3]; 2],
    /// Cameras outside the box.
    pub cameras_outside: usize,
    /// Cameras that see no part of the box.
    pub cameras_blind: usize,
    /// Sparse structure-from-motion points.
    pub points: usize,
    /// Frames with depth.
    pub depth: usize,
    /// Depth is for `eval` alone.
    pub depth_is_ground_truth: bool,
    /// Frames with a mask.
    pub masks: usize,
    /// The optional folders that are there.
    pub folders: Vec<FolderCount>,
    /// The kinds of features that are there, how many frames have each, and their size.
    pub features: Vec<FeatureKind>,
    /// Whether every image, depth and mask was decoded.
    pub deep: bool,
    /// What is suspicious but does not stop anything.
    pub warnings: Vec<String>,
    /// What will fail.
    pub problems: Vec<String>,
}

/// How many frames have one image size.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SizeCount {
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// Frames of this size.
    pub frames: usize,
}

/// What an optional folder holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FolderCount {
    /// Name of the folder.
    pub name: String,
    /// Files directly in it.
    pub files: usize,
    /// Frames that have at least one file in it; `None` where files are not named after frames.
    pub frames: Option<usize>,
}

/// Looks a scene over. `deep` also decodes every image, depth and mask and reads every feature file to its end.
pub fn inspect(scene: &Scene, deep: bool) -> Inspection {
    let mut warnings = scene.warnings.clone();
    let count = |has: fn(&Frame) -> bool| scene.frames.iter().filter(|f| has(f)).count();
    let positions = || scene.frames.iter().map(|f| f.c2w.translation);
    let steps: Vec<f64> =
        scene.frames.windows(2).map(|w| w[0].c2w.translation.distance(w[1].c2w.translation)).collect();
    let lowest = positions().fold(glam::DVec3::INFINITY, glam::DVec3::min);
    let highest = positions().fold(glam::DVec3::NEG_INFINITY, glam::DVec3::max);
    let baseline = if scene.frames.is_empty() { 0.0 } else { (highest - lowest).length() };
    suspect_poses(scene, &steps, baseline, &mut warnings);
    suspect_times(scene, &mut warnings);
    let folders = count_folders(scene, &mut warnings);
    let features = match FeatureStore::open(scene) {
        Ok(store) => store.summary(&scene.frames, deep),
        Err(error) => FeatureSummary { problems: vec![error.to_string()], ..FeatureSummary::default() },
    };
    warnings.extend(features.warnings);
    let mut problems = find_problems(scene, deep);
    problems.extend(features.problems);
    let indices = || scene.frames.iter().map(|f| f.frame_index);
    Inspection {
        root: scene.root.clone(),
        frames: scene.frames.len(),
        train: count(|f| f.split == Split::Train),
        test: count(|f| f.split == Split::Test),
        sizes: sizes(&scene.frames),
        time: [scene.frames.first().map_or(0.0, |f| f.time), scene.frames.last().map_or(0.0, |f| f.time)],
        frame_index: [indices().min().unwrap_or(0), indices().max().unwrap_or(0)],
        path_length: steps.iter().sum(),
        baseline,
        bounds: [scene.bounds.min.to_array(), scene.bounds.max.to_array()],
        cameras_outside: scene.frames.iter().filter(|f| !scene.bounds.contains(f.c2w.translation)).count(),
        cameras_blind: scene.frames.iter().filter(|f| !bounds::sees(f, &scene.bounds)).count(),
        points: scene.points.len(),
        depth: count(|f| f.depth_path.is_some()),
        depth_is_ground_truth: scene.depth_is_ground_truth,
        masks: count(|f| f.mask_path.is_some()),
        folders,
        features: features.kinds,
        deep,
        warnings,
        problems,
    }
}

fn sizes(frames: &[Frame]) -> Vec<SizeCount> {
    let mut counts = BTreeMap::new();
    for frame in frames {
        *counts.entry((frame.camera.width, frame.camera.height)).or_insert(0) += 1;
    }
    let mut sizes: Vec<SizeCount> =
        counts.into_iter().map(|((width, height), frames)| SizeCount { width, height, frames }).collect();
    sizes.sort_by_key(|s| std::cmp::Reverse(s.frames));
    sizes
}

fn suspect_poses(scene: &Scene, steps: &[f64], baseline: f64, warnings: &mut Vec<String>) {
    let same: Vec<&str> =
        (scene.frames.windows(2).filter(|w| w[0].c2w == w[1].c2w)).map(|w| w[1].stem.as_str()).collect();
    if let Some(first) = same.first() {
        warnings.push(format!(
            "{} frames have exactly the pose of the frame before them (first: {first})",
            same.len()
        ));
    }
    let mut sorted = steps.to_vec();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let jumps: Vec<&str> = (steps.iter().zip(scene.frames.iter().skip(1)))
        .filter(|(step, _)| median > 0.0 && **step > JUMP * median && **step > 0.2 * baseline)
        .map(|(_, frame)| frame.stem.as_str())
        .collect();
    if let Some(first) = jumps.first() {
        warnings.push(format!(
            "the camera jumps {} times (first: to {first}); such poses are often wrong",
            jumps.len()
        ));
    }
}

fn suspect_times(scene: &Scene, warnings: &mut Vec<String>) {
    let equal = scene.frames.windows(2).filter(|w| w[0].time == w[1].time).count();
    if equal > 0 {
        warnings.push(format!("{equal} frames have the time of the frame before them"));
    }
    let back = scene.frames.windows(2).filter(|w| w[0].frame_index > w[1].frame_index).count();
    if back > 0 {
        warnings.push(format!("in time order, `frame_index` falls {back} times: one of the two is wrong"));
    }
}

fn count_folders(scene: &Scene, warnings: &mut Vec<String>) -> Vec<FolderCount> {
    let stems: BTreeSet<&str> = scene.frames.iter().map(|f| f.stem.as_str()).collect();
    let mut folders = Vec::new();
    for (name, per_frame) in FOLDERS {
        let Some(files) = file_names(&scene.root.join(name)) else { continue };
        let mut with_files = BTreeSet::new();
        let mut strangers = 0;
        for file in files.iter().filter(|f| per_frame && f.as_str() != "meta.json") {
            match stem_of(file, &stems) {
                Some(stem) => {
                    with_files.insert(stem);
                }
                None => strangers += 1,
            }
        }
        if strangers > 0 {
            warnings.push(format!("{strangers} files in {name}/ are named after none of the frames"));
        }
        folders.push(FolderCount {
            name: name.to_owned(),
            files: files.len(),
            frames: per_frame.then_some(with_files.len()),
        });
    }
    folders
}

/// Names in a folder, sorted; `None` if there is no such folder.
fn file_names(folder: &Path) -> Option<Vec<String>> {
    let entries = std::fs::read_dir(folder).ok()?;
    let mut names: Vec<String> =
        entries.filter_map(|e| Some(e.ok()?.file_name().to_string_lossy().into_owned())).collect();
    names.sort();
    Some(names)
}

/// The frame that `<stem>.ext` or `<stem>_<part>.ext` belongs to.
fn stem_of<'a>(file: &str, stems: &BTreeSet<&'a str>) -> Option<&'a str> {
    let stem = Path::new(file).file_stem()?.to_str()?;
    let part = || stems.get(stem.rsplit_once('_')?.0);
    stems.get(stem).or_else(part).copied()
}

fn find_problems(scene: &Scene, deep: bool) -> Vec<String> {
    let problems_of = |frame: &Frame| -> Vec<String> {
        if deep {
            let results =
                [frame.load_rgb().err(), frame.load_depth(scene.depth_unit).err(), frame.load_mask().err()];
            return results.into_iter().flatten().map(|e| e.to_string()).collect();
        }
        let files = [Some(&frame.image_path), frame.depth_path.as_ref(), frame.mask_path.as_ref()];
        let missing = files.into_iter().flatten().filter(|p| !p.is_file());
        missing.map(|p| format!("frame {}: {} does not exist", frame.stem, p.display())).collect()
    };
    // Collected in frame order, whatever the number of threads.
    let found: Vec<Vec<String>> = scene.frames.par_iter().map(problems_of).collect();
    found.into_iter().flatten().collect()
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "scene      {}", self.root.display())?;
        let sizes: Vec<String> =
            self.sizes.iter().map(|s| format!("{}×{} ({})", s.width, s.height, s.frames)).collect();
        writeln!(
            f,
            "frames     {} ({} train, {} test), {}",
            self.frames,
            self.train,
            self.test,
            sizes.join(", ")
        )?;
        let ([t0, t1], [i0, i1]) = (self.time, self.frame_index);
        writeln!(f, "time       {t0:.3} to {t1:.3}, frame {i0} to {i1}")?;
        writeln!(f, "cameras    way {:.3}, baseline {:.3} (world units)", self.path_length, self.baseline)?;
        let [min, max] = self.bounds.map(|c| format!("[{:.3}, {:.3}, {:.3}]", c[0], c[1], c[2]));
        write!(f, "bounds     {min} to {max}")?;
        if self.cameras_outside + self.cameras_blind > 0 {
            write!(f, "; {} cameras outside, {} see none of it", self.cameras_outside, self.cameras_blind)?;
        }
        writeln!(f)?;
        if self.points > 0 {
            writeln!(f, "points     {} sparse", self.points)?;
        }
        if self.depth > 0 {
            let role = if self.depth_is_ground_truth { " (ground truth: for eval alone)" } else { "" };
            writeln!(f, "depth      {} frames{role}", self.depth)?;
        }
        if self.masks > 0 {
            writeln!(f, "masks      {} frames", self.masks)?;
        }
        for folder in &self.folders {
            write!(f, "{:<18} {} files", format!("{}/", folder.name), folder.files)?;
            match folder.frames {
                Some(frames) => writeln!(f, " for {frames} frames")?,
                None => writeln!(f)?,
            }
        }
        for kind in &self.features {
            writeln!(f, "features   {kind}")?;
        }
        write_list(f, "warning", &self.warnings)?;
        write_list(f, "problem", &self.problems)?;
        if self.problems.is_empty() {
            let how = if self.deep { "every image was decoded" } else { "images were not decoded" };
            writeln!(f, "no problems found ({how})")?;
        }
        Ok(())
    }
}

/// The first items of a list, and how many more there are.
fn write_list(f: &mut fmt::Formatter<'_>, kind: &str, items: &[String]) -> fmt::Result {
    const SHOWN: usize = 10;
    for item in items.iter().take(SHOWN) {
        writeln!(f, "{kind}: {item}")?;
    }
    match items.len().saturating_sub(SHOWN) {
        0 => Ok(()),
        more => writeln!(f, "{kind}: … and {more} more"),
    }
}
