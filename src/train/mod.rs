//! Losses, optimiser, schedule and checkpoints.

pub mod adam;
pub mod loss;
pub mod pixels;
pub mod step;
pub mod trainer;
