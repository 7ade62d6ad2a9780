//! The size of an image, from its header alone.
//!
//! A scene has thousands of images; opening it must not decode them. PNG tells its size in the first 24
//! bytes, JPEG in the first segments, which are walked with seeks over what is of no interest (thumbnails,
//! profiles).

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use super::error::SceneError;

/// What the header of an image says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    /// Stored width, px.
    pub width: u32,
    /// Stored height, px.
    pub height: u32,
    /// EXIF orientation, 1 = upright. Not applied: poses are of the stored pixels.
    pub orientation: u16,
}

/// The header of a frame's image. `listed_in` and `frame` are for the errors.
pub(crate) fn of_frame(listed_in: &Path, frame: &str, path: &Path) -> Result<Header, SceneError> {
    if !path.is_file() {
        return Err(SceneError::MissingFile {
            listed_in: listed_in.to_owned(),
            frame: frame.to_owned(),
            kind: "image",
            path: path.to_owned(),
            remedy: "put the image there or remove the frame from the list".into(),
        });
    }
    let file = File::open(path).map_err(|e| SceneError::io(path, e))?;
    read(&mut BufReader::with_capacity(1024, file)).map_err(|e| {
        SceneError::image(
            path,
            frame,
            format!("its header cannot be read ({e})"),
            "only JPEG and PNG are read; if it is one, it is damaged: extract the frame again",
        )
    })
}

fn read(from: &mut (impl Read + Seek)) -> io::Result<Header> {
    let mut magic = [0; 8];
    from.read_exact(&mut magic)?;
    let header = if magic == *b"\x89PNG\r\n\x1a\n" {
        read_png(from)?
    } else if magic.starts_with(&[0xff, 0xd8, 0xff]) {
        from.seek(SeekFrom::Start(2))?;
        read_jpeg(from)?
    } else {
        return Err(damaged("neither JPEG nor PNG"));
    };
    if header.width == 0 || header.height == 0 {
        return Err(damaged("an image without pixels"));
    }
    Ok(header)
}

fn damaged(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

fn read_png(from: &mut impl Read) -> io::Result<Header> {
    let mut ihdr = [0; 16];
    from.read_exact(&mut ihdr)?;
    if &ihdr[4..8] != b"IHDR" {
        return Err(damaged("PNG without IHDR"));
    }
    let number = |at: usize| u32::from_be_bytes([ihdr[at], ihdr[at + 1], ihdr[at + 2], ihdr[at + 3]]);
    Ok(Header { width: number(8), height: number(12), orientation: 1 })
}

/// Walks the segments from behind the start-of-image marker to the frame header (SOFn).
fn read_jpeg(from: &mut (impl Read + Seek)) -> io::Result<Header> {
    let mut orientation = 1;
    loop {
        let mut head = [0; 2];
        from.read_exact(&mut head)?;
        // Any number of 0xff may fill the space before a marker.
        while head == [0xff, 0xff] {
            from.read_exact(&mut head[1..])?;
        }
        if head[0] != 0xff {
            return Err(damaged("JPEG with a broken segment"));
        }
        let mut length = [0; 2];
        from.read_exact(&mut length)?;
        let length = u16::from_be_bytes(length);
        if length < 2 {
            return Err(damaged("JPEG with a broken segment"));
        }
        let body = usize::from(length) - 2;
        match head[1] {
            // SOF0 to SOF15 without DHT, JPG and DAC.
            0xc0..=0xcf if ![0xc4, 0xc8, 0xcc].contains(&head[1]) => {
                let mut sof = [0; 5];
                from.read_exact(&mut sof)?;
                let height = u16::from_be_bytes([sof[1], sof[2]]).into();
                let width = u16::from_be_bytes([sof[3], sof[4]]).into();
                return Ok(Header { width, height, orientation });
            }
            0xd9 | 0xda => return Err(damaged("JPEG without a frame header")),
            0xe1 => {
                let mut app1 = vec![0; body];
                from.read_exact(&mut app1)?;
                orientation = exif_orientation(&app1).unwrap_or(orientation);
            }
            _ => {
                from.seek_relative(body as i64)?;
            }
        }
    }
}

/// The orientation tag (0x0112) in the first directory of an EXIF segment.
fn exif_orientation(app1: &[u8]) -> Option<u16> {
    let tiff = app1.strip_prefix(b"Exif\0\0")?;
    let big_endian = match tiff.get(..4)? {
        b"MM\0*" => true,
        b"II*\0" => false,
        _ => return None,
    };
    let u16_at = |at: usize| {
        let bytes = tiff.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(if big_endian { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) })
    };
    let u32_at = |at: usize| {
        let bytes = tiff.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(if big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    };
    let directory = u32_at(4)? as usize;
    let entries = usize::from(u16_at(directory)?);
    let entry = |i: usize| directory.checked_add(2 + 12 * i);
    let at = (0..entries).map_while(entry).find(|&at| u16_at(at) == Some(0x0112))?;
    u16_at(at.checked_add(8)?).filter(|o| (1..=8).contains(o))
}

/// Whether a JPEG ends where it should: behind its scans is an end-of-image marker.
///
/// Decoders fill what a cut file lacks with grey; this tells such a file from a whole one. Bytes behind the
/// end (phones append some) do not matter.
pub(crate) fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    loop {
        // In front of a marker, or inside entropy-coded data, where 0xff 0x00 is data and RSTn go by.
        let Some(found) = bytes.get(at..).and_then(|rest| rest.iter().position(|&b| b == 0xff)) else {
            return false;
        };
        at += found + 1;
        match bytes.get(at) {
            None => return false,
            Some(0xd9) => return true,
            Some(0xff) => {}
            Some(0x00 | 0x01 | 0xd0..=0xd8) => at += 1,
            Some(_) => {
                let Some(length) = bytes.get(at + 1..at + 3) else { return false };
                at += 1 + usize::from(u16::from_be_bytes([length[0], length[1]]));
            }
        }
    }
}
