//! PLY → geometry: our own files, and meshes and clouds of other programs.

use std::path::Path;

use super::body::Body;
use super::layout::{Kind, Layout, Role};
use super::matrix::Matrix;
use crate::error::{Error, Result};
use crate::geometry::{Attribute, AttributeValues, Features, Geometry};
use crate::validate::UNIT_LENGTH_TOLERANCE;

/// Beyond this many times its own extent from the origin, a cloud of doubles is read with an offset: f32
/// would otherwise keep less than 24 - 10 = 14 bits for the shape.
const FAR_IN_EXTENTS: f64 = 1024.0;

/// Reads a mesh or point cloud; binary (any scalar types) or ASCII.
///
/// Polygons are split into fans. `float`, `double` → f32 columns, integers → i32, `uchar` → u8. Columns
/// `<name>_000`, `<name>_001`, … become [`Features`]; a `scalar_` prefix is taken off; other names are made
/// slugs. Normals are scaled to unit length, and left out if one of them is zero.
///
/// # Errors
/// `Io`; `Invalid` with the byte offset for any contradiction or early end; `NonFinite` for NaN and infinity;
/// `Unsupported` for lists on vertices.
pub fn read_ply(path: &Path) -> Result<Geometry> {
    let (header, mut body) = Body::open(path)?;
    let notes = Notes::from_comments(path, &header.comments)?;
    let mut vertices = None;
    let mut triangles = Vec::new();
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" if vertices.is_none() => {
                let layout = Layout::of_vertices(path, element, notes.quality.is_some())?;
                let matrices = body.read_matrices(element, &layout)?;
                vertices = Some((layout, matrices));
            }
            "face" => body.read_faces(element, &mut triangles)?,
            _ => body.skip(element)?,
        }
    }
    let (layout, matrices) = vertices.ok_or_else(|| no_vertices(path))?;
    let mut geometry = assemble(path, layout, matrices, notes.offset)?;
    geometry.triangles = triangles;
    geometry.name = notes.name.unwrap_or_else(|| stem(path));
    check(path, geometry)
}

/// Reads the positions of the vertices alone, whatever other columns hold.
///
/// # Errors
/// As [`read_ply`], but for values that are not positions.
pub fn read_ply_positions(path: &Path) -> Result<Vec<[f64; 3]>> {
    let (header, mut body) = Body::open(path)?;
    for element in &header.elements {
        if element.name != "vertex" {
            body.skip(element)?;
            continue;
        }
        let matrices = body.read_matrices(element, &Layout::of_positions(path, element)?)?;
        let Some(positions) = matrices.into_iter().next() else { break };
        return Ok(match positions {
            Matrix::F64(values) => values.as_chunks().0.to_vec(),
            other => floats(other).as_chunks().0.iter().map(|p: &[f32; 3]| p.map(f64::from)).collect(),
        });
    }
    Err(no_vertices(path))
}

fn no_vertices(path: &Path) -> Error {
    Error::invalid(path, "the file has no vertices")
}

/// The invariants, with the file's name in the message where the file is to blame.
fn check(path: &Path, geometry: Geometry) -> Result<Geometry> {
    match geometry.validate() {
        Ok(()) => Ok(geometry),
        Err(Error::Inconsistent { reason, .. }) => Err(Error::invalid(path, reason)),
        Err(Error::NonFinite { column, row, value, .. }) => {
            Err(Error::NonFinite { object: path.display().to_string(), column, row, value })
        }
        Err(other) => Err(other),
    }
}

fn assemble(
    path: &Path,
    layout: Layout,
    matrices: Vec<Matrix>,
    recorded_offset: Option<[f64; 3]>,
) -> Result<Geometry> {
    let mut geometry = Geometry::default();
    for (shape, matrix) in layout.shapes.into_iter().zip(matrices) {
        match shape.role {
            Role::Positions => {
                (geometry.positions, geometry.offset) = positions(matrix, recorded_offset);
            }
            Role::Normals => geometry.normals = unit_normals(triples(floats(matrix))),
            Role::Colors => geometry.colors = triples(bytes(matrix)),
            Role::Features(name) => {
                geometry.features.push(Features { name, dim: shape.width, values: floats(matrix) });
            }
            Role::Attribute(name) => {
                let values = attribute_values(path, &name, shape.kind, matrix)?;
                geometry.attributes.push(Attribute { name, values });
            }
        }
    }
    Ok(geometry)
}

