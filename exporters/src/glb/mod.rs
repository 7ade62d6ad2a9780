//! GLB: glTF 2.0 in one binary file, restricted to what Blender, trimesh and the web agree on
//! (`docs/formats.md`).
//!
//! - Y up; a Z-up world is stored as (x, z, -y), which Blender turns back into the original numbers.
//! - `COLOR_0` is linear RGBA, normalised u16 or f32; no material unless asked for.
//! - Attributes are `_NAME` SCALAR f32: Blender needs one shape and type for all custom attributes of a mesh.
//! - Features go to a second mesh `<name>_features` as `_<FEATURE>_000` VEC4 f32, if asked for.
//! - What glTF has no place for is in `extras`: offset, up axis, integer attribute types, streams and times.

mod animation;
mod color;
mod container;
mod document;
mod read;
mod write;

use serde_json::{Map, Value};

use crate::axes::UpAxis;
use crate::geometry::Geometry;

pub use read::{GlbContents, read_glb};
pub use write::{write_glb, write_scene_glb};

/// Choices for a GLB file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbOptions {
    /// The world's up axis.
    pub up_axis: UpAxis,
    /// Give every mesh an unlit material, so that viewers show the colours without shading.
    pub unlit: bool,
    /// Write the features too, four dimensions per attribute, on meshes of their own.
    pub features: bool,
    /// Store colours as f32 instead of normalised u16: twice the bytes, but trimesh 5.2 keeps only the low
    /// byte of a u16 and shows noise.
    pub float_colors: bool,
    /// Custom properties of the glTF scene, e.g. units and source.
    pub extras: Map<String, Value>,
}

/// When something exists, in scene time (0 to 1 over the video): `time_start <= t < time_end`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// First time.
    pub time_start: f64,
    /// Time from which it is gone; the interval that ends last stays.
    pub time_end: f64,
}

/// A named object of a GLB scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbNode {
    /// Name, e.g. `persistent` or `dynamic_000012`.
    pub name: String,
    /// Index of its geometry; several nodes may share one.
    pub geometry: usize,
    /// `persistent`, `dynamic` or `actor`.
    pub stream: Option<String>,
    /// When it is there; `None`: always.
    pub interval: Option<Interval>,
    /// Further custom properties.
    pub extras: Map<String, Value>,
}

/// Everything for one GLB file with many objects.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbScene<'a> {
    /// Geometry, each stored once. All have the same offset.
    pub geometries: Vec<&'a Geometry>,
    /// Objects.
    pub nodes: Vec<GlbNode>,
    /// Playing time of scene time 0 to 1, seconds.
    pub seconds: f64,
}

#[cfg(test)]
mod tests;
