//! Meshes, point clouds and images with named per-vertex attributes, to and from GLB, PLY, NPZ and EXR.
//!
//! This crate is a leaf: it knows files and plain geometry, and nothing of fields, cameras or training. What
//! each reader (Open3D, trimesh, Blender, ...) keeps of what is written here is recorded in
//! `docs/formats.md`.
//!
//! Conventions: right-handed coordinates in the caller's own frame and units; colours are 8-bit sRGB; row *i*
//! is the same vertex in every format. Every file is written by [`atomic::write_atomically`]: complete, or
//! not at all.
#![forbid(unsafe_code)]

pub mod atomic;
mod axes;
pub mod error;
pub mod exr;
#[cfg(test)]
mod fault_tests;
pub mod geometry;
pub mod glb;
pub mod manifest;
pub mod npy;
pub mod npz;
pub mod ply;
#[cfg(test)]
mod property_tests;
mod rows;
#[cfg(test)]
mod samples;
mod validate;

pub use axes::UpAxis;
pub use error::{Error, Result};
pub use exr::{ExrChannel, ExrCompression, ExrImage, ExrSamples, read_exr, write_exr, write_exr_with};
pub use geometry::{Attribute, AttributeValues, Features, Geometry};
pub use glb::{GlbContents, GlbNode, GlbOptions, GlbScene, Interval, read_glb, write_glb, write_scene_glb};
pub use manifest::Manifest;
pub use npy::{NpyArray, NpyHeader, read_npy, read_npy_header, write_npy};
pub use npz::{NpzCompression, read_npz, write_npz};
pub use ply::{PlyOptions, read_ply, read_ply_positions, write_ply};
