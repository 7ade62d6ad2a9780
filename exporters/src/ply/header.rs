//! The text at the head of a PLY file.

use std::path::Path;

use crate::error::{Error, Result};

/// How the values after the header are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    /// Packed, little endian.
    BinaryLittleEndian,
    /// Packed, big endian.
    BinaryBigEndian,
    /// White space between decimal numbers.
    Ascii,
}

/// A scalar type, by any of its two names in headers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes of one value.
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Whether a number read from text is a value of the type.
    pub(super) fn holds(self, value: f64) -> bool {
        let (low, high) = match self {
            Self::F32 | Self::F64 => return true,
            Self::I8 => (i8::MIN.into(), i8::MAX.into()),
            Self::U8 => (u8::MIN.into(), u8::MAX.into()),
            Self::I16 => (i16::MIN.into(), i16::MAX.into()),
            Self::U16 => (u16::MIN.into(), u16::MAX.into()),
            Self::I32 => (i32::MIN.into(), i32::MAX.into()),
            Self::U32 => (u32::MIN.into(), u32::MAX.into()),
        };
        (low..=high).contains(&value) && value.fract() == 0.0
    }

    /// The big-endian value at the start of `bytes`, as [`Self::read`].
    pub(super) fn read_big_endian(self, bytes: &[u8]) -> Option<f64> {
        let mut reversed = [0; 8];
        let reversed = &mut reversed[..self.size()];
        reversed.copy_from_slice(bytes.get(..self.size())?);
        reversed.reverse();
        self.read(reversed)
    }

    /// The little-endian value at the start of `bytes`; every type fits an f64 exactly. `None` when there are too few
    /// bytes.
    pub(super) fn read(self, bytes: &[u8]) -> Option<f64> {
        Some(match self {
            Self::I8 => f64::from(i8::from_le_bytes(*bytes.first_chunk()?)),
            Self::U8 => f64::from(u8::from_le_bytes(*bytes.first_chunk()?)),
            Self::I16 => f64::from(i16::from_le_bytes(*bytes.first_chunk()?)),
            Self::U16 => f64::from(u16::from_le_bytes(*bytes.first_chunk()?)),
            Self::I32 => f64::from(i32::from_le_bytes(*bytes.first_chunk()?)),
            Self::U32 => f64::from(u32::from_le_bytes(*bytes.first_chunk()?)),
            Self::F32 => f64::from(f32::from_le_bytes(*bytes.first_chunk()?)),
            Self::F64 => f64::from_le_bytes(*bytes.first_chunk()?),
        })
    }
}

/// A property of an element.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Property {
    pub(super) name: String,
    /// Type of the value, or of the items of a list.
    pub(super) scalar: Scalar,
    /// Type of the count, if this is a list.
    pub(super) list: Option<Scalar>,
}

/// A table of the file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: usize,
    pub(super) properties: Vec<Property>,
}

impl Element {
    /// Fewest bytes that a row can take (empty lists).
    pub(super) fn min_row_bytes(&self, encoding: Encoding) -> usize {
        match encoding {
            Encoding::Ascii => 2 * self.properties.len(),
            Encoding::BinaryLittleEndian | Encoding::BinaryBigEndian => {
                self.properties.iter().map(|p| p.list.unwrap_or(p.scalar).size()).sum()
            }
        }
    }
}

/// The whole header.
#[derive(Debug, PartialEq)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) elements: Vec<Element>,
    /// Text after `comment `.
    pub(super) comments: Vec<String>,
    /// Bytes up to and including the line end of `end_header`.
    pub(super) bytes: usize,
}

/// Parses the header at the start of a file of `file_bytes` and checks that the file is long enough for the rows it
/// announces. `head` goes at least to the end of the header.
///
/// # Errors
/// `Invalid` with the byte offset of the offending line; `Unsupported` for an unknown encoding.
pub(super) fn parse_header(path: &Path, head: &[u8], file_bytes: usize) -> Result<Header> {
    let mut header = Header { encoding: Encoding::Ascii, elements: vec![], comments: vec![], bytes: 0 };
    let mut has_format = false;
    let mut is_first = true;
    loop {
        let at = header.bytes;
        let error = |reason: String| Error::invalid_at(path, at, reason);
        let length = head[at..].iter().position(|&b| b == b'\n').ok_or_else(|| {
            error("the PLY header has no `end_header` line; the file is cut short or no PLY".into())
        })?;
        let line = std::str::from_utf8(&head[at..at + length])
            .map_err(|_| error("the PLY header is not text".into()))?
            .trim_end_matches('\r');
        header.bytes = at + length + 1;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["ply"] if is_first => {}
            _ if is_first => return Err(error("this is no PLY file: it does not start with `ply`".into())),
            ["format", encoding, "1.0"] => {
                has_format = true;
                header.encoding = parse_encoding(path, encoding)?;
            }
            ["comment" | "obj_info", ..] => {
                header.comments.push(line.split_once(' ').map_or("", |(_, text)| text).to_owned());
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| error(format!("`{count}` is no element count")))?;
                header.elements.push(Element { name: name.to_owned(), count, properties: vec![] });
            }
            ["property", ref rest @ ..] => {
                let element = header.elements.last_mut();
                let element = element.ok_or_else(|| error("a property comes before any element".into()))?;
                let property = parse_property(rest).ok_or_else(|| error(format!("cannot parse `{line}`")))?;
                element.properties.push(property);
            }
            ["end_header"] => break,
            _ => return Err(error(format!("cannot parse the header line `{line}`"))),
        }
        is_first = false;
    }
    if !has_format {
        return Err(Error::invalid(path, "the PLY header has no `format` line"));
    }
    check_size(path, &header, file_bytes)?;
    Ok(header)
}

fn parse_encoding(path: &Path, name: &str) -> Result<Encoding> {
    match name {
        "binary_little_endian" => Ok(Encoding::BinaryLittleEndian),
        "binary_big_endian" => Ok(Encoding::BinaryBigEndian),
        "ascii" => Ok(Encoding::Ascii),
        _ => Err(Error::Unsupported {
            path: path.to_owned(),
            what: format!("PLY format `{name}`"),
            remedy: "save it as binary_little_endian",
        }),
    }
}

fn parse_property(words: &[&str]) -> Option<Property> {
    match *words {
        ["list", count, item, name] => {
            let list = Scalar::parse(count).filter(|scalar| !matches!(scalar, Scalar::F32 | Scalar::F64))?;
            Some(Property { name: name.to_owned(), scalar: Scalar::parse(item)?, list: Some(list) })
        }
        [scalar, name] => {
            Some(Property { name: name.to_owned(), scalar: Scalar::parse(scalar)?, list: None })
        }
        _ => None,
    }
}

/// Rejects a header that announces more rows than the file's bytes can hold, before anything is allocated.
fn check_size(path: &Path, header: &Header, file_bytes: usize) -> Result<()> {
    let announced = header.elements.iter().try_fold(0usize, |sum, element| {
        if element.count > 0 && element.properties.is_empty() {
            return None;
        }
        sum.checked_add(element.count.checked_mul(element.min_row_bytes(header.encoding))?)
    });
    let present = file_bytes.saturating_sub(header.bytes);
    // The last number of an ASCII file may lack its line end.
    match announced {
        Some(bytes) if bytes <= present + usize::from(header.encoding == Encoding::Ascii) => Ok(()),
        Some(bytes) => Err(Error::invalid_at(
            path,
            file_bytes,
            format!(
                "the header announces at least {bytes} bytes of rows, but {present} follow; it is cut short"
            ),
        )),
        None => Err(Error::invalid(path, "the header announces rows without properties or without end")),
    }
}
