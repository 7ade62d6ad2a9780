//! What a detector found in rendered test views: boxes or masks per phrase, from a file in COCO's form.
//!
//! ```json
//! {"info": {"description": "OWL-ViT"},
//!  "images": [{"id": 1, "file_name": "000004.png", "width": 228, "height": 128}],
//!  "categories": [{"id": 1, "name": "mug"}],
//!  "annotations": [{"image_id": 1, "category_id": 1, "bbox": [12.5, 30, 41, 28.5], "score": 0.8}]}
//! ```
//!
//! `images` lists every test frame, `categories` every phrase of objects, of affordances or of both: what is listed was
//! asked, and where it has no annotation nothing was found. `bbox` is x, y, width, height in pixels from the image's
//! upper left corner. `segmentation`, where there is one, wins over the box: run lengths as COCO's own tools write them,
//! `{"size": [height, width], "counts": …}` down the columns, as numbers or packed into a string. A pixel's score is the
//! best `score` (1 where none is given) of what covers its centre, and 0 elsewhere; it is measured as a field's is.

mod runs;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use self::runs::{Counts, Runs};
use super::{EvalError, PhraseTruth, ScoreSums, Task};
use crate::scene::{Frame, Scene, Split};

/// Why detections cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DetectionError {
    /// The file cannot be read.
    #[error("{}: {source}; name a JSON file of detections", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Not JSON, or not in COCO's form.
    #[error("{}: {source}; write it as COCO does: images, categories, annotations", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// What the parser says, with line and column.
        source: serde_json::Error,
    },
    /// What it says cannot be.
    #[error("{}: {place}: {what}; {remedy}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Which entry.
        place: String,
        /// What is wrong with it.
        what: String,
        /// What to do.
        remedy: &'static str,
    },
}

/// What a detector was asked and what it found.
#[derive(Clone, Debug, PartialEq)]
pub struct Detections {
    /// `info.description`, or the file's name.
    pub name: String,
    /// Whether any detection has a mask; all are boxes otherwise.
    pub masks: bool,
    /// Phrases that it was asked, as the truth spells them.
    phrases: Vec<String>,
    /// By stem of the frame.
    found: BTreeMap<String, Vec<Detection>>,
}

#[derive(Clone, Debug, PartialEq)]
struct Detection {
    phrase: usize,
    score: f32,
    region: Region,
}

/// Pixels that a detection covers.
#[derive(Clone, Debug, PartialEq)]
enum Region {
    /// Left, top, right, bottom, px; a pixel is inside where its centre is.
    Box([f64; 4]),
    Mask(Runs),
}

#[derive(Deserialize)]
struct File {
    #[serde(default)]
    info: Info,
    images: Vec<Image>,
    categories: Vec<Category>,
    annotations: Vec<Annotation>,
}

#[derive(Default, Deserialize)]
struct Info {
    description: Option<String>,
}

#[derive(Deserialize)]
struct Image {
    id: u64,
    file_name: String,
    width: u32,
    height: u32,
}

#[derive(Deserialize)]
struct Category {
    id: u64,
    name: String,
}

#[derive(Deserialize)]
struct Annotation {
    image_id: u64,
    category_id: u64,
    bbox: Option<[f64; 4]>,
    segmentation: Option<Segmentation>,
    score: Option<f64>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Segmentation {
    Runs { size: [u32; 2], counts: Counts },
    Other(serde_json::Value),
}

impl Detections {
    /// Reads a file of detections in the test frames of `scene`, for the phrases of `truth`.
    ///
    /// # Errors
    /// [`DetectionError`]: no such file, not JSON, a frame or a phrase that the scene does not have or that is missing, an
    /// image or a mask of another size than the frame, a box outside it, a score that is not 0 to 1.
    pub fn read(path: &Path, scene: &Scene, truth: &PhraseTruth) -> Result<Self, DetectionError> {
        let bytes =
            std::fs::read(path).map_err(|source| DetectionError::Io { path: path.to_owned(), source })?;
        let file: File = serde_json::from_slice(&bytes)
            .map_err(|source| DetectionError::Json { path: path.to_owned(), source })?;
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let reader = Reader { path, scene, truth };
        let frames = reader.frames(&file.images)?;
        let (phrases, categories) = reader.phrases(&file.categories)?;
        let mut found: BTreeMap<String, Vec<Detection>> =
            frames.values().map(|f| (f.stem.clone(), Vec::new())).collect();
        for (n, annotation) in file.annotations.iter().enumerate() {
            let place = format!("annotations[{n}]");
            let Some(frame) = frames.get(&annotation.image_id) else {
                let what = format!("its image_id {} is not in images", annotation.image_id);
                return Err(reader.invalid(place, what, "list the image, or leave the annotation out"));
            };
            let Some(phrase) = categories.get(&annotation.category_id) else {
                let what = format!("its category_id {} is not in categories", annotation.category_id);
                return Err(reader.invalid(place, what, "list the category, or leave the annotation out"));
            };
            let (score, region) =
                (reader.score(&place, annotation)?, reader.region(&place, annotation, frame)?);
            found.entry(frame.stem.clone()).or_default().push(Detection { phrase: *phrase, score, region });
        }
        let masks = found.values().flatten().any(|d| matches!(d.region, Region::Mask(_)));
        Ok(Self { name: file.info.description.unwrap_or(stem), masks, phrases, found })
    }

