//! Semantic 3D maps from egocentric video, on a plain CPU.
//!
//! ```text
//! scene → field → render → train → extract → map → files
//! ```
#![forbid(unsafe_code)]

pub mod config;
mod bvh;
pub mod eval;
pub mod extract;
pub mod field;
pub mod render;
mod rng;
pub mod scene;
mod simd;
pub mod synth;
pub mod train;
