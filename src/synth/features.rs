//! Surrogate features: what image-language, video-language and part models might say about the pictures, made from
//! the true instances instead. No network is run.
//!
//! The embedding of a phrase is a random unit vector, that of a canonical phrase lies between those: what may be said of
//! anything is a little like all of it. A descriptor of a mask is the embedding of its thing's phrase,
//! a constant vector (the gap between features of images and of texts) and noise, to unit length; descriptors of
//! boxes and of video patches mix what they show by area. In the video space a thing stands for what is done with it.
//! All are half random and half exact: enough to train, ask and measure on, and no claim about real models.

use std::fs;
use std::path::Path;

use divff_exporters::npy::write_npy_i32;
use divff_exporters::write_npy;
use image::ExtendedColorType;
use serde_json::{Value, json};

use super::noise::Rng;
use super::render::Picture;
use super::room::Thing;
use super::write::{png, write_json};
use super::{Kitchen, Shot, SynthError, SynthOptions};
use crate::error::FileError;
use crate::scene::features::{Space, normalise};
use crate::semantics::slug;

/// Numbers per descriptor.
const DIM: usize = 64;
/// Numbers per part feature.
const PARTS: usize = 16;
/// Norms of the gap and of the noise, where the embedding has 1.
const GAP: f32 = 0.6;
const NOISE: f32 = 0.35;
/// Pixels that a segmenter needs to find a mask.
const MIN_PIXELS: f32 = 30.0;
/// Index maps are at most about so wide: they are the largest files.
const MAP_WIDTH: u32 = 80;
/// Video patches along each side: a third of the picture each, half overlapping.
const PATCHES: u32 = 5;
/// Cells of part features across and down.
const CELLS: [u32; 2] = [16, 9];
/// In a mixture small things count more than their area: it is raised to this power.
const AREA_POWER: f32 = 0.7;
/// What is in the hand counts so many times over.
const ACTIVE: f32 = 3.0;
/// Fewer frames all carry features; of more, every second one does.
const FEW_FRAMES: u32 = 60;

/// What can be done in the kitchen, and the queries of the things that it is done with.
const ACTIONS: [(&str, &[&str]); 6] = [
    ("wash a kitchen utensil", &["sink", "faucet"]),
    ("cook food in the pan", &["stove"]),
    ("toast the bread", &["toaster"]),
    ("open the fridge", &["refrigerator"]),
    ("heat up the food", &["microwave oven"]),
    ("read a book", &["book", "bookcase"]),
];

/// Folders that features go to.
pub(super) const FOLDERS: [&str; 5] =
    ["language_features", "video_features", "dino_features", "hotspots", "text"];

/// The embeddings of one space.
struct Embeddings {
    /// Phrases with an embedding, the canonical ones last.
    phrases: Vec<String>,
    /// `[phrases, DIM]`
    rows: Vec<Vec<f32>>,
    /// `[things, DIM]`: what a picture of a thing is like.
    things: Vec<Vec<f32>>,
    gap: Vec<f32>,
}

/// The models that are stood in for.
pub(super) struct Models {
    clip: Embeddings,
    video: Embeddings,
    /// `[things, PARTS]`
    parts: Vec<Vec<f32>>,
    seed: u64,
}

/// A rectangle of pixels: x and y, from and to.
#[derive(Clone, Copy)]
struct Rect {
    x: [u32; 2],
    y: [u32; 2],
}

fn unit(count: usize, rng: &mut Rng) -> Vec<f32> {
    let mut values: Vec<f32> = (0..count).map(|_| rng.range(-1.0, 1.0)).collect();
    normalise(&mut values);
    values
}

/// What lies somewhere between `rows`, and `apart` from them.
fn general(rows: &[Vec<f32>], apart: &[f32], rng: &mut Rng) -> Vec<f32> {
    let mut sum = vec![0.0; DIM];
    for row in rows {
        let share = rng.range(0.0, 1.0);
        sum.iter_mut().zip(row).for_each(|(s, v)| *s += share * v);
    }
    normalise(&mut sum);
    sum.iter_mut().zip(apart).for_each(|(s, v)| *s += v);
    normalise(&mut sum);
    sum
}

