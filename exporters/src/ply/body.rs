//! The bytes after the header: vertices as matrices, faces as triangles.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Mutex;

use rayon::prelude::*;

use super::header::{Element, Encoding, Header, Property, Scalar, parse_header};
use super::layout::Layout;
use super::matrix::{Matrix, Part, Unpacker};
use crate::error::{Error, Result};

/// Bytes of the header that are read at first; a longer one is read in doubling steps.
const HEAD_BYTES: u64 = 64 * 1024;

/// Bytes read and unpacked by one task.
const CHUNK_BYTES: usize = 256 * 1024;

/// Longer headers are taken for damaged: each of its lines takes many times its length in memory.
const MAX_HEAD_BYTES: u64 = 1 << 20;

/// Fewest rows unpacked by one task, so that the tasks' bookkeeping stays below the size of the rows.
const MIN_ROWS: usize = 64;

/// Count byte and three 32-bit indices.
const TRIANGLE_BYTES: usize = 13;

/// An open file and a position in it.
pub(super) struct Body<'a> {
    path: &'a Path,
    file: Mutex<File>,
    encoding: Encoding,
    /// From the start of the file.
    at: usize,
    /// The bytes from `rest_at` to the end, once something needed them one by one.
    rest: Option<Vec<u8>>,
    rest_at: usize,
}

impl<'a> Body<'a> {
    /// Reads the header.
    ///
    /// # Errors
    /// `Io`, and those of [`parse_header`].
    pub(super) fn open(path: &'a Path) -> Result<(Header, Self)> {
        let io_error = |source| Error::io(path, source);
        let mut file = File::open(path).map_err(io_error)?;
        let head = read_head(&mut file).map_err(io_error)?;
        let bytes = file.metadata().map_err(io_error)?.len();
        let header = parse_header(path, &head, usize::try_from(bytes).unwrap_or(usize::MAX))?;
        let (encoding, at) = (header.encoding, header.bytes);
        Ok((header, Self { path, file: Mutex::new(file), encoding, at, rest: None, rest_at: at }))
    }

    /// The layout's matrices of an element without lists.
    ///
    /// # Errors
    /// `Io`; `Invalid` for an early end and for text that is no number of the property's type.
    pub(super) fn read_matrices(&mut self, element: &Element, layout: &Layout) -> Result<Vec<Matrix>> {
        // check_size() has seen that the file holds this many values.
        let mut matrices: Vec<Matrix> =
            layout.shapes.iter().map(|shape| Matrix::zeros(shape, element.count)).collect();
        if self.encoding == Encoding::Ascii {
            self.parse_rows(element, layout, &mut matrices)?;
        } else {
            self.unpack_rows(element, layout, &mut matrices)?;
        }
        Ok(matrices)
    }

    /// Reads chunks of rows into a buffer for each thread and unpacks them from there, so that the file is never whole
    /// in memory.
    fn unpack_rows(&mut self, element: &Element, layout: &Layout, matrices: &mut [Matrix]) -> Result<()> {
        let unpacker = Unpacker::new(self.encoding, element, layout);
        let rows_per_chunk = (CHUNK_BYTES / unpacker.stride.max(1)).max(MIN_ROWS);
        let mut chunks: Vec<Vec<Part>> =
            (0..element.count.div_ceil(rows_per_chunk)).map(|_| Vec::new()).collect();
        for (matrix, shape) in matrices.iter_mut().zip(&layout.shapes) {
            for (chunk, part) in chunks.iter_mut().zip(matrix.parts(rows_per_chunk * shape.width)) {
                chunk.push(part);
            }
        }
        chunks
            .into_par_iter()
            .enumerate()
            .try_for_each_init(Vec::new, |buffer, (chunk, mut parts)| {
                let first_row = chunk * rows_per_chunk;
                let rows = rows_per_chunk.min(element.count - first_row);
                buffer.resize(rows * unpacker.stride, 0);
                self.read_at(self.at + first_row * unpacker.stride, buffer)?;
                unpacker.unpack(buffer, &mut parts);
                Ok(())
            })
            .map_err(|error| self.read_error(error))?;
        self.at += element.count * unpacker.stride;
        Ok(())
    }

