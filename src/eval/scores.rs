//! How well phrases find what they name: mean IoU of objects and affordances at one threshold.

use std::path::{Path, PathBuf};

use image::DynamicImage;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::images::{check_size, mean};
use super::{EvalError, Metrics};
use crate::error::FileError;
use crate::scene::features::Space;
use crate::scene::{Frame, Scene};

/// A pixel belongs to a phrase where its score is above this, whatever the phrase and whoever gives the score.
pub const THRESHOLD: f32 = 0.5;

/// An object or a region is scored in a frame where the truth covers at least so many pixels.
pub(super) const MIN_PIXELS: usize = 50;

/// What phrases are to find; each task has a truth and a measure of its own, whichever features are asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Task {
    /// Dynamic objects that move, by their names.
    Objects,
    /// Where something can be done, by what is done there.
    Affordances,
}

impl Task {
    /// Both, in the order of [`Space::ALL`]: what each space is there for.
    pub const ALL: [Self; 2] = [Self::Objects, Self::Affordances];

    /// The space that is asked for the task's measure.
    pub fn space(self) -> Space {
        Space::ALL[self as usize]
    }

    /// Name of the task's measure in `metrics.json`.
    pub fn measure(self) -> &'static str {
        ["object_miou", "affordance_miou"][self as usize]
    }
}

/// What phrases should find.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhraseTruth {
    pub(super) root: PathBuf,
    /// Number in `gt/instances` and phrase of every object of the dynamic stream that moves.
    pub(super) objects: Vec<(u32, String)>,
    /// Phrase and folder under `gt/affordances`.
    affordances: Vec<(String, String)>,
}

impl PhraseTruth {
    /// Reads `gt/objects.json` and `gt/affordances.json`, as far as they are there.
    ///
    /// # Errors
    /// [`EvalError::Labels`] for a file that is not what it should be.
    pub fn read(scene: &Scene) -> Result<Self, EvalError> {
        let root = scene.root.join("gt");
        let objects = match json(&root.join("objects.json"))? {
            Some((path, value)) => objects(&value).ok_or_else(|| wrong(&path, OBJECTS))?,
            None => Vec::new(),
        };
        let affordances = match json(&root.join("affordances.json"))? {
            Some((path, value)) => affordances(&value).ok_or_else(|| wrong(&path, AFFORDANCES))?,
            None => Vec::new(),
        };
        Ok(Self { root, objects, affordances })
    }

    /// The phrases of a task, each once.
    pub fn phrases(&self, task: Task) -> Vec<String> {
        let mut phrases: Vec<String> = Vec::new();
        let all: Vec<&String> = match task {
            Task::Objects => self.objects.iter().map(|o| &o.1).collect(),
            Task::Affordances => self.affordances.iter().map(|a| &a.0).collect(),
        };
        for phrase in all {
            if !phrases.contains(phrase) {
                phrases.push(phrase.clone());
            }
        }
        phrases
    }
}

impl PhraseTruth {
    /// Where the truth says that a phrase is in a frame; `None` where it says nothing about the frame.
    ///
    /// # Errors
    /// Truth that cannot be read, or of another size than the frame.
    pub fn mask(&self, frame: &Frame, task: Task, phrase: &str) -> Result<Option<Vec<bool>>, EvalError> {
        let name = format!("{}.png", frame.stem);
        if task == Task::Objects {
            let of: Vec<u32> = self.objects.iter().filter(|o| o.1 == phrase).map(|o| o.0).collect();
            let instances = labels(&self.root.join("instances").join(&name), frame)?;
            return Ok(instances.map(|labels| labels.iter().map(|l| of.contains(l)).collect()));
        }
        let Some((_, folder)) = self.affordances.iter().find(|a| a.0 == phrase) else { return Ok(None) };
        let mask = labels(&self.root.join("affordances").join(folder).join(&name), frame)?;
        Ok(mask.map(|labels| labels.iter().map(|l| *l > 127).collect()))
    }
}

const OBJECTS: &str = "an object of {name, query, stream, moves} by instance number";
const AFFORDANCES: &str = "a list of phrases or of {phrase, slug}";

pub(super) fn wrong(path: &Path, expected: &'static str) -> EvalError {
    EvalError::Labels { path: path.to_owned(), expected }
}

