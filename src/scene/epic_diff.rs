//! EPIC-Diff, the data set of NeuralDiff (Tschernezki et al., 3DV 2021): `meta.json` and `frames/`.
//!
//! `ids_all|train|val|test` are lists of frame ids; `images` (file names in `frames/`), `poses`, `nears` and
//! `fars` are keyed by id. Poses are 3×4 camera-to-world with OpenGL camera axes; `intrinsics` is one 3×3
//! matrix in pixels of the stored images, its principal point counted from the image's corner as COLMAP does.
//! Ids are the video's time axis.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::{Map, Value};

use super::draft::{Draft, DraftFrame, ListedSplit};
use super::error::{Place, SceneError};
use super::json::{self, Fields};
use super::{Camera, header, pose};

/// Whether a JSON object looks like EPIC-Diff's `meta.json`.
pub(crate) fn recognises(map: &Map<String, Value>) -> bool {
    ["poses", "images", "intrinsics"].iter().all(|key| map.contains_key(*key))
}

/// Takes the scene out of the JSON object in `file`; images are in `frames/` beside it.
pub(crate) fn read(file: &Path, map: &Map<String, Value>) -> Result<Draft, SceneError> {
    let top = Fields { path: file, frame: None, map };
    let root = file.parent().unwrap_or(Path::new(".")).to_owned();
    let (poses, images) = (top.object("poses")?, top.object("images")?);
    let intrinsics = read_intrinsics(&top)?;
    let size = stored_size(&top)?;
    let splits = Splits::read(&top)?;
    let ids = match read_ids(&top, "ids_all")? {
        Some(ids) => ids,
        None => poses.keys().map(|key| parse_id(&top, "poses", key)).collect::<Result<_, _>>()?,
    };
    let mut draft = Draft::new(root, file.to_owned());
    for id in ids {
        let key = id.to_string();
        let name = images.get(&key).and_then(Value::as_str).ok_or_else(|| missing(&top, &key, "images"))?;
        let frame = Fields { path: file, frame: Some(name), map };
        let pose = poses.get(&key).ok_or_else(|| missing(&top, name, "poses"))?;
        let image_path = draft.root.join("frames").join(name);
        let [width, height] = match size {
            Some(size) => size,
            None => {
                let header = header::of_frame(file, name, &image_path)?;
                [header.width, header.height]
            }
        };
        draft.frames.push(DraftFrame {
            name: name.to_owned(),
            image_path,
            camera: Camera { width, height, ..intrinsics },
            c2w: pose::from_opengl(frame.matrix_of("poses", pose)?),
            time: None,
            frame_index: Some(id),
            split: splits.of(id),
            depth_path: None,
            mask_path: None,
        });
    }
    draft.reach = median_far(&top);
    Ok(draft)
}

fn missing(top: &Fields, frame: &str, key: &str) -> SceneError {
    SceneError::invalid(
        top.path,
        Place::FrameKey { frame: frame.to_owned(), key: key.to_owned() },
        "there is no entry for the frame",
        "add it or remove the frame's id from `ids_all`",
    )
}

fn read_intrinsics(top: &Fields) -> Result<Camera, SceneError> {
    let rows = top.required("intrinsics")?.as_array().filter(|rows| rows.len() == 3);
    let rows: Option<Vec<[f64; 3]>> = rows.and_then(|rows| rows.iter().map(json::finite_array).collect());
    let k =
        rows.ok_or_else(|| top.invalid("intrinsics", "expected 3×3 finite numbers", "correct the matrix"))?;
    if k[0][1] != 0.0 {
        let what = "a skewed pixel grid";
        let remedy = "undistort the images to square pixels";
        return Err(SceneError::unsupported(top.path, top.place("intrinsics"), what, remedy));
    }
    Ok(Camera {
        width: 0,
        height: 0,
        fx: k[0][0],
        fy: k[1][1],
        cx: k[0][2],
        cy: k[1][2],
        distortion: [0.0; 4],
    })
}

/// Width and height that the intrinsics are for, if the file says so (it does not in the first release).
fn stored_size(top: &Fields) -> Result<Option<[u32; 2]>, SceneError> {
    let pixels = |x: f64| (x.round() >= 1.0 && x < f64::from(u32::MAX)).then(|| x.round() as u32);
    let size = |key: &str| Ok(top.number(key)?.and_then(pixels));
    Ok(size("image_w")?.zip(size("image_h")?).map(|(w, h)| [w, h]))
}

fn parse_id(top: &Fields, key: &str, id: &str) -> Result<u32, SceneError> {
    id.parse().map_err(|_| top.invalid(key, format!("`{id}` is not a frame id"), "ids are whole numbers"))
}

/// A list of ids without repetition, in the file's order.
fn read_ids(top: &Fields, key: &str) -> Result<Option<Vec<u32>>, SceneError> {
    let Some(list) = top.list(key)? else { return Ok(None) };
    let mut seen = BTreeSet::new();
    let mut ids = Vec::with_capacity(list.len());
    for value in list {
        let id = value.as_u64().and_then(|id| u32::try_from(id).ok());
        let id =
            id.ok_or_else(|| top.invalid(key, format!("{value} is not a frame id"), "correct the list"))?;
        if seen.insert(id) {
            ids.push(id);
        }
    }
    Ok(Some(ids))
}

/// The lists `ids_train`, `ids_test`, `ids_val`.
struct Splits {
    train: Option<BTreeSet<u32>>,
    test: Option<BTreeSet<u32>>,
    val: BTreeSet<u32>,
}

impl Splits {
    fn read(top: &Fields) -> Result<Self, SceneError> {
        let ids = |key: &str| Ok(read_ids(top, key)?.map(|ids| ids.into_iter().collect::<BTreeSet<u32>>()));
        Ok(Splits {
            train: ids("ids_train")?,
            test: ids("ids_test")?.filter(|ids| !ids.is_empty()),
            val: ids("ids_val")?.unwrap_or_default(),
        })
    }

    /// As NeuralDiff uses them: trained on `ids_train`, measured on `ids_test`; `ids_val` are in neither,
    /// unless there are no test ids.
    fn of(&self, id: u32) -> Option<ListedSplit> {
        let within = |set: &Option<BTreeSet<u32>>| set.as_ref().is_some_and(|s| s.contains(&id));
        if self.train.is_none() && self.test.is_none() && self.val.is_empty() {
            return None;
        }
        let held_out = match &self.test {
            Some(test) => test.contains(&id),
            None => self.val.contains(&id),
        };
        Some(if held_out {
            ListedSplit::Test
        } else if within(&self.train) || (self.train.is_none() && !self.val.contains(&id)) {
            ListedSplit::Train
        } else {
            ListedSplit::LeftOut
        })
    }
}

/// Median of the frames' far planes: how far off things are, in world units.
fn median_far(top: &Fields) -> Option<f64> {
    let fars = top.map.get("fars")?.as_object()?;
    let mut values: Vec<f64> = fars.values().filter_map(json::finite).filter(|far| *far > 0.0).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
