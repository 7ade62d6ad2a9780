//! A marched mesh becomes geometry with attributes: only what was seen, without crumbs.

use divff_exporters::{Attribute, AttributeValues, Geometry};
use glam::{DVec3, Vec3, Vec3A};
use rayon::prelude::*;

use super::build::Context;
use super::error::MapError;
use crate::extract::TriMesh;
use crate::extract::clean::{CleanOptions, remove_small_components, vertex_normals};
use crate::extract::visibility::{VertexViews, ViewFrame, VisibilityOptions, look};
use crate::field::Stream;
use crate::render::query::Query;

/// Vertices that are asked about together; fixed, so that results do not depend on the number of threads.
const BATCH: usize = 1024;

/// A mesh relative to the grid's origin with a row of attributes per vertex.
pub(super) struct Surface {
    pub(super) mesh: TriMesh,
    pub(super) normals: Vec<[f32; 3]>,
    pub(super) seen: VertexViews,
}

impl Surface {
    /// Looks at every vertex from all `views`, then drops triangles of which too few views saw any corner, and small
    /// components.
    pub(super) fn seen_from(
        cx: &Context,
        what: &str,
        mut mesh: TriMesh,
        normals: Vec<[f32; 3]>,
        views: &[ViewFrame],
    ) -> Result<Self, MapError> {
        let failed = |e| MapError::extract(what)(e);
        let options = VisibilityOptions::for_voxel(cx.voxel as f32);
        let seen = look(&mesh.positions, &normals, cx.spec.origin, views, &options).map_err(failed)?;
        let enough = |v: &u32| seen.observations[*v as usize] >= cx.config.min_observations;
        mesh.triangles.retain(|t| t.iter().any(enough));
        let options = CleanOptions {
            min_area_fraction: 0.0,
            min_diagonal: cx.config.min_component_voxels * cx.voxel as f32,
        };
        let report = remove_small_components(&mut mesh, &options).map_err(failed)?;
        let kept = &report.kept_vertices;
        Ok(Self {
            mesh,
            normals: pick(&normals, kept),
            seen: VertexViews {
                observations: pick(&seen.observations, kept),
                mean_distance: pick(&seen.mean_distance, kept),
                confidence: pick(&seen.confidence, kept),
                colors: pick(&seen.colors, kept),
            },
        })
    }

    /// The geometry in world coordinates minus the map's offset. Vertices that no picture shows take the colour that
    /// the field has there.
    pub(super) fn into_geometry(
        self,
        cx: &Context,
        name: String,
        stream: Stream,
        field_colours: impl FnOnce(&Self) -> Vec<[u8; 3]>,
    ) -> Geometry {
        let fallback =
            if self.seen.colors.iter().any(Option::is_none) { field_colours(&self) } else { Vec::new() };
        let colors = self.seen.colors.iter().enumerate().map(|(n, c)| c.unwrap_or_else(|| fallback[n]));
        let colors = colors.collect();
        let shift = DVec3::from_array(cx.spec.origin) - DVec3::from_array(cx.offset);
        let place = |p: &[f32; 3]| (Vec3::from_array(*p).as_dvec3() + shift).as_vec3().to_array();
        let vertices = self.mesh.positions.len();
        let observations = self.seen.observations.iter().map(|&n| n as i32).collect();
        let column = |name: &str, values| Attribute { name: name.to_owned(), values };
        Geometry {
            name,
            positions: self.mesh.positions.iter().map(place).collect(),
            offset: cx.offset,
            normals: self.normals,
            colors,
            triangles: self.mesh.triangles,
            attributes: vec![
                column("confidence", AttributeValues::F32(self.seen.confidence)),
                column("observations", AttributeValues::I32(observations)),
                column("stream", AttributeValues::U8(vec![stream as u8; vertices])),
            ],
            features: Vec::new(),
        }
    }
}

fn pick<T: Clone>(column: &[T], kept: &[u32]) -> Vec<T> {
    kept.iter().map(|&v| column[v as usize].clone()).collect()
}

/// Colours that the field has at the vertices, seen head-on; `to_stream` maps a position relative to the grid's origin
/// to the stream's coordinates.
pub(super) fn field_colours(
    query: &Query,
    surface: &Surface,
    to_stream: impl Fn(Vec3A) -> Vec3 + Sync,
) -> Vec<[u8; 3]> {
    let batches = surface.mesh.positions.par_chunks(BATCH).zip(surface.normals.par_chunks(BATCH));
    let colours: Vec<Vec<[u8; 3]>> = batches
        .map(|(positions, normals)| {
            let points: Vec<Vec3> = positions.iter().map(|p| to_stream(Vec3A::from_array(*p))).collect();
            let directions: Vec<Vec3> = normals.iter().map(|n| -Vec3::from_array(*n)).collect();
            let level = |c: f32| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
            query.colours(&points, &directions).into_iter().map(|c| c.map(level)).collect()
        })
        .collect();
    colours.concat()
}

/// Normals from the gradient of a value that is greater inside, by central differences over `reach`; the mesh's own
/// normal where the value is flat or the two disagree about the outside.
pub(super) fn gradient_normals(
    mesh: &TriMesh,
    value: &(dyn Fn(&[Vec3A], &mut [f32]) + Sync),
    reach: f32,
) -> Vec<[f32; 3]> {
    let facets = vertex_normals(mesh);
    let batches = mesh.positions.par_chunks(BATCH).zip(facets.par_chunks(BATCH));
    let normals: Vec<Vec<[f32; 3]>> = batches
        .map(|(positions, facets)| {
            let steps = [Vec3A::X, Vec3A::Y, Vec3A::Z].map(|a| a * reach);
            let around = |p: &[f32; 3]| steps.map(|s| [Vec3A::from_array(*p) + s, Vec3A::from_array(*p) - s]);
            let points: Vec<Vec3A> = positions.iter().flat_map(around).flatten().collect();
            let mut values = vec![0.0; points.len()];
            value(&points, &mut values);
            let normal = |(v, facet): (&[f32], &[f32; 3])| {
                let n = Vec3A::new(v[1] - v[0], v[3] - v[2], v[5] - v[4]).normalize_or_zero();
                if n.dot(Vec3A::from_array(*facet)) > 0.5 { n.to_array() } else { *facet }
            };
            values.chunks_exact(6).zip(facets).map(normal).collect()
        })
        .collect();
    normals.concat()
}