pub(super) fn json(path: &Path) -> Result<Option<(PathBuf, Value)>, EvalError> {
    if !path.exists() {
        return Ok(None);
    }
    let bytes = std::fs::read(path).map_err(FileError::at(path))?;
    let value = serde_json::from_slice(&bytes).map_err(|_| wrong(path, "JSON"))?;
    Ok(Some((path.to_owned(), value)))
}

fn objects(value: &Value) -> Option<Vec<(u32, String)>> {
    let mut found = Vec::new();
    for (number, object) in value.as_object()? {
        let number: u32 = number.parse().ok()?;
        let phrase = object.get("query").or(object.get("name"))?.as_str()?;
        let moves = object.get("moves").and_then(Value::as_bool).unwrap_or(false);
        if moves && object.get("stream")?.as_str()? == "dynamic" {
            found.push((number, phrase.to_owned()));
        }
    }
    found.sort();
    Some(found)
}

fn affordances(value: &Value) -> Option<Vec<(String, String)>> {
    let list = match value.get("affordances") {
        Some(list) => list.as_array()?,
        None => value.as_array()?,
    };
    let one = |a: &Value| {
        let phrase = a.as_str().or_else(|| a.get("phrase")?.as_str())?.to_owned();
        let slug = a.get("slug").and_then(Value::as_str);
        let folder = slug.map_or_else(|| crate::semantics::slug(&phrase), str::to_owned);
        Some((phrase, folder))
    };
    list.iter().map(one).collect()
}

/// IoUs of one task over frames.
#[derive(Clone, Debug)]
pub struct ScoreSums {
    task: Task,
    /// Phrase and IoU of every object or region in every frame where the truth covers enough.
    ious: Vec<(String, f64)>,
}

impl ScoreSums {
    /// Nothing yet.
    pub fn new(task: Task) -> Self {
        Self { task, ious: Vec::new() }
    }

    /// Compares the scores of one frame with the truth; `scores` gives those of a phrase, `[height * width]`, or `None`
    /// for a phrase that was not asked.
    ///
    /// # Errors
    /// [`EvalError::Size`] for scores or truth of another size than the frame, unreadable truth.
    pub fn add<'s>(
        &mut self,
        truth: &PhraseTruth,
        frame: &Frame,
        scores: impl Fn(&str) -> Option<&'s [f32]>,
    ) -> Result<(), EvalError> {
        let name = format!("{}.png", frame.stem);
        match self.task {
            Task::Objects => {
                let path = truth.root.join("instances").join(&name);
                let Some(instances) = labels(&path, frame)? else { return Ok(()) };
                for (number, phrase) in &truth.objects {
                    let Some(scores) = scores(phrase) else { continue };
                    check_size(frame, "scores", scores.len())?;
                    self.add_mask(phrase, scores, |n| instances[n] == *number);
                }
            }
            Task::Affordances => {
                for (phrase, folder) in &truth.affordances {
                    let Some(scores) = scores(phrase) else { continue };
                    let path = truth.root.join("affordances").join(folder).join(&name);
                    let Some(mask) = labels(&path, frame)? else { continue };
                    check_size(frame, "scores", scores.len())?;
                    self.add_mask(phrase, scores, |n| mask[n] > 127);
                }
            }
        }
        Ok(())
    }

    fn add_mask(&mut self, phrase: &str, scores: &[f32], inside: impl Fn(usize) -> bool) {
        let (mut both, mut any, mut covered) = (0usize, 0usize, 0usize);
        for (n, score) in scores.iter().enumerate() {
            let (found, truth) = (*score > THRESHOLD, inside(n));
            both += usize::from(found && truth);
            any += usize::from(found || truth);
            covered += usize::from(truth);
        }
        if covered >= MIN_PIXELS {
            self.ious.push((phrase.to_owned(), both as f64 / any as f64));
        }
    }

    /// Mean over all objects or regions and frames: the task's measure. `None` where nothing was large enough.
    pub fn mean(&self) -> Option<f64> {
        mean(&self.ious.iter().map(|i| i.1).collect::<Vec<_>>())
    }

    /// Mean over the frames of one phrase.
    pub fn mean_of(&self, phrase: &str) -> Option<f64> {
        mean(&self.ious.iter().filter(|i| i.0 == phrase).map(|i| i.1).collect::<Vec<_>>())
    }

    /// Fills in the task's measure, or why it is absent.
    pub fn fill_in(&self, metrics: &mut Metrics, why: Option<String>) {
        let value = self.mean();
        match self.task {
            Task::Objects => metrics.object_miou = value,
            Task::Affordances => metrics.affordance_miou = value,
        }
        if value.is_none() {
            metrics.absent.insert(self.task.measure().into(), why.unwrap_or_else(|| NOTHING.into()));
        }
    }
}

