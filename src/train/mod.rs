//! Losses, optimiser, schedule and checkpoints.

pub mod adam;
pub mod align;
pub mod checkpoint;
mod config;
mod error;
pub mod loss;
mod moving;
mod novelty;
pub mod pixels;
mod schedule;
mod session;
pub mod step;
pub mod table_pass;
#[cfg(test)]
pub(crate) mod testing;
mod trainer;

pub use self::checkpoint::Trained;
pub use self::config::{StreamChoice, TrainConfig};
pub use self::error::TrainError;
pub use self::session::Session;
pub use self::trainer::{Control, Progress, TrainReport, Trainer};
