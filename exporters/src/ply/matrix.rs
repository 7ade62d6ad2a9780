//! Rows of scalars → matrices of one type each, chunk by chunk.

use super::header::{Element, Encoding, Scalar};
use super::layout::{Kind, Layout, Place, Shape};
use crate::rows::CHUNK_BYTES;

/// Row-major values of one type.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Matrix {
    F32(Vec<f32>),
    F64(Vec<f64>),
    I32(Vec<i32>),
    U8(Vec<u8>),
}

/// Some rows of a matrix, to be filled.
pub(super) enum Part<'a> {
    F32(&'a mut [f32]),
    F64(&'a mut [f64]),
    I32(&'a mut [i32]),
    U8(&'a mut [u8]),
}

impl Matrix {
    pub(super) fn zeros(shape: &Shape, rows: usize) -> Self {
        let length = rows * shape.width;
        match shape.kind {
            Kind::F32 => Self::F32(vec![0.0; length]),
            Kind::F64 => Self::F64(vec![0.0; length]),
            Kind::I32 | Kind::U32 => Self::I32(vec![0; length]),
            Kind::U8 => Self::U8(vec![0; length]),
        }
    }

    /// Cuts after every `length` values.
    pub(super) fn parts(&mut self, length: usize) -> Box<dyn Iterator<Item = Part<'_>> + '_> {
        match self {
            Self::F32(values) => Box::new(values.chunks_mut(length).map(Part::F32)),
            Self::F64(values) => Box::new(values.chunks_mut(length).map(Part::F64)),
            Self::I32(values) => Box::new(values.chunks_mut(length).map(Part::I32)),
            Self::U8(values) => Box::new(values.chunks_mut(length).map(Part::U8)),
        }
    }
}

impl Part<'_> {
    /// Stores a value that the property's type can hold. Unsigned 32-bit integers beyond the signed ones turn
    /// negative.
    pub(super) fn set(&mut self, index: usize, value: f64) {
        match self {
            Self::F32(values) => values[index] = value as f32,
            Self::F64(values) => values[index] = value,
            Self::I32(values) => values[index] = value as i64 as i32,
            Self::U8(values) => values[index] = value as u8,
        }
    }
}

/// Neighbouring properties of one type that go to neighbouring columns.
#[derive(Debug, PartialEq)]
struct Run {
    scalar: Scalar,
    /// First byte in the row.
    at: usize,
    length: usize,
    place: Place,
    /// Of the matrix.
    width: usize,
}

/// How to unpack the rows of an element without lists.
#[derive(Debug)]
pub(super) struct Unpacker {
    /// Bytes of a row.
    pub(super) stride: usize,
    is_big_endian: bool,
    runs: Vec<Run>,
}

impl Unpacker {
    pub(super) fn new(encoding: Encoding, element: &Element, layout: &Layout) -> Self {
        let mut runs: Vec<Run> = Vec::new();
        let mut at = 0;
        for (property, place) in element.properties.iter().zip(&layout.places) {
            let scalar = property.scalar;
            match (*place, runs.last_mut()) {
                (Some(place), Some(run)) if run.is_continued_by(scalar, at, place) => run.length += 1,
                (Some(place), _) => {
                    runs.push(Run { scalar, at, length: 1, place, width: layout.shapes[place.matrix].width });
                }
                (None, _) => {}
            }
            at += scalar.size();
        }
        Self { stride: at, is_big_endian: encoding == Encoding::BinaryBigEndian, runs }
    }

    /// Unpacks whole rows into parts of as many, one of each matrix.
    pub(super) fn unpack(&self, rows: &[u8], parts: &mut [Part]) {
        let rows_at_once = (CHUNK_BYTES / self.stride).max(1);
        for (chunk, rows) in rows.chunks(rows_at_once * self.stride).enumerate() {
            for run in &self.runs {
                self.unpack_run(run, chunk * rows_at_once, rows, &mut parts[run.place.matrix]);
            }
        }
    }

    fn unpack_run(&self, run: &Run, first_row: usize, rows: &[u8], part: &mut Part) {
        let first = first_row * run.width;
        match (run.scalar, part) {
            (Scalar::F32, Part::F32(to)) if !self.is_big_endian => {
                copy(rows, self.stride, run, &mut to[first..], f32::from_le_bytes);
            }
            (Scalar::U8, Part::U8(to)) => copy(rows, self.stride, run, &mut to[first..], |[byte]| byte),
            (_, part) => self.convert(rows, run, first, part),
        }
    }

    /// Any type, by way of f64, which holds all of them.
    fn convert(&self, rows: &[u8], run: &Run, first: usize, part: &mut Part) {
        let size = run.scalar.size();
        for (r, row) in rows.chunks_exact(self.stride).enumerate() {
            for (i, bytes) in row[run.at..run.at + run.length * size].chunks_exact(size).enumerate() {
                let value = if self.is_big_endian {
                    run.scalar.read_big_endian(bytes)
                } else {
                    run.scalar.read(bytes)
                };
                // A chunk of the type's size always has a value.
                part.set(first + r * run.width + run.place.column + i, value.unwrap_or_default());
            }
        }
    }
}

impl Run {
    fn is_continued_by(&self, scalar: Scalar, at: usize, place: Place) -> bool {
        scalar == self.scalar
            && at == self.at + self.length * scalar.size()
            && place == Place { column: self.place.column + self.length, ..self.place }
    }
}

fn copy<T, const N: usize>(
    rows: &[u8],
    stride: usize,
    run: &Run,
    to: &mut [T],
    convert: impl Fn([u8; N]) -> T,
) {
    let rows = rows.chunks_exact(stride);
    if run.width == 1 {
        for (to, row) in to.iter_mut().zip(rows) {
            let bytes: &[u8; N] = row[run.at..].first_chunk().expect("the run is inside the row");
            *to = convert(*bytes);
        }
        return;
    }
    for (to, row) in to.chunks_exact_mut(run.width).zip(rows) {
        let values = row[run.at..run.at + N * run.length].as_chunks::<N>().0;
        for (to, bytes) in to[run.place.column..].iter_mut().zip(values) {
            *to = convert(*bytes);
        }
    }
}