    fn parse_rows(&mut self, element: &Element, layout: &Layout, matrices: &mut [Matrix]) -> Result<()> {
        let lengths = layout.shapes.iter().map(|shape| element.count.max(1) * shape.width.max(1));
        let mut parts: Vec<Part> = matrices
            .iter_mut()
            .zip(lengths)
            .filter_map(|(matrix, length)| matrix.parts(length).next())
            .collect();
        for row in 0..element.count {
            for (property, place) in element.properties.iter().zip(&layout.places) {
                let at = self.at;
                let value = self.next(property.scalar)?;
                let Some(place) = place else { continue };
                if !property.scalar.holds(value) {
                    let reason = format!("{value} does not fit the type of `{}`", property.name);
                    return Err(Error::invalid_at(self.path, at, reason));
                }
                parts[place.matrix].set(row * layout.shapes[place.matrix].width + place.column, value);
            }
        }
        Ok(())
    }

    /// Polygons as fans of triangles.
    ///
    /// # Errors
    /// `Io`; `Invalid` for an early end and for corners that are no vertex indices.
    pub(super) fn read_faces(&mut self, element: &Element, triangles: &mut Vec<[u32; 3]>) -> Result<()> {
        if let Some(all) = self.plain_triangles(element)? {
            triangles.extend(all);
            return Ok(());
        }
        let mut corners = Vec::new();
        for _ in 0..element.count {
            for property in &element.properties {
                let at = self.at;
                let is_corners = matches!(property.name.as_str(), "vertex_indices" | "vertex_index");
                let count = self.list_length(property)?;
                corners.clear();
                for _ in 0..count {
                    let value = self.next(property.scalar)?;
                    if is_corners {
                        corners.push(corner(value).ok_or_else(|| {
                            Error::invalid_at(self.path, at, format!("{value} is no vertex index"))
                        })?);
                    }
                }
                for pair in corners.get(1..).unwrap_or(&[]).windows(2) {
                    triangles.push([corners[0], pair[0], pair[1]]);
                }
            }
        }
        Ok(())
    }

