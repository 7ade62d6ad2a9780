//! Work that is not done because the result does not need it.

use std::ops::AddAssign;

use serde::{Deserialize, Serialize};

/// Amounts of work that were saved; what does not apply is 0 and left out of files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Work {
    /// Points at which a field, or a grid of densities, was not looked at.
    #[serde(skip_serializing_if = "is_zero")]
    pub samples: u64,
    /// Cells of a grid that were neither evaluated nor marched.
    #[serde(skip_serializing_if = "is_zero")]
    pub voxels: u64,
    /// Numbers that were neither held in memory nor written.
    #[serde(skip_serializing_if = "is_zero")]
    pub bytes: u64,
    /// Seconds that an earlier run had taken for the same.
    #[serde(skip_serializing_if = "is_nothing")]
    pub seconds: f64,
}

fn is_zero(amount: &u64) -> bool {
    *amount == 0
}

fn is_nothing(amount: &f64) -> bool {
    *amount == 0.0
}

impl Work {
    /// So many samples.
    pub fn samples(samples: u64) -> Self {
        Self { samples, ..Self::default() }
    }

    /// So many bytes.
    pub fn bytes(bytes: u64) -> Self {
        Self { bytes, ..Self::default() }
    }

    /// So many seconds.
    pub fn seconds(seconds: f64) -> Self {
        Self { seconds, ..Self::default() }
    }
}

impl AddAssign for Work {
    fn add_assign(&mut self, other: Self) {
        self.samples += other.samples;
        self.voxels += other.voxels;
        self.bytes += other.bytes;
        self.seconds += other.seconds;
    }
}
