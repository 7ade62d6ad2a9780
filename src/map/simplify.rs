//! Fewer triangles for the meshes of a finished map, within tolerances of shape and attributes.

use divff_exporters::manifest::{DeviationEntry, SimplifiedEntry};
use divff_exporters::{AttributeValues, Geometry};

use super::build::{Progress, Stage};
use super::config::{MapConfig, Simplify};
use super::{MapError, SemanticMap};
use crate::extract::TriMesh;
use crate::extract::simplify::{Column, simplify_watched};

/// Simplifies every mesh of the map as `config` says and notes in `map.simplified` what came of it; the cloud keeps its
/// points. To be called when all attributes are there: those that are added later would not be looked at.
///
/// # Errors
/// A setting out of range, or a mesh with numbers that are not finite.
pub fn simplify(
    map: &mut SemanticMap,
    config: &MapConfig,
    progress: &mut dyn FnMut(Progress),
) -> Result<(), MapError> {
    config.validate()?;
    let Simplify::Within(tolerance) = config.simplify else { return Ok(()) };
    // In triangles: one mesh has most of them.
    let total = map.geometries.iter().map(|g| g.triangles.len()).sum();
    let mut before = 0;
    for geometry in &mut map.geometries {
        let triangles = geometry.triangles.len();
        let mut part = |share: f32| {
            let done = before + (f64::from(share) * triangles as f64) as usize;
            progress(Progress { stage: Stage::Simplify, done, total });
        };
        map.simplified.push(simplify_geometry(geometry, tolerance, config, &mut part)?);
        before += triangles;
    }
    progress(Progress { stage: Stage::Simplify, done: total, total });
    Ok(())
}

fn simplify_geometry(
    geometry: &mut Geometry,
    tolerance: f64,
    config: &MapConfig,
    progress: &mut dyn FnMut(f32),
) -> Result<SimplifiedEntry, MapError> {
    let bounded = bounded_columns(geometry, config);
    let mesh = TriMesh {
        positions: std::mem::take(&mut geometry.positions),
        triangles: std::mem::take(&mut geometry.triangles),
    };
    let columns: Vec<Column> = bounded.iter().map(Bounded::column).collect();
    let done = simplify_watched(&mesh, &columns, tolerance as f32, progress);
    let done = done.map_err(MapError::extract(&geometry.name))?;
    let deviations = bounded.iter().zip(&done.report.deviations).map(|(column, &largest)| DeviationEntry {
        name: column.name.clone(),
        tolerance: f64::from(column.tolerance),
        largest: f64::from(largest),
    });
    let entry = SimplifiedEntry {
        name: geometry.name.clone(),
        tolerance,
        largest_distance: f64::from(done.report.max_distance),
        triangles_before: done.report.triangles_before,
        triangles_after: done.report.triangles_after,
        patches: done.report.patches,
        kept_patches: done.report.kept_patches,
        deviations: deviations.collect(),
    };
    geometry.positions = done.mesh.positions;
    geometry.triangles = done.mesh.triangles;
    keep_rows(geometry, &done.kept_vertices);
    Ok(entry)
}

/// A column that must be kept to a tolerance.
struct Bounded {
    name: String,
    values: Vec<f32>,
    dim: usize,
    tolerance: f32,
}

impl Bounded {
    fn column(&self) -> Column<'_> {
        Column { values: &self.values, dim: self.dim, tolerance: self.tolerance }
    }
}

/// Colours, scores and features. How often and how well a vertex was seen is said of that vertex alone.
fn bounded_columns(geometry: &Geometry, config: &MapConfig) -> Vec<Bounded> {
    let mut columns = Vec::new();
    if !geometry.colors.is_empty() {
        let values = geometry.colors.as_flattened().iter().map(|&c| f32::from(c)).collect();
        columns.push(Bounded { name: "color".into(), values, dim: 3, tolerance: config.simplify_color });
    }
    for attribute in &geometry.attributes {
        let AttributeValues::F32(values) = &attribute.values else { continue };
        if attribute.name.starts_with("relevancy_") || attribute.name.starts_with("affordance_") {
            let (name, values) = (attribute.name.clone(), values.clone());
            columns.push(Bounded { name, values, dim: 1, tolerance: config.simplify_score });
        }
    }
    for features in &geometry.features {
        let rows = (features.values.len() / features.dim.max(1)).max(1);
        let squares: f64 = features.values.iter().map(|v| f64::from(*v).powi(2)).sum();
        // Codes are relative to a mean, so that one alone may be next to nothing: all of them are the measure.
        let length = (squares / rows as f64).sqrt() as f32;
        if length > 0.0 {
            let (name, values) = (features.name.clone(), features.values.clone());
            let tolerance = config.simplify_feature * length;
            columns.push(Bounded { name, values, dim: features.dim, tolerance });
        }
    }
    columns
}