fn stem(path: &Path) -> String {
    path.file_stem().map_or(String::new(), |stem| stem.to_string_lossy().into_owned())
}

/// What our writer puts into comments.
#[derive(Default)]
struct Notes {
    name: Option<String>,
    offset: Option<[f64; 3]>,
    quality: Option<String>,
}

impl Notes {
    fn from_comments(path: &Path, comments: &[String]) -> Result<Self> {
        let mut notes = Self::default();
        for note in comments.iter().filter_map(|comment| comment.strip_prefix("divff ")) {
            match note.split_once(' ') {
                Some(("name", name)) => notes.name = Some(name.to_owned()),
                Some(("quality", name)) => notes.quality = Some(name.to_owned()),
                Some(("offset", numbers)) => {
                    let offset: Option<Vec<f64>> = numbers.split(' ').map(|n| n.parse().ok()).collect();
                    let offset = offset.and_then(|offset| offset.try_into().ok());
                    let error = || Error::invalid(path, format!("cannot parse `comment divff {note}`"));
                    notes.offset = Some(offset.ok_or_else(error)?);
                }
                _ => {}
            }
        }
        Ok(notes)
    }
}

/// The values of a matrix that the layout made one of f32.
fn floats(matrix: Matrix) -> Vec<f32> {
    match matrix {
        Matrix::F32(values) => values,
        Matrix::F64(values) => values.iter().map(|&v| v as f32).collect(),
        Matrix::I32(values) => values.iter().map(|&v| v as f32).collect(),
        Matrix::U8(values) => values.iter().map(|&v| f32::from(v)).collect(),
    }
}

/// The values of a matrix that the layout made one of bytes.
fn bytes(matrix: Matrix) -> Vec<u8> {
    match matrix {
        Matrix::U8(values) => values,
        _ => vec![],
    }
}

/// Rows of three.
fn triples<T: bytemuck::Pod>(values: Vec<T>) -> Vec<[T; 3]> {
    bytemuck::allocation::try_cast_vec(values).unwrap_or_else(|(_, values)| values.as_chunks().0.to_vec())
}

/// Other programs write normals of any length. Without a direction at every vertex there are no usable
/// normals.
fn unit_normals(mut normals: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    for normal in &mut normals {
        let length = normal.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        if length == 0.0 {
            return vec![];
        }
        // Our own normals stay as they are, bit for bit.
        if (length - 1.0).abs() > f64::from(UNIT_LENGTH_TOLERANCE) {
            *normal = normal.map(|v| (f64::from(v) / length) as f32);
        }
    }
    normals
}

/// f32 positions and the offset to add to them: the recorded one, or a new one for doubles far from the
/// origin.
fn positions(matrix: Matrix, recorded: Option<[f64; 3]>) -> (Vec<[f32; 3]>, [f64; 3]) {
    let Matrix::F64(values) = matrix else {
        return (triples(floats(matrix)), recorded.unwrap_or_default());
    };
    let (rows, _) = values.as_chunks::<3>();
    let mut offset = [0.0; 3];
    if recorded.is_none() {
        let ranges: [(f64, f64); 3] = std::array::from_fn(|axis| {
            let values = rows.iter().map(|row| row[axis]);
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
        });
        let extent = ranges.iter().map(|(lo, hi)| hi - lo).fold(0.0, f64::max);
        let farthest = ranges.iter().map(|(lo, hi)| lo.abs().max(hi.abs())).fold(0.0, f64::max);
        if farthest.is_finite() && farthest > FAR_IN_EXTENTS * extent {
            offset = ranges.map(|(lo, hi)| (0.5 * (lo + hi)).round());
        }
    }
    let near = |row: &[f64; 3]| std::array::from_fn(|axis| (row[axis] - offset[axis]) as f32);
    (rows.iter().map(near).collect(), recorded.unwrap_or(offset))
}

fn attribute_values(path: &Path, name: &str, kind: Kind, matrix: Matrix) -> Result<AttributeValues> {
    Ok(match matrix {
        Matrix::U8(values) => AttributeValues::U8(values),
        Matrix::I32(values) => {
            if kind == Kind::U32
                && let Some(big) = values.iter().find(|value| **value < 0)
            {
                let reason = format!("{} in `{name}` does not fit a 32-bit signed integer", *big as u32);
                return Err(Error::invalid(path, reason));
            }
            AttributeValues::I32(values)
        }
        other => AttributeValues::F32(floats(other)),
    })
}
