//! PLY → geometry: our own files, and meshes and clouds of other programs.

use std::fs;
use std::path::Path;

use super::header::{Element, Encoding, Header, Property, Scalar, parse_header};
use crate::error::{Error, Result};
use crate::geometry::{Attribute, AttributeValues, Features, Geometry};
use crate::validate::{CLOUDCOMPARE_PREFIX, UNIT_LENGTH_TOLERANCE, split_feature_column};

/// Beyond this many times its own extent from the origin, a cloud of doubles is read with an offset: f32
/// would otherwise keep less than 24 - 10 = 14 bits for the shape.
const FAR_IN_EXTENTS: f64 = 1024.0;

/// One property of the vertices, as read.
struct Column {
    name: String,
    scalar: Scalar,
    values: Vec<f64>,
}

/// Reads a mesh or point cloud; binary (any scalar types) or ASCII.
///
/// Polygons are split into fans. `float`, `double` → f32 columns, integers → i32, `uchar` → u8. Columns
/// `<name>_000`, `<name>_001`, … become [`Features`]; a `scalar_` prefix is taken off; other names are made
/// slugs. Normals are scaled to unit length, and left out if one of them is zero.
///
/// # Errors
/// `Io`; `Invalid` with the byte offset for any contradiction or early end; `NonFinite` for NaN and infinity;
/// `Unsupported` for lists on vertices.
pub fn read_ply(path: &Path) -> Result<Geometry> {
    let file = fs::read(path).map_err(|source| Error::io(path, source))?;
    let header = parse_header(path, &file)?;
    let mut body = Body { path, file: &file, at: header.bytes, encoding: header.encoding };
    let mut columns = Vec::new();
    let mut triangles = Vec::new();
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" if columns.is_empty() => columns = body.read_columns(element)?,
            "face" => body.read_faces(element, &mut triangles)?,
            _ => body.skip(element)?,
        }
    }
    let geometry = assemble(path, &header, columns, triangles)?;
    check(path, geometry)
}

/// Reads the positions of the vertices alone, whatever other columns hold.
///
/// # Errors
/// As [`read_ply`], but for values that are not positions.
pub fn read_ply_positions(path: &Path) -> Result<Vec<[f64; 3]>> {
    let file = fs::read(path).map_err(|source| Error::io(path, source))?;
    let header = parse_header(path, &file)?;
    let mut body = Body { path, file: &file, at: header.bytes, encoding: header.encoding };
    for element in &header.elements {
        if element.name != "vertex" {
            body.skip(element)?;
            continue;
        }
        let mut columns = body.read_columns(element)?;
        let mut take = |name: &str| {
            let column = columns.iter_mut().find(|c| c.name == name);
            let missing = || Error::invalid(path, format!("its vertices have no property `{name}`"));
            Ok(std::mem::take(&mut column.ok_or_else(missing)?.values))
        };
        let (x, y, z) = (take("x")?, take("y")?, take("z")?);
        let rows = x.into_iter().zip(y).zip(z);
        return Ok(rows.map(|((x, y), z)| [x, y, z]).collect());
    }
    Err(Error::invalid(path, "the file has no vertices"))
}

/// The invariants, with the file's name in the message where the file is to blame.
fn check(path: &Path, geometry: Geometry) -> Result<Geometry> {
    match geometry.validate() {
        Ok(()) => Ok(geometry),
        Err(Error::Inconsistent { reason, .. }) => Err(Error::invalid(path, reason)),
        Err(Error::NonFinite { column, row, value, .. }) => {
            Err(Error::NonFinite { object: path.display().to_string(), column, row, value })
        }
        Err(other) => Err(other),
    }
}

/// The bytes after the header and a position in them.
struct Body<'a> {
    path: &'a Path,
    file: &'a [u8],
    at: usize,
    encoding: Encoding,
}