/// Keeps these rows of all columns but the positions.
fn keep_rows(geometry: &mut Geometry, rows: &[u32]) {
    fn pick<T: Copy>(column: &mut Vec<T>, rows: &[u32]) {
        if !column.is_empty() {
            *column = rows.iter().map(|&v| column[v as usize]).collect();
        }
    }
    pick(&mut geometry.normals, rows);
    pick(&mut geometry.colors, rows);
    for attribute in &mut geometry.attributes {
        match &mut attribute.values {
            AttributeValues::F32(values) => pick(values, rows),
            AttributeValues::I32(values) => pick(values, rows),
            AttributeValues::U8(values) => pick(values, rows),
        }
    }
    for features in &mut geometry.features {
        let row = |&v: &u32| &features.values[v as usize * features.dim..(v as usize + 1) * features.dim];
        features.values = rows.iter().flat_map(row).copied().collect();
    }
}

#[cfg(test)]
mod tests {
    use divff_exporters::{Attribute, Features};

    use super::*;

    /// A flat square of 16 × 16 cells; colour and score have a step each, at different places.
    fn square() -> Geometry {
        let positions: Vec<[f32; 3]> =
            (0..17 * 17).map(|v| [(v % 17) as f32 / 16.0, (v / 17) as f32 / 16.0, 0.0]).collect();
        let cells = (0..16u32).flat_map(|y| (0..16u32).map(move |x| y * 17 + x));
        let step = |p: &[f32; 3], axis: usize| p[axis] > 0.5;
        Geometry {
            name: "persistent".into(),
            normals: vec![[0.0, 0.0, 1.0]; positions.len()],
            colors: positions.iter().map(|p| [if step(p, 0) { 200 } else { 20 }; 3]).collect(),
            triangles: cells.flat_map(|a| [[a, a + 1, a + 18], [a, a + 18, a + 17]]).collect(),
            attributes: vec![
                Attribute {
                    name: "relevancy_mug".into(),
                    values: AttributeValues::F32(
                        positions.iter().map(|p| f32::from(u8::from(step(p, 1)))).collect(),
                    ),
                },
                Attribute {
                    name: "observations".into(),
                    values: AttributeValues::I32((0..positions.len() as i32).collect()),
                },
            ],
            features: vec![Features {
                name: "clip_pca".into(),
                dim: 2,
                values: positions.iter().flat_map(|p| [p[0], 1.0]).collect(),
            }],
            positions,
            ..Geometry::default()
        }
    }

    #[test]
    fn rows_follow_their_vertices_and_every_kind_of_column_is_bounded() {
        let before = square();
        let within = |simplify_color, simplify_score| {
            let mut geometry = square();
            let config = MapConfig { simplify_color, simplify_score, ..MapConfig::default() };
            let entry = simplify_geometry(&mut geometry, 0.01, &config, &mut |_| {}).unwrap();
            (geometry, entry)
        };
        let (free, _) = within(1e3, 1e3);
        assert_eq!(free.triangles.len(), 2);
        let (both, entry) = within(16.0, 0.1);
        assert!((8..256).contains(&both.triangles.len()), "{}", both.triangles.len());
        assert!(within(16.0, 1e3).0.triangles.len() < both.triangles.len());
        assert!(within(1e3, 0.1).0.triangles.len() < both.triangles.len());
        let names: Vec<&str> = entry.deviations.iter().map(|d| d.name.as_str()).collect();
        assert_eq!(names, ["color", "relevancy_mug", "clip_pca"]);
        assert!(entry.deviations.iter().all(|d| d.largest <= d.tolerance), "{entry:?}");
        let AttributeValues::I32(numbers) = &both.attributes[1].values else { panic!("kept its type") };
        for (n, &v) in numbers.iter().enumerate() {
            let v = v as usize;
            assert_eq!(both.positions[n], before.positions[v]);
            assert_eq!(both.colors[n], before.colors[v]);
            assert_eq!(
                both.features[0].values[2 * n..2 * n + 2],
                before.features[0].values[2 * v..2 * v + 2]
            );
        }
        assert_eq!(both.normals.len(), both.positions.len());
    }
}