    /// The faces, if they are stored as our writer does: triangles of 32-bit indices and nothing else.
    fn plain_triangles(&mut self, element: &Element) -> Result<Option<Vec<[u32; 3]>>> {
        let is_plain = matches!(&element.properties[..],
            [Property { name, scalar: Scalar::I32 | Scalar::U32, list: Some(Scalar::U8) }]
                if matches!(name.as_str(), "vertex_indices" | "vertex_index"));
        if !is_plain || self.encoding != Encoding::BinaryLittleEndian {
            return Ok(None);
        }
        let at = self.at;
        // check_size() has seen that there is a byte for each row at least.
        let bytes = element.count.saturating_mul(TRIANGLE_BYTES);
        let Some(rows) = self.rest()?.get(..bytes) else { return Ok(None) };
        let rows = rows.as_chunks::<TRIANGLE_BYTES>().0;
        // An index that is negative, or would be, is left to the loop that says where it is.
        let is_triangle = |row: &[u8; TRIANGLE_BYTES]| row[0] == 3 && (row[4] | row[8] | row[12]) & 0x80 == 0;
        if !rows.par_iter().with_min_len(CHUNK_BYTES / TRIANGLE_BYTES).all(is_triangle) {
            return Ok(None);
        }
        let index = |row: &[u8; TRIANGLE_BYTES], at: usize| {
            u32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])
        };
        let triangles = rows
            .par_iter()
            .with_min_len(CHUNK_BYTES / TRIANGLE_BYTES)
            .map(|row| [index(row, 1), index(row, 5), index(row, 9)])
            .collect();
        self.at = at + bytes;
        Ok(Some(triangles))
    }

    /// Goes past an element.
    ///
    /// # Errors
    /// `Io`; `Invalid` for an early end.
    pub(super) fn skip(&mut self, element: &Element) -> Result<()> {
        for _ in 0..element.count {
            for property in &element.properties {
                for _ in 0..self.list_length(property)? {
                    self.next(property.scalar)?;
                }
            }
        }
        Ok(())
    }

    /// Number of values of the property in this row.
    fn list_length(&mut self, property: &Property) -> Result<usize> {
        let Some(count_type) = property.list else { return Ok(1) };
        let at = self.at;
        let count = self.next(count_type)?;
        if count < 0.0 || count.fract() != 0.0 {
            return Err(Error::invalid_at(self.path, at, format!("{count} is no list length")));
        }
        Ok(count as usize)
    }

    fn next(&mut self, scalar: Scalar) -> Result<f64> {
        match self.encoding {
            Encoding::BinaryLittleEndian => self.next_binary(scalar, Scalar::read),
            Encoding::BinaryBigEndian => self.next_binary(scalar, Scalar::read_big_endian),
            Encoding::Ascii => self.next_word(),
        }
    }

    fn next_binary(&mut self, scalar: Scalar, read: impl Fn(Scalar, &[u8]) -> Option<f64>) -> Result<f64> {
        let value = read(scalar, self.rest()?).ok_or_else(|| self.error("the file is cut short"))?;
        self.at += scalar.size();
        Ok(value)
    }

    fn next_word(&mut self) -> Result<f64> {
        let rest = self.rest()?;
        let start = rest.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(rest.len());
        let length = rest[start..].iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len() - start);
        let word = &rest[start..start + length];
        let value = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
        let value = value.ok_or_else(|| self.error("expected a number"))?;
        self.at += start + length;
        Ok(value)
    }

    /// Everything from the position to the end of the file, read when first asked for.
    fn rest(&mut self) -> Result<&[u8]> {
        if self.rest.is_none() {
            let file = self.file.get_mut().unwrap_or_else(|poisoned| poisoned.into_inner());
            let mut rest = Vec::new();
            let read = file.seek(SeekFrom::Start(self.at as u64)).and_then(|_| file.read_to_end(&mut rest));
            read.map_err(|source| Error::io(self.path, source))?;
            (self.rest, self.rest_at) = (Some(rest), self.at);
        }
        let rest = self.rest.as_deref().unwrap_or_default();
        // Rows that were unpacked from the file itself may end behind it, if it has shrunk since.
        Ok(rest.get(self.at - self.rest_at..).unwrap_or_default())
    }

    fn read_at(&self, at: usize, buffer: &mut [u8]) -> io::Result<()> {
        let mut file = self.file.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        file.seek(SeekFrom::Start(at as u64))?;
        file.read_exact(buffer)
    }

    fn read_error(&self, error: io::Error) -> Error {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => self.error("the file is cut short"),
            _ => Error::io(self.path, error),
        }
    }

    fn error(&self, reason: &str) -> Error {
        Error::invalid_at(self.path, self.at, reason)
    }
}

/// The beginning of the file, at least to the line `end_header` if there is one.
fn read_head(file: &mut File) -> io::Result<Vec<u8>> {
    const LAST_LINE: &[u8] = b"\nend_header";
    let mut head = Vec::new();
    loop {
        let before = head.len();
        let more = HEAD_BYTES.max(before as u64).min(MAX_HEAD_BYTES.saturating_sub(before as u64));
        file.by_ref().take(more).read_to_end(&mut head)?;
        // Its own line end may come with the next bytes.
        let new = &head[before.saturating_sub(LAST_LINE.len() + 2)..];
        let end = new.windows(LAST_LINE.len()).position(|window| window == LAST_LINE);
        let is_whole = end.is_some_and(|end| new[end + LAST_LINE.len()..].contains(&b'\n'));
        if is_whole || head.len() == before {
            return Ok(head);
        }
    }
}

fn corner(value: f64) -> Option<u32> {
    (value >= 0.0 && value <= f64::from(u32::MAX) && value.fract() == 0.0).then_some(value as u32)
}
