//! Per-frame features and text embeddings that a scene folder may hold (all optional).
//!
//! [`FeatureStore::open`] looks at the folders once; [`FeatureStore::frame`] gives the features of one frame, which are
//! read when asked for. A frame without a file is normal and gives `None`. A file that contradicts itself or its
//! neighbours is a [`FeatureError`]. A single descriptor that is zero or not finite is left out and listed in
//! [`Descriptors::left_out`]; the rest of its file is used.

mod error;
mod grid;
mod meta;
mod summary;
mod table;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
mod text;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use divff_exporters::{NpyHeader, read_npy, read_npy_header};

pub use error::FeatureError;
pub(crate) use grid::cell;
pub use grid::{Blend, CellGrid, Interpolation, PatchGrid, PatchLayout};
use meta::Meta;
pub use summary::{FeatureKind, FeatureSummary};
pub use table::{Descriptors, Unusable};
pub(crate) use text::normalise;
pub use text::{Space, TextTable, read_embeddings};

use super::{Frame, Scene, SceneError};

/// Levels of a patch pyramid that are looked for.
const MAX_SCALES: usize = 8;
/// Masks of one frame; their indices are kept in 16 bits, one value being "none".
const MAX_MASKS: usize = u16::MAX as usize;

/// One of the folders with a file or more for each frame.
#[derive(Clone, Debug, Default)]
struct Folder {
    path: PathBuf,
    files: BTreeSet<String>,
    meta: Meta,
    /// Width of its descriptors and the file that set it.
    width: Option<(usize, PathBuf)>,
}

/// What features a scene has.
#[derive(Clone, Debug)]
pub struct FeatureStore {
    root: PathBuf,
    language: Folder,
    video: Folder,
    dino: Folder,
    hotspots: Folder,
}

impl FeatureStore {
    /// Lists the feature folders of a scene and reads their `meta.json`.
    ///
    /// The width of each folder's descriptors is what `meta.json` says, else that of the first frame's file.
    ///
    /// # Errors
    /// A `meta.json` is damaged, or a folder cannot be listed.
    pub fn open(scene: &Scene) -> Result<Self, FeatureError> {
        let folder = |name: &str, single: &str| Folder::open(scene.root.join(name), single);
        let mut store = Self {
            root: scene.root.clone(),
            language: folder("language_features", "p0")?,
            video: folder("video_features", "p")?,
            dino: folder("dino_features", "")?,
            hotspots: folder("hotspots", "")?,
        };
        let stems: Vec<&str> = scene.frames.iter().map(|f| f.stem.as_str()).collect();
        let scales: Vec<String> = (0..MAX_SCALES).map(|k| format!("_p{k}")).collect();
        let language: Vec<&str> = ["_f", "_b"].into_iter().chain(scales.iter().map(String::as_str)).collect();
        store.language.settle_width(&stems, &language);
        store.video.settle_width(&stems, &["_p", "_g"]);
        store.dino.settle_width(&stems, &[""]);
        Ok(store)
    }

    /// The features of one frame; nothing is read yet.
    pub fn frame<'a>(&'a self, frame: &'a Frame) -> FrameFeatures<'a> {
        FrameFeatures { store: self, frame }
    }

    /// Numbers per image-language descriptor; `None` if the scene has none.
    pub fn language_dim(&self) -> Option<usize> {
        self.language.width.as_ref().map(|w| w.0)
    }

    /// Numbers per video-language descriptor; `None` if the scene has none.
    pub fn video_dim(&self) -> Option<usize> {
        self.video.width.as_ref().map(|w| w.0)
    }

    /// Numbers per part (DINO) descriptor; `None` if the scene has none.
    pub fn dino_dim(&self) -> Option<usize> {
        self.dino.width.as_ref().map(|w| w.0)
    }

    /// Name of the model that made the features of a space, where `meta.json` says it.
    pub fn model(&self, space: Space) -> Option<&str> {
        match space {
            Space::Clip => self.language.meta.model.as_deref(),
            Space::Egovideo => self.video.meta.model.as_deref(),
        }
    }

    /// The text embeddings of a space that come with the scene.
    ///
    /// # Errors
    /// As [`TextTable::read`]; [`FeatureError::Width`] if they do not fit the features of their space.
    pub fn text(&self, space: Space) -> Result<Option<TextTable>, FeatureError> {
        let Some(text) = TextTable::read(&self.root, space)? else { return Ok(None) };
        let folder = if space == Space::Clip { &self.language } else { &self.video };
        folder.check_width(&text.embeddings.path, text.embeddings.dim)?;
        Ok(Some(text))
    }

