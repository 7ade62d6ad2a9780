//! Geometry → PLY: the header as text, then rows packed in chunks on all cores and written in order.

use std::io::{self, Write};
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::columns::{pack_columns, pack_items};
use crate::atomic::write_atomically;
use crate::error::{Error, Result};
use crate::geometry::{AttributeValues, Geometry};
use crate::rows::{triple_bytes, write_rows};
use crate::validate::{CLOUDCOMPARE_PREFIX, any, is_non_finite, is_not_unit};

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
    Positions(&'a [[f32; 3]]),
    Normals(&'a [[f32; 3]]),
    Colors(&'a [[u8; 3]]),
    /// Columns of attributes.
    Floats(Vec<&'a [f32]>),
    /// Likewise.
    Integers(Vec<&'a [i32]>),
    /// One of them.
    Bytes(&'a [u8]),
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
    // Whatever went wrong first, what is wrong with the geometry is told, and what `validate` finds first of it.
    write_valid(path, geometry, options).or_else(|error| geometry.validate().and(Err(error)))
}

/// Looks at the numbers of the columns as it packs them, when they are in the cache: before that, it would take a third
/// as long as writing them.
fn write_valid(path: &Path, geometry: &Geometry, options: &PlyOptions) -> Result<()> {
    geometry.validate_all_but_columns()?;
    let blocks = blocks(geometry, options)?;
    let header = header(geometry, options, &blocks);
    let stride = blocks.iter().map(Block::size).sum();
    let is_invalid = AtomicBool::new(false);
    write_atomically(path, |file| {
        file.write_all(header.as_bytes())?;
        write_rows(file, geometry.positions.len(), stride, |first_row, rows| {
            let mut at = 0;
            for block in &blocks {
                block.pack(first_row, rows, stride, at);
                at += block.size();
                if block.is_invalid(first_row..first_row + rows.len() / stride) {
                    is_invalid.store(true, Ordering::Relaxed);
                }
            }
        })?;
        if is_invalid.load(Ordering::Relaxed) {
            return Err(io::ErrorKind::InvalidData.into());
        }
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
    let mut push = |names: [&str; 3], source| {
        blocks.push(Block { names: names.iter().map(|&name| name.to_owned()).collect(), source });
    };
    push(["x", "y", "z"], Source::Positions(&geometry.positions));
    if !geometry.normals.is_empty() {
        push(["nx", "ny", "nz"], Source::Normals(&geometry.normals));
    }
    if !geometry.colors.is_empty() {
        push(["red", "green", "blue"], Source::Colors(&geometry.colors));
    }
    let prefix = if options.cloudcompare { CLOUDCOMPARE_PREFIX } else { "" };
    if let Some(quality) = &options.quality {
        push_attribute(&mut blocks, "quality".to_owned(), quality_values(geometry, quality)?);
    }
    for attribute in &geometry.attributes {
        push_attribute(&mut blocks, format!("{prefix}{}", attribute.name), &attribute.values);
    }
    for features in &geometry.features {
        let names = (0..features.dim).map(|d| format!("{prefix}{}", features.column(d))).collect();
        blocks.push(Block { names, source: Source::Features(&features.values, features.dim) });
    }
    Ok(blocks)
}

/// Adds a column to the last block, if that holds attributes of its type, else a block.
fn push_attribute<'a>(blocks: &mut Vec<Block<'a>>, name: String, values: &'a AttributeValues) {
    let last = blocks.last_mut();
    let new = match (values, last) {
        (AttributeValues::F32(values), Some(Block { names, source: Source::Floats(columns) })) => {
            names.push(name);
            return columns.push(values);
        }
        (AttributeValues::I32(values), Some(Block { names, source: Source::Integers(columns) })) => {
            names.push(name);
            return columns.push(values);
        }
        (AttributeValues::F32(values), _) => Source::Floats(vec![values]),
        (AttributeValues::I32(values), _) => Source::Integers(vec![values]),
        (AttributeValues::U8(values), _) => Source::Bytes(values),
    };
    blocks.push(Block { names: vec![name], source: new });
}

fn quality_values<'a>(geometry: &'a Geometry, quality: &str) -> Result<&'a AttributeValues> {
    if geometry.attributes.iter().any(|attribute| attribute.name == "quality") {
        let reason = "an attribute is called `quality` already; leave the option out";
        return Err(Error::inconsistent(&geometry.name, reason));
    }
    match geometry.attributes.iter().find(|attribute| attribute.name == quality) {
        Some(attribute) => Ok(&attribute.values),
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
            Source::Positions(_) | Source::Normals(_) | Source::Floats(_) | Source::Features(..) => "float",
            Source::Integers(_) => "int",
            Source::Colors(_) | Source::Bytes(_) => "uchar",
        }
    }

    /// Bytes of the block in a row.
    fn size(&self) -> usize {
        self.names.len() * if self.type_name() == "uchar" { 1 } else { 4 }
    }

    /// Puts the values of the rows from `first_row` at byte `at` of each `stride`-byte row of `rows`.
    fn pack(&self, first_row: usize, rows: &mut [u8], stride: usize, at: usize) {
        match &self.source {
            Source::Positions(vectors) | Source::Normals(vectors) => {
                pack_items(rows, stride, at, &vectors[first_row..], vector_bytes);
            }
            Source::Colors(colors) => pack_items(rows, stride, at, &colors[first_row..], |color| color),
            Source::Floats(columns) => {
                pack_columns(rows, stride, at, first_row, columns, f32::to_le_bytes);
            }
            Source::Integers(columns) => {
                pack_columns(rows, stride, at, first_row, columns, i32::to_le_bytes);
            }
            Source::Bytes(values) => pack_items(rows, stride, at, &values[first_row..], |byte| [byte]),
            &Source::Features(values, dim) => {
                for (r, values) in
                    values[first_row * dim..].chunks_exact(dim).take(rows.len() / stride).enumerate()
                {
                    let row = &mut rows[r * stride + at..][..4 * dim];
                    for (to, value) in row.as_chunks_mut::<4>().0.iter_mut().zip(values) {
                        *to = value.to_le_bytes();
                    }
                }
            }
        }
    }

    /// Whether [`Geometry::validate`] would refuse a value of `rows`.
    fn is_invalid(&self, rows: Range<usize>) -> bool {
        match &self.source {
            Source::Positions(vectors) => any(vectors[rows].as_flattened(), is_non_finite),
            Source::Normals(normals) => {
                let normals = &normals[rows];
                any(normals.as_flattened(), is_non_finite) || any(normals, is_not_unit)
            }
            Source::Floats(columns) => columns.iter().any(|column| any(&column[rows.clone()], is_non_finite)),
            &Source::Features(values, dim) => any(&values[rows.start * dim..rows.end * dim], is_non_finite),
            Source::Colors(_) | Source::Integers(_) | Source::Bytes(_) => false,
        }
    }
}

fn vector_bytes(vector: [f32; 3]) -> [u8; 12] {
    triple_bytes(bytemuck::cast(vector))
}
