//! Which property of the vertices becomes which column of which matrix.

use std::collections::HashMap;
use std::path::Path;

use super::header::{Element, Property, Scalar};
use crate::error::{Error, Result};
use crate::validate::{CLOUDCOMPARE_PREFIX, split_feature_column};

/// What a matrix of vertex properties is.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Role {
    Positions,
    Normals,
    Colors,
    /// By its name in the geometry.
    Attribute(String),
    /// By the name that its columns share.
    Features(String),
}

/// Type of a matrix's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    F32,
    F64,
    I32,
    /// Read as i32; values beyond its range turn negative, and are refused then.
    U32,
    U8,
}

/// A matrix to read, a row for every vertex.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Shape {
    pub(super) role: Role,
    pub(super) kind: Kind,
    pub(super) width: usize,
}

/// Where the values of one property go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) matrix: usize,
    pub(super) column: usize,
}

/// The matrices to read, and the place of each property; `None` for those that are not read.
#[derive(Debug, Default)]
pub(super) struct Layout {
    pub(super) shapes: Vec<Shape>,
    pub(super) places: Vec<Option<Place>>,
}

impl Layout {
    /// Everything that a geometry has a place for. `with_quality_copy`: the property `quality` repeats an attribute.
    ///
    /// # Errors
    /// `Invalid` for vertices without positions and for feature columns out of order; `Unsupported` for lists and for
    /// colours other than 8-bit ones.
    pub(super) fn of_vertices(path: &Path, element: &Element, with_quality_copy: bool) -> Result<Self> {
        let mut layout = Self::of_positions(path, element)?;
        let mut is_read = vec![false; element.properties.len()];
        for (property, place) in layout.places.iter().enumerate() {
            is_read[property] = place.is_some();
        }
        let mut first_of = |name: &str| {
            let unread = |(at, property): &(usize, &Property)| !is_read[*at] && property.name == name;
            let at = element.properties.iter().enumerate().find(unread)?.0;
            is_read[at] = true;
            Some(at)
        };
        if let [Some(x), Some(y), Some(z)] = ["nx", "ny", "nz"].map(&mut first_of) {
            layout.push(Role::Normals, Kind::F32, &[x, y, z]);
        }
        let is_byte = |at: usize| element.properties[at].scalar == Scalar::U8;
        match ["red", "green", "blue"].map(&mut first_of) {
            [Some(r), Some(g), Some(b)] if is_byte(r) && is_byte(g) && is_byte(b) => {
                layout.push(Role::Colors, Kind::U8, &[r, g, b]);
            }
            [None, None, None] => {}
            _ => {
                return Err(Error::Unsupported {
                    path: path.to_owned(),
                    what: "a colour that is not `uchar red, green, blue`".into(),
                    remedy: "save colours as 8-bit red, green, blue",
                });
            }
        }
        if with_quality_copy {
            first_of("quality");
        }
        let mut features = HashMap::new();
        for (at, property) in element.properties.iter().enumerate().filter(|(at, _)| !is_read[*at]) {
            layout.push_extra(path, at, property, &mut features)?;
        }
        Ok(layout)
    }

    /// Positions alone: as f32 where that is exact.
    ///
    /// # Errors
    /// `Invalid` for vertices without positions; `Unsupported` for lists.
    pub(super) fn of_positions(path: &Path, element: &Element) -> Result<Self> {
        if let Some(list) = element.properties.iter().find(|property| property.list.is_some()) {
            return Err(Error::Unsupported {
                path: path.to_owned(),
                what: format!("the list `{}` on vertices", list.name),
                remedy: "write one scalar property per dimension",
            });
        }
        let mut layout = Self { shapes: vec![], places: vec![None; element.properties.len()] };
        let first_of = |name: &str| element.properties.iter().position(|property| property.name == name);
        let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(first_of) else {
            return Err(Error::invalid(path, "the vertices have no `x`, `y` and `z`"));
        };
        let is_wide =
            |at: usize| matches!(element.properties[at].scalar, Scalar::F64 | Scalar::I32 | Scalar::U32);
        let kind = if [x, y, z].into_iter().any(is_wide) { Kind::F64 } else { Kind::F32 };
        layout.push(Role::Positions, kind, &[x, y, z]);
        Ok(layout)
    }

    fn push(&mut self, role: Role, kind: Kind, properties: &[usize]) {
        let matrix = self.shapes.len();
        self.shapes.push(Shape { role, kind, width: properties.len() });
        for (column, &property) in properties.iter().enumerate() {
            self.places[property] = Some(Place { matrix, column });
        }
    }

    /// Tells feature columns from attributes. `features`: the matrices of the names so far.
    fn push_extra(
        &mut self,
        path: &Path,
        at: usize,
        property: &Property,
        features: &mut HashMap<String, usize>,
    ) -> Result<()> {
        let name = slug(property.name.strip_prefix(CLOUDCOMPARE_PREFIX).unwrap_or(&property.name));
        let Some((prefix, d)) = split_feature_column(&name) else {
            let kind = match property.scalar {
                Scalar::F32 | Scalar::F64 => Kind::F32,
                Scalar::U8 => Kind::U8,
                Scalar::U32 => Kind::U32,
                _ => Kind::I32,
            };
            self.push(Role::Attribute(name), kind, &[at]);
            return Ok(());
        };
        let matrix = *features.entry(prefix.to_owned()).or_insert(self.shapes.len());
        if matrix == self.shapes.len() {
            self.shapes.push(Shape { role: Role::Features(prefix.to_owned()), kind: Kind::F32, width: 0 });
        }
        let expected = self.shapes[matrix].width;
        if d != expected {
            let reason = format!("feature column `{name}` comes where `{prefix}_{expected:03}` should");
            return Err(Error::invalid(path, reason));
        }
        self.places[at] = Some(Place { matrix, column: d });
        self.shapes[matrix].width += 1;
        Ok(())
    }
}

/// Lower case, every other character than a letter or digit an underscore, a letter first.
fn slug(name: &str) -> String {
    let slug: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' }).collect();
    if slug.starts_with(|c: char| c.is_ascii_lowercase()) { slug } else { format!("a{slug}") }
}