impl Embeddings {
    /// `of_thing` is the phrase that a thing is like; without one it is like nothing in particular.
    fn new(
        space: Space,
        mut phrases: Vec<String>,
        of_thing: impl Fn(&Thing) -> Option<String>,
        things: &[Thing],
        rng: &mut Rng,
    ) -> Self {
        let mut rows: Vec<Vec<f32>> = phrases.iter().map(|_| unit(DIM, rng)).collect();
        let mut like = |thing: &Thing| {
            let named = of_thing(thing).and_then(|phrase| phrases.iter().position(|p| *p == phrase));
            named.map_or_else(|| general(&rows, &unit(DIM, rng), rng), |row| rows[row].clone())
        };
        let things = things.iter().map(&mut like).collect();
        let canonical = space.canonical_phrases();
        let between: Vec<_> = canonical.iter().map(|_| general(&rows, &[0.0; DIM], rng)).collect();
        rows.extend(between);
        phrases.extend(canonical.iter().map(|p| (*p).to_owned()));
        let gap = unit(DIM, rng);
        Self { phrases, rows, things, gap }
    }

    /// A descriptor of something that shows each thing with some weight; all weights zero are nothing at all.
    fn descriptor(&self, weights: &[f32], rng: &mut Rng) -> Vec<f32> {
        let mut sum = vec![0.0; DIM];
        for (weight, thing) in weights.iter().zip(&self.things) {
            sum.iter_mut().zip(thing).for_each(|(s, t)| *s += weight * t);
        }
        normalise(&mut sum);
        let noise = unit(DIM, rng);
        for k in 0..DIM {
            sum[k] += GAP * self.gap[k] + NOISE * noise[k];
        }
        normalise(&mut sum);
        sum
    }

    fn write(&self, out: &Path, space: Space) -> Result<(), SynthError> {
        let folder = out.join("text");
        let list = self.phrases.join("\n") + "\n";
        let path = folder.join(format!("{}.txt", space.name()));
        fs::write(&path, list).map_err(FileError::at(&path))?;
        let path = folder.join(format!("{}.npy", space.name()));
        Ok(write_npy(&path, &[self.rows.len(), DIM], &self.rows.concat())?)
    }
}

impl Models {
    pub(super) fn new(kitchen: &Kitchen, seed: u64) -> Self {
        let mut rng = Rng::new(seed ^ 0x66_65_61_74);
        let things = kitchen.things();
        // What moves first: that is what people ask for, and a map has columns for the first phrases only.
        let mut named: Vec<&Thing> = things.iter().collect();
        named.sort_by_key(|t| !t.moves);
        let mut queries: Vec<String> = Vec::new();
        for thing in named {
            if !queries.iter().any(|q| q == thing.query) {
                queries.push(thing.query.to_owned());
            }
        }
        let query = |t: &Thing| Some(t.query.to_owned());
        let clip = Embeddings::new(Space::Clip, queries, query, &things, &mut rng);
        let actions = ACTIONS.iter().map(|a| a.0.to_owned()).collect();
        let video = Embeddings::new(Space::Egovideo, actions, action, &things, &mut rng);
        let parts = things.iter().map(|_| unit(PARTS, &mut rng)).collect();
        Self { clip, video, parts, seed }
    }

    /// Everything about one frame; what the instances are is true.
    pub(super) fn frame(&self, shot: &Shot, kitchen: &Kitchen) -> Result<(), SynthError> {
        let Shot { out, options, frame, picture } = shot;
        if !has_features(options, *frame) {
            return Ok(());
        }
        let mut rng = Rng::new(self.seed ^ (u64::from(*frame) << 32) ^ 0x64_65_73_63);
        let view = View { picture, width: options.width, height: options.height, things: self.parts.len() };
        let stem = format!("{frame:06}");
        self.masks(&out.join("language_features"), &stem, &view, &mut rng)?;
        let held = kitchen.story.carried(options.time(*frame) as f32).map(|prop| kitchen.prop_instance(prop));
        self.patches(&out.join("video_features"), &stem, &view, held, &mut rng)?;
        self.cells(&out.join("dino_features"), &stem, &view, &mut rng)?;
        let hands = (1..=2).map(|n| kitchen.prop_instance(kitchen.props.len()) + n - 1);
        hotspot(&out.join("hotspots").join(format!("{stem}.png")), &view, hands.chain(held))
    }

