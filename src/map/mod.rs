//! What goes out: the surfaces of all streams with their attributes, and the files that hold them.
//!
//! ```text
//! Scene + Trained ─ views (depth of every training frame) ─ persistent ─┐
//!                 ─ moving (dynamic and actor, per time) ───────────────┼─ SemanticMap ─ simplify ─ write ─ files
//!                                                        points ────────┘
//! ```

mod build;
mod config;
mod error;
mod moving;
mod persistent;
mod place;
mod points;
mod simplify;
#[cfg(test)]
mod skip_tests;
mod surface;
#[cfg(test)]
mod tests;
mod times;
mod views;
mod write;

use std::collections::BTreeMap;

use divff_exporters::manifest::SimplifiedEntry;
use divff_exporters::{Geometry, Interval, UpAxis};
use serde::Serialize;

pub use self::build::{Progress, Stage, build};
pub use self::config::{MapConfig, Simplify, SurfaceMethod, TimePoint, Times};
pub use self::error::MapError;
pub use self::place::default_voxel;
pub use self::simplify::simplify;
pub use self::write::{Format, write};
use crate::field::{Normalisation, Stream};
use crate::work::Work;

/// A scene's map: geometry in world coordinates (minus one common offset), with attributes per vertex.
#[derive(Clone, Debug)]
pub struct SemanticMap {
    /// Meshes, each stored once; all have the same `offset`. Attributes: `confidence` (0–1), `observations` (views that
    /// saw the vertex), `stream` (0 persistent, 1 dynamic, 2 actor).
    pub geometries: Vec<Geometry>,
    /// What there is and when: persistent first, then by stream and time.
    pub objects: Vec<MapObject>,
    /// Area-uniform samples of the persistent surface and of the dynamic one at its first time, with the same columns.
    pub points: Geometry,
    /// What was left out or shared, and why.
    pub skipped: Vec<Skipped>,
    /// Work that was saved, by what saved it.
    pub saved: BTreeMap<&'static str, Work>,
    /// What [`simplify`] did to each geometry.
    pub simplified: Vec<SimplifiedEntry>,
    /// Features that the geometries have.
    pub features: Vec<MapFeatures>,
    /// Phrases of the columns `affordance_<slug>`: slug and phrase.
    pub affordances: Vec<(String, String)>,
    /// Which world axis is up; see `up_is_known`.
    pub up_axis: UpAxis,
    /// Whether the cameras agree on an up axis that glTF can express; otherwise nothing is turned.
    pub up_is_known: bool,
    /// Training units ↔ world.
    pub normalisation: Normalisation,
    /// Side of a voxel, world units.
    pub voxel_size: f64,
    /// Name of the scene.
    pub source_id: String,
    /// Seed of the run.
    pub seed: u64,
    /// Playing time of the animation, seconds.
    pub animation_seconds: f64,
}

/// One object of the map: a stream, at a time if it changes.
#[derive(Clone, Debug, PartialEq)]
pub struct MapObject {
    /// Which stream.
    pub stream: Stream,
    /// `frame_index` of the frame whose time it shows; `None` for what is always there.
    pub frame_index: Option<u32>,
    /// When it is there, in scene time; `None`: always.
    pub interval: Option<Interval>,
    /// Index of its geometry; objects that do not differ share one.
    pub geometry: usize,
}

impl MapObject {
    /// `persistent`, `dynamic_000012`, …: the name in files, and of its files.
    pub fn name(&self) -> String {
        match self.frame_index {
            None => self.stream.name().to_owned(),
            Some(n) => format!("{}_{n:06}", self.stream.name()),
        }
    }
}

/// What a matrix of features is.
#[derive(Clone, Debug, PartialEq)]
pub struct MapFeatures {
    /// As in the geometries: `clip_pca`.
    pub name: String,
    /// Numbers per vertex.
    pub dim: usize,
    /// Model that made the descriptors.
    pub model: String,
    /// Mean `[full]` and basis `[dim, full]` of the linear map that compressed them: x = mean + z · basis.
    pub map: Option<(Vec<f32>, Vec<f32>)>,
}

/// Something that needed no work, or has no result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Skipped {
    /// Object or stage.
    pub what: String,
    /// Why.
    pub why: String,
}
