//! What the field is made of; resolved into [`super::Field`].

use serde::{Deserialize, Serialize};

/// Size of one stream's grid and networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StreamConfig {
    /// Number of lattices.
    pub levels: usize,
    /// Cells along the longest side of the box at the coarsest level.
    pub coarsest: f32,
    /// Cells along the longest side of the box at the finest level.
    pub finest: f32,
    /// At most 2^this rows a level; 17 is 2 MiB, which a core's L2 holds.
    pub log2_rows: u32,
    /// Width of the hidden layers.
    pub hidden: usize,
    /// Hidden layers of the trunk.
    pub layers: usize,
    /// Width of the frame code (dynamic, actor).
    pub code: usize,
    /// Knots of the frame code over the video; 0: one for every training frame.
    pub knots: usize,
    /// Lattices over space and time (dynamic, actor).
    pub time_levels: usize,
    /// Cells along the longest side of the box at the finest of them.
    pub time_finest: f32,
    /// Cells along time at the finest of them, for every training frame.
    pub time_cells: f32,
    /// Added to the raw density, so that training starts from a nearly empty box.
    pub density_bias: f32,
}

/// The three streams and what they share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FieldConfig {
    /// The environment.
    pub persistent: StreamConfig,
    /// Objects that move now and then, in world coordinates.
    pub dynamic: StreamConfig,
    /// The wearer, in camera coordinates.
    pub actor: StreamConfig,
    /// How far from the camera the actor can be, as a fraction of the box's diagonal.
    pub actor_reach: f32,
    /// Closest distance that is rendered, as a fraction of the box's diagonal.
    pub near: f32,
}

impl Default for FieldConfig {
    fn default() -> Self {
        let persistent = StreamConfig {
            levels: 8,
            coarsest: 12.0,
            finest: 512.0,
            log2_rows: 17,
            hidden: 64,
            layers: 1,
            code: 0,
            knots: 0,
            time_levels: 0,
            time_finest: 0.0,
            time_cells: 0.0,
            density_bias: -3.0,
        };
        let dynamic = StreamConfig {
            levels: 6,
            finest: 192.0,
            layers: 2,
            code: 16,
            knots: 16,
            time_levels: 2,
            time_finest: 64.0,
            time_cells: 0.5,
            density_bias: -5.0,
            ..persistent.clone()
        };
        let actor = StreamConfig {
            levels: 5,
            coarsest: 8.0,
            finest: 64.0,
            log2_rows: 16,
            knots: 0,
            time_levels: 3,
            time_finest: 48.0,
            time_cells: 1.0,
            ..dynamic.clone()
        };
        Self { persistent, dynamic, actor, actor_reach: 0.25, near: 0.015 }
    }
}
