//! Which axis of the world points up.

use serde::{Deserialize, Serialize};

/// The world's up axis. PLY, NPZ and EXR keep the world's own axes; glTF prescribes Y.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum UpAxis {
    /// Y up: glTF's own convention, nothing is converted.
    Y,
    /// Z up, as in robotics and Blender: GLB stores (x, z, -y).
    #[default]
    Z,
}

impl UpAxis {
    /// World → glTF.
    pub(crate) fn to_gltf(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        match self {
            Self::Y => [x, y, z],
            Self::Z => [x, z, -y],
        }
    }

    /// glTF → world, the inverse of [`UpAxis::to_gltf`].
    pub(crate) fn undo_gltf(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        match self {
            Self::Y => [x, y, z],
            Self::Z => [x, -z, y],
        }
    }
}