    /// What there is, for how many frames, and what is wrong with it; `deep` reads every file to its end.
    pub fn summary(&self, frames: &[Frame], deep: bool) -> FeatureSummary {
        summary::summarise(self, frames, deep)
    }
}

impl Folder {
    fn open(path: PathBuf, single: &str) -> Result<Self, FeatureError> {
        if !path.is_dir() {
            return Ok(Self { path, ..Self::default() });
        }
        let io = |source| FeatureError::Io { path: path.clone(), source };
        let mut files = BTreeSet::new();
        for entry in std::fs::read_dir(&path).map_err(io)? {
            files.insert(entry.map_err(io)?.file_name().to_string_lossy().into_owned());
        }
        let meta = Meta::read(&path, single)?;
        let width = meta.dim.map(|d| (d, meta.path.clone()));
        Ok(Self { path, files, meta, width })
    }

    fn file(&self, stem: &str, part: &str, extension: &str) -> Option<PathBuf> {
        let name = format!("{stem}{part}.{extension}");
        self.files.contains(&name).then(|| self.path.join(name))
    }

    /// Takes the width from the first array that can be read; what is wrong with the others shows when they are.
    fn settle_width(&mut self, stems: &[&str], parts: &[&str]) {
        if self.width.is_some() || self.files.is_empty() {
            return;
        }
        let paths = stems.iter().flat_map(|s| parts.iter().filter_map(|p| self.file(s, p, "npy")));
        let first = paths.into_iter().find_map(|path| {
            let width = *read_npy_header(&path).ok()?.shape.last()?;
            (width > 0).then_some((width, path))
        });
        self.width = first;
    }

    fn check_width(&self, path: &Path, found: usize) -> Result<(), FeatureError> {
        match &self.width {
            Some((expected, set_by)) if *expected != found => Err(FeatureError::Width {
                path: path.to_owned(),
                found,
                expected: *expected,
                set_by: set_by.clone(),
            }),
            _ => Ok(()),
        }
    }

    fn read(&self, path: &Path, dimensions: &[&str]) -> Result<(Vec<usize>, Descriptors), FeatureError> {
        let (lead, descriptors) = Descriptors::read(path, dimensions)?;
        self.check_width(path, descriptors.dim)?;
        Ok((lead, descriptors))
    }

    /// Checks type, shape and width of an array without reading it.
    fn check(&self, path: &Path, dimensions: &[&str]) -> Result<NpyHeader, FeatureError> {
        let header = read_npy_header(path)?;
        table::check_floats(path, &header, dimensions)?;
        self.check_width(path, *header.shape.last().unwrap_or(&0))?;
        Ok(header)
    }
}

/// The masks of a frame (a segmenter's) and their descriptors.
#[derive(Clone, Debug, PartialEq)]
pub struct Masks {
    /// Levels of granularity, at least 1.
    pub levels: usize,
    /// Height of the index map; it covers the image, whose resolution may be another.
    pub height: usize,
    /// Width of the index map.
    pub width: usize,
    /// `[levels, height, width]`: row of `masks`, or [`Masks::NONE`].
    pub index: Vec<u16>,
    /// One descriptor per mask, background masked out.
    pub masks: Descriptors,
    /// One descriptor per mask's bounding box, if the scene has them.
    pub boxes: Option<Descriptors>,
}

impl Masks {
    /// What the index map says where there is no mask.
    pub const NONE: u16 = u16::MAX;

    /// Numbers of the masks that a point of an image of `image_px` is in, one a level at most.
    pub fn at(&self, [x, y]: [f64; 2], image_px: [f64; 2]) -> impl Iterator<Item = usize> + '_ {
        let (col, row) = (cell(x, image_px[0], self.width), cell(y, image_px[1], self.height));
        let plane = self.width * self.height;
        let levels = (0..self.levels).map(move |l| self.index[l * plane + row * self.width + col]);
        levels.filter(|i| *i != Self::NONE).map(usize::from)
    }
}

/// Where the hands and what they handle are in a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Hotspot {
    /// Width; the picture covers the image, whose resolution may be another.
    pub width: usize,
    /// Height.
    pub height: usize,
    /// `[height, width]`.
    pub inside: Vec<bool>,
}

/// The features of one frame, read when asked for.
#[derive(Clone, Copy, Debug)]
pub struct FrameFeatures<'a> {
    store: &'a FeatureStore,
    frame: &'a Frame,
}

