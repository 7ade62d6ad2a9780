//! What changes: the dynamic surface and the actor's, at each of the times asked for.

use divff_exporters::Geometry;
use glam::{DVec3, Vec2, Vec3, Vec3A};

use super::MapObject;
use super::build::{Builder, Context, Stage};
use super::error::MapError;
use super::persistent::{HALF, opacity, opacity_grid};
use super::surface::{Surface, field_colours, gradient_normals};
use super::times::Moment;
use super::views::{self, SeenFrame};
use crate::extract::clean::smooth;
use crate::extract::visibility::ViewFrame;
use crate::extract::{GridSpec, SparseGrid, march};
use crate::field::Stream;
use crate::render::query::Query;
use crate::render::refined::refined_camera;
use crate::scene::{Camera, Pose};

/// A block (729 corners) in which more corners than this change sides has changed; fewer are the trembling of a code
/// from frame to frame at a surface that stays.
const CHANGED_CORNERS: usize = 24;

/// Extracts the dynamic surface at every moment; where no block of its grid changed, the geometry is shared.
pub(super) fn extract_dynamic(
    b: &mut Builder,
    seen: &[SeenFrame],
    moments: &[Moment],
) -> Result<(), MapError> {
    if !b.has(Stream::Dynamic) {
        return Ok(());
    }
    let views: Vec<ViewFrame> = seen.iter().map(SeenFrame::moving_view).collect();
    // The last grid that was marched, and the geometry that came of it, if any.
    let mut last: Option<(SparseGrid, Option<usize>, String)> = None;
    for (n, moment) in moments.iter().enumerate() {
        b.report(Stage::Dynamic, n, moments.len());
        let object = object(Stream::Dynamic, moment);
        let Some(query) = Query::new(&b.cx.model, Stream::Dynamic, moment.frame.time as f32) else {
            continue;
        };
        let grid = opacity_grid(&b.cx, &query)?;
        if let Some((before, geometry, of)) = &last {
            if !changed(before, &grid) {
                let (geometry, of) = (*geometry, of.clone());
                drop(query);
                b.skip(object.name(), format!("nothing changed since {of}; its geometry is shared"));
                b.map.objects.extend(geometry.map(|geometry| MapObject { geometry, ..object }));
                continue;
            }
        }
        let geometry = dynamic_geometry(&b.cx, &query, &grid, &object.name(), &views)?;
        drop(query);
        let name = object.name();
        let added = b.add(object, geometry);
        last = Some((grid, added.then(|| b.map.geometries.len() - 1), name));
    }
    b.report(Stage::Dynamic, moments.len(), moments.len());
    Ok(())
}

