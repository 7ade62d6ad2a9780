//! The point cloud: area-uniform samples of what is there at the first time.

use divff_exporters::{Attribute, AttributeValues, Geometry};

use super::build::{Builder, Stage};
use super::error::MapError;
use crate::extract::sample::{SurfaceSamples, sample_surface};
use crate::extract::{ExtractError, TriMesh};
use crate::field::Stream;

/// Samples the persistent surface and the first dynamic one, as many points on each as its share of the area.
pub(super) fn sample(b: &mut Builder) -> Result<(), MapError> {
    let first = |stream: Stream| b.map.objects.iter().find(|o| o.stream == stream);
    let sampled: Vec<usize> =
        [Stream::Persistent, Stream::Dynamic].into_iter().filter_map(first).map(|o| o.geometry).collect();
    let sampled: Vec<(&Geometry, TriMesh)> = sampled
        .into_iter()
        .map(|g| &b.map.geometries[g])
        .map(|g| (g, TriMesh { positions: g.positions.clone(), triangles: g.triangles.clone() }))
        .collect();
    let area = |m: &TriMesh| (0..m.triangles.len()).map(|t| m.area(t)).sum::<f64>();
    let total: f64 = sampled.iter().map(|(_, m)| area(m)).sum();
    let mut cloud = Geometry { name: "points".into(), offset: b.cx.offset, ..Geometry::default() };
    let mut left = b.cx.config.points;
    for (n, (geometry, mesh)) in sampled.iter().enumerate() {
        let share = (b.cx.config.points as f64 * area(mesh) / total.max(f64::MIN_POSITIVE)).round() as usize;
        let count = if n + 1 == sampled.len() { left } else { share.min(left) };
        left -= count;
        let samples = sample_surface(mesh, count, b.map.seed.wrapping_add(n as u64));
        append(&mut cloud, geometry, samples).map_err(MapError::extract("points"))?;
    }
    b.map.points = cloud;
    if b.map.points.positions.is_empty() {
        b.skip("points", "there is no surface to sample");
    }
    b.report(Stage::Points, 1, 1);
    Ok(())
}

/// Interpolates all columns of the mesh at the samples; counts and labels take the nearest corner's value.
fn append(cloud: &mut Geometry, mesh: &Geometry, samples: SurfaceSamples) -> Result<(), ExtractError> {
    if samples.positions.is_empty() {
        return Ok(());
    }
    cloud.normals.extend(samples.interpolate_normals(&mesh.normals)?);
    cloud.colors.extend(samples.interpolate_colors(&mesh.colors)?);
    let nearest: Vec<usize> = samples.vertices.iter().zip(&samples.weights).map(nearest_corner).collect();
    for (n, column) in mesh.attributes.iter().enumerate() {
        let values = match &column.values {
            AttributeValues::F32(v) => AttributeValues::F32(samples.interpolate(v, 1)?),
            AttributeValues::I32(v) => AttributeValues::I32(nearest.iter().map(|&i| v[i]).collect()),
            AttributeValues::U8(v) => AttributeValues::U8(nearest.iter().map(|&i| v[i]).collect()),
        };
        match cloud.attributes.get_mut(n) {
            None => cloud.attributes.push(Attribute { name: column.name.clone(), values }),
            Some(into) => extend(&mut into.values, values),
        }
    }
    cloud.positions.extend(samples.positions);
    Ok(())
}

/// Appends a column of the same type; all meshes of a map have the same columns.
fn extend(into: &mut AttributeValues, from: AttributeValues) {
    match (into, from) {
        (AttributeValues::F32(a), AttributeValues::F32(b)) => a.extend(b),
        (AttributeValues::I32(a), AttributeValues::I32(b)) => a.extend(b),
        (AttributeValues::U8(a), AttributeValues::U8(b)) => a.extend(b),
        _ => unreachable!("all surfaces get their columns in one place"),
    }
}

fn nearest_corner((vertices, weights): (&[u32; 3], &[f32; 3])) -> usize {
    let heaviest = (1..3).fold(0, |best, k| if weights[k] > weights[best] { k } else { best });
    vertices[heaviest] as usize
}
