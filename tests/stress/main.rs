//! Numbers at the ends of f32 and scenes that nobody would film: every kernel, and whole runs, come to an answer that
//! is right, or to an error that says where they left the range.

mod compositing;
mod compression;
mod relevancy;
#[allow(dead_code)]
#[path = "../../src/rng.rs"]
mod rng;
mod runs;
mod sampling;
mod scenes;
mod surfaces;
mod training;

/// Sizes all over f32, down to the denormals and up to its largest number.
const SIZES: [f32; 12] =
    [0.0, 1e-45, 1e-40, f32::MIN_POSITIVE, 1e-30, 1e-15, 1e-6, 1.0, 1e6, 1e15, 1e30, f32::MAX];

/// What is not a number to compute with.
const NOT_FINITE: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