impl Body<'_> {
    fn next(&mut self, scalar: Scalar) -> Result<f64> {
        match self.encoding {
            Encoding::BinaryLittleEndian => self.next_binary(scalar, Scalar::read),
            Encoding::BinaryBigEndian => self.next_binary(scalar, Scalar::read_big_endian),
            Encoding::Ascii => self.next_word(),
        }
    }

    fn next_binary(&mut self, scalar: Scalar, read: impl Fn(Scalar, &[u8]) -> Option<f64>) -> Result<f64> {
        let value = read(scalar, &self.file[self.at..]).ok_or_else(|| self.error("the file is cut short"))?;
        self.at += scalar.size();
        Ok(value)
    }

    fn next_word(&mut self) -> Result<f64> {
        let rest = &self.file[self.at..];
        let start = rest.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(rest.len());
        let length = rest[start..].iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len() - start);
        let word = &rest[start..start + length];
        let value = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
        let value = value.ok_or_else(|| self.error("expected a number"))?;
        self.at += start + length;
        Ok(value)
    }

    fn error(&self, reason: &str) -> Error {
        Error::invalid_at(self.path, self.at, reason)
    }

    fn read_columns(&mut self, element: &Element) -> Result<Vec<Column>> {
        if let Some(list) = element.properties.iter().find(|property| property.list.is_some()) {
            return Err(Error::Unsupported {
                path: self.path.to_owned(),
                what: format!("the list `{}` on vertices", list.name),
                remedy: "write one scalar property per dimension",
            });
        }
        let mut columns: Vec<Column> = element
            .properties
            .iter()
            .map(|property| Column {
                name: property.name.clone(),
                scalar: property.scalar,
                // check_size() has seen that the file holds this many values.
                values: Vec::with_capacity(element.count),
            })
            .collect();
        for _ in 0..element.count {
            for column in &mut columns {
                column.values.push(self.next(column.scalar)?);
            }
        }
        Ok(columns)
    }

    fn read_faces(&mut self, element: &Element, triangles: &mut Vec<[u32; 3]>) -> Result<()> {
        let mut corners = Vec::new();
        for _ in 0..element.count {
            for property in &element.properties {
                let at = self.at;
                let is_corners = matches!(property.name.as_str(), "vertex_indices" | "vertex_index");
                let count = self.list_length(property)?;
                corners.clear();
                for _ in 0..count {
                    let value = self.next(property.scalar)?;
                    if is_corners {
                        corners.push(corner(value).ok_or_else(|| {
                            Error::invalid_at(self.path, at, format!("{value} is no vertex index"))
                        })?);
                    }
                }
                for pair in corners.get(1..).unwrap_or(&[]).windows(2) {
                    triangles.push([corners[0], pair[0], pair[1]]);
                }
            }
        }
        Ok(())
    }

    fn skip(&mut self, element: &Element) -> Result<()> {
        for _ in 0..element.count {
            for property in &element.properties {
                for _ in 0..self.list_length(property)? {
                    self.next(property.scalar)?;
                }
            }
        }
        Ok(())
    }

    /// Number of values of the property in this row.
    fn list_length(&mut self, property: &Property) -> Result<usize> {
        let Some(count_type) = property.list else { return Ok(1) };
        let at = self.at;
        let count = self.next(count_type)?;
        if count < 0.0 || count.fract() != 0.0 {
            return Err(Error::invalid_at(self.path, at, format!("{count} is no list length")));
        }
        Ok(count as usize)
    }
}

fn corner(value: f64) -> Option<u32> {
    (value >= 0.0 && value <= f64::from(u32::MAX) && value.fract() == 0.0).then_some(value as u32)
}

fn assemble(
    path: &Path,
    header: &Header,
    columns: Vec<Column>,
    triangles: Vec<[u32; 3]>,
) -> Result<Geometry> {
    let mut columns: Vec<Option<Column>> = columns.into_iter().map(Some).collect();
    let mut take =
        |name: &str| columns.iter_mut().find(|c| c.as_ref().is_some_and(|c| c.name == name))?.take();
    let notes = Notes::from_comments(path, &header.comments)?;
    let (Some(x), Some(y), Some(z)) = (take("x"), take("y"), take("z")) else {
        return Err(Error::invalid(path, "the vertices have no `x`, `y` and `z`"));
    };
    let (positions, offset) = join_positions(&[x, y, z], notes.offset);
    let normals = match (take("nx"), take("ny"), take("nz")) {
        (Some(x), Some(y), Some(z)) => unit_normals(join3(&[x, y, z], |v| v as f32)),
        _ => vec![],
    };
    let colors = match (take("red"), take("green"), take("blue")) {
        (Some(r), Some(g), Some(b)) if [&r, &g, &b].iter().all(|c| c.scalar == Scalar::U8) => {
            join3(&[r, g, b], |v| v as u8)
        }
        (None, None, None) => vec![],
        _ => {
            return Err(Error::Unsupported {
                path: path.to_owned(),
                what: "a colour that is not `uchar red, green, blue`".into(),
                remedy: "save colours as 8-bit red, green, blue",
            });
        }
    };
    if notes.quality.is_some() {
        take("quality");
    }
    let (attributes, features) = sort_extras(path, columns.into_iter().flatten())?;
    let name = notes.name.unwrap_or_else(|| stem(path));
    Ok(Geometry { name, positions, offset, normals, colors, triangles, attributes, features })
}

fn stem(path: &Path) -> String {
    path.file_stem().map_or(String::new(), |stem| stem.to_string_lossy().into_owned())
}

/// What our writer puts into comments.
#[derive(Default)]
struct Notes {
    name: Option<String>,
    offset: Option<[f64; 3]>,
    quality: Option<String>,
}

impl Notes {
    fn from_comments(path: &Path, comments: &[String]) -> Result<Self> {
        let mut notes = Self::default();
        for note in comments.iter().filter_map(|comment| comment.strip_prefix("divff ")) {
            match note.split_once(' ') {
                Some(("name", name)) => notes.name = Some(name.to_owned()),
                Some(("quality", name)) => notes.quality = Some(name.to_owned()),
                Some(("offset", numbers)) => {
                    let offset: Option<Vec<f64>> = numbers.split(' ').map(|n| n.parse().ok()).collect();
                    let offset = offset.and_then(|offset| offset.try_into().ok());
                    let error = || Error::invalid(path, format!("cannot parse `comment divff {note}`"));
                    notes.offset = Some(offset.ok_or_else(error)?);
                }
                _ => {}
            }
        }
        Ok(notes)
    }
}

