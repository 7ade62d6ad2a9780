//! Fields to surfaces: a density (or fused depth) becomes meshes and surface samples.
//!
//! ```text
//! density closure ─ grid ─┐
//!                         ├─ march ─ clean ─ visibility ─ sample, simplify
//! depth maps ───── tsdf ──┘
//! ```
//!
//! Everything in f32 is **relative to the grid's origin** ([`GridSpec::origin`], f64, world), in world units,
//! so a scene far from the world's origin keeps its precision. All results are the same bytes for any number
//! of threads.

mod blocks;
pub mod clean;
mod error;
pub mod grid;
pub mod march;
mod march_dense;
mod mc_table;
mod mesh;
pub mod sample;
pub mod simplify;
pub mod tsdf;
mod view;
pub mod visibility;

#[cfg(test)]
mod march_tests;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tsdf_tests;

pub use error::ExtractError;
pub use grid::{GridReport, GridSpec, SparseGrid};
pub use march::march;
pub use march_dense::march_dense;
pub use mesh::TriMesh;