    /// The detector's name and what it gives, for a table.
    pub fn method(&self) -> String {
        format!("{} ({})", self.name, if self.masks { "2D masks" } else { "2D boxes" })
    }

    /// Whether the phrases of a task were asked.
    pub fn asks(&self, task: Task, truth: &PhraseTruth) -> bool {
        let phrases = truth.phrases(task);
        !phrases.is_empty() && phrases.iter().all(|p| self.phrases.contains(p))
    }

    /// The score of a phrase at every pixel of a frame, `[height * width]`; `None` if it was not asked there.
    pub fn scores(&self, frame: &Frame, phrase: &str) -> Option<Vec<f32>> {
        let wanted = self.phrases.iter().position(|p| p == phrase)?;
        let found = self.found.get(&frame.stem)?;
        let (width, height) = (frame.camera.width as usize, frame.camera.height as usize);
        let mut scores = vec![0.0f32; width * height];
        for detection in found.iter().filter(|d| d.phrase == wanted) {
            detection.region.visit(width, height, |pixel| {
                scores[pixel] = scores[pixel].max(detection.score);
            });
        }
        Some(scores)
    }

    /// Compares what was found with the truth, over the test frames, by the rule for fields.
    ///
    /// # Errors
    /// Truth that cannot be read, or of another size than its frame.
    pub fn measure(&self, scene: &Scene, truth: &PhraseTruth, task: Task) -> Result<ScoreSums, EvalError> {
        let mut sums = ScoreSums::new(task);
        let phrases = truth.phrases(task);
        for frame in scene.frames.iter().filter(|f| f.split == Split::Test) {
            let scores: BTreeMap<&str, Vec<f32>> =
                phrases.iter().filter_map(|p| Some((p.as_str(), self.scores(frame, p)?))).collect();
            sums.add(truth, frame, |phrase| scores.get(phrase).map(Vec::as_slice))?;
        }
        Ok(sums)
    }
}

impl Region {
    fn visit(&self, width: usize, height: usize, mut visit: impl FnMut(usize)) {
        match self {
            Self::Box([left, top, right, bottom]) => {
                // The first pixel whose centre is not before the edge.
                let first = |edge: f64, size: usize| (edge - 0.5).ceil().clamp(0.0, size as f64) as usize;
                for y in first(*top, height)..first(*bottom, height) {
                    (first(*left, width)..first(*right, width)).for_each(|x| visit(y * width + x));
                }
            }
            Self::Mask(runs) => {
                runs.inside().for_each(|n| visit(n % height * width + n / height));
            }
        }
    }
}

/// Checks the parts of a file.
struct Reader<'a> {
    path: &'a Path,
    scene: &'a Scene,
    truth: &'a PhraseTruth,
}

impl<'a> Reader<'a> {
    fn invalid(&self, place: String, what: String, remedy: &'static str) -> DetectionError {
        DetectionError::Invalid { path: self.path.to_owned(), place, what, remedy }
    }

