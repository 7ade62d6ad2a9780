//! The persistent surface, by fused depth or by density.

use glam::{Vec3, Vec3A};

use super::MapObject;
use super::build::{Builder, Context, Stage};
use super::config::SurfaceMethod;
use super::error::MapError;
use super::surface::{Surface, field_colours, gradient_normals};
use super::views::{SeenFrame, depth_frame};
use crate::extract::clean::{smooth, vertex_normals};
use crate::extract::tsdf::{DepthFrame, TsdfOptions, TsdfVolume};
use crate::extract::visibility::ViewFrame;
use crate::extract::{SparseGrid, TriMesh, march};
use crate::field::Stream;
use crate::render::query::Query;
use crate::simd::one_minus_exp_neg;

/// Where a density surface lies: half of the light is stopped. (σ δ = ln 2 with δ = `opaque_voxels` voxels.)
pub(super) const HALF: f32 = 0.5;

/// Extracts the persistent surface and adds it to the map.
pub(super) fn extract(b: &mut Builder, seen: &[SeenFrame]) -> Result<(), MapError> {
    if !b.has(Stream::Persistent) {
        return Ok(());
    }
    b.report(Stage::Persistent, 0, 1);
    let name = Stream::Persistent.name();
    let mut mesh = match b.cx.config.method {
        SurfaceMethod::Tsdf | SurfaceMethod::Both => fused(&b.cx, seen)?,
        SurfaceMethod::Density => marched(&b.cx)?,
    };
    smooth(&mut mesh, b.cx.config.smoothing, 0.5 * b.cx.voxel as f32);
    let Some(query) = Query::new(&b.cx.model, Stream::Persistent, 0.0) else { return Ok(()) };
    let normals = match b.cx.config.method {
        SurfaceMethod::Tsdf | SurfaceMethod::Both => vertex_normals(&mesh),
        SurfaceMethod::Density => {
            let length = b.cx.opaque_length();
            gradient_normals(
                &mesh,
                &|p, out| opacity(&query, p, out, length, |p| b.cx.to_unit(p)),
                b.cx.voxel as f32,
            )
        }
    };
    let views: Vec<ViewFrame> = seen.iter().map(SeenFrame::persistent_view).collect();
    let surface = Surface::seen_from(&b.cx, name, mesh, normals, &views)?;
    let colours = |s: &Surface| field_colours(&query, s, |p| b.cx.to_unit(p));
    let geometry = surface.into_geometry(&b.cx, name.to_owned(), Stream::Persistent, colours);
    drop(query);
    let object = MapObject { stream: Stream::Persistent, frame_index: None, interval: None, geometry: 0 };
    b.add(object, geometry);
    b.report(Stage::Persistent, 1, 1);
    Ok(())
}

/// Fuses the depth of all training frames.
fn fused(cx: &Context, seen: &[SeenFrame]) -> Result<TriMesh, MapError> {
    let options = TsdfOptions {
        truncation: cx.config.truncation_voxels * cx.voxel,
        min_weight: cx.config.min_views,
        max_depth: f32::INFINITY,
    };
    let frames: Vec<DepthFrame> = seen.iter().map(|s| depth_frame(&s.map)).collect();
    let failed = MapError::extract("persistent");
    let volume = match TsdfVolume::fuse(&cx.spec, &frames, &options) {
        Ok(volume) => volume,
        Err(e) => return Err(failed(e)),
    };
    cx.count(volume.grid().report());
    let query = Query::new(&cx.model, Stream::Persistent, 0.0);
    match (cx.config.method, query) {
        (SurfaceMethod::Both, Some(query)) => {
            let density = opacity_grid(cx, &query)?;
            // Both are positive inside and at most 1 away from the surface.
            let both = volume.grid().or(&density, |opacity| 2.0 * (opacity - HALF));
            both.and_then(|grid| march(&grid, 0.0)).map_err(failed)
        }
        _ => volume.mesh().map_err(failed),
    }
}

/// Marches the density where the density grid says that there may be a surface.
fn marched(cx: &Context) -> Result<TriMesh, MapError> {
    let Some(query) = Query::new(&cx.model, Stream::Persistent, 0.0) else { return Ok(TriMesh::default()) };
    let grid = opacity_grid(cx, &query)?;
    march(&grid, HALF).map_err(MapError::extract("persistent"))
}

/// Opacities of a stream in world coordinates, over the whole box where its density grid is not empty.
pub(super) fn opacity_grid(cx: &Context, query: &Query) -> Result<SparseGrid, MapError> {
    let s = query.stream();
    let (grid, threshold) = (&cx.model.grids.streams[s as usize], cx.model.grids.threshold[s as usize]);
    let may_hold = |center: Vec3A, half: f32| {
        let (low, high) = (cx.to_unit(center - half), cx.to_unit(center + half));
        grid.any_at_least(low, high, threshold)
    };
    let length = cx.opaque_length();
    let value = |p: &[Vec3A], out: &mut [f32]| opacity(query, p, out, length, |p| cx.to_unit(p));
    let grid = SparseGrid::sample(&cx.spec, &may_hold, &value).map_err(MapError::extract(s.name()))?;
    cx.count(grid.report());
    Ok(grid)
}

/// 1 − e^(−σ δ) at positions relative to the grid's origin: bounded, so that linear interpolation between corners
/// finds the iso-level better than it would on densities that differ by orders of magnitude.
pub(super) fn opacity(
    query: &Query,
    points: &[Vec3A],
    out: &mut [f32],
    length: f32,
    to_stream: impl Fn(Vec3A) -> Vec3,
) {
    let points: Vec<Vec3> = points.iter().map(|p| to_stream(*p)).collect();
    query.density(&points, out);
    for v in out {
        *v = one_minus_exp_neg(*v * length);
    }
}