    /// The index map, and the descriptors of masks and boxes.
    fn masks(&self, folder: &Path, stem: &str, view: &View, rng: &mut Rng) -> Result<(), SynthError> {
        let areas = view.areas(view.all());
        let (mut row_of, mut masks, mut boxes) = (vec![-1; areas.len()], Vec::new(), Vec::new());
        for (thing, _) in areas.iter().enumerate().filter(|a| *a.1 >= MIN_PIXELS) {
            row_of[thing] = (masks.len() / DIM) as i32;
            let alone: Vec<f32> = (0..areas.len()).map(|n| f32::from(u8::from(n == thing))).collect();
            masks.extend(self.clip.descriptor(&alone, rng));
            boxes.extend(self.clip.descriptor(&view.areas(view.bounds(thing)), rng));
        }
        if masks.is_empty() {
            return Ok(());
        }
        let (shape, map) = view.reduced(|thing| thing.map_or(-1, |t| row_of[t]));
        let file = |part: &str| folder.join(format!("{stem}_{part}.npy"));
        write_npy_i32(&file("s"), &[1, shape[0], shape[1]], &map)?;
        write_npy(&file("f"), &[masks.len() / DIM, DIM], &masks)?;
        Ok(write_npy(&file("b"), &[boxes.len() / DIM, DIM], &boxes)?)
    }

    /// The patches of the clip, and the clip as a whole.
    fn patches(
        &self,
        folder: &Path,
        stem: &str,
        view: &View,
        held: Option<u16>,
        rng: &mut Rng,
    ) -> Result<(), SynthError> {
        let mut describe = |rect: Rect| {
            let mut weights = view.areas(rect);
            weights.iter_mut().for_each(|w| *w = w.powf(AREA_POWER));
            if let Some(held) = held {
                weights[usize::from(held) - 1] *= ACTIVE;
            }
            self.video.descriptor(&weights, rng)
        };
        let mut patches = Vec::new();
        for (row, col) in (0..PATCHES).flat_map(|row| (0..PATCHES).map(move |col| (row, col))) {
            let third = |n: u32, size: u32| [n * size / 6, ((n + 2) * size / 6).max(n * size / 6 + 1)];
            patches.extend(describe(Rect { x: third(col, view.width), y: third(row, view.height) }));
        }
        let side = PATCHES as usize;
        write_npy(&folder.join(format!("{stem}_p.npy")), &[side, side, DIM], &patches)?;
        Ok(write_npy(&folder.join(format!("{stem}_g.npy")), &[DIM], &describe(view.all()))?)
    }

    /// Part features: a code for each thing, and noise.
    fn cells(&self, folder: &Path, stem: &str, view: &View, rng: &mut Rng) -> Result<(), SynthError> {
        let [cols, rows] = CELLS;
        let mut values = Vec::new();
        for (row, col) in (0..rows).flat_map(|row| (0..cols).map(move |col| (row, col))) {
            let middle = |n: u32, of: u32, size: u32| (2 * n + 1) * size / (2 * of);
            let thing = view.thing(middle(col, cols, view.width), middle(row, rows, view.height));
            let noise = unit(PARTS, rng);
            let code = |k: usize| thing.map_or(0.0, |t| self.parts[t][k]) + NOISE * noise[k];
            values.extend((0..PARTS).map(code));
        }
        let shape = [rows as usize, cols as usize, PARTS];
        Ok(write_npy(&folder.join(format!("{stem}.npy")), &shape, &values)?)
    }

    /// Text embeddings, and what made the features.
    pub(super) fn descriptions(&self, out: &Path, options: &SynthOptions) -> Result<(), SynthError> {
        self.clip.write(out, Space::Clip)?;
        self.video.write(out, Space::Egovideo)?;
        let size = [options.width, options.height];
        let model = "divff synth (surrogate)";
        let patches = json!({
            "size_px": size.map(|s| f64::from(s) / 3.0), "stride_px": size.map(|s| f64::from(s) / 6.0),
            "origin_px": [0, 0],
        });
        let language = json!({ "model": model, "dim": DIM, "image_size": size });
        write_json(&out.join("language_features/meta.json"), &language)?;
        let video = json!({ "model": model, "dim": DIM, "image_size": size, "patches": patches });
        write_json(&out.join("video_features/meta.json"), &video)?;
        write_json(&out.join("dino_features/meta.json"), &json!({ "model": model, "dim": PARTS }))
    }
}

/// Features are on training frames, as those of a video are.
fn has_features(options: &SynthOptions, frame: u32) -> bool {
    let stride = if options.frames < FEW_FRAMES { 1 } else { 2 };
    frame.is_multiple_of(stride) && !options.is_test(frame)
}

fn action(thing: &Thing) -> Option<String> {
    ACTIONS.iter().find(|a| a.1.contains(&thing.query)).map(|a| a.0.to_owned())
}

