//! NPZ → geometry.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use half::f16;
use serde_json::Value;
use zip::ZipArchive;
use zip::result::ZipError;

use crate::error::{Error, Result};
use crate::geometry::{Attribute, AttributeValues, Features, Geometry};
use crate::npy::{self, Dtype};

/// Deflate cannot expand by more than about this factor, so no honest entry claims more.
const MAX_DEFLATE_RATIO: u64 = 1032;

/// Reads what [`super::write_npz`] and `numpy.savez` write with these array names.
///
/// Arrays other than the standard ones become attributes if they have one column, features otherwise.
///
/// # Errors
/// `Io`; `Invalid` for a damaged or truncated archive or array; `NonFinite`; `Unsupported` for other element
/// types.
pub fn read_npz(path: &Path) -> Result<Geometry> {
    let file = File::open(path).map_err(|source| Error::io(path, source))?;
    let file_bytes = file.metadata().map_err(|source| Error::io(path, source))?.len();
    let mut archive = ZipArchive::new(BufReader::new(file)).map_err(|error| zip_error(path, error))?;
    let mut geometry = Geometry::default();
    read_note(path, archive.comment(), &mut geometry)?;
    for index in 0..archive.len() {
        let (name, content) = read_entry(path, &mut archive, index, file_bytes)?;
        let array = parse_array(path, &name, &content)?;
        insert(path, &mut geometry, name, &array)?;
    }
    geometry.validate().map_err(|error| match error {
        Error::Inconsistent { reason, .. } => Error::invalid(path, reason),
        other => other,
    })?;
    Ok(geometry)
}

/// A matrix: name, columns, row-major values.
pub type Matrix = (String, usize, Vec<f32>);

/// Reads what [`super::write_npz_matrices`] writes.
///
/// # Errors
/// As [`read_npz`]; arrays of other types than <f4 are `Unsupported`.
pub fn read_npz_matrices(path: &Path) -> Result<Vec<Matrix>> {
    let file = File::open(path).map_err(|source| Error::io(path, source))?;
    let file_bytes = file.metadata().map_err(|source| Error::io(path, source))?.len();
    let mut archive = ZipArchive::new(BufReader::new(file)).map_err(|error| zip_error(path, error))?;
    let mut matrices = Vec::with_capacity(archive.len());
    for index in 0..archive.len() {
        let (name, content) = read_entry(path, &mut archive, index, file_bytes)?;
        let array = parse_array(path, &name, &content)?;
        if array.dtype != Dtype::F32 {
            return Err(Error::Unsupported {
                path: path.to_owned(),
                what: format!("array `{name}`: its type {}", array.dtype.descr()),
                remedy: "save <f4 arrays of one or two dimensions",
            });
        }
        let values = floats(&array);
        matrices.push((name, array.columns, values));
    }
    Ok(matrices)
}

fn zip_error(path: &Path, error: ZipError) -> Error {
    match error {
        ZipError::Io(source) if source.kind() != std::io::ErrorKind::UnexpectedEof => Error::io(path, source),
        other => Error::invalid(path, format!("the zip archive is damaged or cut short: {other}")),
    }
}

fn read_note(path: &Path, comment: &[u8], geometry: &mut Geometry) -> Result<()> {
    geometry.name = path.file_stem().map_or(String::new(), |stem| stem.to_string_lossy().into_owned());
    let Ok(Value::Object(mut note)) = serde_json::from_slice(comment) else { return Ok(()) };
    if let Some(name) = note.get("name").and_then(Value::as_str) {
        geometry.name = name.to_owned();
    }
    if let Some(offset) = note.remove("offset") {
        geometry.offset = serde_json::from_value(offset)
            .map_err(|error| Error::invalid(path, format!("the offset in the zip comment: {error}")))?;
    }
    Ok(())
}

