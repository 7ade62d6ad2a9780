//! GLB → geometry, for the files that this crate writes (and plain ones of other programs).

use std::cell::Cell;
use std::fs;
use std::path::Path;

use gltf_json::accessor::{Accessor, ComponentType};
use gltf_json::mesh::{Mesh, Mode, Primitive, Semantic};
use gltf_json::validation::{Checked::Valid, USize64};
use gltf_json::{Index, Root, scene};
use serde_json::{Map, Value};

use super::color::srgb_from_linear;
use super::{GlbNode, Interval, container};
use crate::axes::UpAxis;
use crate::error::{Error, Result};
use crate::geometry::{Attribute, AttributeValues, Features, Geometry};
use crate::validate::split_feature_column;

/// What a GLB file holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbContents {
    /// Meshes in file order, in world axes.
    pub geometries: Vec<Geometry>,
    /// Nodes that show them.
    pub nodes: Vec<GlbNode>,
    /// The world's up axis: as recorded, or Y.
    pub up_axis: UpAxis,
    /// Custom properties of the scene.
    pub extras: Map<String, Value>,
}

/// Our files use every byte of the binary chunk once or twice; this is how often a reader puts up with.
const MAX_REUSE: usize = 8;

/// Reads a GLB file.
///
/// Attributes come back in the order and with the integer types that the extras record; features are joined
/// to the mesh they belong to. Animations are not read: intervals come from the nodes' extras.
///
/// # Errors
/// `Io`; `Invalid` for any contradiction or early end; `NonFinite`; `Unsupported` for node transforms,
/// several primitives per mesh, sparse accessors, external buffers and other things that this crate does not
/// write.
pub fn read_glb(path: &Path) -> Result<GlbContents> {
    let file = fs::read(path).map_err(|source| Error::io(path, source))?;
    let (json, bin) = container::split(path, &file)?;
    let root: Root = gltf_json::deserialize::from_slice(json)
        .map_err(|error| Error::invalid(path, format!("the glTF JSON cannot be read: {error}")))?;
    let reader = Reader { path, root: &root, bin, bytes_read: Cell::new(0) };
    reader.contents()
}

struct Reader<'a> {
    path: &'a Path,
    root: &'a Root,
    bin: &'a [u8],
    bytes_read: Cell<usize>,
}

/// One custom attribute as stored.
struct Custom {
    name: String,
    width: usize,
    values: Vec<f32>,
}

