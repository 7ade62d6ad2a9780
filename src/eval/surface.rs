//! Accuracy, completeness and F-score of one surface against another.
//!
//! Both surfaces are sampled uniformly by area; distances go from each sample to the other *surface*, not
//! to its samples. Only truth that a view saw counts, and only our surface where a view could have seen it:
//! what floats in front of the truth counts against us, what lies well behind it was never observed by
//! anyone.

use divff_exporters::Geometry;
use glam::{DAffine3, DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::bvh::TriangleBvh;
use crate::scene::{Camera, Pose};

/// Samples of each surface.
pub const SAMPLES: usize = 200_000;
/// A camera sees nothing nearer than this, world units.
const NEAREST: f64 = 0.05;
/// Queries per task: enough to hide the hand-over, small enough to share evenly.
const CHUNK: usize = 1024;

/// How two surfaces compare. Lengths are in world units (metres in the names, as the scenes are).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SurfaceMetrics {
    /// Mean distance from our samples to the truth.
    pub accuracy_m: f64,
    /// Mean distance from the truth's samples to our surface.
    pub completeness_m: f64,
    /// Mean of the two.
    pub chamfer_m: f64,
    /// Harmonic mean of the fractions of samples nearer than 2 cm.
    pub fscore_2cm: f64,
    /// Harmonic mean of the fractions of samples nearer than 5 cm.
    pub fscore_5cm: f64,
    /// Number of times averaged over, for streams that change.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub times: Option<usize>,
}

impl SurfaceMetrics {
    /// Average over times; `None` of none.
    pub fn mean(all: &[Self]) -> Option<Self> {
        let average = |f: fn(&Self) -> f64| super::images::mean(&all.iter().map(f).collect::<Vec<_>>());
        Some(Self {
            accuracy_m: average(|m| m.accuracy_m)?,
            completeness_m: average(|m| m.completeness_m)?,
            chamfer_m: average(|m| m.chamfer_m)?,
            fscore_2cm: average(|m| m.fscore_2cm)?,
            fscore_5cm: average(|m| m.fscore_5cm)?,
            times: Some(all.len()),
        })
    }
}

/// Why two surfaces cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SurfaceError {
    /// No triangle with an area and no point.
    #[error("the {0} surface is empty")]
    Empty(&'static str),
    /// The views saw nothing of one of them.
    #[error(
        "nothing to compare: the views saw {predicted} samples of our surface and {truth} of the true one"
    )]
    Unseen {
        /// Samples of our surface that a view could see.
        predicted: usize,
        /// Samples of the truth that a view saw.
        truth: usize,
    },
    /// A triangle names a vertex that does not exist.
    #[error(
        "triangle {triangle} of the {which} surface names vertex {vertex} of {vertices}; write the mesh again"
    )]
    Index {
        /// Which surface.
        which: &'static str,
        /// Index of the triangle.
        triangle: usize,
        /// The vertex that it names.
        vertex: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A vertex holds NaN or infinity.
    #[error("vertex {vertex} of the {which} surface is not finite; write the mesh again")]
    NonFinite {
        /// Which surface.
        which: &'static str,
        /// Index of the vertex.
        vertex: usize,
    },
}

impl SurfaceError {
    /// Whether there is simply nothing to measure, as opposed to a damaged mesh.
    pub fn is_absence(&self) -> bool {
        matches!(self, Self::Empty(_) | Self::Unseen { .. })
    }
}

/// A camera with the depth that it measured: it tells which points were seen.
#[derive(Clone, Debug)]
pub struct DepthView {
    camera: Camera,
    w2c: DAffine3,
    /// Row-major `[height * width]`, along the camera's z axis, 0 = unknown.
    depth: Vec<f32>,
}

impl DepthView {
    /// `depth` is row-major `[camera.height * camera.width]`, world units along z, 0 = unknown.
    ///
    /// # Panics
    /// When `depth` is not as large as the camera's image.
    pub fn new(camera: Camera, c2w: Pose, depth: Vec<f32>) -> Self {
        assert_eq!(depth.len(), camera.width as usize * camera.height as usize, "depth must fit the camera");
        Self { camera, w2c: c2w.inverse(), depth }
    }