fn read_entry(
    path: &Path,
    archive: &mut ZipArchive<BufReader<File>>,
    index: usize,
    file_bytes: u64,
) -> Result<(String, Vec<u8>)> {
    let mut entry = archive.by_index(index).map_err(|error| zip_error(path, error))?;
    let Some(name) = entry.name().strip_suffix(".npy").map(str::to_owned) else {
        return Err(Error::invalid(path, format!("`{}` is no NPY array", entry.name())));
    };
    let size = entry.size();
    if entry.compressed_size() > file_bytes || size > file_bytes.saturating_mul(MAX_DEFLATE_RATIO) {
        return Err(Error::invalid(path, format!("array `{name}` claims more bytes than the file can hold")));
    }
    let mut content = Vec::with_capacity(usize::try_from(size.min(file_bytes)).unwrap_or(0));
    // One byte more than promised, so that a longer entry is noticed; the checksum is verified on the way.
    let read = entry.by_ref().take(size.saturating_add(1)).read_to_end(&mut content);
    read.map_err(|error| Error::invalid(path, format!("array `{name}` cannot be unpacked: {error}")))?;
    if content.len() as u64 != size {
        return Err(Error::invalid(path, format!("array `{name}` has {} bytes, not {size}", content.len())));
    }
    Ok((name, content))
}

/// An array as stored; one dimension counts as one column.
pub(super) struct Array<'a> {
    pub(super) dtype: Dtype,
    pub(super) columns: usize,
    pub(super) bytes: &'a [u8],
}

/// An array of one or two dimensions and of the types that geometry has.
///
/// # Errors
/// `Invalid` for contradictions, `Unsupported` for other types and dimensions.
pub(super) fn parse_array<'a>(path: &Path, name: &str, file: &'a [u8]) -> Result<Array<'a>> {
    let (header, _) = npy::parse_header(path, name, file)?;
    let unsupported = |what: String| Error::Unsupported {
        path: path.to_owned(),
        what: format!("array `{name}`: {what}"),
        remedy: "save C-ordered <f4, <f2, <i4 or |u1 arrays of one or two dimensions",
    };
    if !matches!(header.dtype, Dtype::F16 | Dtype::F32 | Dtype::I32 | Dtype::U8) {
        return Err(unsupported(format!("its type {}", header.dtype.descr())));
    }
    let columns = match header.shape[..] {
        [_] => 1,
        [_, columns] => columns,
        _ => return Err(unsupported("not one or two dimensions".into())),
    };
    let (_, bytes) = npy::parse(path, name, file)?;
    Ok(Array { dtype: header.dtype, columns, bytes })
}

fn insert(path: &Path, geometry: &mut Geometry, name: String, array: &Array) -> Result<()> {
    let wrong = |expected: &str| {
        let reason = format!(
            "array `{name}` has {} columns of {}, not {expected}",
            array.columns,
            array.dtype.descr()
        );
        Err(Error::invalid(path, reason))
    };
    match (name.as_str(), array.dtype, array.columns) {
        ("positions", Dtype::F32, 3) => geometry.positions = floats(array).as_chunks().0.to_vec(),
        ("normals", Dtype::F32, 3) => geometry.normals = floats(array).as_chunks().0.to_vec(),
        ("colors", Dtype::U8, 3) => geometry.colors = array.bytes.as_chunks().0.to_vec(),
        ("triangles", Dtype::I32, 3) => {
            // A negative index turns into a huge one, which validate() rejects.
            let corners: Vec<u32> = integers(array).into_iter().map(|v| v as u32).collect();
            geometry.triangles = corners.as_chunks().0.to_vec();
        }
        ("positions" | "normals", ..) => return wrong("3 of <f4"),
        ("colors", ..) => return wrong("3 of |u1"),
        ("triangles", ..) => return wrong("3 of <i4"),
        (_, Dtype::F16 | Dtype::F32, 1) => push(geometry, name, AttributeValues::F32(floats(array))),
        (_, Dtype::I32, 1) => push(geometry, name, AttributeValues::I32(integers(array))),
        (_, Dtype::U8, 1) => push(geometry, name, AttributeValues::U8(array.bytes.to_vec())),
        (_, Dtype::F16 | Dtype::F32, dim) => {
            geometry.features.push(Features { name, dim, values: floats(array) })
        }
        _ => return wrong("1, or any number of <f4"),
    }
    Ok(())
}

fn push(geometry: &mut Geometry, name: String, values: AttributeValues) {
    geometry.attributes.push(Attribute { name, values });
}

fn floats(array: &Array) -> Vec<f32> {
    if array.dtype == Dtype::F16 {
        return array.bytes.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect();
    }
    array.bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

fn integers(array: &Array) -> Vec<i32> {
    array.bytes.as_chunks().0.iter().map(|bytes| i32::from_le_bytes(*bytes)).collect()
}
