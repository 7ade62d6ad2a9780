//! The box that holds what is to be mapped.
//!
//! Given bounds are checked; without them the box comes from what is known: sparse points and cameras, or
//! where the cameras look. Percentiles keep a few wrong points or poses from blowing the box up.

use glam::{DMat3, DVec2, DVec3};
use kdtree::KdTree;
use kdtree::distance::squared_euclidean;
use rayon::prelude::*;

use super::draft::Draft;
use super::error::{Place, SceneError};
use super::{Aabb, Frame};

/// Fewer sparse points say too little about where the surfaces are.
const ENOUGH_POINTS: usize = 50;
/// Share of the points or cameras that is cut off at either end of an axis.
const TRIM: f64 = 0.01;
/// A point is a stray if its neighbour of this rank is farther away than so many times the median of those distances.
/// Walls have far fewer points than what lies on a table: a smaller factor would take them for strays.
const NEIGHBOUR: usize = 8;
const STRAY: f64 = 20.0;
/// Points that are looked at for that, at most: evenly through the list.
const LOOKED_AT: usize = 50_000;
/// Widening of a box found from data, as a share of its size, on every side.
const MARGIN: f64 = 0.05;

impl Aabb {
    /// The eight corners, world units.
    pub fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|i| {
            let pick = |bit: usize, a: f64, b: f64| if i >> bit & 1 == 0 { a } else { b };
            DVec3::new(
                pick(0, self.min.x, self.max.x),
                pick(1, self.min.y, self.max.y),
                pick(2, self.min.z, self.max.z),
            )
        })
    }

    /// Whether `p` (world) is inside or on the boundary.
    pub fn contains(&self, p: DVec3) -> bool {
        p.cmpge(self.min).all() && p.cmple(self.max).all()
    }
}

/// The scene's box: the given one if it is sound, else the best that can be found.
pub(crate) fn find(draft: &Draft, frames: &[Frame], warnings: &mut Vec<String>) -> Result<Aabb, SceneError> {
    let given = draft.aabb.is_some();
    let bounds = match draft.aabb {
        Some(aabb) => aabb,
        None if draft.points.len() >= ENOUGH_POINTS => from_points(&draft.points, frames),
        None => from_cameras(frames, draft.reach, warnings),
    };
    let invalid = |what: String, remedy: &str| {
        let at = if given { Place::Key("aabb".into()) } else { Place::File };
        SceneError::invalid(&draft.source, at, what, remedy)
    };
    if !(bounds.min.is_finite() && bounds.max.is_finite() && bounds.min.cmplt(bounds.max).all()) {
        let what = format!("the box from {} to {} is empty or not finite", bounds.min, bounds.max);
        return Err(invalid(what, "give the smallest corner first, then the largest"));
    }
    let blind = frames.iter().filter(|f| !sees(f, &bounds)).count();
    if blind == frames.len() {
        let what = format!("no camera sees the box from {} to {}", bounds.min, bounds.max);
        return Err(invalid(what, "check that box and poses have the same coordinates and units"));
    }
    if blind > 0 {
        warnings.push(format!("{blind} of {} cameras do not see the box at all", frames.len()));
    }
    let outside = frames.iter().filter(|f| !bounds.contains(f.c2w.translation)).count();
    if outside > 0 {
        warnings.push(format!(
            "{outside} of {} cameras are outside the box; what is between them and the box is not mapped",
            frames.len()
        ));
    }
    Ok(bounds)
}

/// Box around the sparse points and the cameras.
fn from_points(points: &[DVec3], frames: &[Frame]) -> Aabb {
    let of_points = trimmed_box(without_strays(points));
    let of_cameras = trimmed_box(frames.iter().map(|f| f.c2w.translation).collect());
    widened(Aabb { min: of_points.min.min(of_cameras.min), max: of_points.max.max(of_cameras.max) })
}

