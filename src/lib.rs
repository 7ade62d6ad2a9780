//! Semantic 3D maps from egocentric video, on a plain CPU.
//!
//! ```text
//! scene → field → render → train → extract → semantics → map → files
//! ```
#![deny(unsafe_code)]

pub mod bench;
mod bvh;
#[cfg(test)]
mod bvh_tests;
pub mod config;
pub mod error;
pub mod eval;
pub mod extract;
pub mod field;
pub mod map;
pub mod pipeline;
pub mod render;
pub mod report;
mod rng;
pub mod scene;
pub mod semantics;
pub mod simd;
pub mod stereo;
pub mod synth;
mod tasks;
pub mod train;
pub mod work;
