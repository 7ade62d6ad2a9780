//! What is skipped changes nothing: maps with and without.

use divff_exporters::manifest::FileEntry;

use super::build::Builder;
use super::persistent::{HALF, opacity};
use super::tests::{HERE, config, map_of, scene, trained};
use super::*;
use crate::extract::testing::soup;
use crate::extract::{SparseGrid, march};
use crate::render::query::Query;

#[test]
fn a_density_looked_for_everywhere_gives_the_same_surface() {
    let trained = trained([true, false, false], HERE, [true, false, false]);
    let folder = tempfile::tempdir().unwrap();
    let (scene, mut config) = (scene(folder.path(), HERE), config(""));
    config.map.voxel_size = Some(0.02);
    let mut nobody = |_: Progress| {};
    let b = Builder::new(&scene, &trained, &config, &mut nobody);
    let query = Query::new(&b.cx.model, Stream::Persistent, 0.0).unwrap();
    let sparse = persistent::opacity_grid(&b.cx, &query).unwrap();
    let length = b.cx.opaque_length();
    let value = |p: &[glam::Vec3A], out: &mut [f32]| opacity(&query, p, out, length, |p| b.cx.to_unit(p));
    let full = SparseGrid::sample(&b.cx.spec, &|_, _| true, &value).unwrap();
    assert!(sparse.report().skipped_blocks > full.report().evaluated_blocks / 2, "{:?}", sparse.report());
    let [sparse, full] = [sparse, full].map(|grid| soup(&march(&grid, HALF).unwrap(), 1.0));
    assert!(sparse.len() > 1000);
    assert!(sparse == full, "{} triangles, {} from everywhere", sparse.len(), full.len());
    let map = map_of(&trained, HERE, "method = \"density\"");
    assert!(map.saved["empty_blocks"].voxels > 0 && map.saved["empty_blocks"].bytes > 0);
}

#[test]
fn an_unchanged_time_is_where_its_own_extraction_puts_it() {
    let trained = trained([true, true, false], HERE, [true, true, false]);
    let both = map_of(&trained, HERE, "times = \"frame:25,frame:75\"");
    let alone = map_of(&trained, HERE, "times = \"frame:75\"");
    let of = |map: &SemanticMap| {
        let object = map.objects.iter().find(|o| o.frame_index == Some(75)).unwrap();
        map.geometries[object.geometry].clone()
    };
    let (shared, own) = (of(&both), of(&alone));
    let farthest = |a: &Geometry, b: &Geometry| {
        let nearest = |p: &[f32; 3]| {
            let to = |q: &[f32; 3]| glam::Vec3::from_array(*p).distance(glam::Vec3::from_array(*q));
            b.positions.iter().map(to).fold(f32::MAX, f32::min)
        };
        let mut distances: Vec<f32> = a.positions.iter().map(nearest).collect();
        distances.sort_by(f32::total_cmp);
        distances[distances.len() * 95 / 100]
    };
    let voxel = both.voxel_size as f32;
    // Other frames look at it from elsewhere, and see a little more or less of its sides.
    assert!(farthest(&shared, &own).max(farthest(&own, &shared)) <= voxel, "95 % within a voxel");
    assert!(both.saved["unchanged_times"].samples > 0 && !alone.saved.contains_key("unchanged_times"));
}

#[test]
fn formats_that_are_not_asked_for_change_no_other_file() {
    let trained = trained([true, true, false], HERE, [true, true, false]);
    let map = map_of(&trained, HERE, "times = \"frame:25\"");
    let files = |formats: &[Format]| {
        let folder = tempfile::tempdir().unwrap();
        let files = write(&map, folder.path(), formats).unwrap().files;
        let size = |f: FileEntry| {
            let bytes = std::fs::metadata(folder.path().join(&f.path)).unwrap().len();
            (f, bytes)
        };
        files.into_iter().map(size).collect::<Vec<_>>()
    };
    let all = files(&Format::ALL);
    for format in Format::ALL {
        let alone = files(&[format]);
        let kind = format!(".{format}");
        let (expected, others): (Vec<_>, Vec<_>) =
            all.iter().cloned().partition(|f| f.0.path.ends_with(&kind));
        assert_eq!(alone, expected);
        // What is said to be saved are the arrays of the other files, without their headers.
        let said = Format::ALL.into_iter().filter(|f| *f != format).map(|f| f.bytes(&map)).sum::<u64>();
        let written: u64 = others.iter().map(|f| f.1).sum();
        assert!((0.6..1.1).contains(&(said as f64 / written as f64)), "{format}: {said} of {written} bytes");
    }
}