    /// Depth of a world point along the camera's axis and the measured depth at its pixel, if there is one.
    fn depths(&self, world: DVec3) -> Option<(f64, f64)> {
        let p = self.w2c.transform_point3(world);
        if p.z <= NEAREST {
            return None;
        }
        let uv = self.camera.project(p)?;
        let (u, v) = (uv.x.floor(), uv.y.floor());
        let inside =
            u >= 0.0 && v >= 0.0 && u < f64::from(self.camera.width) && v < f64::from(self.camera.height);
        if !inside {
            return None;
        }
        let seen = f64::from(self.depth[v as usize * self.camera.width as usize + u as usize]);
        (seen > 0.0).then_some((p.z, seen))
    }

    /// Whether a point of the true surface is what this view saw: within 2 cm + 1 % of the measured depth.
    fn saw(&self, world: DVec3) -> bool {
        self.depths(world).is_some_and(|(z, seen)| (z - seen).abs() < 0.02 + 0.01 * seen)
    }

    /// Whether a point would have been noticed: in front of, on, or at most 10 cm behind what was seen.
    fn notices(&self, world: DVec3) -> bool {
        self.depths(world).is_some_and(|(z, seen)| z < seen + 0.10)
    }
}

/// A surface ready to be sampled and to answer distance queries.
pub struct SurfaceIndex {
    bvh: TriangleBvh,
    triangles: Vec<[Vec3; 3]>,
    /// Running sum of the areas, for sampling; empty for a point cloud.
    cumulative_area: Vec<f64>,
}

impl SurfaceIndex {
    /// Indexes a mesh, or a point cloud when `triangles` is empty. `which` names the surface in errors.
    ///
    /// # Errors
    /// [`SurfaceError`] for an empty surface, indices out of range, and non-finite vertices.
    pub fn new(
        which: &'static str,
        positions: &[[f32; 3]],
        triangles: &[[u32; 3]],
    ) -> Result<Self, SurfaceError> {
        if let Some(vertex) = positions.iter().position(|p| p.iter().any(|x| !x.is_finite())) {
            return Err(SurfaceError::NonFinite { which, vertex });
        }
        for (triangle, corners) in triangles.iter().enumerate() {
            if let Some(&vertex) = corners.iter().find(|v| **v as usize >= positions.len()) {
                return Err(SurfaceError::Index { which, triangle, vertex, vertices: positions.len() });
            }
        }
        let corners: Vec<[Vec3; 3]> = if triangles.is_empty() {
            positions.iter().map(|p| [Vec3::from(*p); 3]).collect()
        } else {
            triangles.iter().map(|t| t.map(|v| Vec3::from(positions[v as usize]))).collect()
        };
        let mut total = 0.0;
        let mut cumulative_area = Vec::new();
        if !triangles.is_empty() {
            cumulative_area.extend(corners.iter().map(|t| {
                total += area(t);
                total
            }));
        }
        if corners.is_empty() || (!triangles.is_empty() && total <= 0.0) {
            return Err(SurfaceError::Empty(which));
        }
        Ok(Self { bvh: TriangleBvh::new(corners.len(), |i| corners[i]), triangles: corners, cumulative_area })
    }

    /// `n` samples, uniform by area and the same for the same seed; all points of a point cloud.
    ///
    /// Stratified: sample *i* falls in the *i*-th of `n` equal shares of the area, which keeps neighbours
    /// together in memory and the variance low.
    pub fn samples(&self, n: usize, seed: u64) -> Vec<Vec3> {
        let Some(&total) = self.cumulative_area.last() else {
            return self.triangles.iter().map(|t| t[0]).collect();
        };
        (0..n)
            .into_par_iter()
            .map(|i| {
                let [r, u, v] = [0, 1, 2].map(|k| uniform(seed, 3 * i as u64 + k));
                let target = (i as f64 + r) / n as f64 * total;
                let t = self.cumulative_area.partition_point(|a| *a <= target).min(self.triangles.len() - 1);
                let [a, b, c] = self.triangles[t].map(|p| p.as_dvec3());
                // Folding the square onto the triangle keeps the density uniform.
                let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
                (a + (b - a) * u + (c - a) * v).as_vec3()
            })
            .collect()
    }