fn join3<T>(columns: &[Column; 3], convert: impl Fn(f64) -> T) -> Vec<[T; 3]> {
    let [x, y, z] = columns;
    let rows = x.values.iter().zip(&y.values).zip(&z.values);
    rows.map(|((&x, &y), &z)| [convert(x), convert(y), convert(z)]).collect()
}

/// Other programs write normals of any length. Without a direction at every vertex there are no usable
/// normals.
fn unit_normals(mut normals: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    for normal in &mut normals {
        let length = normal.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        if length == 0.0 {
            return vec![];
        }
        // Our own normals stay as they are, bit for bit.
        if (length - 1.0).abs() > f64::from(UNIT_LENGTH_TOLERANCE) {
            *normal = normal.map(|v| (f64::from(v) / length) as f32);
        }
    }
    normals
}

/// f32 positions and the offset to add to them: the recorded one, or a new one for doubles far from the
/// origin.
fn join_positions(columns: &[Column; 3], recorded: Option<[f64; 3]>) -> (Vec<[f32; 3]>, [f64; 3]) {
    let mut offset = [0.0; 3];
    if recorded.is_none() && columns.iter().any(|column| column.scalar == Scalar::F64) {
        let ranges = columns.each_ref().map(|column| {
            column
                .values
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &v| (lo.min(v), hi.max(v)))
        });
        let extent = ranges.iter().map(|(lo, hi)| hi - lo).fold(0.0, f64::max);
        let farthest = ranges.iter().map(|(lo, hi)| lo.abs().max(hi.abs())).fold(0.0, f64::max);
        if farthest.is_finite() && farthest > FAR_IN_EXTENTS * extent {
            offset = ranges.map(|(lo, hi)| (0.5 * (lo + hi)).round());
        }
    }
    let [x, y, z] = columns;
    let rows = x.values.iter().zip(&y.values).zip(&z.values);
    let positions =
        rows.map(|((x, y), z)| [(x - offset[0]) as f32, (y - offset[1]) as f32, (z - offset[2]) as f32]);
    (positions.collect(), recorded.unwrap_or(offset))
}

/// Tells feature columns from attributes.
fn sort_extras(
    path: &Path,
    columns: impl Iterator<Item = Column>,
) -> Result<(Vec<Attribute>, Vec<Features>)> {
    let mut attributes = Vec::new();
    let mut groups: Vec<(String, Vec<Vec<f64>>)> = Vec::new();
    for column in columns {
        let name = slug(column.name.strip_prefix(CLOUDCOMPARE_PREFIX).unwrap_or(&column.name));
        let Some((prefix, d)) = split_feature_column(&name) else {
            attributes.push(Attribute { values: attribute_values(path, &column)?, name });
            continue;
        };
        let group = match groups.iter_mut().position(|(known, _)| known == prefix) {
            Some(group) => &mut groups[group].1,
            None => {
                groups.push((prefix.to_owned(), vec![]));
                &mut groups.last_mut().expect("just pushed").1
            }
        };
        if d != group.len() {
            let expected = group.len();
            let reason = format!("feature column `{name}` comes where `{prefix}_{expected:03}` should");
            return Err(Error::invalid(path, reason));
        }
        group.push(column.values);
    }
    let features = groups.into_iter().map(|(name, columns)| interleave(name, &columns)).collect();
    Ok((attributes, features))
}

fn interleave(name: String, columns: &[Vec<f64>]) -> Features {
    let dim = columns.len();
    let rows = columns[0].len();
    let values = (0..rows).flat_map(|row| columns.iter().map(move |column| column[row] as f32)).collect();
    Features { name, dim, values }
}

fn attribute_values(path: &Path, column: &Column) -> Result<AttributeValues> {
    let values = &column.values;
    Ok(match column.scalar {
        Scalar::F32 | Scalar::F64 => AttributeValues::F32(values.iter().map(|&v| v as f32).collect()),
        Scalar::U8 => AttributeValues::U8(values.iter().map(|&v| v as u8).collect()),
        Scalar::I8 | Scalar::I16 | Scalar::U16 | Scalar::I32 | Scalar::U32 => {
            if let Some(big) = values.iter().find(|&&v| v > f64::from(i32::MAX)) {
                let reason =
                    format!("{big} in column `{}` does not fit a 32-bit signed integer", column.name);
                return Err(Error::invalid(path, reason));
            }
            AttributeValues::I32(values.iter().map(|&v| v as i32).collect())
        }
    })
}

/// Lower case, every other character than a letter or digit an underscore, a letter first.
fn slug(name: &str) -> String {
    let slug: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' }).collect();
    if slug.starts_with(|c: char| c.is_ascii_lowercase()) { slug } else { format!("a{slug}") }
}
