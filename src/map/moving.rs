//! What changes: the dynamic surface and the actor's, at each of the times asked for.
//!
//! These streams are seen for moments and from few sides, so their density is spread along the rays and no iso-level
//! of it is a surface. Their median depth is: it is rendered from the frames nearest in time (the actor: from its own
//! frame alone), where the stream takes most of the light, and fused.

use divff_exporters::Geometry;
use glam::{DVec2, Vec2, Vec3, Vec3A};
use rayon::prelude::*;

use super::MapObject;
use super::build::{Builder, Context, Stage};
use super::error::MapError;
use super::surface::{Surface, field_colours};
use super::times::Moment;
use super::views::{self, SeenFrame};
use crate::extract::clean::{smooth, vertex_normals};
use crate::extract::tsdf::{DepthFrame, TsdfOptions, TsdfVolume};
use crate::extract::visibility::ViewFrame;
use crate::field::Stream;
use crate::render::depth::{DepthMap, stream_depth};
use crate::render::query::Query;
use crate::render::refined::refined_camera;
use crate::scene::{Camera, Frame, Pose};
use crate::simd::one_minus_exp_neg;
use crate::work::Work;

/// A pixel shows a stream where it takes more than this share of the light.
const SHOWN: f32 = 0.5;

/// The dynamic surface has changed where the opacity of a cell of the density grid differs by more than this.
const CHANGED: f32 = 0.15;

/// Extracts the dynamic surface at every moment; where no cell's opacity changed, the geometry is shared.
pub(super) fn extract_dynamic(
    b: &mut Builder,
    seen: &[SeenFrame],
    moments: &[Moment],
) -> Result<(), MapError> {
    if !b.has(Stream::Dynamic) {
        return Ok(());
    }
    let views: Vec<ViewFrame> = seen.iter().map(SeenFrame::moving_view).collect();
    let cells = occupied_cells(&b.cx);
    // What was last extracted: opacities, geometry if there is any, name.
    let mut last: Option<(Vec<f32>, Option<usize>, String)> = None;
    for (n, moment) in moments.iter().enumerate() {
        b.report(Stage::Dynamic, n, moments.len());
        let object = object(Stream::Dynamic, moment);
        let name = object.name();
        let now = opacities(&b.cx, moment, &cells);
        if let Some((before, geometry, of)) = &last
            && before.iter().zip(&now).all(|(a, b)| (a - b).abs() <= CHANGED)
        {
            b.skip(name, format!("nothing changed since {of}; its geometry is shared"));
            let frames = nearest(&b.cx, moment.frame);
            let rays = views::pixels(&frames, stride(&b.cx, &frames));
            b.save("unchanged_times", Work::samples(rays * b.cx.sampling.count as u64));
            b.map.objects.extend(geometry.map(|geometry| MapObject { geometry, ..object }));
            continue;
        }
        let frames = nearest(&b.cx, moment.frame);
        let geometry = fused(&b.cx, Stream::Dynamic, moment, &frames, &name, &views)?;
        let added = b.add(object, geometry);
        last = Some((now, added.then(|| b.map.geometries.len() - 1), name));
    }
    b.report(Stage::Dynamic, moments.len(), moments.len());
    Ok(())
}

/// Extracts the actor at every moment, as far as its own frame sees it.
pub(super) fn extract_actor(b: &mut Builder, moments: &[Moment]) -> Result<(), MapError> {
    if !b.has(Stream::Actor) {
        return Ok(());
    }
    for (n, moment) in moments.iter().enumerate() {
        b.report(Stage::Actor, n, moments.len());
        let object = object(Stream::Actor, moment);
        let seen = views::look(&b.cx, moment.frame, stride(&b.cx, &[moment.frame]))?;
        let frames = [moment.frame];
        let geometry = fused(&b.cx, Stream::Actor, moment, &frames, &object.name(), &[seen.moving_view()])?;
        b.add(object, geometry);
    }
    b.report(Stage::Actor, moments.len(), moments.len());
    Ok(())
}

fn object(stream: Stream, moment: &Moment) -> MapObject {
    MapObject {
        stream,
        frame_index: Some(moment.frame.frame_index),
        interval: Some(moment.interval),
        geometry: 0,
    }
}

/// The reduction for some frames: one time may take as many rays as an eighth of the persistent surface.
fn stride(cx: &Context, frames: &[&Frame]) -> u32 {
    views::stride(frames, cx.config.depth_rays / 8)
}

