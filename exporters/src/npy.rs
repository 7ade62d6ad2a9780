//! One array of numbers as numpy stores it (`numpy.lib.format`): the header, reading and writing.
//!
//! What is read: C-ordered little-endian arrays of floats and integers with any number of dimensions. Nothing is
//! allocated before the header's shape has been compared with the bytes that are really there.

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;

use half::f16;

use crate::atomic::write_atomically;
use crate::error::{Error, Result};
use crate::rows::write_words;

const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// The longest header that is believed: magic, version, length, and a dictionary of three short entries.
const MAX_HEADER: usize = 64 * 1024;

/// Element type of an array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Dtype {
    F16,
    F32,
    F64,
    U8,
    U16,
    I16,
    I32,
    I64,
}

impl Dtype {
    const ALL: [Self; 8] =
        [Self::F16, Self::F32, Self::F64, Self::U8, Self::U16, Self::I16, Self::I32, Self::I64];

    /// numpy's name of the type, as in `<f4`.
    pub fn descr(self) -> &'static str {
        match self {
            Self::F16 => "<f2",
            Self::F32 => "<f4",
            Self::F64 => "<f8",
            Self::U8 => "|u1",
            Self::U16 => "<u2",
            Self::I16 => "<i2",
            Self::I32 => "<i4",
            Self::I64 => "<i8",
        }
    }

    /// Bytes of one element.
    pub fn size(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::F16 | Self::U16 | Self::I16 => 2,
            Self::F32 | Self::I32 => 4,
            Self::F64 | Self::I64 => 8,
        }
    }

    /// Whether elements are floating-point numbers.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F16 | Self::F32 | Self::F64)
    }
}

/// Type and shape of an array, without its values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NpyHeader {
    /// Element type.
    pub dtype: Dtype,
    /// Lengths, slowest dimension first.
    pub shape: Vec<usize>,
}

impl NpyHeader {
    /// Bytes of all values; `None` if no memory could hold them.
    pub fn bytes(&self) -> Option<usize> {
        let items = self.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        items.and_then(|n| n.checked_mul(self.dtype.size()))
    }
}

/// An array in memory, its values as they were stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NpyArray {
    /// Type and shape.
    pub header: NpyHeader,
    bytes: Vec<u8>,
}

impl NpyArray {
    /// All values as f32, in stored order. Integers and f64 are rounded to the nearest f32; an f64 beyond its
    /// range becomes infinite.
    pub fn to_f32(&self) -> Vec<f32> {
        let b = &self.bytes;
        match self.header.dtype {
            Dtype::F16 => b.as_chunks().0.iter().map(|c| f16::from_le_bytes(*c).to_f32()).collect(),
            Dtype::F32 => b.as_chunks().0.iter().map(|c| f32::from_le_bytes(*c)).collect(),
            Dtype::F64 => b.as_chunks().0.iter().map(|c| f64::from_le_bytes(*c) as f32).collect(),
            _ => self.integers().map(|v| v as f32).collect(),
        }
    }

    /// All values as i64, in stored order; `None` for an array of floats.
    pub fn to_i64(&self) -> Option<Vec<i64>> {
        (!self.header.dtype.is_float()).then(|| self.integers().collect())
    }

    fn integers(&self) -> Box<dyn Iterator<Item = i64> + '_> {
        let b = &self.bytes;
        match self.header.dtype {
            Dtype::U8 => Box::new(b.iter().map(|v| i64::from(*v))),
            Dtype::U16 => Box::new(b.as_chunks().0.iter().map(|c| i64::from(u16::from_le_bytes(*c)))),
            Dtype::I16 => Box::new(b.as_chunks().0.iter().map(|c| i64::from(i16::from_le_bytes(*c)))),
            Dtype::I32 => Box::new(b.as_chunks().0.iter().map(|c| i64::from(i32::from_le_bytes(*c)))),
            Dtype::I64 => Box::new(b.as_chunks().0.iter().map(|c| i64::from_le_bytes(*c))),
            Dtype::F16 | Dtype::F32 | Dtype::F64 => Box::new(std::iter::empty()),
        }
    }
}

