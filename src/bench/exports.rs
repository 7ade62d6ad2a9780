//! File formats and their storage: what is lost, how large files are, and how long writing and reading take.

use std::path::{Path, PathBuf};
use std::time::Instant;

use divff_exporters::{
    AttributeValues, Error, ExrChannel, ExrCompression, ExrImage, ExrSamples, Geometry, GlbOptions,
    NpzCompression, PlyOptions, UpAxis, read_exr, read_glb, read_npz, read_ply, write_exr_with, write_glb,
    write_npz, write_ply,
};
use half::f16;

use super::runs::base;
use super::{Bench, Better, Cell, Kind, Plot, Row, Sweep, peers};
use crate::error::FileError;
use crate::map;
use crate::pipeline::{Event, PipelineError, Stage};
use crate::render::forward::Model;
use crate::render::image::render;
use crate::scene::Split;
use crate::semantics::bake::annotate;
use crate::train::Trained;

/// What is written and what comes back, as columns.
type Columns = Vec<Vec<f32>>;

/// What is done with a file.
type Step<'a, T> = Box<dyn Fn(&Path) -> Result<T, Error> + 'a>;

/// A way to write something, and its way back.
struct Way<'a> {
    name: &'static str,
    file: &'static str,
    write: Step<'a, ()>,
    read: Step<'a, Columns>,
    truth: Columns,
    /// Script of the program that is timed at writing the same.
    peer: Option<&'static str>,
}

/// Error, bytes and seconds of every way to store the mesh of what stays, the points and a view.
///
/// A sweep for each of them: only files of the same content can take each other's place.
pub(super) fn export(bench: &mut Bench) -> Result<Option<Vec<Sweep>>, PipelineError> {
    let Some(run) = base(bench)? else { return Ok(None) };
    bench.announce(Kind::Export, "map and view");
    bench.observer.event(&Event::Stage(Stage::Mapping));
    let observer = &mut *bench.observer;
    let mut map =
        map::build(bench.scene, &run.trained, bench.config, &mut |p| observer.event(&Event::Mapping(p)))?;
    annotate(&mut map, bench.scene, &run.trained, &run.fields, &bench.config.semantics)?;
    if bench.observer.stop() {
        return Ok(None);
    }
    let folder = bench.out.join("exports");
    std::fs::create_dir_all(&folder).map_err(FileError::at(&folder))?;
    let view = rendered(bench, &run.trained);
    bench.observer.event(&Event::Stage(Stage::Exporting));
    let mesh = map.geometries.first();
    let cloud = Some(&map.points).filter(|p| !p.positions.is_empty());
    let all = [
        ("export_points", "Files of points: what is lost, size and seconds", cloud.map(clouds)),
        (
            "export_mesh",
            "Files of a mesh: what is lost, size and seconds",
            mesh.map(|m| meshes(m, map.up_axis)),
        ),
        ("export_view", "Files of a view: what is lost, size and seconds", view.as_ref().map(views)),
    ];
    let mut sweeps = Vec::new();
    for (name, title, ways) in all {
        let measured: Result<Vec<Row>, _> = ways.iter().flatten().map(|way| way.measure(&folder)).collect();
        let plots = vec![
            Plot { cost: "mb", quality: "error", better: Better::Lower },
            Plot { cost: "write_ms", quality: "mb", better: Better::Lower },
        ];
        sweeps.push(Sweep { name, title, rows: measured?, plots, notes: vec![NOTE.to_owned()] });
    }
    Ok(Some(sweeps))
}

/// How to read the columns.
const NOTE: &str = "error: the largest difference of a value that is read back, as a share of its column's range; \
    peer_ratio: how many times as long Open3D, plyfile (points) or trimesh (mesh) take to write what they keep of it";

impl Way<'_> {
    fn measure(&self, folder: &Path) -> Result<Row, PipelineError> {
        let path = folder.join(self.file);
        let write = least(|| (self.write)(&path))?;
        let read = least(|| (self.read)(&path).map(drop))?;
        let error = largest_difference(&self.truth, &(self.read)(&path)?);
        let bytes = std::fs::metadata(&path).map_err(FileError::at(&path))?.len();
        let peer = match self.peer {
            Some(script) => peers::ratio(script, &[&path, &again(&path)], write),
            None => Cell::Missing("no peer".to_owned()),
        };
        Ok(Row::new(self.name, Vec::new())
            .with("mb", bytes as f64 / 1e6)
            .with("write_ms", 1e3 * write)
            .with("read_ms", 1e3 * read)
            .with("error", error)
            .with("peer_ratio", peer))
    }
}

