//! Maps of small fields: what is extracted, what is shared, and what the files say.

use std::path::Path;

use divff_exporters::manifest::MANIFEST_NAME;
use divff_exporters::{AttributeValues, Manifest, UpAxis, read_ply};
use glam::{DVec3, Vec3};

use super::*;
use crate::config::Config;
use crate::field::Field;
use crate::render::forward::Grids;
use crate::render::testing::{field_at, frame_at};
use crate::scene::{Aabb, Scene};
use crate::train::Trained;
use crate::train::checkpoint::TrainingState;

/// Density grid cells along the box.
const CELLS: f32 = 16.0;
pub(super) const HERE: DVec3 = DVec3::new(10.0, 20.0, 30.0);

/// A field whose density grids leave only a slab of the persistent stream (and of the dynamic one, on request), which
/// the networks fill with dense fog: a wall across the cameras' view.
pub(super) fn trained(streams: [bool; 3], origin: DVec3, slab: [bool; 3]) -> Trained {
    let mut field = field_at(streams, origin);
    for net in field.nets.iter_mut().flatten() {
        net.density_bias = 5.0;
    }
    still(&mut field);
    let mut grids = Grids::new(&field, CELLS);
    grids.threshold = [1.0; 3];
    for (s, grid) in grids.streams.iter_mut().enumerate() {
        for n in 0..grid.sigma.len() {
            let p = grid.point(n, Vec3::splat(0.5), 0.5).0;
            let inside = if s == 1 { (0.4..0.6).contains(&p.y) && p.x < 0.5 } else { p.y > 0.7 };
            grid.sigma[n] = if slab[s] && inside { 100.0 } else { 0.0 };
        }
    }
    Trained { field, grids, progress: TrainingState::default() }
}

/// The dynamic stream does not depend on time.
fn still(field: &mut Field) {
    let codes = field.layout.streams[1].code.clone();
    field.weights[codes].fill(0.0);
}

pub(super) fn scene(folder: &Path, origin: DVec3) -> Scene {
    let frames = [0.0, 0.25, 0.5, 0.75, 1.0].map(|t| {
        let mut frame = frame_at(t, origin);
        frame.image_path = folder.join("grey.png");
        frame
    });
    let (w, h) = (frames[0].camera.width, frames[0].camera.height);
    image::RgbImage::from_pixel(w, h, image::Rgb([90, 120, 150])).save(folder.join("grey.png")).unwrap();
    Scene {
        root: folder.to_owned(),
        frames: frames.to_vec(),
        bounds: Aabb { min: origin, max: origin + 2.0 },
        depth_unit: 1.0,
        depth_is_ground_truth: false,
        points: Vec::new(),
        warnings: Vec::new(),
    }
}

pub(super) fn config(overlay: &str) -> Config {
    let base = "[map]\nvoxel_size = 0.08\npoints = 500\nmin_component_voxels = 3.0\n";
    Config::default().overlaid(&format!("{base}{overlay}"), "test").unwrap()
}

pub(super) fn map_of(trained: &Trained, origin: DVec3, overlay: &str) -> SemanticMap {
    let folder = tempfile::tempdir().unwrap();
    build(&scene(folder.path(), origin), trained, &config(overlay), &mut |_| {}).unwrap()
}

/// World y of all vertices, relative to the box.
fn depths(map: &SemanticMap, geometry: usize, origin: DVec3) -> Vec<f64> {
    let g = &map.geometries[geometry];
    g.positions.iter().map(|p| f64::from(p[1]) + g.offset[1] - origin.y).collect()
}

#[test]
fn both_methods_find_the_wall_where_it_is() {
    let trained = trained([true, false, false], HERE, [true, false, false]);
    for method in ["tsdf", "density"] {
        let map = map_of(&trained, HERE, &format!("method = \"{method}\""));
        assert_eq!(map.objects.len(), 1, "{method}: {:?}", map.skipped);
        let ys = depths(&map, 0, HERE);
        let mean = ys.iter().sum::<f64>() / ys.len() as f64;
        // The slab begins at 0.6875 units = 1.375; half of the light is stopped within a voxel or so of that.
        assert!((1.3..1.55).contains(&mean), "{method}: {mean}");
        let g = &map.geometries[0];
        assert!(g.normals.iter().filter(|n| n[1] < -0.7).count() > g.normals.len() / 2, "{method}");
        assert!(g.colors.iter().filter(|c| **c == [90, 120, 150]).count() > g.colors.len() / 2, "{method}");
        let names: Vec<&str> = g.attributes.iter().map(|a| a.name.as_str()).collect();
        assert_eq!(names, ["confidence", "observations", "stream"]);
        assert_eq!(map.points.positions.len(), 500);
        assert!((map.up_axis, map.up_is_known) == (UpAxis::Z, true));
    }
}

