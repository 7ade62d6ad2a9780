//! `report.html`: a run at a glance, in one file without network access.
//!
//! Everything in it is read from the run's folder, so that the report shows what is really on the disk.

pub(crate) mod chart;
mod colour;
mod embed;
mod features;
pub(crate) mod html;
pub mod raster;
pub mod tables;

use std::path::{Path, PathBuf};

pub use colour::{depth_picture, depth_range, stream_picture, turbo};
use divff_exporters::atomic::write_bytes_atomically;
use divff_exporters::{ExrImage, ExrSamples, Geometry, Manifest, read_exr, read_ply};
use glam::{DVec3, Vec3};
use html::Figure;
use image::ImageError;
use raster::{Picture, Viewpoint, rasterise};

use crate::pipeline::{PipelineError, RunFolder, log, metrics};
use crate::scene::{Frame, Scene, SceneError, Split};

/// Test frames that are shown.
const FRAMES_SHOWN: usize = 4;
/// Size of the pictures of the map, px.
const MESH_SIZE: (usize, usize) = (720, 480);
/// Height of the viewpoints above the horizon, degrees.
const ELEVATION_DEG: f64 = 48.0;

/// Why no report was written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file of the run cannot be read, or the report not be written.
    #[error(transparent)]
    File(#[from] divff_exporters::Error),
    /// A frame of the scene cannot be read.
    #[error(transparent)]
    Scene(#[from] Box<SceneError>),
    /// The truth that phrases are compared with cannot be read.
    #[error(transparent)]
    Truth(#[from] Box<crate::eval::EvalError>),
    /// A picture cannot be read or stored.
    #[error("{}: {source}", path.display())]
    Picture {
        /// The file, or what the picture shows.
        path: PathBuf,
        /// What is wrong.
        source: ImageError,
    },
}

/// Writes `report.html` of a run from what is in its folder. What is not there yet is left out.
///
/// # Errors
/// [`PipelineError`] for files that are there but cannot be read, or a report that cannot be written.
pub fn write(run: &RunFolder, scene: &Scene) -> Result<(), PipelineError> {
    let config = run.config()?;
    let page = html::Page {
        title: scene
            .root
            .file_name()
            .map_or_else(|| scene.root.display().to_string(), |name| name.to_string_lossy().into_owned()),
        scene,
        metrics: metrics::read(&run.metrics_path()).unwrap_or_default(),
        curve: chart::training_curve(&log::read(&run.log_path())?),
        views: views(run, scene)?,
        queries: features::queries(run, scene)?,
        meshes: meshes(run, scene)?,
        files: files(run),
        config: config.to_toml(),
    };
    write_bytes_atomically(&run.report_path(), page.render().as_bytes())?;
    Ok(())
}

/// Rows of pictures: truth, rendering, depth and streams of a few test frames, evenly spread.
fn views(run: &RunFolder, scene: &Scene) -> Result<Vec<Vec<Figure>>, ReportError> {
    let there = |f: &&Frame| run.views().join(format!("{}.png", f.stem)).is_file();
    let test: Vec<&Frame> = scene.frames.iter().filter(|f| f.split == Split::Test).filter(there).collect();
    let count = test.len().min(FRAMES_SHOWN);
    (0..count).map(|n| view(run, test[(2 * n + 1) * test.len() / (2 * count)])).collect()
}

fn view(run: &RunFolder, frame: &Frame) -> Result<Vec<Figure>, ReportError> {
    let picture = |path: &Path, source| ReportError::Picture { path: path.to_owned(), source };
    let truth = frame.load_rgb().map_err(Box::new)?;
    let size = (truth.width as usize, truth.height as usize);
    let address = |pixels: &[[u8; 3]], size: (usize, usize)| {
        embed::png_address(pixels, size.0, size.1).map_err(|e| picture(&frame.image_path, e))
    };
    let path = run.views().join(format!("{}.png", frame.stem));
    let ours = image::open(&path).map_err(|e| picture(&path, e))?.into_rgb8();
    let ours_size = (ours.width() as usize, ours.height() as usize);
    let ours = ours.into_raw();
    let mut row = vec![
        Figure::new(address(&truth.pixels, size)?, format!("frame {}: video", frame.stem)),
        Figure::new(address(ours.as_chunks::<3>().0, ours_size)?, "rendered, not trained on".into()),
    ];
    let path = run.views().join(format!("{}.exr", frame.stem));
    if !path.is_file() {
        return Ok(row);
    }
    let exr = read_exr(&path)?;
    let size = (exr.width, exr.height);
    if let Some(depth) = channel(&exr, "depth.Z") {
        let range = depth_range(&depth);
        let caption = range
            .map_or("no depth".into(), |[near, far]| format!("depth: {near:.2} (red) to {far:.2} (blue)"));
        row.push(Figure::new(address(&depth_picture(&depth, range), size)?, caption));
    }
    let streams = ["persistent", "dynamic", "actor"].map(|s| channel(&exr, &format!("stream_{s}.Y")));
    if let [Some(p), Some(d), Some(a)] = streams {
        let opacity: Vec<[f32; 3]> = (0..p.len()).map(|n| [p[n], d[n], a[n]]).collect();
        let pixels = stream_picture(&opacity);
        row.push(Figure::new(address(&pixels, size)?, "streams: stays, is moved, moves it".into()));
    }
    Ok(row)
}

/// Values of a channel; `None` where the picture has no such channel.
fn channel(exr: &ExrImage, name: &str) -> Option<Vec<f32>> {
    exr.channel(name).map(|samples| match samples {
        ExrSamples::F16(v) => v.iter().map(|v| v.to_f32()).collect(),
        ExrSamples::F32(v) => v.clone(),
    })
}

/// The map from two sides from above, and from where a test frame was taken.
fn meshes(run: &RunFolder, scene: &Scene) -> Result<Vec<Figure>, ReportError> {
    let Some(persistent) = read_mesh(run, "persistent")? else { return Ok(Vec::new()) };
    let frame = middle_test_frame(run, scene);
    let mut all = vec![persistent];
    let mut caption = "what stays".to_owned();
    if let Some(frame) = frame {
        for stream in ["dynamic", "actor"] {
            all.extend(read_mesh(run, &format!("{stream}_{:06}", frame.frame_index))?);
        }
        if all.len() > 1 {
            caption = format!("what stays, and what else is there at frame {}", frame.frame_index);
        }
    }
    let all: Vec<&Geometry> = all.iter().collect();
    let mut figures = Vec::new();
    if let Some((centre, radius)) = middle(all[0]) {
        let up = up_axis(scene);
        for azimuth in [35.0f64, 215.0] {
            let view = Viewpoint::around(centre, radius, direction(up, azimuth), up.as_vec3());
            figures.push(mesh_figure(&all, &view, format!("{caption}, from above"))?);
        }
        for (name, caption) in features::features_of(all[0]) {
            let view = Viewpoint::around(centre, radius, direction(up, 35.0), up.as_vec3());
            let coloured: Vec<Geometry> = all.iter().filter_map(|g| features::coloured_by(g, name)).collect();
            figures.push(mesh_figure(&coloured.iter().collect::<Vec<_>>(), &view, caption)?);
        }
    }
    if let Some(frame) = frame {
        let view = Viewpoint {
            eye: frame.c2w.translation,
            rotation: frame.c2w.matrix3.as_mat3(),
            focal: (frame.camera.fy / f64::from(frame.camera.height)) as f32,
            distance: 1.0,
        };
        figures.push(mesh_figure(&all, &view, format!("{caption}, from that frame's camera"))?);
    }
    Ok(figures)
}

fn mesh_figure(all: &[&Geometry], view: &Viewpoint, caption: String) -> Result<Figure, ReportError> {
    let Picture { width, height, rgba } = rasterise(all, view, MESH_SIZE.0, MESH_SIZE.1);
    let address = embed::png_address(&rgba, width, height)
        .map_err(|source| ReportError::Picture { path: caption.clone().into(), source })?;
    Ok(Figure::new(address, caption))
}

fn read_mesh(run: &RunFolder, name: &str) -> Result<Option<Geometry>, ReportError> {
    let path = run.map().join(format!("{name}.ply"));
    if !path.is_file() {
        return Ok(None);
    }
    Ok(Some(read_ply(&path)?).filter(|g| !g.positions.is_empty()))
}

/// A test frame near the middle of the video, one with dynamic geometry if there is one.
fn middle_test_frame<'a>(run: &RunFolder, scene: &'a Scene) -> Option<&'a Frame> {
    let mut test: Vec<&Frame> = scene.frames.iter().filter(|f| f.split == Split::Test).collect();
    let moving = |f: &&&Frame| run.map().join(format!("dynamic_{:06}.ply", f.frame_index)).is_file();
    let with_moving: Vec<&Frame> = test.iter().filter(moving).copied().collect();
    if !with_moving.is_empty() {
        test = with_moving;
    }
    test.get(test.len() / 2).copied()
}

