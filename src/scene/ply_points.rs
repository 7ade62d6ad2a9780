//! The points of a PLY file, as nerfstudio's `ply_file_path` names one.

use std::path::Path;

use glam::DVec3;

use super::error::{Place, SceneError};

/// How the body of a file is written.
#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Number types of PLY.
#[derive(Clone, Copy)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// What is needed of a header to find the positions.
struct Header {
    encoding: Encoding,
    /// Offset of the first byte behind the header.
    body: usize,
    vertices: usize,
    /// Name and type of the properties of a vertex, in order.
    properties: Vec<(String, Scalar)>,
}

/// Vertex positions of a PLY file, in its own coordinates and units.
///
/// # Errors
/// [`SceneError`] with the line or byte if the file cannot be read, is cut short, or has its vertices behind
/// other elements or with lists.
pub(crate) fn read(path: &Path) -> Result<Vec<DVec3>, SceneError> {
    let bytes = std::fs::read(path).map_err(|e| SceneError::io(path, e))?;
    let header = read_header(path, &bytes)?;
    let column = |name: &str| {
        header.properties.iter().position(|p| p.0 == name).ok_or_else(|| {
            let what = format!("its vertices have no property `{name}`");
            SceneError::invalid(
                path,
                Place::File,
                what,
                "name a point cloud with x, y and z, or remove the key",
            )
        })
    };
    let columns = [column("x")?, column("y")?, column("z")?];
    match header.encoding {
        Encoding::Ascii => read_ascii(path, &bytes, &header, columns),
        _ => read_binary(path, &bytes, &header, columns),
    }
}

fn read_header(path: &Path, bytes: &[u8]) -> Result<Header, SceneError> {
    let remedy = "write the points as a plain PLY point cloud, or remove the key";
    let wrong =
        |line: usize, what: &str| SceneError::invalid(path, Place::Line(line), what.to_owned(), remedy);
    let mut header = Header { encoding: Encoding::Ascii, body: 0, vertices: 0, properties: Vec::new() };
    let (mut in_vertices, mut had_vertices) = (false, false);
    let mut line_number = 0;
    loop {
        line_number += 1;
        let rest = &bytes[header.body..];
        let end = rest
            .iter()
            .position(|&b| b == b'\n')
            .ok_or_else(|| wrong(line_number, "the header ends early"))?;
        let line = String::from_utf8_lossy(&rest[..end]);
        header.body += end + 1;
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            _ if line_number == 1 && words != ["ply"] => return Err(wrong(1, "not a PLY file")),
            ["format", encoding, _] => {
                header.encoding = match encoding {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::LittleEndian,
                    "binary_big_endian" => Encoding::BigEndian,
                    _ => return Err(wrong(line_number, "unknown encoding")),
                }
            }
            ["element", "vertex", count] => {
                header.vertices =
                    count.parse().map_err(|_| wrong(line_number, "the count is not a number"))?;
                (in_vertices, had_vertices) = (true, true);
            }
            ["element", ..] if !had_vertices => {
                return Err(wrong(line_number, "the vertices are not the first element"));
            }
            ["element", ..] => in_vertices = false,
            ["property", "list", ..] if in_vertices => {
                return Err(wrong(line_number, "the vertices have a list property"));
            }
            ["property", kind, name] if in_vertices => {
                let kind = scalar(kind).ok_or_else(|| wrong(line_number, "unknown property type"))?;
                header.properties.push((name.to_owned(), kind));
            }
            ["end_header"] if had_vertices => return Ok(header),
            ["end_header"] => return Err(wrong(line_number, "the file has no vertices")),
            _ => {}
        }
    }
}

fn scalar(name: &str) -> Option<Scalar> {
    Some(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        _ => return None,
    })
}

fn read_ascii(
    path: &Path,
    bytes: &[u8],
    header: &Header,
    columns: [usize; 3],
) -> Result<Vec<DVec3>, SceneError> {
    let first = bytes[..header.body].iter().filter(|&&b| b == b'\n').count() + 1;
    let mut lines = bytes[header.body..].split(|&b| b == b'\n').enumerate();
    let mut points = Vec::new();
    for _ in 0..header.vertices {
        let wrong = |index: usize| {
            let what = format!("vertex {} of {} cannot be read", points.len(), header.vertices);
            SceneError::invalid(path, Place::Line(first + index), what, "the file is cut short or damaged")
        };
        let (index, line) = lines.next().ok_or_else(|| wrong(points.len()))?;
        let line = std::str::from_utf8(line).map_err(|_| wrong(index))?;
        let words: Vec<&str> = line.split_whitespace().collect();
        let mut position = [0.0; 3];
        for (slot, &column) in position.iter_mut().zip(&columns) {
            *slot = words.get(column).and_then(|w| w.parse().ok()).ok_or_else(|| wrong(index))?;
        }
        points.push(DVec3::from(position));
    }
    Ok(points)
}

fn read_binary(
    path: &Path,
    bytes: &[u8],
    header: &Header,
    columns: [usize; 3],
) -> Result<Vec<DVec3>, SceneError> {
    let little = header.encoding == Encoding::LittleEndian;
    let mut offsets = Vec::with_capacity(header.properties.len());
    let mut stride = 0;
    for (_, kind) in &header.properties {
        offsets.push(stride);
        stride += size(*kind);
    }
    let body = &bytes[header.body..];
    if header.vertices.checked_mul(stride).is_none_or(|needed| needed > body.len()) {
        let what = format!("{} vertices of {stride} bytes do not fit into the file", header.vertices);
        let at = Place::Byte(bytes.len() as u64);
        return Err(SceneError::invalid(path, at, what, "the file is cut short: write it again"));
    }
    let rows = body.chunks_exact(stride).take(header.vertices);
    Ok(rows
        .map(|row| DVec3::from(columns.map(|c| number(&row[offsets[c]..], header.properties[c].1, little))))
        .collect())
}

fn size(kind: Scalar) -> usize {
    match kind {
        Scalar::I8 | Scalar::U8 => 1,
        Scalar::I16 | Scalar::U16 => 2,
        Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
        Scalar::F64 => 8,
    }
}

/// The number at the start of `bytes`, which holds at least [`size`] bytes.
fn number(bytes: &[u8], kind: Scalar, little: bool) -> f64 {
    let mut raw = [0; 8];
    let n = size(kind);
    raw[..n].copy_from_slice(&bytes[..n]);
    if !little {
        raw[..n].reverse();
    }
    let bits = u64::from_le_bytes(raw);
    match kind {
        Scalar::I8 => f64::from(bits as i8),
        Scalar::U8 => f64::from(bits as u8),
        Scalar::I16 => f64::from(bits as i16),
        Scalar::U16 => f64::from(bits as u16),
        Scalar::I32 => f64::from(bits as i32),
        Scalar::U32 => f64::from(bits as u32),
        Scalar::F32 => f64::from(f32::from_bits(bits as u32)),
        Scalar::F64 => f64::from_bits(bits),
    }
}
