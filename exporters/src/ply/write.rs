//! Geometry → PLY: the header as text, then rows packed in chunks on all cores and written in order.

use std::io::Write;
use std::path::Path;

use crate::atomic::write_atomically;
use crate::error::{Error, Result};
use crate::geometry::{AttributeValues, Geometry};
use crate::rows::{triple_bytes, write_rows};
use crate::validate::CLOUDCOMPARE_PREFIX;

/// Choices that other programs' habits make necessary. The default is plain names and no copies.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PlyOptions {
    /// Attribute that is also written as `quality`, the only scalar that MeshLab shows.
    pub quality: Option<String>,
    /// Prefix extra columns with `scalar_`: CloudCompare keeps only names that contain `scal`.
    pub cloudcompare: bool,
}

/// Values of neighbouring properties of a vertex. A whole block is copied at once: 32 feature columns one by one would
/// pass over the rows 32 times.
enum Source<'a> {
    /// Three floats.
    Vectors(&'a [[f32; 3]]),
    /// Three bytes.
    Colors(&'a [[u8; 3]]),
    /// An attribute.
    Scalars(&'a AttributeValues),
    /// Rows of `.1` floats.
    Features(&'a [f32], usize),
}

/// Neighbouring properties of one type.
struct Block<'a> {
    names: Vec<String>,
    source: Source<'a>,
}

/// Writes a mesh, or a point cloud when there are no triangles.
///
/// Columns: `x y z`, `nx ny nz`, `red green blue`, the attributes in their order, then the features,
/// dimension by dimension, as `<name>_000`. Coordinates are relative to `geometry.offset`, which a comment
/// records.
///
/// # Errors
/// `Inconsistent` or `NonFinite` when the geometry breaks its invariants or has no attribute called as
/// `options.quality` says; `Io`.
pub fn write_ply(path: &Path, geometry: &Geometry, options: &PlyOptions) -> Result<()> {
    geometry.validate()?;
    let blocks = blocks(geometry, options)?;
    let header = header(geometry, options, &blocks);
    let stride = blocks.iter().map(Block::size).sum();
    write_atomically(path, |file| {
        file.write_all(header.as_bytes())?;
        write_rows(file, geometry.positions.len(), stride, |first_row, rows| {
            let mut at = 0;
            for block in &blocks {
                block.pack(first_row, rows, stride, at);
                at += block.size();
            }
        })?;
        write_rows(file, geometry.triangles.len(), FACE_BYTES, |first_face, rows| {
            for (row, triangle) in rows.chunks_exact_mut(FACE_BYTES).zip(&geometry.triangles[first_face..]) {
                row[0] = 3;
                row[1..].copy_from_slice(&triple_bytes(*triangle));
            }
        })
    })
}

/// One count byte and three 32-bit indices.
const FACE_BYTES: usize = 13;

fn blocks<'a>(geometry: &'a Geometry, options: &PlyOptions) -> Result<Vec<Block<'a>>> {
    let mut blocks = Vec::new();
    let mut push = |names: &[&str], source| {
        blocks.push(Block { names: names.iter().map(|&name| name.to_owned()).collect(), source });
    };
    push(&["x", "y", "z"], Source::Vectors(&geometry.positions));
    if !geometry.normals.is_empty() {
        push(&["nx", "ny", "nz"], Source::Vectors(&geometry.normals));
    }
    if !geometry.colors.is_empty() {
        push(&["red", "green", "blue"], Source::Colors(&geometry.colors));
    }
    let prefix = if options.cloudcompare { CLOUDCOMPARE_PREFIX } else { "" };
    if let Some(quality) = &options.quality {
        push(&["quality"], quality_source(geometry, quality)?);
    }
    for attribute in &geometry.attributes {
        push(&[&format!("{prefix}{}", attribute.name)], Source::Scalars(&attribute.values));
    }
    for features in &geometry.features {
        let names = (0..features.dim).map(|d| format!("{prefix}{}", features.column(d))).collect();
        blocks.push(Block { names, source: Source::Features(&features.values, features.dim) });
    }
    Ok(blocks)
}