/// The world axis that points upwards in most frames.
fn up_axis(scene: &Scene) -> DVec3 {
    let mean: DVec3 = scene.frames.iter().map(|f| -f.c2w.matrix3.y_axis).sum();
    let axis = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().max_by(|a, b| {
        let along = |v: &DVec3| mean.dot(*v).abs();
        along(a).total_cmp(&along(b))
    });
    let axis = axis.unwrap_or(DVec3::Z);
    if mean.dot(axis) < 0.0 { -axis } else { axis }
}

/// The direction at an azimuth around `up`, above the horizon.
fn direction(up: DVec3, azimuth_deg: f64) -> DVec3 {
    let east = up.any_orthonormal_vector();
    let north = up.cross(east);
    let (sin, cos) = azimuth_deg.to_radians().sin_cos();
    let (above, along) = ELEVATION_DEG.to_radians().sin_cos();
    (east * cos + north * sin) * along + up * above
}

/// Centre and radius of most of a mesh: the 1 % of the vertices that are farthest out on each axis do not count.
fn middle(geometry: &Geometry) -> Option<(DVec3, f64)> {
    let (mut low, mut high) = (Vec3::ZERO, Vec3::ZERO);
    for axis in 0..3 {
        let mut along: Vec<f32> = geometry.positions.iter().map(|p| p[axis]).collect();
        along.sort_by(f32::total_cmp);
        let last = along.len().checked_sub(1)?;
        (low[axis], high[axis]) = (along[last / 100], along[last - last / 100]);
    }
    let centre = (low + high).as_dvec3() * 0.5 + DVec3::from_array(geometry.offset);
    Some((centre, 0.5 * f64::from((high - low).length()).max(1e-9)))
}

