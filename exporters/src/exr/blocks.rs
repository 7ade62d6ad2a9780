//! ZIP blocks of an EXR file: sixteen lines, split into low and high bytes, differenced and deflated.
//!
//! The `exr` crate does the same with `miniz_oxide` and the general search for repetitions, which finds hardly any in
//! noise and takes most of the time. Looking for runs of one byte alone (zlib's `Z_RLE`) is several times as fast, and
//! of differences of neighbours makes smaller files besides.

use exr::prelude::FlatSamples;
use zlib_rs::{DeflateConfig, ReturnCode, Strategy, compress_bound, compress_slice};

/// Lines in a block, as the format prescribes for ZIP.
pub(super) const BLOCK_LINES: usize = 16;

/// OpenEXR's own default.
const LEVEL: i32 = 4;

/// The content of the block whose first line is `first`: compressed, or as it is where that is not shorter.
///
/// `channels` hold `[height * width]` samples each, in the order of the file.
pub(super) fn compressed_block(
    channels: &[&FlatSamples],
    width: usize,
    height: usize,
    first: usize,
) -> Vec<u8> {
    let mut lines = Vec::new();
    for y in first..(first + BLOCK_LINES).min(height) {
        for samples in channels {
            let line = y * width..(y + 1) * width;
            match samples {
                FlatSamples::F16(values) => {
                    lines.extend(values[line].iter().flat_map(|v| v.to_bits().to_le_bytes()));
                }
                FlatSamples::F32(values) => lines.extend(values[line].iter().flat_map(|v| v.to_le_bytes())),
                FlatSamples::U32(values) => lines.extend(values[line].iter().flat_map(|v| v.to_le_bytes())),
            }
        }
    }
    let config = DeflateConfig { level: LEVEL, strategy: Strategy::Rle, ..DeflateConfig::default() };
    let mut compressed = vec![0; compress_bound(lines.len())];
    match compress_slice(&mut compressed, &differences(&lines), config) {
        (bytes, ReturnCode::Ok) if bytes.len() < lines.len() => {
            let length = bytes.len();
            compressed.truncate(length);
            compressed
        }
        // A block as long as its lines is read as it is.
        _ => lines,
    }
}

/// Bytes at even places, then those at odd ones, and of each the difference to the one before, plus 128.
fn differences(lines: &[u8]) -> Vec<u8> {
    let mut split: Vec<u8> = Vec::with_capacity(lines.len());
    split.extend(lines.iter().step_by(2));
    split.extend(lines.iter().skip(1).step_by(2));
    let mut differences = Vec::with_capacity(lines.len());
    differences.extend(split.first());
    differences.extend(split.windows(2).map(|pair| pair[1].wrapping_sub(pair[0]).wrapping_add(128)));
    differences
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_those_of_the_format() {
        // By hand: even places 1 2 3 0, odd places 10 30 5; differences plus 128 in one row.
        let lines = [1, 10, 2, 30, 3, 5, 0];
        assert_eq!(differences(&lines), [1, 129, 129, 125, 138, 148, 103]);
        assert!(differences(&[]).is_empty());
    }

    #[test]
    fn what_does_not_compress_is_stored_as_it_is() {
        let noise = |i: u32| i.wrapping_mul(2_654_435_761).rotate_left(i % 32) ^ i.wrapping_mul(40_503);
        let values: Vec<f32> = (0..64u32).map(|i| f32::from_bits(noise(i))).collect();
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(compressed_block(&[&FlatSamples::F32(values)], 8, 8, 0), bytes);
    }
}