fn quality_source<'a>(geometry: &'a Geometry, quality: &str) -> Result<Source<'a>> {
    if geometry.attributes.iter().any(|attribute| attribute.name == "quality") {
        let reason = "an attribute is called `quality` already; leave the option out";
        return Err(Error::inconsistent(&geometry.name, reason));
    }
    match geometry.attributes.iter().find(|attribute| attribute.name == quality) {
        Some(attribute) => Ok(Source::Scalars(&attribute.values)),
        None => {
            let reason = format!("there is no attribute `{quality}` to write as `quality`");
            Err(Error::inconsistent(&geometry.name, reason))
        }
    }
}

fn header(geometry: &Geometry, options: &PlyOptions, blocks: &[Block]) -> String {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    // The name comes from the caller; a line break in it would end the comment.
    let name = geometry.name.replace(|c: char| c.is_control(), " ");
    header += &format!("comment divff name {name}\n");
    if geometry.offset != [0.0; 3] {
        // `{}` of f64 prints the shortest decimal that parses to the same bits.
        let [x, y, z] = geometry.offset;
        header += &format!("comment divff offset {x} {y} {z}\n");
    }
    if let Some(quality) = &options.quality {
        header += &format!("comment divff quality {quality}\n");
    }
    header += &format!("element vertex {}\n", geometry.positions.len());
    for block in blocks {
        for name in &block.names {
            header += &format!("property {} {name}\n", block.type_name());
        }
    }
    if !geometry.triangles.is_empty() {
        header += &format!("element face {}\n", geometry.triangles.len());
        header += "property list uchar int vertex_indices\n";
    }
    header + "end_header\n"
}

impl Block<'_> {
    fn type_name(&self) -> &'static str {
        match self.source {
            Source::Vectors(_) | Source::Features(..) | Source::Scalars(AttributeValues::F32(_)) => "float",
            Source::Scalars(AttributeValues::I32(_)) => "int",
            Source::Colors(_) | Source::Scalars(AttributeValues::U8(_)) => "uchar",
        }
    }

    /// Bytes of the block in a row.
    fn size(&self) -> usize {
        self.names.len() * if self.type_name() == "uchar" { 1 } else { 4 }
    }

    /// Puts the values of the rows from `first_row` at byte `at` of each `stride`-byte row of `rows`.
    fn pack(&self, first_row: usize, rows: &mut [u8], stride: usize, at: usize) {
        match self.source {
            Source::Vectors(vectors) => pack(rows, stride, at, vectors[first_row..].iter().map(vector_bytes)),
            Source::Colors(colors) => pack(rows, stride, at, colors[first_row..].iter().copied()),
            Source::Scalars(AttributeValues::F32(values)) => {
                pack(rows, stride, at, values[first_row..].iter().map(|v| v.to_le_bytes()));
            }
            Source::Scalars(AttributeValues::I32(values)) => {
                pack(rows, stride, at, values[first_row..].iter().map(|v| v.to_le_bytes()));
            }
            Source::Scalars(AttributeValues::U8(values)) => {
                pack(rows, stride, at, values[first_row..].iter().map(|&v| [v]));
            }
            Source::Features(values, dim) => {
                for (row, values) in
                    rows.chunks_exact_mut(stride).zip(values[first_row * dim..].chunks_exact(dim))
                {
                    for (to, value) in row[at..at + 4 * dim].as_chunks_mut::<4>().0.iter_mut().zip(values) {
                        *to = value.to_le_bytes();
                    }
                }
            }
        }
    }
}

fn vector_bytes(vector: &[f32; 3]) -> [u8; 12] {
    triple_bytes(bytemuck::cast(*vector))
}

fn pack<const N: usize>(rows: &mut [u8], stride: usize, at: usize, values: impl Iterator<Item = [u8; N]>) {
    for (row, value) in rows.chunks_exact_mut(stride).zip(values) {
        row[at..at + N].copy_from_slice(&value);
    }
}