/// A picture of geometries from above, from far enough to see most of the first; `up` is the axis that points upwards.
/// `None` where there is nothing to see.
pub fn overview(all: &[&Geometry], up: DVec3, width: usize, height: usize) -> Option<Picture> {
    let (centre, radius) = middle(all.first()?)?;
    let view = Viewpoint::around(centre, radius, direction(up, 35.0), up.as_vec3());
    Some(rasterise(all, &view, width, height))
}

/// The files of the map and what is in them; without a manifest the map is not complete.
fn files(run: &RunFolder) -> Vec<html::FileRow> {
    let Ok(manifest) = Manifest::read(&run.map()) else { return Vec::new() };
    let bytes = |path: &Path| std::fs::metadata(path).map_or(0, |m| m.len());
    let row = |f: &divff_exporters::manifest::FileEntry| html::FileRow {
        bytes: bytes(&run.map().join(&f.path)),
        path: format!("map/{}", f.path),
        vertices: f.vertices,
        triangles: f.faces,
    };
    manifest.files.iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viewpoints_are_above_the_horizon_whatever_is_up() {
        for up in [DVec3::X, -DVec3::Y, DVec3::Z] {
            for azimuth in [35.0, 215.0] {
                let d = direction(up, azimuth);
                assert!((d.length() - 1.0).abs() < 1e-12);
                assert!((d.dot(up) - ELEVATION_DEG.to_radians().sin()).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn outliers_do_not_move_the_middle() {
        let mut positions: Vec<[f32; 3]> =
            (0..1000).map(|n| [(n % 10) as f32, (n / 100) as f32, 0.0]).collect();
        positions.push([1e6, 0.0, 0.0]);
        let geometry = Geometry { positions, offset: [100.0, 0.0, 0.0], ..Geometry::default() };
        let (centre, radius) = middle(&geometry).unwrap();
        assert!((centre - DVec3::new(104.5, 4.5, 0.0)).length() < 0.1, "{centre}");
        assert!((radius - 4.5 * 2f64.sqrt()).abs() < 0.1, "{radius}");
        assert!(middle(&Geometry::default()).is_none());
    }
}
