//! What comes in: posed video frames, one [`Scene`] type whatever the file format.

mod assemble;
mod bounds;
mod camera;
mod colmap;
mod colmap_bin;
mod colmap_txt;
mod draft;
mod epic_diff;
mod epic_fields;
mod error;
pub mod features;
mod header;
mod image;
mod inspect;
mod json;
mod open;
mod pose;
#[cfg(test)]
mod tests;
mod timeline;
mod transforms;

use std::path::PathBuf;

pub use camera::{Camera, Pose};
pub use error::{Place, SceneError};
use glam::DVec3;
pub use image::RgbImage;
pub use inspect::{FolderCount, Inspection, SizeCount, inspect};

/// Which part of the protocol a frame belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Split {
    /// Trained on.
    Train,
    /// Held out; what `eval` and the progress bar's PSNR look at.
    Test,
}

/// An axis-aligned box in world coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Smallest corner, world units.
    pub min: DVec3,
    /// Largest corner, world units.
    pub max: DVec3,
}

/// One posed video frame. Its pixels stay on disk until asked for.
#[derive(Clone, Debug)]
pub struct Frame {
    /// File stem of the image: the key of every per-frame feature file and output.
    pub stem: String,
    /// Image path (JPEG or PNG), absolute or relative to the working directory.
    pub image_path: PathBuf,
    /// Intrinsics.
    pub camera: Camera,
    /// Camera-to-world, OpenCV axes, world units.
    pub c2w: Pose,
    /// Time in `[0, 1]` over the video.
    pub time: f64,
    /// Index of the frame in the source video; names the outputs `dynamic_<frame_index:06>`.
    pub frame_index: u32,
    /// Train or test.
    pub split: Split,
    /// 16-bit depth along the camera's z axis, if the scene has it.
    pub depth_path: Option<PathBuf>,
    /// Mask of usable pixels (non-zero = use), if the scene has it.
    pub mask_path: Option<PathBuf>,
}

/// A posed video: frames in time order, bounds, and what else the folder offers.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The scene folder.
    pub root: PathBuf,
    /// Frames sorted by time; never empty; poses and intrinsics are finite and valid.
    pub frames: Vec<Frame>,
    /// Box that holds what is to be mapped.
    pub bounds: Aabb,
    /// World units per stored depth unit (0.001 for millimetres in a scene in metres).
    pub depth_unit: f64,
    /// Depth is for `eval` alone, never for training.
    pub depth_is_ground_truth: bool,
    /// Sparse structure-from-motion points (world), if the source has them.
    pub points: Vec<DVec3>,
    /// Things that are odd but can be worked with, in the reader's words.
    pub warnings: Vec<String>,
}
