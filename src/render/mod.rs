//! Rays, empty-space skipping and compositing; forward and backward.

pub mod composite;
pub mod density_grid;
pub mod forward;
pub mod image;
pub mod rays;
pub mod sampler;
pub mod views;
