//! Marching and fusion of hostile numbers, far from the origin, and of nothing.

use divff::extract::clean::{CleanOptions, mesh_stats, remove_small_components, smooth, vertex_normals};
use divff::extract::sample::sample_surface;
use divff::extract::tsdf::{DepthFrame, TsdfOptions, TsdfVolume};
use divff::extract::{ExtractError, GridSpec, SparseGrid, TriMesh, march, march_dense};
use divff::scene::{Camera, Pose};
use glam::{DVec3, Vec3A};

use crate::rng::Rng;
use crate::{NOT_FINITE, SIZES};

type Field<'a> = &'a (dyn Fn(Vec3A) -> f32 + Sync);

fn sampled(spec: &GridSpec, field: Field) -> Result<SparseGrid, ExtractError> {
    SparseGrid::sample(spec, &|_, _| true, &|points, out| {
        points.iter().zip(out).for_each(|(p, v)| *v = field(*p));
    })
}

fn assert_sound(mesh: &TriMesh, what: &str) {
    assert!(mesh.positions.as_flattened().iter().all(|v| v.is_finite()), "{what}");
    let stats = mesh_stats(mesh);
    assert_eq!(stats.non_manifold_edges, 0, "{what}");
    assert!(vertex_normals(mesh).as_flattened().iter().all(|v| v.is_finite()), "{what}");
}

#[test]
fn a_value_that_is_not_finite_is_named_by_its_index() {
    let dims = [7, 6, 5];
    for bad in NOT_FINITE {
        for index in [0, 1, 41, 209] {
            let mut values = vec![0.5; 210];
            values[index] = bad;
            let found = march_dense(&values, dims, 0.0);
            assert_eq!(found, Err(ExtractError::NonFinite { stage: "march_dense", index }));
        }
        let spec = GridSpec::new([0.0; 3], [10, 10, 10], 0.1);
        let at = |p: Vec3A| if (p - Vec3A::new(0.3, 0.4, 0.5)).length() < 0.01 { bad } else { 1.0 };
        let index = (5 * 11 + 4) * 11 + 3;
        assert_eq!(
            sampled(&spec, &at).unwrap_err(),
            ExtractError::NonFinite { stage: "density grid", index }
        );
        let grid = sampled(&spec, &|p| 0.4 - p.length()).unwrap();
        assert!(matches!(march(&grid, bad), Err(ExtractError::Invalid { name: "iso", .. })));
    }
}

#[test]
fn values_from_denormal_to_the_largest_make_a_sound_surface() {
    let mut rng = Rng::new(1, 0, 0);
    let dims = [13, 12, 11];
    for size in SIZES {
        for iso in [0.0, 1e-45, size] {
            let values: Vec<f32> = (0..dims.iter().product::<usize>())
                .map(|_| if rng.below(2) == 0 { size } else { -size })
                .collect();
            assert_sound(&march_dense(&values, dims, iso).unwrap(), &format!("±{size:e} at {iso:e}"));
        }
    }
    let mixed = |p: Vec3A| {
        let mut rng = Rng::new(p.x.to_bits().into(), p.y.to_bits().into(), p.z.to_bits().into());
        SIZES[rng.below(SIZES.len())] * if rng.below(2) == 0 { 1.0 } else { -1.0 }
    };
    let spec = GridSpec::new([0.0; 3], [20, 17, 9], 0.1);
    assert_sound(&march(&sampled(&spec, &mixed).unwrap(), 0.0).unwrap(), "mixed sizes");
}

#[test]
fn nothing_and_everything_have_no_surface_and_go_through_all_that_follows() {
    let spec = GridSpec::new([0.0; 3], [9, 9, 9], 0.1);
    for value in [-1.0, 1.0, 0.0] {
        let mut mesh = march(&sampled(&spec, &|_| value).unwrap(), 0.0).unwrap();
        assert!(mesh.triangles.is_empty() && mesh.positions.is_empty());
        let options = CleanOptions { min_area_fraction: 0.5, min_diagonal: 1.0 };
        assert_eq!(remove_small_components(&mut mesh, &options).unwrap().components, 0);
        smooth(&mut mesh, 3, 0.1);
        assert!(vertex_normals(&mesh).is_empty());
        assert!(!mesh_stats(&mesh).is_watertight);
        assert!(sample_surface(&mesh, 100, 1).positions.is_empty());
    }
    assert!(march_dense(&[], [0, 5, 5], 0.0).unwrap().triangles.is_empty());
    assert!(march_dense(&[1.0], [1, 1, 1], 0.0).unwrap().triangles.is_empty());
}