    /// Distance from each query to the surface, `[queries]`.
    pub fn distances(&self, queries: &[Vec3]) -> Vec<f32> {
        let one = |q: &Vec3| self.bvh.nearest(*q).map_or(f32::INFINITY, |n| n.distance);
        queries.par_iter().with_min_len(CHUNK).map(one).collect()
    }
}

/// Measures our surface against the true one, as seen by `views`.
///
/// # Errors
/// [`SurfaceError`]: one of them is empty, unseen, or damaged.
pub fn compare(
    views: &[DepthView],
    predicted: &Geometry,
    truth: &Geometry,
) -> Result<SurfaceMetrics, SurfaceError> {
    let origin = DVec3::from(truth.offset);
    let truth = SurfaceIndex::new("true", &truth.positions, &truth.triangles)?;
    let shift = DVec3::from(predicted.offset) - origin;
    let positions: Vec<[f32; 3]> = if shift == DVec3::ZERO {
        predicted.positions.clone()
    } else {
        let moved = |p: &[f32; 3]| (Vec3::from(*p).as_dvec3() + shift).as_vec3().to_array();
        predicted.positions.iter().map(moved).collect()
    };
    let ours = SurfaceIndex::new("predicted", &positions, &predicted.triangles)?;

    let seen = |samples: Vec<Vec3>, test: fn(&DepthView, DVec3) -> bool| -> Vec<Vec3> {
        let visible = |p: &Vec3| views.iter().any(|view| test(view, p.as_dvec3() + origin));
        samples.into_par_iter().with_min_len(CHUNK).filter(visible).collect()
    };
    let truth_samples = seen(truth.samples(SAMPLES, 0), DepthView::saw);
    let our_samples = seen(ours.samples(SAMPLES, 1), DepthView::notices);
    if truth_samples.is_empty() || our_samples.is_empty() {
        return Err(SurfaceError::Unseen { predicted: our_samples.len(), truth: truth_samples.len() });
    }
    Ok(summarise(&truth.distances(&our_samples), &ours.distances(&truth_samples)))
}

/// `accuracy`: distances from our samples to the truth; `completeness`: the other way. Neither may be
/// empty.
fn summarise(accuracy: &[f32], completeness: &[f32]) -> SurfaceMetrics {
    let mean = |d: &[f32]| d.iter().map(|x| f64::from(*x)).sum::<f64>() / d.len() as f64;
    let within = |d: &[f32], t: f32| d.iter().filter(|x| **x < t).count() as f64 / d.len() as f64;
    let fscore = |t: f32| {
        let (precision, recall) = (within(accuracy, t), within(completeness, t));
        2.0 * precision * recall / (precision + recall).max(1e-9)
    };
    let (a, c) = (mean(accuracy), mean(completeness));
    SurfaceMetrics {
        accuracy_m: a,
        completeness_m: c,
        chamfer_m: (a + c) / 2.0,
        fscore_2cm: fscore(0.02),
        fscore_5cm: fscore(0.05),
        times: None,
    }
}

fn area([a, b, c]: &[Vec3; 3]) -> f64 {
    let [a, b, c] = [a, b, c].map(|p| p.as_dvec3());
    (b - a).cross(c - a).length() / 2.0
}

