//! What the features of a pixel should be: rows of a table, so that no descriptor is copied for a ray.
//!
//! Three kinds, each of which a scene may lack: [`ImageTargets`] (φ, CLIP), [`VideoTargets`] (ψ, EgoVideo) and
//! [`PartTargets`] (DINO, which regularises ψ). Frames are numbered as in the list that they were loaded with.

mod image;
mod table;
#[cfg(test)]
mod tests;
mod video;

pub use image::{ImageMode, ImageTargetConfig, ImageTargets};
pub use table::{EncodedTable, TargetTable};
pub use video::{PartTargets, VideoTarget, VideoTargetConfig, VideoTargets};

/// Centre of a pixel, px.
fn centre(x: u32, y: u32) -> [f64; 2] {
    [f64::from(x) + 0.5, f64::from(y) + 0.5]
}

/// Several warnings about one kind of thing as one: how many, and the first.
fn gathered(warnings: Vec<String>) -> Vec<String> {
    const SHOWN: usize = 5;
    let more = warnings.len().saturating_sub(SHOWN);
    let mut kept: Vec<String> = warnings.into_iter().take(SHOWN).collect();
    if more > 0 {
        kept.push(format!("… and {more} more feature files with descriptors that are left out"));
    }
    kept
}
