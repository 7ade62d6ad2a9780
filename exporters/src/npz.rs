//! NPZ: numpy's zip of arrays. The best form for Python, because feature matrices stay matrices.
//!
//! Arrays: `positions` and `normals` (N,3) f32, `colors` (N,3) u8, each attribute (N,1) f32, i32 or u8, each
//! feature (N,dim) f32 (f16 on request), and `triangles` (M,3) i32 of meshes. Name and offset are a JSON object in the zip's
//! comment, where neither numpy nor Open3D stumbles over them.

mod read;
mod write;

pub use read::{Matrix, read_npz, read_npz_matrices};
pub use write::{NpzCompression, write_npz, write_npz_matrices};

#[cfg(test)]
mod tests;
