use std::collections::BTreeMap;

use super::*;
use glam::{DVec3, Vec3};

use crate::bvh::TriangleBvh;
use crate::scene::{Scene, Split};

fn small(seed: u64) -> SynthOptions {
    SynthOptions { frames: 16, width: 48, height: 27, seed }
}

/// Every file of a folder, by relative name.
fn contents(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                files.insert(path.strip_prefix(root).unwrap().to_path_buf(), std::fs::read(&path).unwrap());
            }
        }
    }
    files
}

fn generated(options: &SynthOptions) -> (tempfile::TempDir, SynthSummary) {
    let dir = tempfile::tempdir().unwrap();
    let summary = generate(options, dir.path()).unwrap();
    (dir, summary)
}

#[test]
fn one_seed_gives_the_same_bytes_on_one_and_two_threads() {
    let bytes = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| contents(generated(&small(3)).0.path()))
    };
    let (one, two) = (bytes(1), bytes(2));
    assert!(one.len() > 16 * 4);
    assert!(one == two);
}

#[test]
fn seeds_differ_in_layout_and_story() {
    let (a, b) = (contents(generated(&small(1)).0.path()), contents(generated(&small(2)).0.path()));
    for file in ["transforms.json", "gt/timeline.json", "gt/mesh/persistent.ply", "images/000004.png"] {
        assert_ne!(a[Path::new(file)], b[Path::new(file)], "{file}");
    }
}

#[test]
fn scene_opens_without_warnings_and_keeps_the_split_rule() {
    let (dir, _) = generated(&small(1));
    let scene = Scene::open(dir.path()).unwrap();
    assert_eq!(scene.warnings, Vec::<String>::new());
    assert_eq!(scene.frames.len(), 16);
    assert!(scene.depth_is_ground_truth);
    for frame in &scene.frames {
        assert_eq!(frame.split == Split::Test, frame.frame_index % 8 == 4);
        let m = frame.c2w.matrix3;
        assert!(
            (m.determinant() - 1.0).abs() < 1e-5
                && (m.transpose() * m).abs_diff_eq(glam::DMat3::IDENTITY, 1e-5)
        );
        assert!(scene.bounds.contains(frame.c2w.translation));
    }
    let times: Vec<f64> = scene.frames.iter().map(|f| f.time).collect();
    assert!(times[0] == 0.0 && times[15] == 1.0 && times.is_sorted());
}

/// Casts the stored meshes at the stored poses and compares with the stored depth and streams.
#[test]
fn depth_and_streams_are_those_of_the_meshes() {
    let (dir, summary) = generated(&small(5));
    let scene = Scene::open(dir.path()).unwrap();
    for &index in &summary.mesh_frames {
        let frame = scene.frames.iter().find(|f| f.frame_index == index).unwrap();
        let stem = &frame.stem;
        let names = ["persistent".to_string(), format!("dynamic_{stem}"), format!("actor_{stem}")];
        let meshes = names.map(|name| {
            let path = dir.path().join("gt/mesh").join(name).with_extension("ply");
            let g = divff_exporters::read_ply(&path).unwrap();
            let corner = |v: u32| Vec3::from(g.positions[v as usize]);
            TriangleBvh::new(g.triangles.len(), |i| g.triangles[i].map(corner))
        });
        let depth = frame.load_depth(scene.depth_unit).unwrap().unwrap();
        let streams =
            image::open(dir.path().join(format!("gt/streams/{stem}.png"))).unwrap().into_luma8().into_raw();
        let (mut off, mut seen) = (0, [0; 3]);
        for (i, (&z, &stream)) in depth.iter().zip(&streams).enumerate() {
            let uv = glam::DVec2::new((i % 48) as f64 + 0.5, (i / 48) as f64 + 0.5);
            let dir = frame.c2w.transform_vector3(frame.camera.unproject(uv)).as_vec3();
            let origin = frame.c2w.translation.as_vec3();
            let hits = meshes
                .each_ref()
                .map(|m| m.first_hit(origin, dir, 0.01, 100.0).map_or(f32::INFINITY, |h| h.t));
            let nearest = hits.iter().copied().fold(f32::INFINITY, f32::min);
            // Half a millimetre is lost in storing; a ray that grazes an edge may go either way.
            off += usize::from((nearest - z).abs() > 0.0006 || hits[usize::from(stream)] > nearest);
            seen[usize::from(stream)] += 1;
        }
        assert!(off <= 2, "{off} of {} pixels disagree in frame {stem}", depth.len());
        assert!(seen[0] > 48 * 27 / 4, "the kitchen must be visible: {seen:?}");
    }
}

