//! The invariants of [`Geometry`], checked by every writer before the first byte, and the names of its
//! columns.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::geometry::{AttributeValues, Features, Geometry};

/// Names that PLY and NPZ use for the columns that every geometry has.
const RESERVED: [&str; 13] =
    ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "positions", "normals", "colors", "triangles"];

/// Largest integer up to which every integer is an f32: 24 bits of mantissa. GLB stores integers as f32.
pub(crate) const EXACT_IN_F32: i32 = 1 << 24;

/// A normal may be this much longer or shorter than one; the Khronos validator rejects 0.00674.
pub(crate) const UNIT_LENGTH_TOLERANCE: f32 = 0.005;

/// Work per rayon task: big enough to pay for the task, small enough to share out.
const CHUNK: usize = 1 << 16;

impl Geometry {
    /// Checks every invariant of the type: column lengths, index range, names, finite numbers, unit normals.
    ///
    /// # Errors
    /// `Inconsistent` or `NonFinite`, naming the column and the vertex.
    pub fn validate(&self) -> Result<()> {
        self.validate_shapes()?;
        self.validate_names()?;
        self.validate_offset()?;
        self.validate_columns()?;
        self.validate_triangles()
    }

    /// [`Self::validate`] but for the numbers in the columns of vertices.
    pub(crate) fn validate_all_but_columns(&self) -> Result<()> {
        self.validate_shapes()?;
        self.validate_names()?;
        self.validate_offset()?;
        self.validate_triangles()
    }

    fn validate_shapes(&self) -> Result<()> {
        let vertices = self.positions.len();
        let wrong = |column: &str, entries: usize| {
            let reason = format!("`{column}` has {entries} entries for {vertices} vertices");
            Err(Error::inconsistent(&self.name, reason))
        };
        if vertices > u32::MAX as usize {
            let reason = format!("{vertices} vertices do not fit 32-bit indices; split the map");
            return Err(Error::inconsistent(&self.name, reason));
        }
        for (column, entries) in [("normals", self.normals.len()), ("colors", self.colors.len())] {
            if entries != 0 && entries != vertices {
                return wrong(column, entries);
            }
        }
        for attribute in &self.attributes {
            if attribute.values.len() != vertices {
                return wrong(&attribute.name, attribute.values.len());
            }
        }
        for features in &self.features {
            if features.dim == 0 {
                let reason = format!("features `{}` have no dimensions; leave them out", features.name);
                return Err(Error::inconsistent(&self.name, reason));
            }
            if Some(features.values.len()) != vertices.checked_mul(features.dim) {
                let reason = format!(
                    "features `{}` have {} values for {vertices} vertices of {} dimensions",
                    features.name,
                    features.values.len(),
                    features.dim
                );
                return Err(Error::inconsistent(&self.name, reason));
            }
        }
        Ok(())
    }

    fn validate_names(&self) -> Result<()> {
        let attributes = self.attributes.iter().map(|attribute| attribute.name.as_str());
        let features = self.features.iter().map(|features| features.name.as_str());
        let mut seen = std::collections::HashSet::new();
        for name in attributes.chain(features) {
            let problem = if !is_slug(name) {
                "must be lower case: a letter, then letters, digits and underscores"
            } else if RESERVED.contains(&name) {
                "is the name of a standard column"
            } else if split_feature_column(name).is_some() {
                "ends like a feature column (`_000`)"
            } else if name.starts_with(CLOUDCOMPARE_PREFIX) {
                "starts with `scalar_`, which CloudCompare and our reader take off"
            } else if !seen.insert(name) {
                "is used twice"
            } else {
                continue;
            };
            return Err(Error::inconsistent(&self.name, format!("the column name `{name}` {problem}")));
        }
        Ok(())
    }

    fn validate_offset(&self) -> Result<()> {
        match self.offset.iter().position(|value| !value.is_finite()) {
            Some(axis) => Err(self.non_finite("offset", axis, self.offset[axis])),
            None => Ok(()),
        }
    }

    fn validate_columns(&self) -> Result<()> {
        self.check_finite("positions", self.positions.as_flattened(), 3)?;
        self.check_finite("normals", self.normals.as_flattened(), 3)?;
        for attribute in &self.attributes {
            if let AttributeValues::F32(values) = &attribute.values {
                self.check_finite(&attribute.name, values, 1)?;
            }
        }
        for features in &self.features {
            self.check_finite(&features.name, &features.values, features.dim)?;
        }
        match position_of_first(&self.normals, is_not_unit) {
            Some(vertex) => {
                let reason = format!(
                    "the normal of vertex {vertex}, {:?}, is not of unit length",
                    self.normals[vertex]
                );
                Err(Error::inconsistent(&self.name, reason))
            }
            None => Ok(()),
        }
    }

    fn check_finite(&self, column: &str, values: &[f32], width: usize) -> Result<()> {
        match first_non_finite(values) {
            Some(index) => Err(self.non_finite(column, index / width, values[index].into())),
            None => Ok(()),
        }
    }

    fn non_finite(&self, column: &str, row: usize, value: f64) -> Error {
        Error::NonFinite { object: self.name.clone(), column: column.to_owned(), row, value }
    }

    fn validate_triangles(&self) -> Result<()> {
        let vertices = self.positions.len();
        let out_of_range = |[a, b, c]: &[u32; 3]| *a.max(b).max(c) as usize >= vertices;
        match position_of_first(&self.triangles, out_of_range) {
            Some(triangle) => {
                let corners = self.triangles[triangle];
                let reason = format!("triangle {triangle} is {corners:?} but there are {vertices} vertices");
                Err(Error::inconsistent(&self.name, reason))
            }
            None => Ok(()),
        }
    }
}

