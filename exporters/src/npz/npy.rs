//! One array of an NPZ file: the NPY header (numpy's `numpy.lib.format`, version 1.0).

use std::path::Path;

use crate::error::{Error, Result};

const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// Element type of an array that this crate writes or reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Dtype {
    F32,
    I32,
    U8,
}

impl Dtype {
    pub(super) fn descr(self) -> &'static str {
        match self {
            Self::F32 => "<f4",
            Self::I32 => "<i4",
            Self::U8 => "|u1",
        }
    }

    pub(super) fn size(self) -> usize {
        match self {
            Self::F32 | Self::I32 => 4,
            Self::U8 => 1,
        }
    }
}

/// Header of a C-ordered array `[rows, columns]`, padded so that the values start at a multiple of 64 bytes.
pub(super) fn header(dtype: Dtype, rows: usize, columns: usize) -> Vec<u8> {
    let mut text =
        format!("{{'descr': '{}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}", dtype.descr());
    let unpadded = MAGIC.len() + 2 + 2 + text.len() + 1;
    text.extend(std::iter::repeat_n(' ', unpadded.next_multiple_of(64) - unpadded));
    text.push('\n');
    let mut header = MAGIC.to_vec();
    header.extend([1, 0]);
    // Two numbers of at most 20 digits: far below 65,536.
    header.extend((text.len() as u16).to_le_bytes());
    header.extend(text.bytes());
    header
}

/// An array as stored; one dimension counts as one column.
pub(super) struct Array<'a> {
    pub(super) dtype: Dtype,
    pub(super) columns: usize,
    pub(super) bytes: &'a [u8],
}

/// Parses an array of one or two dimensions.
///
/// # Errors
/// `Invalid` for contradictions, `Unsupported` for other types, orders and dimensions.
pub(super) fn parse<'a>(path: &Path, name: &str, file: &'a [u8]) -> Result<Array<'a>> {
    let invalid = |reason: &str| Error::invalid(path, format!("array `{name}`: {reason}"));
    let unsupported = |what: String| Error::Unsupported {
        path: path.to_owned(),
        what: format!("array `{name}`: {what}"),
        remedy: "save C-ordered <f4, <i4 or |u1 arrays of one or two dimensions",
    };
    let (text, bytes) =
        split_header(file).ok_or_else(|| invalid("the NPY header is damaged or cut short"))?;
    let descr = value_of(text, "descr").ok_or_else(|| invalid("no `descr` in the header"))?;
    let dtype = [Dtype::F32, Dtype::I32, Dtype::U8]
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
    let (rows, columns) = match shape.as_deref() {
        Ok([rows]) => (*rows, 1),
        Ok([rows, columns]) => (*rows, *columns),
        Ok(_) => return Err(unsupported("not one or two dimensions".into())),
        Err(_) => return Err(invalid("its shape is no numbers")),
    };
    let expected = rows.checked_mul(columns).and_then(|items| items.checked_mul(dtype.size()));
    if expected != Some(bytes.len()) {
        let reason = format!("shape ({rows}, {columns}) does not fit {} bytes of values", bytes.len());
        return Err(invalid(&reason));
    }
    Ok(Array { dtype, columns, bytes })
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
