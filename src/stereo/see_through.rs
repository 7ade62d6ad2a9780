//! What rests and yet is not persistent: surfaces that other frames, earlier or later, see through.

use glam::{DAffine3, Mat3, Vec3};
use rayon::prelude::*;

use super::StereoDepth;

/// A ray passes a point if it ends this much behind it, as a share of the depth.
const BEHIND: f32 = 0.03;

/// It ends there if its depth differs by less than this.
const THERE: f32 = 0.02;

/// Rays that must pass for each one that ends there: a true surface is passed by false matches only.
const ENDS: i32 = 3;

/// Observers of each point at most; more frames say the same again.
const OBSERVERS: usize = 256;

/// Depth of frames and where they were taken from.
#[derive(Clone, Copy)]
pub struct SeenFrame<'a> {
    /// Camera to world, in the unit of the depths.
    pub c2w: DAffine3,
    /// Its depth by stereo.
    pub depth: &'a StereoDepth,
    /// When.
    pub time: f64,
}

/// For each pixel of the stereo depth of the frames `of`, how many more rays pass its surface than end there, in the best
/// stretch of time from the beginning or to the end: large where something was put down or taken away, about zero on what
/// is always there. 0 where there is no depth.
///
/// Rays that end at the surface count three times.
pub fn seen_through(frames: &[SeenFrame], of: &[usize]) -> Vec<Vec<i32>> {
    let mut order: Vec<usize> = (0..frames.len()).collect();
    order.sort_by(|a, b| frames[*a].time.total_cmp(&frames[*b].time).then(a.cmp(b)));
    let every = order.len().div_ceil(OBSERVERS).max(1);
    let observers: Vec<Observer> = order.iter().step_by(every).map(|n| Observer::new(&frames[*n])).collect();
    of.par_iter()
        .map(|n| {
            let frame = Observer::new(&frames[*n]);
            let depth = frame.depth;
            (0..depth.depth.len())
                .map(|k| match depth.depth[k] {
                    z if z > 0.0 => evidence(&observers, frame.point(k, z)),
                    _ => 0,
                })
                .collect()
        })
        .collect()
}

/// Passing minus ending rays, summed from the beginning or to the end, whichever stretch gives most.
fn evidence(observers: &[Observer], point: Vec3) -> i32 {
    let (mut sum, mut highest, mut lowest) = (0, 0, 0);
    for observer in observers {
        sum += observer.judge(point);
        highest = highest.max(sum);
        lowest = lowest.min(sum);
    }
    highest.max(sum - lowest)
}

struct Observer<'a> {
    to_camera: Mat3,
    centre: Vec3,
    depth: &'a StereoDepth,
}

impl<'a> Observer<'a> {
    fn new(frame: &SeenFrame<'a>) -> Self {
        Self {
            to_camera: frame.c2w.matrix3.as_mat3().transpose(),
            centre: frame.c2w.translation.as_vec3(),
            depth: frame.depth,
        }
    }

    /// Where pixel number `k` ends at depth `z`.
    fn point(&self, k: usize, z: f32) -> Vec3 {
        self.centre + self.to_camera.transpose() * (self.depth.ray(k) * z)
    }

    /// 1 if the ray towards a point passes it, −[`ENDS`] if it ends there, 0 if it ends before or nothing is known.
    #[inline]
    fn judge(&self, point: Vec3) -> i32 {
        let q = self.to_camera * (point - self.centre);
        if q.z <= 0.0 {
            return 0;
        }
        match self.depth.pixel(q / q.z).map(|k| self.depth.depth[k]) {
            Some(found) if found > q.z * (1.0 + BEHIND) => 1,
            Some(found) if found > 0.0 && (found - q.z).abs() < THERE * q.z => -ENDS,
            _ => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Camera;

    const CAMERA: Camera =
        Camera { width: 20, height: 10, fx: 10.0, fy: 10.0, cx: 10.0, cy: 5.0, distortion: [0.0; 4] };

    /// Frames from slightly different places that look at a wall.
    fn frames(depths: &[StereoDepth]) -> Vec<SeenFrame<'_>> {
        depths
            .iter()
            .enumerate()
            .map(|(n, depth)| SeenFrame {
                c2w: DAffine3::from_translation(glam::DVec3::new(0.01 * n as f64, 0.0, 0.0)),
                depth,
                time: n as f64,
            })
            .collect()
    }

    /// Depth of a wall 3 m away, in the frames `hidden` with something 2 m away in the left half.
    fn depths(count: usize, hidden: std::ops::Range<usize>) -> Vec<StereoDepth> {
        let frame = |n: usize| {
            let mut depth = StereoDepth::flat(&CAMERA, 3.0);
            if hidden.contains(&n) {
                (0..depth.depth.len()).filter(|k| k % 20 < 10).for_each(|k| depth.depth[k] = 2.0);
            }
            depth
        };
        (0..count).map(frame).collect()
    }

    #[test]
    fn what_is_taken_away_or_put_down_is_seen_through() {
        for hidden in [0..12, 12..30] {
            let depths = depths(30, hidden.clone());
            let found = &seen_through(&frames(&depths), &[hidden.start + 2])[0];
            let passed = (30 - hidden.len()) as i32;
            assert_eq!(found[5 * 20 + 4], passed, "{hidden:?}");
            assert!(found[5 * 20 + 16] <= 0, "the wall beside it is always there");
        }
    }

    #[test]
    fn what_stays_is_not_seen_through_and_the_unknown_has_no_evidence() {
        let mut depths = depths(20, 0..20);
        // A false match now and then.
        depths[7].depth.fill(3.0);
        depths[3].depth[5 * 20 + 4] = 0.0;
        let found = seen_through(&frames(&depths), &[2, 3]);
        assert!(found[0][5 * 20 + 4] <= 1);
        assert_eq!(found[1][5 * 20 + 4], 0);
    }

    #[test]
    fn time_is_what_counts_not_the_order_of_frames() {
        let depths = depths(30, 0..12);
        let mut shuffled = frames(&depths);
        shuffled.reverse();
        let straight = seen_through(&frames(&depths), &[0]);
        assert_eq!(seen_through(&shuffled, &[29]), straight);
    }
}
