//! Rays, empty-space skipping and compositing; forward and backward.

pub mod composite;
#[cfg(test)]
mod composite_tests;
pub mod density_grid;
pub mod forward;
pub mod image;
pub mod rays;
pub mod sampler;
#[cfg(test)]
mod sampler_tests;
