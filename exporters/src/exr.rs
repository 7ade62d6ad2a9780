//! EXR: a rendered view as named channels, in the one form that OpenEXR, Blender and viewers agree on.
//!
//! One unnamed part, scan lines in increasing Y, ZIP over blocks of 16 lines. Channel names are the caller's:
//! `R G B`, `depth.Z`, `relevancy_<slug>.Y`, `clip_000.R` … (`docs/formats.md`).

mod blocks;

use std::fs::File;
use std::io::{self, BufReader};
use std::path::Path;

use exr::block::chunk::{Chunk, CompressedBlock, CompressedScanLineBlock};
use exr::block::writer::ChunksWriter;
use exr::prelude as x;
use exr::prelude::{ReadChannels, ReadLayers, WritableImage};
use half::f16;
use rayon::prelude::*;

use self::blocks::{BLOCK_LINES, compressed_block};
use crate::atomic::{AtomicWriter, write_atomically};
use crate::error::{Error, Result};
use crate::validate::{first_non_finite, position_of_first};

/// Values of one channel, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub enum ExrSamples {
    /// Half precision: colours, scores, features.
    F16(Vec<f16>),
    /// Full precision: depth, ids.
    F32(Vec<f32>),
}

/// One named channel.
#[derive(Clone, Debug, PartialEq)]
pub struct ExrChannel {
    /// Name with layer: `R`, `depth.Z`, `clip_000.R`.
    pub name: String,
    /// `[height * width]`.
    pub samples: ExrSamples,
}

/// A picture of named channels.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExrImage {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// Channels in any order; files list them by name.
    pub channels: Vec<ExrChannel>,
}

/// How the pixels are stored. Others than [`Self::Zip`] are there to be compared with it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ExrCompression {
    /// As they are.
    None,
    /// Deflated, in blocks of 16 lines.
    #[default]
    Zip,
    /// Wavelets and Huffman's codes.
    Piz,
    /// Deflated; f32 loses the last 8 of its 24 digits, f16 nothing.
    Pxr24,
}

/// More pixels than this along a side are taken for a damaged header.
const MAX_SIDE: usize = 1 << 20;

/// zlib and the run-length coders cannot expand by more than about this factor.
const MAX_EXPANSION: u64 = 1032;

impl ExrImage {
    /// The channel of this name.
    pub fn channel(&self, name: &str) -> Option<&ExrSamples> {
        self.channels.iter().find(|channel| channel.name == name).map(|channel| &channel.samples)
    }

    fn validate(&self, object: &str) -> Result<()> {
        let wrong = |reason: String| Err(Error::inconsistent(object, reason));
        if self.width == 0 || self.height == 0 || self.width.max(self.height) > MAX_SIDE {
            return wrong(format!("{}×{} px is no picture size", self.width, self.height));
        }
        if self.channels.is_empty() {
            return wrong("there are no channels".into());
        }
        let mut names: Vec<_> = self.channels.iter().map(|channel| channel.name.as_str()).collect();
        names.sort_unstable();
        if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            return wrong(format!("there are two channels `{}`", pair[0]));
        }
        for channel in &self.channels {
            if !is_channel_name(&channel.name) {
                return wrong(format!("`{}` is no channel name (ASCII, at most 255 bytes)", channel.name));
            }
            let length = match &channel.samples {
                ExrSamples::F16(values) => values.len(),
                ExrSamples::F32(values) => values.len(),
            };
            if length != self.width * self.height {
                return wrong(format!("`{}` has {length} values, not one per pixel", channel.name));
            }
            channel.check_finite(object)?;
        }
        Ok(())
    }
}

impl ExrChannel {
    fn check_finite(&self, object: &str) -> Result<()> {
        let bad = match &self.samples {
            ExrSamples::F16(values) => {
                position_of_first(values, |v| !v.is_finite()).map(|row| (row, values[row].to_f64()))
            }
            ExrSamples::F32(values) => first_non_finite(values).map(|row| (row, f64::from(values[row]))),
        };
        match bad {
            Some((row, value)) => {
                let column = self.name.clone();
                Err(Error::NonFinite { object: object.to_owned(), column, row, value })
            }
            None => Ok(()),
        }
    }
}

fn is_channel_name(name: &str) -> bool {
    (1..=255).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_graphic())
}

/// Writes a picture, deflated. Takes it by value: the samples are moved, not copied.
///
/// # Errors
/// `Inconsistent` for wrong lengths, sizes or names; `NonFinite` with channel and pixel; `Io`.
pub fn write_exr(path: &Path, image: ExrImage) -> Result<()> {
    write_exr_with(path, image, ExrCompression::Zip)
}