/// True regions of the actions in a test frame: `gt/affordances/<slug>/<stem>.png`.
pub(super) fn affordance_masks(shot: &Shot, things: &[Thing]) -> Result<(), SynthError> {
    let Shot { out, options, frame, picture } = shot;
    for (phrase, queries) in ACTIONS {
        let inside = |i: &u16| *i > 0 && queries.contains(&things[usize::from(*i) - 1].query);
        let mask: Vec<u8> = picture.instance.iter().map(|i| 255 * u8::from(inside(i))).collect();
        if mask.contains(&255) {
            let path = out.join("gt/affordances").join(slug(phrase)).join(format!("{frame:06}.png"));
            png(&path, &mask, (options.width, options.height), ExtendedColorType::L8)?;
        }
    }
    Ok(())
}

/// Folders of the regions.
pub(super) fn affordance_folders() -> impl Iterator<Item = String> {
    ACTIONS.iter().map(|a| format!("gt/affordances/{}", slug(a.0)))
}

/// `gt/affordances.json`.
pub(super) fn affordances(things: &[Thing]) -> Value {
    let one = |(phrase, queries): &(&str, &[&str])| {
        let number = |(n, t): (usize, &Thing)| queries.contains(&t.query).then_some(n + 1);
        let instances: Vec<usize> = things.iter().enumerate().filter_map(number).collect();
        json!({ "slug": slug(phrase), "phrase": phrase, "instances": instances })
    };
    ACTIONS.iter().map(one).collect()
}

/// A hand-object detector's boxes: what is in the hand, and the hands.
fn hotspot(path: &Path, view: &View, instances: impl Iterator<Item = u16>) -> Result<(), SynthError> {
    let things: Vec<usize> = instances.map(|i| usize::from(i) - 1).collect();
    let boxes: Vec<Rect> = things.iter().map(|t| view.bounds(*t)).filter(|b| b.x[0] < b.x[1]).collect();
    if boxes.is_empty() {
        return Ok(());
    }
    let covers = |x, y| boxes.iter().any(|b| (b.x[0]..b.x[1]).contains(&x) && (b.y[0]..b.y[1]).contains(&y));
    let pixels = (0..view.height).flat_map(|y| (0..view.width).map(move |x| (x, y)));
    let pixels: Vec<u8> = pixels.map(|(x, y)| 255 * u8::from(covers(x, y))).collect();
    png(path, &pixels, (view.width, view.height), ExtendedColorType::L8)
}

/// A picture's instances.
struct View<'a> {
    picture: &'a Picture,
    width: u32,
    height: u32,
    things: usize,
}

impl View<'_> {
    /// The thing at a pixel, instance number minus one.
    fn thing(&self, x: u32, y: u32) -> Option<usize> {
        usize::from(self.picture.instance[(y * self.width + x) as usize]).checked_sub(1)
    }

    fn all(&self) -> Rect {
        Rect { x: [0, self.width], y: [0, self.height] }
    }

    /// Pixels of each thing in a rectangle.
    fn areas(&self, rect: Rect) -> Vec<f32> {
        let mut areas = vec![0.0; self.things];
        for (x, y) in (rect.y[0]..rect.y[1]).flat_map(|y| (rect.x[0]..rect.x[1]).map(move |x| (x, y))) {
            if let Some(thing) = self.thing(x, y) {
                areas[thing] += 1.0;
            }
        }
        areas
    }

    /// The box around a thing; empty where it is not seen.
    fn bounds(&self, thing: usize) -> Rect {
        let mut rect = Rect { x: [self.width, 0], y: [self.height, 0] };
        for (x, y) in (0..self.height).flat_map(|y| (0..self.width).map(move |x| (x, y))) {
            if self.thing(x, y) == Some(thing) {
                rect.x = [rect.x[0].min(x), rect.x[1].max(x + 1)];
                rect.y = [rect.y[0].min(y), rect.y[1].max(y + 1)];
            }
        }
        rect
    }

    /// Height and width of a smaller picture, and the nearest pixel of each of its own.
    fn reduced(&self, value: impl Fn(Option<usize>) -> i32) -> ([usize; 2], Vec<i32>) {
        let by = (self.width / MAP_WIDTH).max(1);
        let [height, width] = [self.height, self.width].map(|s| s.div_ceil(by));
        let at = |n: u32, size: u32| (n * by + by / 2).min(size - 1);
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let map = pixels.map(|(x, y)| value(self.thing(at(x, self.width), at(y, self.height)))).collect();
        ([height as usize, width as usize], map)
    }
}
