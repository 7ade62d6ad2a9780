//! Geometry → NPZ.

use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use half::f16;
use serde_json::json;
use zip::write::{SimpleFileOptions, ZipWriter};

use crate::atomic::{AtomicWriter, write_atomically};
use crate::error::{Error, Result};
use crate::geometry::{AttributeValues, Geometry};
use crate::npy::{self, Dtype};
use crate::rows::{write_items, write_words};
use crate::validate::position_of_first;

/// How the arrays are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum NpzCompression {
    /// As they are, like `numpy.savez`: fastest, and float features hardly compress.
    #[default]
    Stored,
    /// Deflated, like `numpy.savez_compressed`.
    Deflated,
    /// As they are, but feature matrices in half precision; Open3D does not read those.
    HalfFeatures,
}

/// From here on sizes need zip64 fields, which Open3D's reader does not know.
const ZIP64_FROM: u64 = u32::MAX as u64;

/// Writes all columns. Open3D's point-cloud reader loads every one of them, matrices included.
///
/// # Errors
/// `Inconsistent` or `NonFinite` when the geometry breaks its invariants; `Io`.
pub fn write_npz(path: &Path, geometry: &Geometry, compression: NpzCompression) -> Result<()> {
    geometry.validate()?;
    if compression == NpzCompression::HalfFeatures {
        check_half(geometry)?;
    }
    write_atomically(path, |file| {
        write_archive(file, compression, |archive| {
            let note = json!({ "name": geometry.name, "offset": geometry.offset });
            archive.zip.set_comment(note.to_string());
            archive.geometry(geometry)
        })
    })
}

/// # Errors
/// `NonFinite` for a feature that half precision would make infinite.
fn check_half(geometry: &Geometry) -> Result<()> {
    for features in &geometry.features {
        let too_large = |v: &f32| f16::from_f32(*v).is_infinite();
        if let Some(index) = position_of_first(&features.values, too_large) {
            return Err(Error::NonFinite {
                object: geometry.name.clone(),
                column: features.name.clone(),
                row: index / features.dim,
                value: f64::from(f16::from_f32(features.values[index])),
            });
        }
    }
    Ok(())
}

/// Writes matrices that belong to no vertices: name, columns and row-major values of each.
///
/// # Errors
/// `Inconsistent` for values that do not fill their rows; `Io`.
pub fn write_npz_matrices(path: &Path, matrices: &[(&str, usize, &[f32])]) -> Result<()> {
    let uneven = |m: &&(&str, usize, &[f32])| m.1 == 0 || !m.2.len().is_multiple_of(m.1);
    if let Some((name, columns, values)) = matrices.iter().find(uneven) {
        let reason = format!("`{name}` has {} values in {columns} columns", values.len());
        return Err(Error::inconsistent(&path.display().to_string(), reason));
    }
    write_atomically(path, |file| {
        write_archive(file, NpzCompression::Stored, |archive| {
            matrices.iter().try_for_each(|(name, columns, values)| archive.floats(name, *columns, values))
        })
    })
}

/// Writes the archive that `fill` fills.
fn write_archive(
    file: &mut AtomicWriter,
    compression: NpzCompression,
    fill: impl FnOnce(&mut Archive) -> io::Result<()>,
) -> io::Result<()> {
    let mut output = Output { file, position: 0, end: 0, error: None };
    let filled = {
        let mut archive = Archive { zip: ZipWriter::new(&mut output), compression };
        let filled = fill(&mut archive);
        let finished = archive.zip.finish().map(|_| ());
        filled.and(finished.map_err(io::Error::from))
    };
    output.error.map_or(filled, Err)
}

/// A file that keeps its first error for the end and takes everything from then on: an archive whose writer fails tries
/// to finish when it is dropped, and complains or panics when that fails, too.
struct Output<'a> {
    file: &'a mut AtomicWriter,
    position: u64,
    end: u64,
    error: Option<io::Error>,
}

impl Output<'_> {
    /// What `action` gives, or nothing where it or something before it failed.
    fn attempt<T>(&mut self, action: impl FnOnce(&mut AtomicWriter) -> io::Result<T>) -> Option<T> {
        if self.error.is_some() {
            return None;
        }
        action(self.file).map_err(|error| self.error = Some(error)).ok()
    }
}

