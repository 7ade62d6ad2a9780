//! What every reader hands over: the frames as their file lists them, before anything is checked.

use std::path::PathBuf;

use glam::{DMat4, DVec3};

use super::{Aabb, Camera};

/// The split that a file names for a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ListedSplit {
    Train,
    Test,
    /// Neither trained on nor tested: a validation frame of a scene that also names test frames.
    LeftOut,
}

/// One frame as a file lists it.
#[derive(Clone, Debug)]
pub(crate) struct DraftFrame {
    /// What messages call the frame: its image as written in the file.
    pub name: String,
    pub image_path: PathBuf,
    /// Intrinsics, unchecked, for the image size that the file gives.
    pub camera: Camera,
    /// Camera-to-world, OpenCV axes, unchecked.
    pub c2w: DMat4,
    pub time: Option<f64>,
    pub frame_index: Option<u32>,
    /// `None` in every frame where the file names no split.
    pub split: Option<ListedSplit>,
    pub depth_path: Option<PathBuf>,
    pub mask_path: Option<PathBuf>,
}

/// A scene as a file lists it.
#[derive(Clone, Debug)]
pub(crate) struct Draft {
    pub root: PathBuf,
    /// The file that lists the frames, for messages.
    pub source: PathBuf,
    pub frames: Vec<DraftFrame>,
    pub aabb: Option<Aabb>,
    /// How far from the cameras things are (world units), where the file says so.
    pub reach: Option<f64>,
    pub points: Vec<DVec3>,
    pub depth_unit: f64,
    pub depth_is_ground_truth: bool,
    pub warnings: Vec<String>,
}

impl Draft {
    /// A scene without frames and without anything optional.
    pub fn new(root: PathBuf, source: PathBuf) -> Self {
        Draft {
            root,
            source,
            frames: Vec::new(),
            aabb: None,
            reach: None,
            points: Vec::new(),
            depth_unit: 0.001,
            depth_is_ground_truth: false,
            warnings: Vec::new(),
        }
    }
}