    /// The test frames by the file's numbers; all of them must be there.
    fn frames(&self, images: &[Image]) -> Result<BTreeMap<u64, &'a Frame>, DetectionError> {
        let test = || self.scene.frames.iter().filter(|f| f.split == Split::Test);
        let mut frames = BTreeMap::new();
        for (n, image) in images.iter().enumerate() {
            let place = || format!("images[{n}] ({})", image.file_name);
            let stem = Path::new(&image.file_name).file_stem().unwrap_or_default().to_string_lossy();
            let Some(frame) = test().find(|f| f.stem == stem) else {
                let what = "the scene has no test frame of this name".into();
                return Err(self.invalid(place(), what, "use the pictures of `divff render --split test`"));
            };
            let (width, height) = (frame.camera.width, frame.camera.height);
            if [image.width, image.height] != [width, height] {
                let what =
                    format!("it is {} x {} px, the frame {width} x {height}", image.width, image.height);
                return Err(self.invalid(place(), what, "detect in pictures of the frame's size"));
            }
            if frames.insert(image.id, frame).is_some() {
                let what = format!("the id {} is there twice", image.id);
                return Err(self.invalid(place(), what, "number the images differently"));
            }
        }
        match test().find(|f| frames.values().all(|g| g.stem != f.stem)) {
            Some(frame) => {
                let what = format!("the test frame {} is missing", frame.stem);
                Err(self.invalid(
                    "images".into(),
                    what,
                    "list every test frame, also those with nothing in them",
                ))
            }
            None => Ok(frames),
        }
    }

    /// The phrases, and which of them the file's numbers are; none or all of a task must be there.
    fn phrases(
        &self,
        categories: &[Category],
    ) -> Result<(Vec<String>, BTreeMap<u64, usize>), DetectionError> {
        let known: Vec<String> = Task::ALL.into_iter().flat_map(|t| self.truth.phrases(t)).collect();
        let plain = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
        let (mut phrases, mut numbers) = (Vec::new(), BTreeMap::new());
        for (n, category) in categories.iter().enumerate() {
            let place = || format!("categories[{n}] ({})", category.name);
            let Some(phrase) = known.iter().find(|p| plain(p) == plain(&category.name)) else {
                let what = format!("the scene's truth has no such phrase; it has {}", known.join(", "));
                return Err(self.invalid(place(), what, "ask for the scene's phrases"));
            };
            if numbers.insert(category.id, phrases.len()).is_some() || phrases.contains(phrase) {
                let what = format!("the phrase or the id {} is there twice", category.id);
                return Err(self.invalid(place(), what, "list every phrase once"));
            }
            phrases.push(phrase.clone());
        }
        for task in Task::ALL {
            let asked = self.truth.phrases(task);
            let missing = asked.iter().find(|p| !phrases.contains(p));
            // A phrase of both tasks does not make a file about one of them a file about the other.
            let other: Vec<String> =
                Task::ALL.into_iter().filter(|t| *t != task).flat_map(|t| self.truth.phrases(t)).collect();
            let own = asked.iter().any(|p| phrases.contains(p) && !other.contains(p));
            if let (true, Some(missing)) = (own, missing) {
                let what = format!("the phrase \"{missing}\" is missing");
                return Err(self.invalid("categories".into(), what, "list all phrases of a table, or none"));
            }
        }
        match phrases.is_empty() {
            true => Err(self.invalid("categories".into(), "there are none".into(), "list the phrases asked")),
            false => Ok((phrases, numbers)),
        }
    }

    fn score(&self, place: &str, annotation: &Annotation) -> Result<f32, DetectionError> {
        let score = annotation.score.unwrap_or(1.0);
        if !(0.0..=1.0).contains(&score) {
            let what = format!("its score is {score}");
            return Err(self.invalid(place.to_owned(), what, "give a score from 0 to 1, or none"));
        }
        Ok(score as f32)
    }

    fn region(&self, place: &str, annotation: &Annotation, frame: &Frame) -> Result<Region, DetectionError> {
        let (width, height) = (frame.camera.width, frame.camera.height);
        let invalid = |what: String, remedy| Err(self.invalid(place.to_owned(), what, remedy));
        match &annotation.segmentation {
            Some(Segmentation::Runs { size, .. }) if *size != [height, width] => invalid(
                format!("its mask is {} x {} px, the frame {width} x {height}", size[1], size[0]),
                "give size as [height, width] of the frame",
            ),
            Some(Segmentation::Runs { counts, .. }) => {
                match Runs::new(counts, u64::from(width) * u64::from(height)) {
                    Ok(runs) => Ok(Region::Mask(runs)),
                    Err(what) => invalid(what, "write the mask with COCO's mask tools"),
                }
            }
            // What some tools write where there is no mask.
            Some(Segmentation::Other(value)) if value.as_array().is_none_or(|a| !a.is_empty()) => invalid(
                "its segmentation is not {\"size\", \"counts\"}".into(),
                "write masks as run lengths; COCO's mask tools make them from polygons",
            ),
            _ => match annotation.bbox {
                None => invalid("it has neither a bbox nor a mask".into(), "give one of them"),
                Some([x, y, w, h]) => {
                    let (right, bottom) = (x + w, y + h);
                    let sound = [x, y, right, bottom].iter().all(|v| v.is_finite()) && w >= 0.0 && h >= 0.0;
                    let touches = right > 0.0 && bottom > 0.0 && x < width.into() && y < height.into();
                    match sound && touches {
                        true => Ok(Region::Box([x, y, right, bottom])),
                        false => invalid(
                            format!(
                                "its box {:?} is outside the {width} x {height} px of the frame",
                                [x, y, w, h]
                            ),
                            "give a bbox as x, y, width, height in pixels",
                        ),
                    }
                }
            },
        }
    }
}
