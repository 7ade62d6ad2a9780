//! A trained field that may have to be trained further.

use std::path::Path;

use super::{TrainError, Trained, Trainer};
use crate::config::Config;
use crate::scene::Scene;

/// Training that has come to an end for now, with or without all that it needs to go on.
pub enum Session {
    /// Of an earlier call: the field alone.
    Over(Box<Trained>),
    /// Still in memory, with pixels, depths and the optimiser's state.
    Open(Box<Trainer>),
}

impl Session {
    /// The field.
    pub fn trained(&self) -> &Trained {
        match self {
            Self::Over(trained) => trained,
            Self::Open(trainer) => trainer.trained(),
        }
    }

    /// The field, when nothing else is wanted.
    pub fn into_trained(self) -> Trained {
        match self {
            Self::Over(trained) => *trained,
            Self::Open(trainer) => trainer.into_trained(),
        }
    }

    /// What can train it further: if it was over, read again from the checkpoint of `run`.
    ///
    /// # Errors
    /// A frame or a checkpoint that cannot be read.
    pub fn open(&mut self, scene: &Scene, config: &Config, run: &Path) -> Result<&mut Trainer, TrainError> {
        if let Self::Over(_) = self {
            *self = Self::Open(Box::new(Trainer::resume(scene, config, run)?));
        }
        match self {
            Self::Open(trainer) => Ok(trainer),
            Self::Over(_) => unreachable!("it was opened above"),
        }
    }
}