/// Where a peer writes: `points.peer.ply` beside `points.ply`.
fn again(path: &Path) -> PathBuf {
    let kind = path.extension().map(|e| e.to_string_lossy().into_owned()).unwrap_or_default();
    path.with_extension(format!("peer.{kind}"))
}

/// The least seconds of three calls.
fn least(job: impl Fn() -> Result<(), Error>) -> Result<f64, Error> {
    let mut least = f64::INFINITY;
    for _ in 0..3 {
        let start = Instant::now();
        job()?;
        least = least.min(start.elapsed().as_secs_f64());
    }
    Ok(least)
}

fn clouds(points: &Geometry) -> Vec<Way<'_>> {
    let truth = || columns(points, true);
    let npz = |name, file, compression| Way {
        name,
        file,
        write: Box::new(move |path: &Path| write_npz(path, points, compression)),
        read: Box::new(|path: &Path| Ok(columns(&read_npz(path)?, true))),
        truth: truth(),
        peer: None,
    };
    let ply = |peer, name, file| Way {
        name,
        file,
        write: Box::new(|path| write_ply(path, points, &PlyOptions::default())),
        read: Box::new(|path| Ok(columns(&read_ply(path)?, true))),
        truth: truth(),
        peer: Some(peer),
    };
    vec![
        ply(peers::OPEN3D_PLY, "PLY beside Open3D", "points.ply"),
        ply(peers::PLYFILE_PLY, "PLY beside plyfile", "points2.ply"),
        npz("NPZ stored", "stored.npz", NpzCompression::Stored),
        npz("NPZ deflated", "deflated.npz", NpzCompression::Deflated),
        npz("NPZ with f16 features", "half.npz", NpzCompression::HalfFeatures),
    ]
}

fn meshes(mesh: &Geometry, up_axis: UpAxis) -> Vec<Way<'_>> {
    let glb = |name, file, float_colors| Way {
        name,
        file,
        write: Box::new(move |path: &Path| {
            write_glb(path, mesh, &GlbOptions { up_axis, float_colors, ..GlbOptions::default() })
        }),
        read: Box::new(|path| {
            Ok(read_glb(path)?.geometries.first().map_or(Vec::new(), |g| columns(g, false)))
        }),
        truth: columns(mesh, false),
        peer: Some(peers::TRIMESH_MESH),
    };
    vec![
        Way {
            name: "PLY",
            file: "mesh.ply",
            write: Box::new(|path| write_ply(path, mesh, &PlyOptions::default())),
            read: Box::new(|path| Ok(columns(&read_ply(path)?, true))),
            truth: columns(mesh, true),
            peer: Some(peers::TRIMESH_MESH),
        },
        glb("GLB with u16 colours", "u16.glb", false),
        glb("GLB with f32 colours", "f32.glb", true),
    ]
}

fn views(view: &Columns) -> Vec<Way<'_>> {
    let way = |name, file, half, compression| Way {
        name,
        file,
        write: Box::new(move |path: &Path| write_exr_with(path, exr(view, half), compression)),
        read: Box::new(|path| Ok(read_exr(path)?.channels.into_iter().map(|c| samples(c.samples)).collect())),
        truth: view[..view.len() - 1].to_vec(),
        peer: None,
    };
    vec![
        way("EXR of f16 as ZIP", "f16.zip.exr", true, ExrCompression::Zip),
        way("EXR of f16 as it is", "f16.none.exr", true, ExrCompression::None),
        way("EXR of f16 as PIZ", "f16.piz.exr", true, ExrCompression::Piz),
        way("EXR of f32 as ZIP", "f32.zip.exr", false, ExrCompression::Zip),
        way("EXR of f32 as it is", "f32.none.exr", false, ExrCompression::None),
        way("EXR of f32 as PIZ", "f32.piz.exr", false, ExrCompression::Piz),
        way("EXR of f32 as PXR24", "f32.pxr24.exr", false, ExrCompression::Pxr24),
    ]
}

/// Channels `a`, `b`, … of columns; the last column holds the width alone.
fn exr(view: &Columns, half: bool) -> ExrImage {
    let (size, channels) = view.split_last().map_or((1, &[][..]), |(size, c)| (size[0] as usize, c));
    let channel = |(n, values): (usize, &Vec<f32>)| ExrChannel {
        name: char::from(b'a' + n as u8).to_string(),
        samples: match half {
            true => ExrSamples::F16(values.iter().map(|v| f16::from_f32(*v)).collect()),
            false => ExrSamples::F32(values.clone()),
        },
    };
    let height = channels.first().map_or(0, |c| c.len() / size.max(1));
    ExrImage { width: size, height, channels: channels.iter().enumerate().map(channel).collect() }
}

