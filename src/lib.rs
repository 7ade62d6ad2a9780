//! Semantic 3D maps from egocentric video, on a plain CPU.
//!
//! ```text
//! scene → field → render → train → extract → map → files
//! ```
#![forbid(unsafe_code)]

pub mod extract;
mod bvh;
pub mod eval;
pub mod field;
pub mod render;
mod rng;
pub mod scene;
pub mod synth;
mod simd;
pub mod train;