/// As [`write_exr`], with another compression.
///
/// # Errors
/// As for [`write_exr`].
pub fn write_exr_with(path: &Path, image: ExrImage, compression: ExrCompression) -> Result<()> {
    image.validate(&path.display().to_string())?;
    let channels = image.channels.into_iter().map(|channel| {
        let samples = match channel.samples {
            ExrSamples::F16(values) => x::FlatSamples::F16(values),
            ExrSamples::F32(values) => x::FlatSamples::F32(values),
        };
        x::AnyChannel::new(x::Text::from(channel.name.as_str()), samples)
    });
    let channels = x::AnyChannels::sort(channels.collect());
    let encoding = x::Encoding {
        compression: match compression {
            ExrCompression::None => x::Compression::Uncompressed,
            ExrCompression::Zip => x::Compression::ZIP16,
            ExrCompression::Piz => x::Compression::PIZ,
            ExrCompression::Pxr24 => x::Compression::PXR24,
        },
        blocks: x::Blocks::ScanLines,
        line_order: x::LineOrder::Increasing,
    };
    let size = (image.width, image.height);
    // Default attributes: a part with a name would make Blender turn every channel group into a layer.
    let picture =
        x::Image::from_layer(x::Layer::new(size, x::LayerAttributes::default(), encoding, channels));
    write_atomically(path, |file| {
        let written = match compression {
            ExrCompression::Zip => write_blocks(file, &picture),
            _ => picture.write().to_buffered(file),
        };
        written.map_err(|error| match error {
            exr::error::Error::Io(source) => source,
            other => io::Error::other(other),
        })
    })
}

type Picture = x::Image<x::Layer<x::AnyChannels<x::FlatSamples>>>;

/// Compresses blocks on all cores, some for each at a time, and writes them in order.
fn write_blocks(file: &mut AtomicWriter, picture: &Picture) -> exr::error::UnitResult {
    let layer = &picture.layer_data;
    let channels: Vec<_> = layer.channel_data.list.iter().map(|channel| &channel.sample_data).collect();
    let (width, height) = (layer.size.width(), layer.size.height());
    let block_count = height.div_ceil(BLOCK_LINES);
    let at_once = 4 * rayon::current_num_threads();
    exr::block::write(file, picture.write().infer_meta_data(), true, |_, writer| {
        for first in (0..block_count).step_by(at_once) {
            let blocks: Vec<Vec<u8>> = (first..(first + at_once).min(block_count))
                .into_par_iter()
                .map(|block| compressed_block(&channels, width, height, block * BLOCK_LINES))
                .collect();
            for (index, compressed_pixels_le) in (first..).zip(blocks) {
                // MAX_SIDE is far below what an i32 holds.
                let y_coordinate = (index * BLOCK_LINES) as i32;
                let block = CompressedScanLineBlock { y_coordinate, compressed_pixels_le };
                let chunk = Chunk { layer_index: 0, compressed_block: CompressedBlock::ScanLine(block) };
                writer.write_chunk(index, chunk)?;
            }
        }
        Ok(())
    })
}

/// Reads the first part of a scan-line or tiled file; channels come in the order of their names.
///
/// # Errors
/// `Io`; `Invalid` for damaged and truncated files and for channels that skip pixels; `NonFinite`;
/// `Unsupported` for integer channels and deep pictures.
pub fn read_exr(path: &Path) -> Result<ExrImage> {
    check_size(path)?;
    let file = File::open(path).map_err(|source| Error::io(path, source))?;
    let read = x::read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
    let picture =
        read.all_attributes().from_buffered(BufReader::new(file)).map_err(|e| exr_error(path, e))?;
    let size = picture.layer_data.size;
    let mut image = ExrImage { width: size.width(), height: size.height(), channels: vec![] };
    for channel in picture.layer_data.channel_data.list {
        let name = channel.name.to_string();
        let samples = match channel.sample_data {
            x::FlatSamples::F16(values) => ExrSamples::F16(values),
            x::FlatSamples::F32(values) => ExrSamples::F32(values),
            x::FlatSamples::U32(_) => {
                return Err(Error::Unsupported {
                    path: path.to_owned(),
                    what: format!("the integer channel `{name}`"),
                    remedy: "store it as a float channel",
                });
            }
        };
        image.channels.push(ExrChannel { name, samples });
    }
    image.validate(&path.display().to_string()).map_err(|error| match error {
        Error::Inconsistent { reason, .. } => Error::invalid(path, reason),
        other => other,
    })?;
    Ok(image)
}

fn exr_error(path: &Path, error: exr::error::Error) -> Error {
    match error {
        // A damaged offset leads behind the end of the file, or before its beginning.
        exr::error::Error::Io(source)
            if !matches!(source.kind(), io::ErrorKind::UnexpectedEof | io::ErrorKind::InvalidInput) =>
        {
            Error::io(path, source)
        }
        exr::error::Error::NotSupported(what) => Error::Unsupported {
            path: path.to_owned(),
            what: what.into_owned(),
            remedy: "save it as a flat scan-line picture",
        },
        other => Error::invalid(path, format!("the EXR file is damaged or cut short: {other}")),
    }
}

/// Rejects a header that claims more pixels than the file's bytes can hold, before anything is allocated.
fn check_size(path: &Path) -> Result<()> {
    let meta = exr::meta::MetaData::read_from_file(path, false).map_err(|e| exr_error(path, e))?;
    let file_bytes = std::fs::metadata(path).map_err(|source| Error::io(path, source))?.len();
    for header in &meta.headers {
        let size = header.layer_size;
        let bytes_per_pixel = header.channels.bytes_per_pixel as u64;
        let claimed = (size.width() as u64).checked_mul(size.height() as u64);
        let claimed = claimed.and_then(|pixels| pixels.checked_mul(bytes_per_pixel));
        if claimed.is_none_or(|bytes| bytes > file_bytes.saturating_mul(MAX_EXPANSION)) {
            let reason = format!(
                "the header claims {}×{} px, more than the file can hold",
                size.width(),
                size.height()
            );
            return Err(Error::invalid(path, reason));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