/// Number `i` of stream `seed`, in [0, 1): SplitMix64 (Steele et al. 2014), which needs no state to share.
fn uniform(seed: u64, i: u64) -> f64 {
    let mut z = (seed << 40).wrapping_add(i).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::truth::tests::frame;

    fn mesh(positions: Vec<[f32; 3]>, triangles: Vec<[u32; 3]>) -> Geometry {
        Geometry { positions, triangles, ..Default::default() }
    }

    /// A `2 half` wide square at depth `z` in front of an identity camera, in `n * n` cells.
    fn square(half: f32, z: f32, n: u32) -> Geometry {
        let at = |i: u32| half * (2.0 * i as f32 / n as f32 - 1.0);
        let positions = (0..(n + 1) * (n + 1)).map(|i| [at(i % (n + 1)), at(i / (n + 1)), z]).collect();
        let cell = |i: u32| {
            let a = i / n * (n + 1) + i % n;
            [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
        };
        mesh(positions, (0..n * n).flat_map(cell).collect())
    }

    /// One view, 90° wide, that measured `depth` everywhere.
    fn view(depth: f32) -> Vec<DepthView> {
        let f = frame(64, 64);
        vec![DepthView::new(f.camera, f.c2w, vec![depth; 64 * 64])]
    }

    #[test]
    fn a_shifted_wall_is_off_by_the_shift() {
        let m = compare(&view(2.0), &square(1.9, 2.03, 7), &square(1.9, 2.0, 3)).unwrap();
        for d in [m.accuracy_m, m.completeness_m, m.chamfer_m] {
            assert!((d - 0.03).abs() < 1e-5, "{m:?}");
        }
        assert_eq!((m.fscore_2cm, m.fscore_5cm), (0.0, 1.0));
    }

    #[test]
    fn floaters_in_front_count_and_what_hides_behind_does_not() {
        let truth = square(1.9, 2.0, 3);
        let mut ours = truth.clone();
        let mut add = |part: Geometry| {
            let base = ours.positions.len() as u32;
            ours.positions.extend(part.positions);
            ours.triangles.extend(part.triangles.iter().map(|t| t.map(|v| v + base)));
        };
        add(square(1.9, 2.5, 2));
        let behind = compare(&view(2.0), &ours, &truth).unwrap();
        assert!(behind.accuracy_m < 1e-6, "{behind:?}");
        let mut add = |part: Geometry| {
            let base = ours.positions.len() as u32;
            ours.positions.extend(part.positions);
            ours.triangles.extend(part.triangles.iter().map(|t| t.map(|v| v + base)));
        };
        add(square(0.4, 1.0, 2));
        let floating = compare(&view(2.0), &ours, &truth).unwrap();
        // A floater of 0.64 m², 1 m off, beside a wall of 14.44 m².
        let expected = 0.64 / (0.64 + 14.44);
        assert!((floating.accuracy_m - expected).abs() < 1e-3, "{floating:?}");
        assert!(floating.completeness_m < 1e-6);
    }

    #[test]
    fn truth_that_no_view_saw_is_not_missed() {
        let mut truth = square(1.9, 2.0, 3);
        truth.positions.extend([[0.0, 0.0, -3.0], [1.0, 0.0, -3.0], [0.0, 1.0, -3.0]]);
        truth.triangles.push([16, 17, 18]);
        let m = compare(&view(2.0), &square(1.9, 2.0, 3), &truth).unwrap();
        assert!(m.completeness_m < 1e-6, "{m:?}");
    }

    /// The measure as DESIGN.md words it, written once more with pseudo-random samples, points for surfaces
    /// and a double loop, on a bumpy wall with a hole.
    #[test]
    fn measures_equal_an_independent_brute_force() {
        let truth = square(1.0, 2.0, 4);
        let mut ours = square(1.0, 2.0, 6);
        for (i, p) in ours.positions.iter_mut().enumerate() {
            p[2] += [0.0, 0.05, -0.02, 0.03][i % 4];
        }
        ours.triangles.truncate(60);
        let m = compare(&view(2.0), &ours, &truth).unwrap();

        let points = |g: &Geometry, n: usize, mut s: u64| -> Vec<DVec3> {
            let mut unit = move || {
                s ^= s << 13;
                s ^= s >> 7;
                s ^= s << 17;
                (s >> 11) as f64 / (1u64 << 53) as f64
            };
            let corners: Vec<_> = g
                .triangles
                .iter()
                .map(|t| t.map(|v| Vec3::from(g.positions[v as usize]).as_dvec3()))
                .collect();
            let areas: Vec<f64> =
                corners.iter().map(|[a, b, c]| (*b - *a).cross(*c - *a).length() / 2.0).collect();
            let total: f64 = areas.iter().sum();
            (0..n)
                .map(|_| {
                    let mut left = unit() * total;
                    let t = areas.iter().position(|a| {
                        left -= a;
                        left < 0.0
                    });
                    let [a, b, c] = corners[t.unwrap_or(corners.len() - 1)];
                    let (r, q) = (unit().sqrt(), unit());
                    a * (1.0 - r) + b * (r * (1.0 - q)) + c * (r * q)
                })
                .collect()
        };
        let to = |from: &[DVec3], surface: &[DVec3]| -> f64 {
            let nearest = |p: &DVec3| surface.iter().map(|q| p.distance(*q)).fold(f64::INFINITY, f64::min);
            from.iter().map(nearest).sum::<f64>() / from.len() as f64
        };
        // 20,000 points on 4 m² are 7 mm apart on average: distances to them are a few mm longer than to
        // the surface where the surfaces touch, and hardly where they are centimetres apart.
        let (a, b) = (to(&points(&ours, 2000, 5), &points(&truth, 20_000, 9)), m.accuracy_m);
        let (c, d) = (to(&points(&truth, 2000, 7), &points(&ours, 20_000, 3)), m.completeness_m);
        assert!((a - b).abs() < 0.003, "accuracy {a} {b}");
        assert!((c - d).abs() < 0.004, "completeness {c} {d}");
        assert!(d > 0.015 && b > 0.01, "the wall must be visibly wrong: {m:?}");
    }

    #[test]
    fn samples_are_uniform_by_area_and_repeat() {
        let g = mesh(
            vec![
                [0.0, 0.0, 0.0],
                [3.0, 0.0, 0.0],
                [0.0, 2.0, 0.0],
                [0.0, 0.0, 5.0],
                [1.0, 0.0, 5.0],
                [0.0, 2.0, 5.0],
            ],
            vec![[0, 1, 2], [3, 4, 5]],
        );
        let index = SurfaceIndex::new("true", &g.positions, &g.triangles).unwrap();
        let samples = index.samples(40_000, 1);
        assert_eq!(samples, index.samples(40_000, 1));
        assert_ne!(samples, index.samples(40_000, 2));
        let lower = samples.iter().filter(|p| p.z == 0.0).count();
        assert!((lower as i64 - 30_000).abs() <= 1, "areas are 3 : 1, got {lower}");
        let mean = samples[..lower].iter().sum::<Vec3>() / lower as f32;
        assert!((mean - Vec3::new(1.0, 2.0 / 3.0, 0.0)).length() < 0.02, "the centroid is the mean: {mean}");
    }

    #[test]
    fn far_offsets_do_not_change_the_measure() {
        let f = frame(64, 64);
        let place = DVec3::new(4e5, -7e6, 30.0);
        let c2w = Pose::from_translation(place);
        let views = vec![DepthView::new(f.camera, c2w, vec![2.0; 64 * 64])];
        let mut truth = square(1.9, 2.0, 3);
        truth.offset = place.to_array();
        let mut ours = square(1.9, 1.04, 7);
        ours.offset = (place + DVec3::Z).to_array();
        let m = compare(&views, &ours, &truth).unwrap();
        assert!((m.chamfer_m - 0.04).abs() < 1e-5, "{m:?}");
    }

    #[test]
    fn a_point_cloud_is_its_points() {
        let cloud = mesh(square(1.9, 2.01, 200).positions, vec![]);
        let m = compare(&view(2.0), &cloud, &square(1.9, 2.0, 3)).unwrap();
        assert!((m.accuracy_m - 0.01).abs() < 1e-5 && m.completeness_m < 0.015, "{m:?}");
    }

    #[test]
    fn empty_unseen_and_damaged_surfaces_say_so() {
        let wall = square(1.9, 2.0, 3);
        let empty = compare(&view(2.0), &mesh(vec![], vec![]), &wall).unwrap_err();
        assert!(empty.is_absence() && empty.to_string().contains("predicted"), "{empty}");
        let flat = mesh(vec![[0.0; 3]; 3], vec![[0, 1, 2]]);
        assert_eq!(compare(&view(2.0), &flat, &wall), Err(SurfaceError::Empty("predicted")));
        let unseen = compare(&[], &wall, &wall).unwrap_err();
        assert!(unseen.is_absence());
        let broken = mesh(vec![[0.0; 3]], vec![[0, 0, 9]]);
        assert!(matches!(compare(&view(2.0), &broken, &wall), Err(SurfaceError::Index { vertex: 9, .. })));
        let nan = mesh(vec![[f32::NAN; 3]; 3], vec![[0, 1, 2]]);
        assert!(matches!(compare(&view(2.0), &nan, &wall), Err(SurfaceError::NonFinite { vertex: 0, .. })));
    }
}
