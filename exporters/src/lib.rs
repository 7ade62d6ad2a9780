//! Meshes, point clouds and images with named per-vertex attributes, to and from GLB, PLY, NPZ and EXR.
//!
//! This crate is a leaf: it knows files and plain geometry, and nothing of fields, cameras or training. What each
//! reader (Open3D, trimesh, Blender, ...) keeps of what is written here is recorded in `docs/formats.md`.
//!
//! Conventions: right-handed coordinates in the caller's own frame and units; colours are 8-bit sRGB; row *i* is the
//! same vertex in every format.

pub mod geometry;

pub use geometry::{Attribute, AttributeValues, Features, Geometry};
