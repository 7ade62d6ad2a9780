//! Semantic 3D maps from egocentric video, on a plain CPU.
//!
//! ```text
//! scene → field → render → train → extract → map → files
//! ```

pub mod scene;
