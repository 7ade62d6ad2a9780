//! The glTF document under construction: JSON objects, and the pieces of the binary chunk that they point to.

use std::io::{self, Write};

use gltf_json::accessor::{Accessor, ComponentType, GenericComponentType, Type};
use gltf_json::buffer::{Buffer, Target, View};
use gltf_json::validation::{Checked::Valid, USize64};
use gltf_json::{Index, Root, Value};
use serde_json::{Map, json};

use super::color::linear_u16_table;
use crate::axes::UpAxis;
use crate::geometry::AttributeValues;
use crate::rows::{triple_bytes, write_items, write_rows, write_words};

/// A run of bytes of the binary chunk, converted while it is written. Lengths are multiples of four.
pub(super) enum Piece<'a> {
    /// Positions or normals, turned to glTF's axes.
    Vectors(&'a [[f32; 3]], UpAxis),
    /// sRGB → linear RGBA, normalised u16.
    Colors(&'a [[u8; 3]]),
    /// sRGB → linear RGBA, f32.
    FloatColors(&'a [[u8; 3]]),
    /// An attribute as f32.
    Scalars(&'a AttributeValues),
    /// Dimensions `first..first + 4` of rows `dim` wide, zero beyond the last one.
    Quads { values: &'a [f32], dim: usize, first: usize },
    /// Triangle corners.
    Indices(&'a [[u32; 3]]),
    /// Times of animation keys, seconds.
    Seconds(Vec<f32>),
    /// Scale at animation keys.
    Scales(Vec<[f32; 3]>),
}

impl Piece<'_> {
    fn component_and_type(&self) -> (ComponentType, Type) {
        match self {
            Self::Vectors(..) | Self::Scales(_) => (ComponentType::F32, Type::Vec3),
            Self::Colors(_) => (ComponentType::U16, Type::Vec4),
            Self::Scalars(_) | Self::Seconds(_) => (ComponentType::F32, Type::Scalar),
            Self::Quads { .. } | Self::FloatColors(_) => (ComponentType::F32, Type::Vec4),
            Self::Indices(_) => (ComponentType::U32, Type::Scalar),
        }
    }

    fn count(&self) -> usize {
        match self {
            Self::Vectors(vectors, _) => vectors.len(),
            Self::Colors(colors) | Self::FloatColors(colors) => colors.len(),
            Self::Scalars(values) => values.len(),
            Self::Quads { values, dim, .. } => values.len() / dim,
            Self::Indices(triangles) => 3 * triangles.len(),
            Self::Seconds(seconds) => seconds.len(),
            Self::Scales(scales) => scales.len(),
        }
    }

    fn byte_length(&self) -> usize {
        let (component, shape) = self.component_and_type();
        self.count() * component.size() * shape.multiplicity()
    }

    fn target(&self) -> Option<Target> {
        match self {
            Self::Indices(_) => Some(Target::ElementArrayBuffer),
            Self::Seconds(_) | Self::Scales(_) => None,
            _ => Some(Target::ArrayBuffer),
        }
    }

    /// Smallest and largest value per component; glTF wants them for positions and animation times.
    fn bounds(&self) -> Option<(Value, Value)> {
        match self {
            Self::Vectors(vectors, up) => {
                let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
                for vector in *vectors {
                    let vector = up.to_gltf(*vector);
                    for axis in 0..3 {
                        low[axis] = low[axis].min(vector[axis]);
                        high[axis] = high[axis].max(vector[axis]);
                    }
                }
                Some((json!(low), json!(high)))
            }
            Self::Seconds(seconds) => Some((json!([seconds.first()?]), json!([seconds.last()?]))),
            _ => None,
        }
    }

    fn write(&self, file: &mut (impl Write + Send)) -> io::Result<()> {
        match self {
            Self::Vectors(vectors, UpAxis::Y) => write_words(file, bytemuck::cast_slice(vectors)),
            Self::Vectors(vectors, up) => {
                write_items(file, vectors, |v| triple_bytes(bytemuck::cast(up.to_gltf(*v))))
            }
            Self::Scales(scales) => write_words(file, bytemuck::cast_slice(scales)),
            Self::Colors(colors) => {
                let linear = linear_u16_table();
                write_items(file, colors, |color| {
                    let [r, g, b] = color.map(|byte| linear[usize::from(byte)]);
                    bytemuck::cast::<[u16; 4], [u8; 8]>([r, g, b, u16::MAX].map(u16::to_le))
                })
            }
            Self::FloatColors(colors) => {
                let linear = linear_u16_table().map(|value| f32::from(value) / 65535.0);
                write_items(file, colors, |color| {
                    let [r, g, b] = color.map(|byte| linear[usize::from(byte)].to_bits().to_le());
                    bytemuck::cast::<[u32; 4], [u8; 16]>([r, g, b, 1f32.to_bits().to_le()])
                })
            }
            Self::Scalars(AttributeValues::F32(values)) => write_words(file, bytemuck::cast_slice(values)),
            Self::Scalars(AttributeValues::I32(values)) => {
                write_items(file, values, |v| (*v as f32).to_le_bytes())
            }
            Self::Scalars(AttributeValues::U8(values)) => {
                write_items(file, values, |v| f32::from(*v).to_le_bytes())
            }
            Self::Quads { values, dim, first } => write_rows(file, self.count(), 16, |first_row, rows| {
                let features = values[first_row * dim..].chunks_exact(*dim);
                for (to, row) in rows.as_chunks_mut::<16>().0.iter_mut().zip(features) {
                    let quad: [f32; 4] = std::array::from_fn(|i| row.get(first + i).copied().unwrap_or(0.0));
                    *to = bytemuck::cast(quad.map(|v| v.to_bits().to_le()));
                }
            }),
            Self::Indices(triangles) => write_words(file, triangles.as_flattened()),
            Self::Seconds(seconds) => write_words(file, bytemuck::cast_slice(seconds)),
        }
    }
}

/// JSON and binary pieces, growing together.
#[derive(Default)]
pub(super) struct Document<'a> {
    pub(super) root: Root,
    pieces: Vec<Piece<'a>>,
    bin_bytes: usize,
}

impl<'a> Document<'a> {
    /// Adds a piece with its buffer view and accessor.
    pub(super) fn push(&mut self, piece: Piece<'a>) -> Index<Accessor> {
        let (component, shape) = piece.component_and_type();
        let bounds = piece.bounds();
        let view = self.root.push(View {
            buffer: Index::new(0),
            byte_length: USize64::from(piece.byte_length()),
            byte_offset: Some(USize64::from(self.bin_bytes)),
            byte_stride: None,
            name: None,
            target: piece.target().map(Valid),
            extensions: None,
            extras: None,
        });
        self.bin_bytes += piece.byte_length();
        let accessor = Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64::from(piece.count()),
            component_type: Valid(GenericComponentType(component)),
            extensions: None,
            extras: None,
            type_: Valid(shape),
            min: bounds.as_ref().map(|(low, _)| low.clone()),
            max: bounds.map(|(_, high)| high),
            name: None,
            normalized: matches!(piece, Piece::Colors(_)),
            sparse: None,
        };
        self.pieces.push(piece);
        self.root.push(accessor)
    }

    /// Bytes of the binary chunk so far.
    pub(super) fn bin_bytes(&self) -> usize {
        self.bin_bytes
    }

    /// The JSON chunk, padded with spaces to a multiple of four.
    pub(super) fn json(&mut self) -> io::Result<Vec<u8>> {
        if self.bin_bytes > 0 {
            self.root.buffers = vec![Buffer {
                byte_length: USize64::from(self.bin_bytes),
                name: None,
                uri: None,
                extensions: None,
                extras: None,
            }];
        }
        let mut json = gltf_json::serialize::to_vec(&self.root)?;
        json.resize(json.len().next_multiple_of(4), b' ');
        Ok(json)
    }

    /// Streams the binary chunk's content.
    pub(super) fn write_bin(&self, file: &mut (impl Write + Send)) -> io::Result<()> {
        self.pieces.iter().try_for_each(|piece| piece.write(file))
    }
}

/// `extras` of any object; `None` when there is nothing to say.
pub(super) fn extras(map: &Map<String, Value>) -> gltf_json::Extras {
    if map.is_empty() {
        return None;
    }
    // A map of strings to JSON values always prints.
    serde_json::value::to_raw_value(map).ok()
}