fn samples(samples: ExrSamples) -> Vec<f32> {
    match samples {
        ExrSamples::F16(values) => values.into_iter().map(f16::to_f32).collect(),
        ExrSamples::F32(values) => values,
    }
}

/// Colour, depth and opacities of the first test frame (else of the first frame), and last the width.
fn rendered(bench: &Bench, trained: &Trained) -> Option<Columns> {
    let frames = &bench.scene.frames;
    let frame = frames.iter().find(|f| f.split == Split::Test).or(frames.first())?;
    let model = Model::new(&trained.field, &trained.grids, [true; 3]);
    let image = render(&model, frame, &bench.config.train.render_sampling(), 1);
    let mut view: Columns = (0..3).map(|c| image.rgb.iter().map(|p| p[c]).collect()).collect();
    view.push(image.depth.clone());
    view.extend((0..3).map(|s| image.opacity.iter().map(|o| o[s]).collect::<Vec<f32>>()));
    view.push(vec![image.width as f32]);
    Some(view)
}

/// Everything that a geometry says of its vertices, column by column.
fn columns(geometry: &Geometry, with_features: bool) -> Columns {
    let vectors = |v: &[[f32; 3]]| (0..3).map(|a| v.iter().map(|p| p[a]).collect()).collect::<Columns>();
    let mut found = vectors(&geometry.positions);
    found.extend(vectors(&geometry.normals));
    found.extend((0..3).map(|c| geometry.colors.iter().map(|p| f32::from(p[c])).collect::<Vec<f32>>()));
    // GLB keeps them in no order.
    let mut attributes: Vec<_> = geometry.attributes.iter().collect();
    attributes.sort_by_key(|a| &a.name);
    for attribute in attributes {
        found.push(match &attribute.values {
            AttributeValues::F32(v) => v.clone(),
            AttributeValues::I32(v) => v.iter().map(|x| *x as f32).collect(),
            AttributeValues::U8(v) => v.iter().map(|x| f32::from(*x)).collect(),
        });
    }
    if with_features {
        found.extend(geometry.features.iter().map(|f| f.values.clone()));
    }
    found
}

/// The largest difference, as a share of its column's range; infinite where a column is missing or cut.
fn largest_difference(truth: &Columns, found: &Columns) -> f64 {
    if truth.len() != found.len() || truth.iter().zip(found).any(|(t, f)| t.len() != f.len()) {
        return f64::INFINITY;
    }
    let share = |(truth, found): (&Vec<f32>, &Vec<f32>)| {
        let (low, high) = truth.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        let range = f64::from(high - low);
        let most = truth.iter().zip(found).map(|(t, f)| f64::from((t - f).abs())).fold(0.0, f64::max);
        if range > 0.0 { most / range } else { most }
    };
    truth.iter().zip(found).map(share).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_shares_of_a_columns_range() {
        let truth = vec![vec![0.0, 10.0], vec![1.0, 1.0]];
        assert_eq!(largest_difference(&truth, &truth), 0.0);
        assert_eq!(largest_difference(&truth, &vec![vec![0.0, 9.0], vec![1.0, 1.0]]), 0.1);
        assert_eq!(largest_difference(&truth, &vec![vec![0.0, 9.0]]), f64::INFINITY);
        assert_eq!(largest_difference(&truth, &vec![vec![0.0], vec![1.0, 1.0]]), f64::INFINITY);
    }

    #[test]
    fn a_view_survives_its_file() {
        let dir = tempfile::tempdir().unwrap();
        let view: Columns = vec![vec![0.25, 0.1, 1.0, 3.0], vec![7.0, 0.0, 0.0, 1e-3], vec![2.0]];
        let errors: Vec<f64> = views(&view)
            .iter()
            .map(|w| {
                w.measure(dir.path())
                    .unwrap()
                    .values
                    .iter()
                    .find(|v| v.0 == "error")
                    .unwrap()
                    .1
                    .number()
                    .unwrap()
            })
            .collect();
        let (halves, &[zip, none, piz, pxr24]) = errors.split_at(3) else { panic!("{errors:?}") };
        assert!(halves.iter().all(|e| *e == halves[0] && *e > 0.0 && *e < 1e-3), "f16 rounds: {errors:?}");
        assert_eq!([zip, none, piz], [0.0; 3]);
        assert!(pxr24 < 1e-4, "24 bits are left: {errors:?}");
    }
}
