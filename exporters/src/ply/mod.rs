//! PLY: binary little endian, scalar columns only, the form that every reader takes (`docs/formats.md`).
//!
//! What PLY has no place for travels in header comments, which other readers skip:
//! `comment divff name <name>`, `comment divff offset <x> <y> <z>`, `comment divff quality <attribute>`.

mod body;
mod columns;
mod header;
mod layout;
mod matrix;
mod read;
mod write;

pub use read::{read_ply, read_ply_positions};
pub use write::{PlyOptions, write_ply};

#[cfg(test)]
mod tests;