#[test]
fn a_surface_a_thousand_kilometres_off_is_the_one_at_the_origin() {
    let sphere = |p: Vec3A| 0.4 - p.distance(Vec3A::splat(0.5));
    let at = |origin: [f64; 3]| {
        let spec = GridSpec::new(origin, [30; 3], 1.0 / 30.0);
        march(&sampled(&spec, &sphere).unwrap(), 0.0).unwrap()
    };
    let far = at([1e6, -1e6, 1e6]);
    assert_eq!(far, at([0.0; 3]));
    assert!(mesh_stats(&far).is_watertight);
}

/// A box a million times as long as it is high, of which only the far end is looked at.
#[test]
fn a_million_cells_along_one_axis_resolve_their_far_end() {
    let cells = 1_000_000u32;
    let spec = GridSpec::new([0.0; 3], [cells, 1, 1], 1.0);
    let end = f64::from(cells) as f32 - 20.0;
    let grid = SparseGrid::sample(&spec, &|center, half| center.x + half > end, &|points, out| {
        points.iter().zip(out).for_each(|(p, v)| *v = 0.5 - p.y);
    })
    .unwrap();
    let mesh = march(&grid, 0.0).unwrap();
    assert_sound(&mesh, "the far end");
    let last = mesh.positions.iter().map(|p| p[0]).fold(0.0, f32::max);
    assert_eq!(last, cells as f32);
    let too_long = GridSpec::new([0.0; 3], [1 << 21, 1, 1], 1.0);
    assert!(matches!(sampled(&too_long, &|_| 0.0), Err(ExtractError::Invalid { name: "grid dims", .. })));
}

const CAMERA: Camera =
    Camera { width: 24, height: 18, fx: 20.0, fy: 20.0, cx: 12.0, cy: 9.0, distortion: [0.0; 4] };

/// Fuses the same depth seen from some places, all looking along +z.
fn fused(origin: f64, places: &[DVec3], depth: &[f32]) -> Result<TsdfVolume, ExtractError> {
    let frames: Vec<DepthFrame> = places
        .iter()
        .map(|p| DepthFrame {
            camera: CAMERA,
            c2w: Pose::from_translation(*p + origin),
            depth,
            confidence: None,
            rgb: None,
        })
        .collect();
    let spec = GridSpec::new([origin - 1.0, origin - 1.0, origin], [40, 40, 40], 0.05);
    TsdfVolume::fuse(&spec, &frames, &TsdfOptions { min_weight: 0.5, ..TsdfOptions::for_voxel(0.05) })
}

fn flat(depth: f32) -> Vec<f32> {
    vec![depth; (CAMERA.width * CAMERA.height) as usize]
}

#[test]
fn depth_that_is_not_finite_is_named_by_its_pixel() {
    for bad in NOT_FINITE {
        let mut depth = flat(1.0);
        depth[77] = bad;
        let error = fused(0.0, &[DVec3::ZERO], &depth).unwrap_err();
        assert_eq!(error, ExtractError::NonFinite { stage: "depth map", index: 77 });
    }
}

#[test]
fn one_view_many_equal_views_and_none_fuse_to_the_wall_that_they_see() {
    for views in [0, 1, 2, 50] {
        let mesh = fused(0.0, &vec![DVec3::ZERO; views], &flat(1.02)).unwrap().mesh().unwrap();
        assert_sound(&mesh, &format!("{views} views"));
        assert_eq!(mesh.triangles.is_empty(), views == 0);
        assert!(mesh.positions.iter().all(|p| (p[2] - 1.02).abs() < 1e-3), "{views} views");
    }
    let [near, far] = [0.0, 1e6].map(|o| fused(o, &[DVec3::ZERO], &flat(1.02)).unwrap().mesh().unwrap());
    assert_eq!(near.triangles.len(), far.triangles.len());
    for (a, b) in near.positions.iter().zip(&far.positions) {
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-4), "{a:?} {b:?}");
    }
}

#[test]
fn depth_at_the_ends_of_f32_fuses_or_says_where_it_cannot() {
    for size in SIZES.into_iter().chain(SIZES.map(|s| -s)) {
        for other in [0.0, 1.02] {
            let mut depth = flat(size);
            depth[..200].fill(other);
            match fused(0.0, &[DVec3::ZERO, DVec3::X * 0.1], &depth) {
                Ok(volume) => {
                    let values = volume.grid().blocks_of_values().flatten();
                    assert!(values.into_iter().all(|v| !v.is_infinite()), "{size:e} {other}");
                    assert_sound(&volume.mesh().unwrap(), &format!("{size:e} {other}"));
                }
                Err(error) => assert!(
                    matches!(error, ExtractError::NonFinite { stage: "fused depth", .. }),
                    "{size:e} {other}: {error}"
                ),
            }
        }
    }
}