impl AttributeValues {
    /// Number of vertices.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::I32(values) => values.len(),
            Self::U8(values) => values.len(),
        }
    }

    /// Whether there are no vertices.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl Features {
    /// Name of dimension `d` where a format wants one scalar column each: `clip_000`.
    pub fn column(&self, d: usize) -> String {
        format!("{}_{d:03}", self.name)
    }
}

/// Index of the first NaN or infinity.
pub(crate) fn first_non_finite(values: &[f32]) -> Option<usize> {
    position_of_first(values, is_non_finite)
}

pub(crate) fn is_non_finite(value: &f32) -> bool {
    !value.is_finite()
}

pub(crate) fn is_not_unit(normal: &[f32; 3]) -> bool {
    let [x, y, z] = normal;
    let length = (x * x + y * y + z * z).sqrt();
    (length - 1.0).abs() > UNIT_LENGTH_TOLERANCE
}

/// Index of the first item that is bad.
pub(crate) fn position_of_first<T: Sync>(items: &[T], is_bad: impl Fn(&T) -> bool + Sync) -> Option<usize> {
    items.par_chunks(CHUNK).enumerate().find_map_first(|(chunk, items)| {
        if !any(items, &is_bad) {
            return None;
        }
        items.iter().position(&is_bad).map(|index| chunk * CHUNK + index)
    })
}

/// Whether any item is bad. Looking at every item vectorises, stopping at the first bad one does not.
pub(crate) fn any<T>(items: &[T], is_bad: impl Fn(&T) -> bool) -> bool {
    items.iter().fold(false, |any, item| any | is_bad(item))
}

/// What CloudCompare wants extra columns to start with.
pub(crate) const CLOUDCOMPARE_PREFIX: &str = "scalar_";

/// Whether `name` is `[a-z][a-z0-9_]*`.
pub(crate) fn is_slug(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_')
}

/// `clip_017` → (`clip`, 17); `None` where the name does not end in an underscore and at least three digits.
pub(crate) fn split_feature_column(name: &str) -> Option<(&str, usize)> {
    let (prefix, digits) = name.rsplit_once('_')?;
    let is_number = digits.len() >= 3 && digits.bytes().all(|b| b.is_ascii_digit());
    (is_number && !prefix.is_empty()).then(|| digits.parse().ok().map(|d| (prefix, d)))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Attribute;

    fn triangle() -> Geometry {
        Geometry {
            name: "triangle".into(),
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            normals: vec![[0.0, 0.0, 1.0]; 3],
            triangles: vec![[0, 1, 2]],
            attributes: vec![Attribute {
                name: "confidence".into(),
                values: AttributeValues::F32(vec![1.0; 3]),
            }],
            features: vec![Features { name: "clip".into(), dim: 2, values: vec![0.5; 6] }],
            ..Geometry::default()
        }
    }

    fn complaint(change: impl FnOnce(&mut Geometry)) -> String {
        let mut geometry = triangle();
        geometry.validate().expect("the unchanged geometry is valid");
        change(&mut geometry);
        geometry.validate().unwrap_err().to_string()
    }

    #[test]
    fn every_broken_invariant_is_named() {
        assert!(complaint(|g| g.normals.truncate(2)).contains("`normals` has 2 entries for 3"));
        assert!(complaint(|g| g.colors.push([0; 3])).contains("`colors` has 1"));
        assert!(complaint(|g| g.triangles[0][1] = 3).contains("triangle 0"));
        assert!(complaint(|g| g.normals[2] = [0.0; 3]).contains("normal of vertex 2"));
        assert!(complaint(|g| g.features[0].dim = 3).contains("6 values"));
        assert!(complaint(|g| g.features[0].dim = 0).contains("no dimensions"));
        assert!(complaint(|g| g.attributes[0].name = "Wash".into()).contains("lower case"));
        assert!(complaint(|g| g.attributes[0].name = "x".into()).contains("standard column"));
        assert!(complaint(|g| g.attributes[0].name = "clip_001".into()).contains("feature column"));
        assert!(complaint(|g| g.attributes[0].name = "clip".into()).contains("twice"));
        assert!(complaint(|g| g.attributes[0].name = "scalar_a".into()).contains("CloudCompare"));
    }

    #[test]
    fn every_non_finite_number_is_found() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(complaint(|g| g.positions[1][2] = bad).contains("`positions`"));
            assert!(complaint(|g| g.features[0].values[5] = bad).contains("row 2"));
            let values = AttributeValues::F32(vec![0.0, bad, 0.0]);
            assert!(complaint(|g| g.attributes[0].values = values).contains("row 1"));
        }
        assert!(complaint(|g| g.offset[1] = f64::NAN).contains("offset"));
    }

    #[test]
    fn the_first_non_finite_value_is_reported_wherever_it_is() {
        let mut values = vec![f32::MAX; 3 * CHUNK];
        assert_eq!(first_non_finite(&values), None);
        values[2 * CHUNK + 5] = f32::NAN;
        assert_eq!(first_non_finite(&values), Some(2 * CHUNK + 5));
        values[CHUNK] = f32::INFINITY;
        assert_eq!(first_non_finite(&values), Some(CHUNK));
    }

    #[test]
    fn feature_columns_are_told_from_other_names() {
        assert_eq!(split_feature_column("clip_pca_017"), Some(("clip_pca", 17)));
        assert_eq!(split_feature_column("label_01"), None);
        assert_eq!(split_feature_column("_001"), None);
        assert_eq!(split_feature_column("clip_0001"), Some(("clip", 1)));
    }
}