/// Why a task that was asked has no measure.
pub(crate) const NOTHING: &str = "no true mask of a phrase covers 50 px in a test frame";

/// Labels of a frame, 8 or 16 bits; `None` without such a file.
pub(super) fn labels(path: &Path, frame: &Frame) -> Result<Option<Vec<u32>>, EvalError> {
    if !path.exists() {
        return Ok(None);
    }
    let image = image::open(path).map_err(|source| EvalError::Image { path: path.to_owned(), source })?;
    let labels: Vec<u32> = match image {
        DynamicImage::ImageLuma8(image) => image.into_raw().into_iter().map(u32::from).collect(),
        DynamicImage::ImageLuma16(image) => image.into_raw().into_iter().map(u32::from).collect(),
        other => {
            return Err(EvalError::PixelType { path: path.to_owned(), got: format!("{:?}", other.color()) });
        }
    };
    check_size(frame, "true label image", labels.len())?;
    Ok(Some(labels))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::truth::tests::frame;

    #[test]
    fn only_what_moves_is_an_object_and_phrases_count_once() {
        let text = r#"{"3": {"name": "mug", "stream": "dynamic", "moves": true},
            "12": {"name": "red mug", "query": "mug", "stream": "dynamic", "moves": true},
            "1": {"name": "wall", "stream": "persistent", "moves": false}}"#;
        let found = objects(&serde_json::from_str(text).unwrap()).unwrap();
        assert_eq!(found, [(3, "mug".into()), (12, "mug".into())]);
        let truth = PhraseTruth { objects: found, ..PhraseTruth::default() };
        assert_eq!(truth.phrases(Task::Objects), ["mug"]);
        assert_eq!(objects(&serde_json::json!({"x": {}})), None);
    }

    #[test]
    fn affordances_are_phrases_with_or_without_a_folder() {
        let found = affordances(&serde_json::json!(["wash it", {"phrase": "cut", "slug": "c-u-t"}])).unwrap();
        assert_eq!(found, [("wash it".into(), "wash_it".into()), ("cut".into(), "c-u-t".into())]);
        assert_eq!(affordances(&serde_json::json!([1])), None);
    }

    #[test]
    fn ious_count_masks_of_fifty_pixels_at_one_half() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("instances")).unwrap();
        let f = frame(20, 10);
        // Object 3 covers 60 pixels, object 4 only 40.
        let labels: Vec<u8> = (0..200)
            .map(|n| {
                if n < 60 {
                    3
                } else if n < 100 {
                    4
                } else {
                    0
                }
            })
            .collect();
        let image = image::GrayImage::from_raw(20, 10, labels).unwrap();
        image.save(folder.path().join("instances").join(format!("{}.png", f.stem))).unwrap();
        let truth = PhraseTruth {
            root: folder.path().to_owned(),
            objects: vec![(3, "mug".into()), (4, "pan".into())],
            affordances: vec![],
        };
        // Half of the mug and 10 pixels beside it are found; exactly 0.5 does not count.
        let score = |n: usize| if (30..70).contains(&n) { 0.6 } else { 0.5 };
        let scores: Vec<f32> = (0..200).map(score).collect();
        let mut sums = ScoreSums::new(Task::Objects);
        sums.add(&truth, &f, |_| Some(&scores)).unwrap();
        assert_eq!(sums.mean(), sums.mean_of("mug"), "the pan is too small to count");
        assert_eq!(sums.mean_of("pan"), None);
        let mut metrics = Metrics::default();
        sums.fill_in(&mut metrics, None);
        ScoreSums::new(Task::Affordances).fill_in(&mut metrics, Some("no video features".into()));
        assert!((metrics.object_miou.unwrap() - 30.0 / 70.0).abs() < 1e-12, "{:?}", metrics.object_miou);
        assert_eq!(metrics.absent["affordance_miou"], "no video features");
        assert!(matches!(sums.add(&truth, &f, |_| Some(&[0.0; 3])), Err(EvalError::Size { .. })));
    }
}
