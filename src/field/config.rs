//! What the field is made of; resolved into [`super::Field`].

use serde::{Deserialize, Serialize};

/// How positions are made into what networks see.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EncodingKind {
    /// Lattices of learned features, coarse to fine; what does not fit its table is hashed (instant-ngp).
    #[default]
    Hash,
    /// The same without hashing: lattices only as fine as fit their tables.
    Dense,
    /// Sines and cosines of the position, under networks that are as deep as the paper's (NeRF).
    Frequency,
}

/// Encoding and networks of [`EncodingKind::Frequency`]; by default those of the paper, for all three streams.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrequencyConfig {
    /// Number of bands, even: sine and cosine of 2^k π times each coordinate, for k from 0.
    pub bands: usize,
    /// Width of the trunk's layers, and of the features that it hands on to the head.
    pub hidden: usize,
    /// Hidden layers of the trunk. What comes after layer `layers / 2 + 1` (the fifth of eight) sees the trunk's input again.
    pub layers: usize,
    /// Width of the head's one hidden layer.
    pub head: usize,
}

impl Default for FrequencyConfig {
    fn default() -> Self {
        Self { bands: 10, hidden: 256, layers: 8, head: 128 }
    }
}

/// Widths of a stream's networks.
#[derive(Clone, Debug, PartialEq)]
pub struct Widths {
    /// Of the hidden layers of the trunk.
    pub hidden: usize,
    /// Number of hidden layers of the trunk.
    pub layers: usize,
    /// Layer of the trunk, from 0, that sees its input again.
    pub skip: Option<usize>,
    /// Output of the trunk: raw density, then geometry features for the head.
    pub geometry: usize,
    /// Hidden layer of the head.
    pub head: usize,
}

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
    /// How positions are encoded, in all three streams.
    pub encoding: EncodingKind,
    /// What [`EncodingKind::Frequency`] has instead of the streams' lattices and networks.
    pub frequency: FrequencyConfig,
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
        Self {
            encoding: EncodingKind::default(),
            frequency: FrequencyConfig::default(),
            persistent,
            dynamic,
            actor,
            actor_reach: 0.25,
            near: 0.015,
        }
    }
}
