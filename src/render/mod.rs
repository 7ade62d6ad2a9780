//! Rays, empty-space skipping and compositing; forward and backward.

pub mod composite;
pub mod density_grid;
pub mod depth;
pub mod forward;
pub mod image;
pub mod query;
pub mod rays;
pub mod refined;
pub mod sampler;
#[cfg(test)]
pub(crate) mod testing;
pub mod views;