impl FrameFeatures<'_> {
    /// `language_features/<stem>_s.npy`, `_f.npy` and, if there, `_b.npy`.
    ///
    /// # Errors
    /// [`FeatureError`]: not readable, shapes that do not fit the image or each other, an index out of range.
    pub fn masks(&self) -> Result<Option<Masks>, FeatureError> {
        let Some([s, f]) = self.mask_files()? else { return Ok(None) };
        let folder = &self.store.language;
        let (_, masks) = folder.read(&f, &["N", "D"])?;
        let boxes = self.language("_b").map(|b| folder.read(&b, &["N", "D"])).transpose()?;
        let boxes = boxes.map(|(_, boxes)| boxes);
        if let Some(boxes) = boxes.as_ref().filter(|b| b.rows() != masks.rows()) {
            return Err(count_differs(&boxes.path, boxes.rows(), masks.rows()));
        }
        let map = read_npy(&s)?;
        let [levels, height, width] = self.check_map(&s, &map.header)?;
        let index = map.to_i64().unwrap_or_default();
        let index = narrow(&index, [levels, height, width], &s, &f, masks.rows())?;
        Ok(Some(Masks { levels, height, width, index, masks, boxes }))
    }

    /// Levels of the patch pyramid that this frame has, as numbers `k` of `_p<k>.npy`.
    pub fn patch_scales(&self) -> Vec<usize> {
        (0..MAX_SCALES).filter(|k| self.language(&format!("_p{k}")).is_some()).collect()
    }

    /// `language_features/<stem>_p<scale>.npy`: one level of the patch pyramid.
    ///
    /// # Errors
    /// [`FeatureError`]: not readable, or of the wrong shape.
    pub fn patches(&self, scale: usize) -> Result<Option<PatchGrid>, FeatureError> {
        let part = format!("_p{scale}");
        self.grid(&self.store.language, &part)
    }

    /// `video_features/<stem>_p.npy`: the patches of the clip around this frame.
    ///
    /// # Errors
    /// [`FeatureError`]: not readable, or of the wrong shape.
    pub fn video_patches(&self) -> Result<Option<PatchGrid>, FeatureError> {
        self.grid(&self.store.video, "_p")
    }

    /// `video_features/<stem>_g.npy`: the clip around this frame as a whole, one row.
    ///
    /// # Errors
    /// [`FeatureError`]: not readable, or of the wrong shape.
    pub fn video_clip(&self) -> Result<Option<Descriptors>, FeatureError> {
        let folder = &self.store.video;
        let Some(path) = folder.file(&self.frame.stem, "_g", "npy") else { return Ok(None) };
        Ok(Some(folder.read(&path, &["D"])?.1))
    }

    /// `dino_features/<stem>.npy`.
    ///
    /// # Errors
    /// [`FeatureError`]: not readable, or of the wrong shape.
    pub fn dino(&self) -> Result<Option<CellGrid>, FeatureError> {
        let folder = &self.store.dino;
        let Some(path) = folder.file(&self.frame.stem, "", "npy") else { return Ok(None) };
        let (lead, descriptors) = folder.read(&path, &["rows", "cols", "D"])?;
        let [rows, cols] = not_empty(&path, &lead)?;
        Ok(Some(CellGrid { rows, cols, descriptors }))
    }

    /// `hotspots/<stem>.png`: inside is what is not black.
    ///
    /// # Errors
    /// [`FeatureError::Scene`] for a damaged picture, [`FeatureError::Shape`] for one of another aspect ratio.
    pub fn hotspot(&self) -> Result<Option<Hotspot>, FeatureError> {
        let Some(path) = self.store.hotspots.file(&self.frame.stem, "", "png") else { return Ok(None) };
        let bytes = std::fs::read(&path).map_err(|e| SceneError::io(&path, e))?;
        let decoded = super::image::decoder(&bytes)
            .and_then(|decoder| image::DynamicImage::from_decoder(decoder).map_err(|e| e.to_string()));
        let picture = decoded.map_err(|e| {
            let what = format!("the hotspot cannot be decoded: {e}");
            SceneError::image(&path, &self.frame.stem, what, "the file is damaged; write it again")
        })?;
        let picture = picture.into_luma8();
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        self.check_aspect(&path, height, width)?;
        Ok(Some(Hotspot { width, height, inside: picture.pixels().map(|p| p.0[0] > 0).collect() }))
    }

    fn language(&self, part: &str) -> Option<PathBuf> {
        self.store.language.file(&self.frame.stem, part, "npy")
    }

    /// The index map and the descriptors of the masks: both or neither.
    fn mask_files(&self) -> Result<Option<[PathBuf; 2]>, FeatureError> {
        let missing = |part: &str| self.store.language.path.join(format!("{}{part}.npy", self.frame.stem));
        match (self.language("_s"), self.language("_f")) {
            (None, None) => Ok(None),
            (Some(s), Some(f)) => Ok(Some([s, f])),
            (Some(path), None) => Err(FeatureError::Companion { path, missing: missing("_f") }),
            (None, Some(path)) => Err(FeatureError::Companion { path, missing: missing("_s") }),
        }
    }

    fn grid(&self, folder: &Folder, part: &str) -> Result<Option<PatchGrid>, FeatureError> {
        let Some(path) = folder.file(&self.frame.stem, part, "npy") else { return Ok(None) };
        let (lead, descriptors) = folder.read(&path, &["rows", "cols", "D"])?;
        let [rows, cols] = not_empty(&path, &lead)?;
        let layout = folder.meta.layout(&part[1..], self.image_px(), cols, rows);
        Ok(Some(PatchGrid { layout, rows, cols, descriptors }))
    }

    /// Size of the frame's image, px.
    pub fn image_px(&self) -> [f64; 2] {
        [self.frame.camera.width, self.frame.camera.height].map(f64::from)
    }

    /// `[levels, height, width]` of an index map.
    fn check_map(&self, path: &Path, header: &NpyHeader) -> Result<[usize; 3], FeatureError> {
        let shape = match header.shape[..] {
            [levels, height, width] if levels > 0 && !header.dtype.is_float() => [levels, height, width],
            _ => {
                return Err(FeatureError::shape(
                    path,
                    format!("{} of shape {:?}", header.dtype.descr(), header.shape),
                    "integers of shape [levels, height, width]",
                    "store the index maps as int32, one level after the other",
                ));
            }
        };
        self.check_aspect(path, shape[1], shape[2])?;
        Ok(shape)
    }

    /// A map may be smaller or larger than the image, but must show the same.
    fn check_aspect(&self, path: &Path, height: usize, width: usize) -> Result<(), FeatureError> {
        let camera = &self.frame.camera;
        let (w, h) = (width as f64, height as f64);
        let (image_w, image_h) = (f64::from(camera.width), f64::from(camera.height));
        // Whole pixels: either side of either picture may have been rounded by up to one.
        let rounding = 1.0 / w.min(image_w) + 1.0 / h.min(image_h);
        if width > 0 && height > 0 && ((w / h) / (image_w / image_h) - 1.0).abs() <= rounding {
            return Ok(());
        }
        Err(FeatureError::shape(
            path,
            format!("{width}×{height}"),
            format!("the image's {}×{} or a scaled version of it", camera.width, camera.height),
            "extract the features from the images of this scene, not from cropped or turned ones",
        ))
    }
}