/// The points that have neighbours (statistical outlier removal, Rusu et al. 2008, with a median): wrong matches of
/// structure from motion lie alone and far away, and more than a percentile cuts off may be wrong.
fn without_strays(points: &[DVec3]) -> Vec<DVec3> {
    let every = points.len().div_ceil(LOOKED_AT).max(1);
    let points: Vec<DVec3> = points.iter().step_by(every).copied().filter(|p| p.is_finite()).collect();
    let mut tree = KdTree::with_capacity(3, 16);
    for p in &points {
        // Only numbers that are not finite are refused.
        let _ = tree.add(p.to_array(), ());
    }
    let distance = |p: &DVec3| {
        let near = tree.nearest(&p.to_array(), NEIGHBOUR + 1, &squared_euclidean).unwrap_or_default();
        near.last().map_or(0.0, |(squared, ())| squared.sqrt())
    };
    let distances: Vec<f64> = points.par_iter().map(distance).collect();
    let mut sorted = distances.clone();
    sorted.sort_by(f64::total_cmp);
    let limit = sorted.get(sorted.len() / 2).map_or(0.0, |median| STRAY * median);
    // More than half of the points in one place say nothing about the others.
    let kept = points.iter().zip(distances).filter(|(_, d)| limit == 0.0 || *d <= limit);
    kept.map(|(p, _)| *p).collect()
}

/// Box around the cameras and what they can see up to the distance where things probably are.
fn from_cameras(frames: &[Frame], reach: Option<f64>, warnings: &mut Vec<String>) -> Aabb {
    let reach = reach.unwrap_or_else(|| probable_reach(frames));
    let mut seen = Vec::with_capacity(6 * frames.len());
    for frame in frames {
        seen.push(frame.c2w.translation);
        let (w, h) = (f64::from(frame.camera.width), f64::from(frame.camera.height));
        for (x, y) in [(0.5, 0.5), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            // At one distance, not one depth: corners of wide lenses would reach far too far.
            let dir = frame.camera.unproject(DVec2::new(x * w, y * h)).normalize();
            seen.push(frame.c2w.transform_point3(dir * reach));
        }
    }
    let bounds = widened(trimmed_box(seen));
    warnings.push(format!(
        "the bounds were guessed from the cameras (reach {reach:.3}); give `aabb` if the map is cut off"
    ));
    bounds
}

/// How far from the cameras things probably are.
///
/// Cameras that circle something look at one point: twice its distance covers what is behind it. Cameras that
/// walk through a room have no such point: things are about as far off as the cameras get around.
fn probable_reach(frames: &[Frame]) -> f64 {
    let positions: Vec<DVec3> = frames.iter().map(|f| f.c2w.translation).collect();
    let around = trimmed_box(positions);
    let spread = (around.max - around.min).length();
    // Cameras on one spot have no scale: one unit is as good as any other.
    let fallback = if spread > 1e-9 * (1.0 + around.max.length()) { spread } else { 1.0 };
    let Some(focus) = focus_point(frames) else { return fallback };
    let mut depths: Vec<f64> =
        frames.iter().map(|f| f.c2w.inverse().transform_point3(focus).z).filter(|z| *z > 0.0).collect();
    if depths.len() * 10 < frames.len() * 9 {
        return fallback;
    }
    depths.sort_by(f64::total_cmp);
    (2.0 * depths[depths.len() / 2]).max(fallback)
}

/// The point nearest to all optical axes (least squares); `None` if the axes are almost parallel.
fn focus_point(frames: &[Frame]) -> Option<DVec3> {
    let (mut normal, mut rhs) = (DMat3::ZERO, DVec3::ZERO);
    let origin = frames.first()?.c2w.translation;
    for frame in frames {
        let axis = frame.c2w.matrix3.z_axis;
        // Projection onto the plane across the axis.
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        normal += across;
        rhs += across * (frame.c2w.translation - origin);
    }
    // Determinant of the mean: 0 for parallel axes, sin²(angle)-like else; 1e-3 is about 3° between axes.
    let mean = normal * (1.0 / frames.len() as f64);
    (mean.determinant() > 1e-3).then(|| origin + normal.inverse() * rhs)
}

/// Box between the percentiles [`TRIM`] and 1 − [`TRIM`] of each axis.
fn trimmed_box(points: Vec<DVec3>) -> Aabb {
    let axis = |pick: fn(&DVec3) -> f64| {
        let mut values: Vec<f64> = points.iter().map(pick).collect();
        values.sort_by(f64::total_cmp);
        let cut = (TRIM * values.len() as f64) as usize;
        match (values.get(cut), values.get(values.len().saturating_sub(1 + cut))) {
            (Some(low), Some(high)) => (*low, *high),
            _ => (0.0, 0.0),
        }
    };
    let (x, y, z) = (axis(|p| p.x), axis(|p| p.y), axis(|p| p.z));
    Aabb { min: DVec3::new(x.0, y.0, z.0), max: DVec3::new(x.1, y.1, z.1) }
}

