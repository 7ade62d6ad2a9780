//! `meta.json` of a feature folder: the model, the width of its descriptors, and where patches lie.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::error::FeatureError;
use super::grid::PatchLayout;
use crate::scene::SceneError;
use crate::scene::error::Place;
use crate::scene::json;

/// What a `meta.json` says. All of it is optional; keys that are not known are ignored.
#[derive(Clone, Debug, Default)]
pub(super) struct Meta {
    pub path: PathBuf,
    /// Name of the model.
    pub model: Option<String>,
    /// Numbers per descriptor.
    pub dim: Option<usize>,
    /// Size of the images that the features were made from, px.
    image_px: Option<[f64; 2]>,
    /// Patches by the part of the file's name that they are stored under.
    patches: Vec<(String, Patches)>,
}

#[derive(Clone, Copy, Debug)]
struct Patches {
    size_px: [f64; 2],
    stride_px: [f64; 2],
    origin_px: [f64; 2],
}

impl Meta {
    /// Reads `meta.json` of a folder; without one, nothing is known.
    ///
    /// `single` is the part of the name that `patches` belongs to where it is one object and not a list.
    pub fn read(folder: &Path, single: &str) -> Result<Self, FeatureError> {
        let path = folder.join("meta.json");
        if !path.is_file() {
            return Ok(Self { path, ..Self::default() });
        }
        let map = json::read_object(&path)?;
        let fields = json::Fields { path: &path, frame: None, map: &map };
        let model = fields.text("model")?.map(str::to_owned);
        let dim = fields.whole("dim")?.map(|d| d as usize);
        if dim == Some(0) {
            return Err(fields.invalid("dim", "0 numbers are no descriptor", "correct it").into());
        }
        let image_px = map.get("image_size").map(|v| pair(&path, "image_size", v)).transpose()?;
        let patches = match map.get("patches") {
            Some(Value::Array(list)) => list
                .iter()
                .filter_map(|item| {
                    let item = item.as_object()?;
                    let file = item.get("file")?.as_str()?.to_owned();
                    Some(Patches::read(&path, item).map(|p| (file, p)))
                })
                .collect::<Result<_, _>>()?,
            Some(Value::Object(one)) => vec![(single.to_owned(), Patches::read(&path, one)?)],
            _ => Vec::new(),
        };
        Ok(Self { path, model, dim, image_px, patches })
    }

    /// Where the patches of `part` are in an image; assumed to overlap by half and cover it where nothing is said.
    pub fn layout(&self, part: &str, image_px: [f64; 2], cols: usize, rows: usize) -> PatchLayout {
        match self.patches.iter().find(|(name, _)| name == part) {
            Some((_, p)) => PatchLayout {
                size_px: p.size_px,
                stride_px: p.stride_px,
                origin_px: p.origin_px,
                image_px: self.image_px.unwrap_or(image_px),
            },
            None => PatchLayout::covering(image_px, cols, rows),
        }
    }

    /// Whether it says where the patches of `part` are.
    pub fn knows(&self, part: &str) -> bool {
        self.patches.iter().any(|(name, _)| name == part)
    }
}

impl Patches {
    fn read(path: &Path, map: &Map<String, Value>) -> Result<Self, FeatureError> {
        let get = |key: &str| {
            let at = format!("patches.{key}");
            map.get(key).map(|v| pair_or_number(path, &at, v)).transpose()
        };
        let required = |key: &str| {
            get(key)?.ok_or_else(|| invalid(path, &format!("patches.{key}"), "the key is missing"))
        };
        let (size_px, stride_px) = (required("size_px")?, required("stride_px")?);
        Ok(Self { size_px, stride_px, origin_px: origin(path, map)? })
    }
}

fn origin(path: &Path, map: &Map<String, Value>) -> Result<[f64; 2], FeatureError> {
    let Some(value) = map.get("origin_px") else { return Ok([0.0; 2]) };
    json::finite_array(value).ok_or_else(|| invalid(path, "patches.origin_px", "expected two numbers"))
}

fn pair_or_number(path: &Path, key: &str, value: &Value) -> Result<[f64; 2], FeatureError> {
    match json::finite(value) {
        Some(x) if x > 0.0 => Ok([x, x]),
        _ => pair(path, key, value),
    }
}

fn pair(path: &Path, key: &str, value: &Value) -> Result<[f64; 2], FeatureError> {
    json::finite_array::<2>(value)
        .filter(|p| p.iter().all(|x| *x > 0.0))
        .ok_or_else(|| invalid(path, key, "expected numbers of pixels above 0"))
}

fn invalid(path: &Path, key: &str, what: &str) -> FeatureError {
    SceneError::invalid(path, Place::Key(key.to_owned()), what, "correct it, or remove the file").into()
}
