//! Rays, empty-space skipping and compositing; forward and backward.

pub mod composite;
#[cfg(test)]
mod composite_tests;
pub mod density_grid;
pub mod depth;
pub mod forward;
pub mod image;
pub mod query;
pub mod rays;
pub mod refined;
pub mod sampler;
#[cfg(test)]
mod sampler_tests;
#[cfg(test)]
pub(crate) mod testing;
pub mod views;