impl Write for Output<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.attempt(|file| file.write_all(bytes));
        self.position += bytes.len() as u64;
        self.end = self.end.max(self.position);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.attempt(|file| file.flush());
        Ok(())
    }
}

impl Seek for Output<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let place = match to {
            SeekFrom::Start(place) => Some(place),
            SeekFrom::Current(by) => self.position.checked_add_signed(by),
            SeekFrom::End(by) => self.end.checked_add_signed(by),
        };
        let before_start = || io::Error::new(io::ErrorKind::InvalidInput, "a place before the file's start");
        let place = place.ok_or_else(before_start)?;
        if place != self.position {
            self.attempt(|file| file.seek(SeekFrom::Start(place)));
            self.position = place;
        }
        Ok(place)
    }
}

struct Archive<'a, 'f> {
    zip: ZipWriter<&'a mut Output<'f>>,
    compression: NpzCompression,
}

impl Archive<'_, '_> {
    fn geometry(&mut self, geometry: &Geometry) -> io::Result<()> {
        self.floats("positions", 3, geometry.positions.as_flattened())?;
        if !geometry.normals.is_empty() {
            self.floats("normals", 3, geometry.normals.as_flattened())?;
        }
        if !geometry.colors.is_empty() {
            self.bytes("colors", 3, geometry.colors.as_flattened())?;
        }
        for attribute in &geometry.attributes {
            match &attribute.values {
                AttributeValues::F32(values) => self.floats(&attribute.name, 1, values)?,
                AttributeValues::I32(values) => {
                    self.words(&attribute.name, Dtype::I32, 1, bytemuck::cast_slice(values))?;
                }
                AttributeValues::U8(values) => self.bytes(&attribute.name, 1, values)?,
            }
        }
        for features in &geometry.features {
            match self.compression {
                NpzCompression::HalfFeatures => {
                    self.halves(&features.name, features.dim, &features.values)?
                }
                _ => self.floats(&features.name, features.dim, &features.values)?,
            }
        }
        if !geometry.triangles.is_empty() {
            // Signed, as Open3D wants it; validate() keeps indices below the vertex count.
            self.words("triangles", Dtype::I32, 3, geometry.triangles.as_flattened())?;
        }
        Ok(())
    }

    fn floats(&mut self, name: &str, columns: usize, values: &[f32]) -> io::Result<()> {
        self.words(name, Dtype::F32, columns, bytemuck::cast_slice(values))
    }

    fn halves(&mut self, name: &str, columns: usize, values: &[f32]) -> io::Result<()> {
        self.start(name, Dtype::F16, columns, values.len())?;
        write_items(&mut self.zip, values, |v| f16::from_f32(*v).to_le_bytes())
    }

    /// `values` is row-major `[rows, columns]`, of a type of four bytes.
    fn words(&mut self, name: &str, dtype: Dtype, columns: usize, values: &[u32]) -> io::Result<()> {
        self.start(name, dtype, columns, values.len())?;
        write_words(&mut self.zip, values)
    }

    fn bytes(&mut self, name: &str, columns: usize, values: &[u8]) -> io::Result<()> {
        self.start(name, Dtype::U8, columns, values.len())?;
        self.zip.write_all(values)
    }

    /// Everything of an array but its values.
    fn start(&mut self, name: &str, dtype: Dtype, columns: usize, values: usize) -> io::Result<()> {
        let header = npy::header_bytes(dtype, &[values / columns, columns]);
        let total = (header.len() + values * dtype.size()) as u64;
        let method = match self.compression {
            NpzCompression::Stored | NpzCompression::HalfFeatures => zip::CompressionMethod::Stored,
            NpzCompression::Deflated => zip::CompressionMethod::Deflated,
        };
        // The default time stamp is fixed (1980), so that the same input gives the same bytes.
        let options = SimpleFileOptions::default().compression_method(method).large_file(total >= ZIP64_FROM);
        self.zip.start_file(format!("{name}.npy"), options)?;
        self.zip.write_all(&header)
    }
}