/// Reads a `.npy` file.
///
/// # Errors
/// `Io`; `Invalid` for a damaged header or a file that is shorter or longer than its shape says; `Unsupported` for
/// other types (complex numbers, objects, big-endian) and Fortran order.
pub fn read_npy(path: &Path) -> Result<NpyArray> {
    let file = std::fs::read(path).map_err(|source| Error::io(path, source))?;
    let (header, values) = parse(path, "", &file)?;
    Ok(NpyArray { header, bytes: values.to_vec() })
}

/// Reads type and shape of a `.npy` file and checks that the file is as long as they say.
///
/// # Errors
/// As for [`read_npy`].
pub fn read_npy_header(path: &Path) -> Result<NpyHeader> {
    let file = File::open(path).map_err(|source| Error::io(path, source))?;
    let length = file.metadata().map_err(|source| Error::io(path, source))?.len();
    let mut start = Vec::new();
    file.take(MAX_HEADER as u64).read_to_end(&mut start).map_err(|source| Error::io(path, source))?;
    let (header, values) = parse_header(path, "", &start)?;
    let expected = header.bytes().and_then(|n| n.checked_add(start.len() - values.len()));
    if expected.map(|n| n as u64) != Some(length) {
        return Err(wrong_length(
            path,
            "",
            &header,
            length.saturating_sub((start.len() - values.len()) as u64),
        ));
    }
    Ok(header)
}

/// Writes an f32 array of any shape, atomically.
///
/// # Errors
/// `Io`; `Inconsistent` when `values` is not as long as `shape` says.
pub fn write_npy(path: &Path, shape: &[usize], values: &[f32]) -> Result<()> {
    write_array(path, NpyHeader { dtype: Dtype::F32, shape: shape.to_vec() }, bytemuck::cast_slice(values))
}

/// Writes an i32 array of any shape, atomically.
///
/// # Errors
/// As for [`write_npy`].
pub fn write_npy_i32(path: &Path, shape: &[usize], values: &[i32]) -> Result<()> {
    write_array(path, NpyHeader { dtype: Dtype::I32, shape: shape.to_vec() }, bytemuck::cast_slice(values))
}

fn write_array(path: &Path, header: NpyHeader, values: &[u32]) -> Result<()> {
    if header.bytes() != Some(size_of_val(values)) {
        let reason = format!("{} values do not make an array of {:?}", values.len(), header.shape);
        return Err(Error::inconsistent(&path.display().to_string(), reason));
    }
    write_atomically(path, |file| {
        file.write_all(&header_bytes(header.dtype, &header.shape))?;
        write_words(file, values)
    })
}

/// Header of a C-ordered array, padded so that the values start at a multiple of 64 bytes.
pub(crate) fn header_bytes(dtype: Dtype, shape: &[usize]) -> Vec<u8> {
    let shape = match shape {
        [one] => format!("({one},)"),
        _ => format!("({})", shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")),
    };
    let mut text = format!("{{'descr': '{}', 'fortran_order': False, 'shape': {shape}, }}", dtype.descr());
    let unpadded = MAGIC.len() + 2 + 2 + text.len() + 1;
    text.extend(std::iter::repeat_n(' ', unpadded.next_multiple_of(64) - unpadded));
    text.push('\n');
    let mut header = MAGIC.to_vec();
    header.extend([1, 0]);
    // A few numbers of at most 20 digits: far below 65,536.
    header.extend((text.len() as u16).to_le_bytes());
    header.extend(text.bytes());
    header
}

/// Splits a whole file into header and values. `name` is for messages; empty if the file is one array.
pub(crate) fn parse<'a>(path: &Path, name: &str, file: &'a [u8]) -> Result<(NpyHeader, &'a [u8])> {
    let (header, values) = parse_header(path, name, file)?;
    if header.bytes() != Some(values.len()) {
        return Err(wrong_length(path, name, &header, values.len() as u64));
    }
    Ok((header, values))
}

fn wrong_length(path: &Path, name: &str, header: &NpyHeader, bytes: u64) -> Error {
    let NpyHeader { dtype, shape } = header;
    let reason = format!("shape {shape:?} of {} does not fit {bytes} bytes of values", dtype.descr());
    Error::invalid(path, in_array(name, &reason))
}