/// The frames nearest in time, in order of time.
fn nearest<'a>(cx: &Context<'a>, frame: &Frame) -> Vec<&'a Frame> {
    let mut frames: Vec<&Frame> = cx.scene.frames.iter().collect();
    frames.sort_by(|a, b| (a.time - frame.time).abs().total_cmp(&(b.time - frame.time).abs()));
    frames.truncate(cx.config.dynamic_views.max(1));
    frames.sort_by(|a, b| a.time.total_cmp(&b.time));
    frames
}

/// The surface that some frames' cameras see of a stream at a moment.
fn fused(
    cx: &Context,
    stream: Stream,
    moment: &Moment,
    frames: &[&Frame],
    name: &str,
    views: &[ViewFrame],
) -> Result<Geometry, MapError> {
    let time = moment.frame.time as f32;
    let (stride, spread) = (stride(cx, frames), cx.config.truncation_voxels * cx.voxel);
    let shown = |frame: &&Frame| {
        let mut map = stream_depth(&cx.model, stream, frame, time, &cx.sampling, stride, spread);
        for (depth, shares) in map.depth.iter_mut().zip(&map.shares) {
            if shares[stream as usize] <= SHOWN {
                *depth = 0.0;
            }
        }
        map
    };
    let maps: Vec<DepthMap> = frames.iter().map(shown).collect();
    let depths: Vec<DepthFrame> = maps.iter().map(views::depth_frame).collect();
    let options = TsdfOptions { truncation: spread, min_weight: 0.0, max_depth: f32::INFINITY };
    let volume = TsdfVolume::fuse(&cx.spec, &depths, &options).map_err(MapError::extract(name))?;
    cx.count(volume.grid().report());
    let mut mesh = volume.mesh().map_err(MapError::extract(name))?;
    smooth(&mut mesh, cx.config.smoothing, 0.5 * cx.voxel as f32);
    let normals = vertex_normals(&mesh);
    let surface = Surface::seen_from(cx, name, mesh, normals, views)?;
    let Some(query) = Query::new(&cx.model, stream, time) else { return Ok(Geometry::default()) };
    let (camera, c2w) = refined_camera(cx.model.field, moment.frame);
    let to_stream = |p: Vec3A| match stream {
        Stream::Actor => actor_point(cx, &camera, &c2w, p),
        _ => cx.to_unit(p),
    };
    let colours = |s: &Surface| field_colours(&query, s, to_stream);
    Ok(surface.into_geometry(cx, name.to_owned(), stream, colours))
}

/// Actor coordinates of a position relative to the grid's origin; the nearest in the image for those outside.
fn actor_point(cx: &Context, camera: &Camera, c2w: &Pose, p: Vec3A) -> Vec3 {
    let world = glam::DVec3::from_array(cx.spec.origin) + p.as_dvec3();
    let at = c2w.inverse().transform_point3(world);
    let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
    let uv = camera.project(at).map_or(Vec2::splat(0.5), |uv| (uv / size).as_vec2());
    let z = (at.z / cx.model.field.normalisation.scale) as f32;
    cx.model.actor_point(uv.clamp(Vec2::ZERO, Vec2::ONE), z)
}

/// Centres (units) of the cells in which there is dynamic density at some time.
fn occupied_cells(cx: &Context) -> Vec<Vec3> {
    let (grid, threshold) = (&cx.model.grids.streams[1], cx.model.grids.threshold[1]);
    let cells = grid.dims().as_usizevec3().element_product();
    let center = |n: usize| grid.point(n, Vec3::splat(0.5), 0.5).0;
    let at_some_time = |n: &usize| grid.sigma.iter().skip(*n).step_by(cells).any(|&sigma| sigma >= threshold);
    (0..cells).filter(at_some_time).map(center).collect()
}

/// Opacities of these cells at a moment.
fn opacities(cx: &Context, moment: &Moment, cells: &[Vec3]) -> Vec<f32> {
    let Some(query) = Query::new(&cx.model, Stream::Dynamic, moment.frame.time as f32) else {
        return Vec::new();
    };
    let length = cx.model.grids.streams[1].cell().max_element();
    let mut out = vec![0.0; cells.len()];
    out.par_chunks_mut(1024).zip(cells.par_chunks(1024)).for_each(|(out, cells)| {
        query.density(cells, out);
        out.iter_mut().for_each(|v| *v = one_minus_exp_neg(*v * length));
    });
    out
}