impl Reader<'_> {
    fn contents(&self) -> Result<GlbContents> {
        let extras = self.root.scenes.first().map_or(Map::new(), |scene| extras_map(&scene.extras));
        let up_axis = extras.get("up_axis").map_or(Ok(UpAxis::Y), |axis| {
            serde_json::from_value(axis.clone()).map_err(|_| self.invalid(format!("{axis} is no up axis")))
        })?;
        let mut geometries = Vec::new();
        let mut geometry_of_mesh = Vec::new();
        for mesh in &self.root.meshes {
            let mesh_extras = extras_map(&mesh.extras);
            let features_of = mesh_extras.get("features_of").and_then(Value::as_str);
            let Some(name) = features_of else {
                geometry_of_mesh.push(Some(geometries.len()));
                geometries.push(self.geometry(mesh, &mesh_extras, up_axis)?);
                continue;
            };
            geometry_of_mesh.push(None);
            let owner = geometries.iter_mut().rev().find(|geometry| geometry.name == name);
            let owner =
                owner.ok_or_else(|| self.invalid(format!("features of the unknown mesh `{name}`")))?;
            owner.features = self.features(mesh, &mesh_extras)?;
        }
        let nodes = self.nodes(&mut geometries, &geometry_of_mesh)?;
        for geometry in &geometries {
            geometry.validate().map_err(|error| match error {
                Error::Inconsistent { object, reason } => self.invalid(format!("mesh `{object}`: {reason}")),
                other => other,
            })?;
        }
        Ok(GlbContents { geometries, nodes, up_axis, extras })
    }

    /// Nodes that show a geometry; a childless node without a mesh stands for an empty geometry.
    fn nodes(
        &self,
        geometries: &mut Vec<Geometry>,
        geometry_of_mesh: &[Option<usize>],
    ) -> Result<Vec<GlbNode>> {
        let mut nodes = Vec::new();
        for node in &self.root.nodes {
            let name = node.name.clone().unwrap_or_default();
            let geometry = match node.mesh {
                Some(mesh) => match geometry_of_mesh.get(mesh.value()) {
                    Some(Some(geometry)) => *geometry,
                    Some(None) => continue,
                    None => return Err(self.invalid(format!("node `{name}` has no such mesh"))),
                },
                None if node.children.is_some() || node.camera.is_some() => continue,
                None => {
                    geometries.push(Geometry { name: name.clone(), ..Geometry::default() });
                    geometries.len() - 1
                }
            };
            let mut extras = extras_map(&node.extras);
            let interval = take_interval(&mut extras);
            self.check_transform(node, &name, interval.is_some())?;
            let stream = extras.remove("stream").and_then(|stream| stream.as_str().map(str::to_owned));
            nodes.push(GlbNode { name, geometry, stream, interval, extras });
        }
        Ok(nodes)
    }

    fn check_transform(&self, node: &scene::Node, name: &str, is_animated: bool) -> Result<()> {
        // The rest pose of an animated node may be scaled to nothing.
        let scaled = !is_animated && node.scale.is_some_and(|scale| scale != [1.0; 3]);
        if node.matrix.is_some() || node.rotation.is_some() || node.translation.is_some() || scaled {
            return Err(self.unsupported(format!("the transform of node `{name}`"), "apply it to the mesh"));
        }
        Ok(())
    }

    fn geometry(&self, mesh: &Mesh, extras: &Map<String, Value>, up: UpAxis) -> Result<Geometry> {
        let primitive = self.primitive(mesh)?;
        let mut geometry = Geometry { name: mesh.name.clone().unwrap_or_default(), ..Geometry::default() };
        if let Some(offset) = extras.get("offset") {
            geometry.offset = serde_json::from_value(offset.clone())
                .map_err(|_| self.invalid(format!("{offset} is no offset")))?;
        }
        let mut customs = Vec::new();
        for (semantic, &accessor) in &primitive.attributes {
            match semantic {
                Valid(Semantic::Positions) => geometry.positions = self.vectors(accessor, up)?,
                Valid(Semantic::Normals) => geometry.normals = self.vectors(accessor, up)?,
                Valid(Semantic::Colors(0)) => geometry.colors = self.colors(accessor)?,
                Valid(Semantic::Extras(name)) => customs.push(self.custom(name, accessor)?),
                // Texture coordinates, tangents, skinning: nothing in a geometry corresponds to them.
                _ => {}
            }
        }
        geometry.attributes = self.attributes(customs, extras)?;
        geometry.triangles = self.triangles(primitive, geometry.positions.len())?;
        Ok(geometry)
    }

    fn primitive<'b>(&self, mesh: &'b Mesh) -> Result<&'b Primitive> {
        match &mesh.primitives[..] {
            [primitive] => Ok(primitive),
            _ => Err(self.unsupported("a mesh of several primitives".into(), "join them into one")),
        }
    }

    fn attributes(&self, customs: Vec<Custom>, extras: &Map<String, Value>) -> Result<Vec<Attribute>> {
        let order: Vec<&str> = match extras.get("attributes") {
            Some(Value::Array(names)) => names.iter().filter_map(Value::as_str).collect(),
            _ => vec![],
        };
        let rank = |name: &str| order.iter().position(|known| *known == name).unwrap_or(order.len());
        let integers = extras.get("integer_attributes").and_then(Value::as_object);
        let mut attributes = Vec::new();
        for custom in customs {
            if custom.width != 1 {
                let what = format!("the vector attribute `_{}`", custom.name.to_ascii_uppercase());
                return Err(self.unsupported(what, "store one scalar attribute per component"));
            }
            let integer = integers.and_then(|types| types.get(&custom.name)).and_then(Value::as_str);
            let values = match integer {
                Some("u8") => AttributeValues::U8(custom.values.iter().map(|&v| v as u8).collect()),
                Some("i32") => AttributeValues::I32(custom.values.iter().map(|&v| v as i32).collect()),
                _ => AttributeValues::F32(custom.values),
            };
            attributes.push(Attribute { name: custom.name, values });
        }
        attributes.sort_by_cached_key(|attribute| rank(&attribute.name));
        Ok(attributes)
    }

    fn features(&self, mesh: &Mesh, extras: &Map<String, Value>) -> Result<Vec<Features>> {
        let primitive = self.primitive(mesh)?;
        let mut quads = Vec::new();
        for (semantic, &accessor) in &primitive.attributes {
            if let Valid(Semantic::Extras(name)) = semantic {
                quads.push(self.custom(name, accessor)?);
            }
        }
        let dims = extras.get("feature_dims").and_then(Value::as_object);
        let dims = dims.ok_or_else(|| self.invalid("a features mesh without `feature_dims`".into()))?;
        dims.iter().map(|(name, dim)| self.join_quads(name, dim, &quads)).collect()
    }

    fn join_quads(&self, name: &str, dim: &Value, quads: &[Custom]) -> Result<Features> {
        let wrong =
            || self.invalid(format!("features `{name}` do not have the {dim} dimensions that they claim"));
        let dim = dim.as_u64().and_then(|dim| usize::try_from(dim).ok()).ok_or_else(wrong)?;
        let mut own: Vec<(usize, &Custom)> = quads
            .iter()
            .filter_map(|quad| split_feature_column(&quad.name).map(|(prefix, i)| (prefix, i, quad)))
            .filter_map(|(prefix, i, quad)| (prefix == name).then_some((i, quad)))
            .collect();
        own.sort_by_key(|(i, _)| *i);
        let rows = own.first().map_or(0, |(_, quad)| quad.values.len() / 4);
        let is_complete = own.len() == dim.div_ceil(4)
            && own
                .iter()
                .enumerate()
                .all(|(i, (j, quad))| i == *j && quad.width == 4 && quad.values.len() == 4 * rows);
        if !is_complete {
            return Err(wrong());
        }
        let values = (0..rows).flat_map(|row| {
            let quads = own.iter().flat_map(move |(_, quad)| &quad.values[4 * row..4 * row + 4]);
            quads.take(dim).copied()
        });
        Ok(Features { name: name.to_owned(), dim, values: values.collect() })
    }

    fn triangles(&self, primitive: &Primitive, vertices: usize) -> Result<Vec<[u32; 3]>> {
        match primitive.mode {
            Valid(Mode::Points) => return Ok(vec![]),
            Valid(Mode::Triangles) => {}
            _ => {
                return Err(
                    self.unsupported("a mesh of lines, strips or fans".into(), "save it as triangles")
                );
            }
        }
        let corners = match primitive.indices {
            Some(accessor) => self.indices(accessor)?,
            None => {
                (0..u32::try_from(vertices).map_err(|_| self.invalid("too many vertices".into()))?).collect()
            }
        };
        let (triangles, rest) = corners.as_chunks::<3>();
        if !rest.is_empty() {
            return Err(self.invalid(format!("{} indices are no whole triangles", corners.len())));
        }
        Ok(triangles.to_vec())
    }

    fn vectors(&self, accessor: Index<Accessor>, up: UpAxis) -> Result<Vec<[f32; 3]>> {
        let (width, values) = self.floats(accessor)?;
        if width != 3 {
            return Err(self.invalid(format!("positions or normals of {width} components")));
        }
        Ok(values.as_chunks::<3>().0.iter().map(|v| up.undo_gltf(*v)).collect())
    }

    fn colors(&self, accessor: Index<Accessor>) -> Result<Vec<[u8; 3]>> {
        let (width, values) = self.floats(accessor)?;
        if !(3..=4).contains(&width) {
            return Err(self.invalid(format!("colours of {width} components")));
        }
        Ok(values.chunks_exact(width).map(|c| [c[0], c[1], c[2]].map(srgb_from_linear)).collect())
    }

    fn custom(&self, name: &str, accessor: Index<Accessor>) -> Result<Custom> {
        let (width, values) = self.floats(accessor)?;
        Ok(Custom { name: name.to_ascii_lowercase(), width, values })
    }

    /// Components per item and all values; normalised integers become 0..1 (or -1..1).
    fn floats(&self, accessor: Index<Accessor>) -> Result<(usize, Vec<f32>)> {
        let (component, width, items, normalized) = self.items(accessor)?;
        let scaled = |value: f32, largest: f32| if normalized { (value / largest).max(-1.0) } else { value };
        let values = match component {
            ComponentType::F32 => collect(items, width, f32::from_le_bytes),
            ComponentType::U8 => collect(items, width, |[b]| scaled(f32::from(b), 255.0)),
            ComponentType::I8 => collect(items, width, |[b]| scaled(f32::from(b as i8), 127.0)),
            ComponentType::U16 => {
                collect(items, width, |b| scaled(f32::from(u16::from_le_bytes(b)), 65535.0))
            }
            ComponentType::I16 => {
                collect(items, width, |b| scaled(f32::from(i16::from_le_bytes(b)), 32767.0))
            }
            ComponentType::U32 => collect(items, width, |b| u32::from_le_bytes(b) as f32),
        };
        Ok((width, values))
    }

    fn indices(&self, accessor: Index<Accessor>) -> Result<Vec<u32>> {
        let (component, width, items, _) = self.items(accessor)?;
        if width != 1 {
            return Err(self.invalid("indices are no scalars".into()));
        }
        match component {
            ComponentType::U8 => Ok(collect(items, 1, |[byte]| u32::from(byte))),
            ComponentType::U16 => Ok(collect(items, 1, |bytes| u32::from(u16::from_le_bytes(bytes)))),
            ComponentType::U32 => Ok(collect(items, 1, u32::from_le_bytes)),
            _ => Err(self.invalid("indices are not unsigned integers".into())),
        }
    }

    /// The accessor's items as byte slices, after checking that all of them are inside the file.
    #[allow(clippy::type_complexity)]
    fn items(
        &self,
        accessor: Index<Accessor>,
    ) -> Result<(ComponentType, usize, impl ExactSizeIterator<Item = &[u8]>, bool)> {
        let wrong = |what: &str| self.invalid(format!("accessor {}: {what}", accessor.value()));
        let accessor =
            self.root.accessors.get(accessor.value()).ok_or_else(|| wrong("there is no such accessor"))?;
        let (Some(view), None) = (accessor.buffer_view, &accessor.sparse) else {
            return Err(self.unsupported("a sparse or empty accessor".into(), "store the values plainly"));
        };
        let view =
            self.root.buffer_views.get(view.value()).ok_or_else(|| wrong("there is no such buffer view"))?;
        let is_in_file =
            view.buffer.value() == 0 && self.root.buffers.first().is_some_and(|b| b.uri.is_none());
        if !is_in_file {
            return Err(self.unsupported("a buffer outside the file".into(), "save it as one .glb file"));
        }
        let (Valid(component), Valid(shape)) = (accessor.component_type, accessor.type_) else {
            return Err(wrong("its type is unknown"));
        };
        let number = |n: USize64| usize::try_from(n.0).map_err(|_| wrong("a length is too large"));
        let view_start = number(view.byte_offset.unwrap_or_default())?;
        let in_view = number(accessor.byte_offset.unwrap_or_default())?;
        let count = number(accessor.count)?;
        let width = shape.multiplicity();
        let item_bytes = width * component.0.size();
        let stride = view.byte_stride.map_or(item_bytes, |stride| stride.0);
        if stride < item_bytes {
            return Err(wrong("its items overlap"));
        }
        let view_end = view_start.checked_add(number(view.byte_length)?);
        let bytes =
            view_end.and_then(|end| self.bin.get(view_start..end)).and_then(|bytes| bytes.get(in_view..));
        let bytes = bytes.ok_or_else(|| wrong("its bytes are outside the file"))?;
        // The last item need not be followed by padding up to the stride.
        let needed = count.checked_sub(1).map_or(Some(0), |n| n.checked_mul(stride)?.checked_add(item_bytes));
        if needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(wrong("it has more items than bytes"));
        }
        self.bytes_read.set(self.bytes_read.get().saturating_add(count * item_bytes));
        if self.bytes_read.get() > self.bin.len().saturating_mul(MAX_REUSE) {
            return Err(wrong("the same bytes are used too often"));
        }
        let items = (0..count).map(move |i| &bytes[i * stride..i * stride + item_bytes]);
        Ok((component.0, width, items, accessor.normalized))
    }

    fn invalid(&self, reason: String) -> Error {
        Error::invalid(self.path, reason)
    }

    fn unsupported(&self, what: String, remedy: &'static str) -> Error {
        Error::Unsupported { path: self.path.to_owned(), what, remedy }
    }
}

/// All values of items that are `width` values of `N` bytes each.
fn collect<'a, T, const N: usize>(
    items: impl ExactSizeIterator<Item = &'a [u8]>,
    width: usize,
    convert: impl Fn([u8; N]) -> T,
) -> Vec<T> {
    let mut values = Vec::with_capacity(items.len() * width);
    for item in items {
        for bytes in item.as_chunks::<N>().0 {
            values.push(convert(*bytes));
        }
    }
    values
}

fn extras_map(extras: &gltf_json::Extras) -> Map<String, Value> {
    extras.as_ref().and_then(|raw| serde_json::from_str(raw.get()).ok()).unwrap_or_default()
}

fn take_interval(extras: &mut Map<String, Value>) -> Option<Interval> {
    let time_start = extras.get("time_start")?.as_f64()?;
    let time_end = extras.get("time_end")?.as_f64()?;
    extras.remove("time_start");
    extras.remove("time_end");
    Some(Interval { time_start, time_end })
}