#[test]
fn unchanged_times_share_one_geometry_and_say_so() {
    let trained = trained([true, true, false], HERE, [true, true, false]);
    let map = map_of(&trained, HERE, "times = \"frame:25,frame:75,1.0\"");
    let dynamic: Vec<&MapObject> = map.objects.iter().filter(|o| o.stream == Stream::Dynamic).collect();
    assert_eq!(dynamic.iter().map(|o| o.frame_index).collect::<Vec<_>>(), [Some(25), Some(75), Some(100)]);
    assert!(dynamic.iter().all(|o| o.geometry == dynamic[0].geometry), "{:?}", map.objects);
    assert_eq!(map.skipped.iter().filter(|s| s.why.contains("shared")).count(), 2);
    let interval = dynamic[1].interval.unwrap();
    assert_eq!((interval.time_start, interval.time_end), (0.5, 0.875));
    let ys = depths(&map, dynamic[0].geometry, HERE);
    assert!(ys.iter().all(|y| (0.6..1.4).contains(y)), "it stands in front of the wall");
    let streams = &map.points.attributes[2].values;
    let AttributeValues::U8(streams) = streams else { panic!("{streams:?}") };
    assert!(streams.contains(&0) && streams.contains(&1));
}

#[test]
fn empty_streams_have_no_files_and_are_explained() {
    let trained = trained([true, true, true], HERE, [true, false, false]);
    let map = map_of(&trained, HERE, "times = \"frame:50\"");
    assert_eq!(map.objects.iter().map(MapObject::name).collect::<Vec<_>>(), ["persistent"]);
    let folder = tempfile::tempdir().unwrap();
    let manifest = write(&map, folder.path(), &Format::ALL).unwrap();
    let files: Vec<&str> = manifest.files.iter().map(|f| f.path.as_str()).collect();
    assert_eq!(files, ["persistent.ply", "points.ply", "persistent.glb", "scene.glb", "points.npz"]);
    let skipped: Vec<&str> = manifest.skipped.iter().map(|s| s.what.as_str()).collect();
    assert_eq!(skipped, ["dynamic_000050", "actor_000050"]);
    let nothing = map_of(&self::trained([true; 3], HERE, [false; 3]), HERE, "times = \"frame:50\"");
    assert!(nothing.objects.is_empty() && nothing.points.positions.is_empty());
    let folder = tempfile::tempdir().unwrap();
    assert!(write(&nothing, folder.path(), &Format::ALL).unwrap().files.is_empty());
}

#[test]
fn files_are_the_same_bytes_for_any_number_of_threads() {
    let trained = trained([true; 3], HERE, [true; 3]);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let map = pool.install(|| map_of(&trained, HERE, "times = \"frame:25\""));
        let map = SemanticMap { source_id: "scene".into(), ..map };
        pool.install(|| write(&map, folder.path(), &Format::ALL)).unwrap()
    };
    let (one, four) = (run(1), run(4));
    assert!(one.files.len() >= 7, "{:?} {:?}", one.files, one.skipped);
    // The manifest holds the hash of every file.
    assert_eq!(one, four);
}

#[test]
fn a_scene_far_from_the_origin_keeps_its_shape() {
    let far = DVec3::new(4e6, -2e6, 1e6);
    let wall = |origin| map_of(&trained([true, false, false], origin, [true, false, false]), origin, "");
    let (near, away) = (wall(DVec3::ZERO), wall(far));
    assert_eq!(near.geometries[0].offset, [0.0; 3]);
    assert_ne!(away.geometries[0].offset, [0.0; 3]);
    let (a, b) = (depths(&near, 0, DVec3::ZERO), depths(&away, 0, far));
    assert_eq!(a.len(), b.len());
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-4));
}

#[test]
fn an_export_replaces_an_earlier_one() {
    let trained = trained([true, true, false], HERE, [true, true, false]);
    let folder = tempfile::tempdir().unwrap();
    let export = |times: &str| {
        let map = map_of(&trained, HERE, &format!("times = \"{times}\""));
        write(&map, folder.path(), &[Format::Ply]).unwrap()
    };
    export("frame:25");
    std::fs::write(folder.path().join("notes.txt"), b"mine").unwrap();
    let manifest = export("frame:75");
    assert!(!folder.path().join("dynamic_000025.ply").exists(), "a file of the earlier export");
    assert!(folder.path().join("notes.txt").exists(), "a file that is not ours");
    assert_eq!(Manifest::read(folder.path()).unwrap(), manifest);
    manifest.verify(folder.path()).unwrap();
    let mesh = read_ply(&folder.path().join("dynamic_000075.ply")).unwrap();
    assert!(
        mesh.attributes
            .iter()
            .any(|a| a.name == "stream" && a.values == AttributeValues::U8(vec![1; mesh.positions.len()]))
    );
    assert!(folder.path().join(MANIFEST_NAME).exists());
}

#[test]
fn frames_that_do_not_exist_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let trained = trained([true, false, false], HERE, [true, false, false]);
    let config = config("times = \"frame:3\"");
    let error = build(&scene(folder.path(), HERE), &trained, &config, &mut |_| {}).unwrap_err();
    assert_eq!(error.to_string(), "there is no frame with index 3; the scene has frames 0 to 100");
}
