//! Geometry → PLY: the header as text, then rows packed in chunks on all cores and written in order.

use std::io::{self, Write};
use std::path::Path;

use rayon::prelude::*;

use crate::atomic::write_atomically;
use crate::error::{Error, Result};
use crate::geometry::{AttributeValues, Geometry};
use crate::validate::CLOUDCOMPARE_PREFIX;

/// Choices that other programs' habits make necessary. The default is plain names and no copies.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PlyOptions {
    /// Attribute that is also written as `quality`, the only scalar that MeshLab shows.
    pub quality: Option<String>,
    /// Prefix extra columns with `scalar_`: CloudCompare keeps only names that contain `scal`.
    pub cloudcompare: bool,
}

/// Bytes packed by one task: two such buffers per core stay in its second-level cache.
const CHUNK_BYTES: usize = 256 * 1024;

/// One property of a vertex, and where its values are.
enum Source<'a> {
    /// Component of a 3-vector.
    Axis(&'a [[f32; 3]], usize),
    /// Component of a colour.
    Color(&'a [[u8; 3]], usize),
    /// An attribute.
    Scalar(&'a AttributeValues),
    /// Dimension `.1` of rows that are `.2` wide.
    Feature(&'a [f32], usize, usize),
}

struct Column<'a> {
    name: String,
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
    let columns = columns(geometry, options)?;
    let header = header(geometry, options, &columns);
    let stride = columns.iter().map(Column::size).sum();
    write_atomically(path, |file| {
        file.write_all(header.as_bytes())?;
        write_rows(file, geometry.positions.len(), stride, |first_row, rows| {
            let mut at = 0;
            for column in &columns {
                column.pack(first_row, rows, stride, at);
                at += column.size();
            }
        })?;
        write_rows(file, geometry.triangles.len(), FACE_BYTES, |first_face, rows| {
            for (row, triangle) in rows.chunks_exact_mut(FACE_BYTES).zip(&geometry.triangles[first_face..]) {
                row[0] = 3;
                row[1..].copy_from_slice(bytemuck::bytes_of(&triangle.map(u32::to_le)));
            }
        })
    })
}

/// One count byte and three 32-bit indices.
const FACE_BYTES: usize = 13;

fn columns<'a>(geometry: &'a Geometry, options: &PlyOptions) -> Result<Vec<Column<'a>>> {
    let mut columns = Vec::new();
    let mut push = |name: &str, source| columns.push(Column { name: name.to_owned(), source });
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        push(name, Source::Axis(&geometry.positions, axis));
    }
    if !geometry.normals.is_empty() {
        for (axis, name) in ["nx", "ny", "nz"].into_iter().enumerate() {
            push(name, Source::Axis(&geometry.normals, axis));
        }
    }
    if !geometry.colors.is_empty() {
        for (channel, name) in ["red", "green", "blue"].into_iter().enumerate() {
            push(name, Source::Color(&geometry.colors, channel));
        }
    }
    let prefix = if options.cloudcompare { CLOUDCOMPARE_PREFIX } else { "" };
    if let Some(quality) = &options.quality {
        push("quality", quality_source(geometry, quality)?);
    }
    for attribute in &geometry.attributes {
        push(&format!("{prefix}{}", attribute.name), Source::Scalar(&attribute.values));
    }
    for features in &geometry.features {
        for d in 0..features.dim {
            push(
                &format!("{prefix}{}", features.column(d)),
                Source::Feature(&features.values, d, features.dim),
            );
        }
    }
    Ok(columns)
}

fn quality_source<'a>(geometry: &'a Geometry, quality: &str) -> Result<Source<'a>> {
    if geometry.attributes.iter().any(|attribute| attribute.name == "quality") {
        let reason = "an attribute is called `quality` already; leave the option out";
        return Err(Error::inconsistent(&geometry.name, reason));
    }
    match geometry.attributes.iter().find(|attribute| attribute.name == quality) {
        Some(attribute) => Ok(Source::Scalar(&attribute.values)),
        None => {
            let reason = format!("there is no attribute `{quality}` to write as `quality`");
            Err(Error::inconsistent(&geometry.name, reason))
        }
    }
}

fn header(geometry: &Geometry, options: &PlyOptions, columns: &[Column]) -> String {
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
    for column in columns {
        header += &format!("property {} {}\n", column.type_name(), column.name);
    }
    if !geometry.triangles.is_empty() {
        header += &format!("element face {}\n", geometry.triangles.len());
        header += "property list uchar int vertex_indices\n";
    }
    header + "end_header\n"
}

impl Column<'_> {
    fn type_name(&self) -> &'static str {
        match self.source {
            Source::Axis(..) | Source::Feature(..) | Source::Scalar(AttributeValues::F32(_)) => "float",
            Source::Scalar(AttributeValues::I32(_)) => "int",
            Source::Color(..) | Source::Scalar(AttributeValues::U8(_)) => "uchar",
        }
    }

    fn size(&self) -> usize {
        if self.type_name() == "uchar" { 1 } else { 4 }
    }

    /// Puts the values of the rows from `first_row` at byte `at` of each `stride`-byte row of `rows`.
    fn pack(&self, first_row: usize, rows: &mut [u8], stride: usize, at: usize) {
        match self.source {
            Source::Axis(vectors, axis) => {
                pack(rows, stride, at, vectors[first_row..].iter().map(|v| v[axis].to_le_bytes()));
            }
            Source::Color(colors, channel) => {
                pack(rows, stride, at, colors[first_row..].iter().map(|c| [c[channel]]));
            }
            Source::Scalar(AttributeValues::F32(values)) => {
                pack(rows, stride, at, values[first_row..].iter().map(|v| v.to_le_bytes()));
            }
            Source::Scalar(AttributeValues::I32(values)) => {
                pack(rows, stride, at, values[first_row..].iter().map(|v| v.to_le_bytes()));
            }
            Source::Scalar(AttributeValues::U8(values)) => {
                pack(rows, stride, at, values[first_row..].iter().map(|&v| [v]));
            }
            Source::Feature(values, d, dim) => {
                let of_dimension =
                    values[first_row * dim..].chunks_exact(dim).map(|row| row[d].to_le_bytes());
                pack(rows, stride, at, of_dimension);
            }
        }
    }
}

fn pack<const N: usize>(rows: &mut [u8], stride: usize, at: usize, values: impl Iterator<Item = [u8; N]>) {
    for (row, value) in rows.chunks_exact_mut(stride).zip(values) {
        row[at..at + N].copy_from_slice(&value);
    }
}

/// Packs chunks of rows in parallel, a batch at a time, while the batch before is being written.
fn write_rows(
    file: &mut impl Write,
    rows: usize,
    stride: usize,
    pack: impl Fn(usize, &mut [u8]) + Sync,
) -> io::Result<()> {
    let rows_per_chunk = (CHUNK_BYTES / stride).max(1);
    let rows_per_batch = rows_per_chunk * 4 * rayon::current_num_threads();
    let mut batch = vec![0; rows_per_batch.min(rows) * stride];
    for first_row in (0..rows).step_by(rows_per_batch) {
        let batch = &mut batch[..rows_per_batch.min(rows - first_row) * stride];
        batch
            .par_chunks_mut(rows_per_chunk * stride)
            .enumerate()
            .for_each(|(chunk, bytes)| pack(first_row + chunk * rows_per_chunk, bytes));
        file.write_all(batch)?;
    }
    Ok(())
}