/// Extracts the actor at every moment, in the camera's coordinates, as far as its own frame sees it.
pub(super) fn extract_actor(b: &mut Builder, moments: &[Moment]) -> Result<(), MapError> {
    if !b.has(Stream::Actor) {
        return Ok(());
    }
    for (n, moment) in moments.iter().enumerate() {
        b.report(Stage::Actor, n, moments.len());
        let object = object(Stream::Actor, moment);
        let geometry = actor_geometry(&b.cx, moment, &object.name())?;
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

/// Whether a surface that matters moved between two grids of the same blocks.
fn changed(before: &SparseGrid, after: &SparseGrid) -> bool {
    let blocks = before.blocks_of_values().zip(after.blocks_of_values());
    let sides = |(a, b): &(&f32, &f32)| (**a > HALF) != (**b > HALF);
    blocks.into_iter().any(|(a, b)| a.iter().zip(b).filter(sides).count() > CHANGED_CORNERS)
}

fn dynamic_geometry(
    cx: &Context,
    query: &Query,
    grid: &SparseGrid,
    name: &str,
    views: &[ViewFrame],
) -> Result<Geometry, MapError> {
    let mut mesh = march(grid, HALF).map_err(MapError::extract(name))?;
    smooth(&mut mesh, cx.config.smoothing, 0.5 * cx.voxel as f32);
    let length = cx.opaque_length();
    let value = |p: &[Vec3A], out: &mut [f32]| opacity(query, p, out, length, |p| cx.to_unit(p));
    let normals = gradient_normals(&mesh, &value, cx.voxel as f32);
    let surface = Surface::seen_from(cx, name, mesh, normals, views)?;
    let colours = |s: &Surface| field_colours(query, s, |p| cx.to_unit(p));
    Ok(surface.into_geometry(cx, name.to_owned(), Stream::Dynamic, colours))
}

fn actor_geometry(cx: &Context, moment: &Moment, name: &str) -> Result<Geometry, MapError> {
    let frame = moment.frame;
    let Some(query) = Query::new(&cx.model, Stream::Actor, frame.time as f32) else {
        return Ok(Geometry::default());
    };
    let (camera, c2w) = refined_camera(cx.model.field, frame);
    let frustum = Frustum::new(cx, camera, c2w);
    let (grid, threshold) = (&cx.model.grids.streams[2], cx.model.grids.threshold[2]);
    let may_hold = |center: Vec3A, half: f32| {
        let Some((low, high)) = frustum.bounds(cx, center, half) else { return false };
        grid.any_at_least(low, high, threshold)
    };
    let length = cx.opaque_length();
    // Outside the image the actor's coordinates mean nothing.
    let value = |points: &[Vec3A], out: &mut [f32]| {
        opacity(&query, points, out, length, |p| frustum.to_stream(cx, p).unwrap_or(Vec3::ZERO));
        for (p, v) in points.iter().zip(out) {
            if frustum.to_stream(cx, *p).is_none() {
                *v = 0.0;
            }
        }
    };
    let extract = |e| MapError::extract(name)(e);
    let mut mesh = march(&SparseGrid::sample(&frustum.spec, &may_hold, &value).map_err(extract)?, HALF)
        .map_err(extract)?;
    smooth(&mut mesh, cx.config.smoothing, 0.5 * cx.voxel as f32);
    let normals = gradient_normals(&mesh, &value, cx.voxel as f32);
    let normals = normals.iter().map(|n| frustum.turn(*n)).collect();
    for p in &mut mesh.positions {
        *p = frustum.to_grid(cx, *p);
    }
    let stride = views::stride(&[frame], cx.config.depth_rays / cx.scene.frames.len().max(1));
    let seen = views::look(cx, frame, stride)?;
    let surface = Surface::seen_from(cx, name, mesh, normals, &[seen.moving_view()])?;
    let colours = |s: &Surface| field_colours(&query, s, |p| frustum.from_grid(cx, p));
    Ok(surface.into_geometry(cx, name.to_owned(), Stream::Actor, colours))
}

/// A grid in one camera's axes over what the actor can reach.
struct Frustum {
    camera: Camera,
    c2w: Pose,
    /// Origin: the box's smallest corner in camera coordinates.
    spec: GridSpec,
    /// World units per unit.
    scale: f32,
    near: f32,
}

impl Frustum {
    fn new(cx: &Context, camera: Camera, c2w: Pose) -> Self {
        let field = cx.model.field;
        let scale = field.normalisation.scale;
        let (near, far) = (f64::from(field.near) * scale, f64::from(field.actor_far) * scale);
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        let (mut min, mut max) = (DVec3::new(0.0, 0.0, near), DVec3::new(0.0, 0.0, far));
        for (x, y) in
            [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5)]
        {
            let p = camera.unproject(glam::DVec2::new(x * w, y * h)) * far;
            min = min.min(p);
            max = max.max(p);
        }
        let spec = GridSpec::covering(min.to_array(), max.to_array(), cx.voxel);
        Self { camera, c2w, spec, scale: scale as f32, near: near as f32 }
    }

    /// Camera coordinates (world units) of a position relative to this grid's origin.
    fn to_camera(&self, p: Vec3A) -> DVec3 {
        DVec3::from_array(self.spec.origin) + p.as_dvec3()
    }

    /// Image fraction and actor coordinates; `None` outside the image.
    fn to_stream(&self, cx: &Context, p: Vec3A) -> Option<Vec3> {
        self.actor(cx, self.to_camera(p))
    }

    fn actor(&self, cx: &Context, at: DVec3) -> Option<Vec3> {
        let uv = self.camera.project(at)?;
        let uv = Vec2::new(uv.x as f32 / self.camera.width as f32, uv.y as f32 / self.camera.height as f32);
        let inside = uv.cmpge(Vec2::ZERO).all() && uv.cmple(Vec2::ONE).all();
        inside.then(|| cx.model.actor_point(uv, at.z as f32 / self.scale))
    }

    /// Bounds of a cube in actor coordinates; `None` if it is behind the camera.
    fn bounds(&self, cx: &Context, center: Vec3A, half: f32) -> Option<(Vec3, Vec3)> {
        let center = self.to_camera(center);
        let half = f64::from(half);
        if center.z + half <= f64::from(self.near) {
            return None;
        }
        let (mut low, mut high) = (Vec3::ONE, Vec3::ZERO);
        for i in 0..8 {
            let sign = |bit: i32| if i >> bit & 1 == 0 { -half } else { half };
            let mut corner = center + DVec3::new(sign(0), sign(1), sign(2));
            corner.z = corner.z.max(f64::from(self.near));
            // Without the lens: its bend is small against a cell of the actor's grid, and outside the image the
            // polynomial may fold back.
            let uv = Vec2::new(
                ((corner.x / corner.z * self.camera.fx + self.camera.cx) / f64::from(self.camera.width))
                    as f32,
                ((corner.y / corner.z * self.camera.fy + self.camera.cy) / f64::from(self.camera.height))
                    as f32,
            );
            let p = cx.model.actor_point(uv, corner.z as f32 / self.scale);
            low = low.min(p);
            high = high.max(p);
        }
        let visible = low.x <= 1.0 && low.y <= 1.0 && high.x >= 0.0 && high.y >= 0.0;
        visible.then(|| (low.clamp(Vec3::ZERO, Vec3::ONE), high.clamp(Vec3::ZERO, Vec3::ONE)))
    }

    fn turn(&self, normal: [f32; 3]) -> [f32; 3] {
        (self.c2w.matrix3.as_mat3() * Vec3::from_array(normal)).normalize_or(Vec3::Z).to_array()
    }

    /// From relative to this grid's origin to relative to the map's grid.
    fn to_grid(&self, cx: &Context, p: [f32; 3]) -> [f32; 3] {
        let world = self.c2w.transform_point3(self.to_camera(Vec3A::from_array(p)));
        (world - DVec3::from_array(cx.spec.origin)).as_vec3().to_array()
    }

    /// Actor coordinates of a position relative to the map's grid.
    fn from_grid(&self, cx: &Context, p: Vec3A) -> Vec3 {
        let world = DVec3::from_array(cx.spec.origin) + p.as_dvec3();
        self.actor(cx, self.c2w.inverse().transform_point3(world)).unwrap_or(Vec3::splat(0.5))
    }
}