fn in_array(name: &str, what: &str) -> String {
    if name.is_empty() { what.to_owned() } else { format!("array `{name}`: {what}") }
}

/// Type, shape, and what follows the header.
pub(crate) fn parse_header<'a>(path: &Path, name: &str, file: &'a [u8]) -> Result<(NpyHeader, &'a [u8])> {
    let invalid = |reason: &str| Error::invalid(path, in_array(name, reason));
    let unsupported = |what: String| Error::Unsupported {
        path: path.to_owned(),
        what: in_array(name, &what),
        remedy: "save C-ordered little-endian arrays of floats or integers (np.ascontiguousarray, astype)",
    };
    let (text, values) =
        split_header(file).ok_or_else(|| invalid("the NPY header is damaged or cut short"))?;
    let descr = value_of(text, "descr").ok_or_else(|| invalid("no `descr` in the header"))?;
    let dtype = Dtype::ALL
        .into_iter()
        .find(|dtype| descr.starts_with(&format!("'{}'", dtype.descr())))
        .ok_or_else(|| unsupported(format!("its type {}", descr.split(',').next().unwrap_or(descr))))?;
    match value_of(text, "fortran_order") {
        Some(order) if order.starts_with("False") => {}
        Some(_) => return Err(unsupported("Fortran order".into())),
        None => return Err(invalid("no `fortran_order` in the header")),
    }
    let shape = value_of(text, "shape").and_then(|shape| shape.strip_prefix('(')?.split_once(')'));
    let (shape, _) = shape.ok_or_else(|| invalid("no `shape` in the header"))?;
    let shape: std::result::Result<Vec<usize>, _> =
        shape.split(',').map(str::trim).filter(|n| !n.is_empty()).map(str::parse).collect();
    let shape = shape.map_err(|_| invalid("its shape is no numbers"))?;
    Ok((NpyHeader { dtype, shape }, values))
}

/// Header text and what follows it. Versions 2 and 3 have a four-byte length.
fn split_header(file: &[u8]) -> Option<(&str, &[u8])> {
    let (version, rest) = file.strip_prefix(MAGIC)?.split_first_chunk::<2>()?;
    let (length, rest) = match version[0] {
        1 => rest.split_first_chunk::<2>().map(|(n, rest)| (usize::from(u16::from_le_bytes(*n)), rest))?,
        2 | 3 => rest.split_first_chunk::<4>().map(|(n, rest)| (u32::from_le_bytes(*n) as usize, rest))?,
        _ => return None,
    };
    let (text, values) = rest.split_at_checked(length)?;
    Some((std::str::from_utf8(text).ok()?, values))
}

/// What comes after `'key':` in the Python dictionary.
fn value_of<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let (_, after) = text.split_once(&format!("'{key}':"))?;
    Some(after.trim_start())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrays_come_back_with_their_shape() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let values: Vec<f32> = (0..24).map(|i| i as f32 * 0.5).collect();
        for shape in [vec![24], vec![2, 12], vec![2, 3, 4]] {
            write_npy(&path, &shape, &values).unwrap();
            let back = read_npy(&path).unwrap();
            assert_eq!((back.header.shape.clone(), back.to_f32()), (shape, values.clone()));
            assert_eq!(read_npy_header(&path).unwrap(), back.header);
            assert_eq!(back.to_i64(), None, "floats are no integers");
        }
        write_npy_i32(&path, &[3], &[-1, 0, 7]).unwrap();
        assert_eq!(read_npy(&path).unwrap().to_i64(), Some(vec![-1, 0, 7]));
    }

    #[test]
    fn every_truncation_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        write_npy(&path, &[2, 3], &[1.0; 6]).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for length in 0..whole.len() {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert!(read_npy(&path).is_err(), "{length} bytes were read");
            assert!(read_npy_header(&path).is_err(), "{length} bytes have a header");
        }
    }

    #[test]
    fn half_floats_of_numpy_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let mut file = header_bytes(Dtype::F16, &[2]);
        file.extend([f16::from_f32(0.25), f16::from_f32(-3.0)].map(f16::to_le_bytes).concat());
        std::fs::write(&path, file).unwrap();
        assert_eq!(read_npy(&path).unwrap().to_f32(), [0.25, -3.0]);
    }
}