/// Every frame is inside the room, sees something everywhere, and is not blocked by it.
#[test]
fn head_stays_clear_of_the_furniture() {
    for seed in 0..6 {
        let options = SynthOptions { frames: 60, width: 16, height: 16, seed };
        let kitchen = Kitchen::new(&options);
        for frame in 0..options.frames {
            let p = kitchen.picture(&options.lens(), options.time(frame));
            let near =
                p.instance.iter().zip(&p.depth).filter(|(i, _)| kitchen.stream(**i) == 0).map(|(_, z)| *z);
            let nearest = near.fold(f32::INFINITY, f32::min);
            assert!(nearest > 0.2, "seed {seed} frame {frame}: {nearest} m");
            assert!(p.instance.iter().all(|i| *i > 0), "seed {seed} frame {frame} looks out of the room");
        }
    }
}

#[test]
fn objects_rest_where_the_timeline_says_and_only_move_in_the_hand() {
    let options = SynthOptions { frames: 120, width: 32, height: 18, seed: 4 };
    let kitchen = Kitchen::new(&options);
    assert!(kitchen.story.moves.len() >= 3);
    for prop in 0..kitchen.props.len() {
        let at = |f: u32| Vec3::from(kitchen.prop_pose(prop, options.time(f)).translation);
        for frame in 1..options.frames {
            let times = [frame - 1, frame].map(|f| options.time(f) as f32);
            let carried = kitchen
                .story
                .moves
                .iter()
                .any(|m| m.prop == prop && m.grab < times[1] && times[0] < m.release);
            let moved = at(frame).distance(at(frame - 1));
            assert!(carried || moved == 0.0, "prop {prop} moved {moved} m by itself in frame {frame}");
        }
    }
    for m in &kitchen.story.moves {
        let place = |t: f32| Vec3::from(kitchen.prop_pose(m.prop, f64::from(t)).translation);
        let (from, to) = (place(m.grab), place(m.release));
        assert!(from.distance(to) > 0.5);
        for rest in [from, to] {
            assert!(kitchen.room.places.iter().any(|p| p.at.distance(rest) < 1e-5), "{rest} is no place");
        }
    }
}

/// What rests stands on something: straight down from just above its base there is a surface within 1 cm.
#[test]
fn resting_objects_stand_on_furniture() {
    for seed in 0..8 {
        let kitchen = Kitchen::new(&SynthOptions { seed, ..SynthOptions::default() });
        let mesh = &kitchen.still.mesh;
        let bvh = TriangleBvh::new(mesh.triangles.len(), |i| mesh.corners(i));
        for place in &kitchen.room.places {
            let hit = bvh.first_hit(place.at + Vec3::Z * 0.02, -Vec3::Z, 0.0, 1.0);
            let gap = hit.map_or(1.0, |h| h.t - 0.02);
            assert!((-0.001..0.01).contains(&gap), "seed {seed}, {:?}: {gap} m", place.at);
        }
    }
}

#[test]
fn instances_are_described_and_visible_objects_are_where_they_should_be() {
    let (dir, summary) = generated(&SynthOptions { frames: 24, width: 96, height: 54, seed: 2 });
    let read = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(dir.path().join("gt").join(name)).unwrap()).unwrap()
    };
    let (objects, timeline) = (read("objects.json"), read("timeline.json"));
    assert_eq!(objects.as_object().unwrap().len(), summary.instances);
    assert!(objects.as_object().unwrap().values().filter(|o| o["stream"] == "dynamic").count() >= 3);
    let scene = Scene::open(dir.path()).unwrap();
    let mut checked = 0;
    for (f, frame) in scene.frames.iter().enumerate() {
        let path = dir.path().join(format!("gt/instances/{}.png", frame.stem));
        let instances = image::open(path).unwrap().into_luma16().into_raw();
        let depth = frame.load_depth(scene.depth_unit).unwrap().unwrap();
        for (i, (instance, z)) in instances.iter().zip(depth).enumerate() {
            assert!(objects.get(instance.to_string()).is_some(), "instance {instance} is not described");
            let Some(poses) = timeline["object_to_world"].get(instance.to_string()) else { continue };
            let uv = glam::DVec2::new((i % 96) as f64 + 0.5, (i / 96) as f64 + 0.5);
            let point = frame.c2w.transform_point3(frame.camera.unproject(uv) * f64::from(z));
            let at = DVec3::from([3, 7, 11].map(|k| poses[f][k].as_f64().unwrap()));
            // No prop reaches further than the pan's handle from its origin.
            assert!(point.distance(at) < 0.40, "instance {instance} in frame {f}: {point} is not at {at}");
            checked += 1;
        }
    }
    assert!(checked > 500, "dynamic objects must be seen: {checked} pixels");
}

#[test]
fn used_folders_and_odd_options_are_refused() {
    let (dir, _) = generated(&small(1));
    assert!(matches!(generate(&small(1), dir.path()), Err(SynthError::NotEmpty { .. })));
    let none = SynthOptions { frames: 0, ..small(1) };
    assert!(matches!(generate(&none, dir.path()), Err(SynthError::Option { name: "frames", .. })));
    let flat = SynthOptions { height: 1, ..small(1) };
    assert!(generate(&flat, dir.path()).unwrap_err().to_string().contains("height is 1"));
}