fn count_differs(path: &Path, found: usize, expected: usize) -> FeatureError {
    FeatureError::shape(
        path,
        format!("{found} rows"),
        format!("{expected}, one for each mask"),
        "extract the frame's masks and boxes together",
    )
}

fn not_empty(path: &Path, lead: &[usize]) -> Result<[usize; 2], FeatureError> {
    match *lead {
        [rows, cols] if rows > 0 && cols > 0 => Ok([rows, cols]),
        _ => Err(FeatureError::shape(
            path,
            format!("a grid of {lead:?}"),
            "at least one row and one column",
            "remove the file or extract the frame again",
        )),
    }
}

/// Checks every index and packs it into 16 bits.
fn narrow(
    index: &[i64],
    [_, height, width]: [usize; 3],
    map: &Path,
    descriptors: &Path,
    masks: usize,
) -> Result<Vec<u16>, FeatureError> {
    if masks > MAX_MASKS {
        let expected = format!("at most {MAX_MASKS}");
        let remedy = "merge masks: this is more than one for every other pixel of a small image";
        return Err(FeatureError::shape(descriptors, format!("{masks} masks"), expected, remedy));
    }
    let pack = |(n, &i): (usize, &i64)| match i {
        -1 => Ok(Masks::NONE),
        i if (0..masks as i64).contains(&i) => Ok(i as u16),
        index => Err(FeatureError::MaskIndex {
            path: map.to_owned(),
            level: n / (height * width),
            y: n / width % height,
            x: n % width,
            index,
            descriptors: descriptors.to_owned(),
            masks,
        }),
    };
    index.iter().enumerate().map(pack).collect()
}