/// The box with a margin; no side is shorter than a hundredth of the longest.
fn widened(b: Aabb) -> Aabb {
    let size = b.max - b.min;
    let pad = (size * MARGIN).max(DVec3::splat(size.max_element() * 0.005));
    Aabb { min: b.min - pad, max: b.max + pad }
}

/// Whether a camera sees some part of the box: one of its rays hits it, or one of the box's points is in the
/// image.
pub(crate) fn sees(frame: &Frame, bounds: &Aabb) -> bool {
    const STEPS: u32 = 8;
    let share = |i: u32| f64::from(i) / f64::from(STEPS);
    let camera = &frame.camera;
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    // Rays find boxes that are large in the image.
    for i in 0..=STEPS {
        for j in 0..=STEPS {
            let dir = camera.unproject(DVec2::new(share(i) * w, share(j) * h));
            if ray_hits(frame.c2w.translation, frame.c2w.transform_vector3(dir), bounds) {
                return true;
            }
        }
    }
    // Points find those that are small in it.
    let w2c = frame.c2w.inverse();
    let size = bounds.max - bounds.min;
    (0..=STEPS).any(|i| {
        (0..=STEPS).any(|j| {
            (0..=STEPS).any(|k| {
                let p = bounds.min + size * DVec3::new(share(i), share(j), share(k));
                let uv = camera.project(w2c.transform_point3(p));
                uv.is_some_and(|uv| uv.x >= 0.0 && uv.y >= 0.0 && uv.x <= w && uv.y <= h)
            })
        })
    })
}

/// Whether a ray that starts at `origin` meets the box (slab test).
fn ray_hits(origin: DVec3, dir: DVec3, bounds: &Aabb) -> bool {
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let (low, high) = (bounds.min[axis] - origin[axis], bounds.max[axis] - origin[axis]);
        if dir[axis] == 0.0 {
            // Along the slab: inside it or never in it. Dividing would give 0/0 on its faces.
            if low > 0.0 || high < 0.0 {
                return false;
            }
            continue;
        }
        let (a, b) = (low / dir[axis], high / dir[axis]);
        near = near.max(a.min(b));
        far = far.min(a.max(b));
    }
    near <= far
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    /// Points on the sides of a unit cube, as dense on one of them as on all others together.
    fn room(rng: &mut Rng) -> Vec<DVec3> {
        let mut point = |n: usize| {
            let mut p = [0.0; 3].map(|_: f64| f64::from(rng.uniform()));
            let side = if n.is_multiple_of(2) { 0 } else { 1 + n / 2 % 5 };
            p[side % 3] = (side / 3) as f64;
            DVec3::from_array(p)
        };
        (0..4000).map(&mut point).collect()
    }

    #[test]
    fn strays_are_dropped_and_sparse_walls_are_kept() {
        let mut rng = Rng::new(5, 0, 0);
        let mut points = room(&mut rng);
        assert_eq!(without_strays(&points).len(), points.len());
        // A twentieth of all: more than a percentile would cut off.
        for _ in 0..200 {
            points.push(DVec3::from_array([0.0; 3].map(|_: f64| 400.0 * f64::from(rng.uniform()) - 200.0)));
        }
        points.push(DVec3::NAN);
        let b = trimmed_box(without_strays(&points));
        assert!(b.min.cmpge(DVec3::splat(-1.0)).all() && b.max.cmple(DVec3::splat(2.0)).all(), "{b:?}");
        assert!((b.max - b.min).min_element() > 0.9, "{b:?}");
    }

    #[test]
    fn points_in_one_place_are_no_reason_to_drop_the_others() {
        let mut points = vec![DVec3::ONE; 500];
        points.extend((0..100).map(|n| DVec3::splat(f64::from(n))));
        assert_eq!(without_strays(&points).len(), 600);
        assert!(without_strays(&[]).is_empty());
    }
}
