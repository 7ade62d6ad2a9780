//! The GLB container: a 12-byte header, a JSON chunk and a binary chunk.

use std::io::{self, Write};
use std::path::Path;

use crate::error::{Error, Result};

const MAGIC: &[u8; 4] = b"glTF";
const VERSION: u32 = 2;
const JSON_CHUNK: u32 = 0x4E4F_534A;
const BIN_CHUNK: u32 = 0x004E_4942;
const HEADER_BYTES: usize = 12;
const CHUNK_HEADER_BYTES: usize = 8;

/// Total file size for these chunks; `None` beyond the 4 GiB that the header can say.
pub(super) fn total_bytes(json_bytes: usize, bin_bytes: usize) -> Option<u32> {
    let bin = if bin_bytes == 0 { 0 } else { CHUNK_HEADER_BYTES.checked_add(bin_bytes)? };
    let total = (HEADER_BYTES + CHUNK_HEADER_BYTES).checked_add(json_bytes)?.checked_add(bin)?;
    u32::try_from(total).ok()
}

/// Writes everything before the binary data. `json` and `bin_bytes` are multiples of four long.
pub(super) fn write_head(file: &mut impl Write, total: u32, json: &[u8], bin_bytes: usize) -> io::Result<()> {
    file.write_all(MAGIC)?;
    // total_bytes() has seen that the lengths fit.
    for word in [VERSION, total, json.len() as u32, JSON_CHUNK] {
        file.write_all(&word.to_le_bytes())?;
    }
    file.write_all(json)?;
    if bin_bytes > 0 {
        file.write_all(&(bin_bytes as u32).to_le_bytes())?;
        file.write_all(&BIN_CHUNK.to_le_bytes())?;
    }
    Ok(())
}

/// The JSON text and the binary data (empty if there is none) of a file.
///
/// # Errors
/// `Invalid` with the offset when a length contradicts the file's size or a chunk is not what it should be.
pub(super) fn split<'a>(path: &Path, file: &'a [u8]) -> Result<(&'a [u8], &'a [u8])> {
    if !file.starts_with(MAGIC) {
        return Err(Error::invalid_at(path, 0, "this is no GLB file: it does not start with `glTF`"));
    }
    if word(path, file, 4)? != VERSION {
        return Err(Error::invalid_at(path, 4, "the GLB version is not 2"));
    }
    let total = word(path, file, 8)?;
    if total as usize != file.len() {
        let reason =
            format!("the header says {total} bytes but the file has {}; is it cut short?", file.len());
        return Err(Error::invalid_at(path, 8, reason));
    }
    let (json, next) = chunk(path, file, HEADER_BYTES, JSON_CHUNK)?;
    if next == file.len() {
        return Ok((json, &[]));
    }
    let (bin, _) = chunk(path, file, next, BIN_CHUNK)?;
    Ok((json, bin))
}

fn word(path: &Path, file: &[u8], at: usize) -> Result<u32> {
    let bytes = file.get(at..).and_then(|rest| rest.first_chunk());
    let bytes = bytes.ok_or_else(|| Error::invalid_at(path, at, "the file is cut short"))?;
    Ok(u32::from_le_bytes(*bytes))
}

/// The content of the chunk at `at` and where the next one starts.
fn chunk<'a>(path: &Path, file: &'a [u8], at: usize, kind: u32) -> Result<(&'a [u8], usize)> {
    let length = word(path, file, at)? as usize;
    if word(path, file, at + 4)? != kind {
        return Err(Error::invalid_at(path, at + 4, format!("expected a chunk of type {kind:#010x}")));
    }
    let start = at + CHUNK_HEADER_BYTES;
    let content = file[start..].get(..length);
    let content = content.ok_or_else(|| Error::invalid_at(path, at, "the chunk is longer than the file"))?;
    Ok((content, start + length))
}
