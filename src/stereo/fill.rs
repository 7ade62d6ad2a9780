//! Depth of what has no texture: where a picture is even it shows one surface, and most large surfaces are flat.
//!
//! A picture is divided into regions of even brightness. The depth that is known of a region, which is mostly that of its
//! rim, is continued to all of it where it is a plane, as far as the rim tells the plane. What other frames see through
//! is taken back.

use glam::{DVec3, Vec2};

use super::plane::{Plane, Point};
use super::rig::WorkView;
use crate::rng::Rng;

/// How uneven a region may be: grey levels (0–255) that a region of one pixel may differ from its neighbours, and a
/// region of n pixels by the n-th part of that more than it does within itself (Felzenszwalb and Huttenlocher 2004).
const UNEVENNESS: f32 = 100.0;

/// Pixels that a region must have, and of which depth must be known.
const LEAST_PIXELS: usize = 40;
const LEAST_KNOWN: usize = 16;

/// Share of what is known of a region that must lie on one plane.
const PLANAR: f64 = 0.75;

/// Largest relative error (one standard deviation) of depth that is continued.
const ERROR: f64 = 0.015;

/// Another frame agrees with a depth, or sees through it, if its own differs by this share.
const SAME: f32 = 0.03;
const BEHIND: f32 = 0.05;

/// What planes say of the pixels of `view` whose depth is not known: all depths, those that were known as they were.
/// `number` is the frame's.
pub(super) fn continued(view: &WorkView, number: usize, depth: &[f32]) -> Vec<f32> {
    let mut out = depth.to_vec();
    let direction = |pixel: usize| {
        let p = Vec2::new((pixel % view.width) as f32 + 0.5, (pixel / view.width) as f32 + 0.5);
        ((p - view.principal) / view.focal).as_dvec2().extend(1.0)
    };
    for (n, region) in regions(&view.grey, view.width).into_iter().enumerate() {
        let known: Vec<Point> = (region.iter().filter(|p| depth[**p] > 0.0))
            .map(|p| (direction(*p), 1.0 / f64::from(depth[*p])))
            .collect();
        if region.len() < LEAST_PIXELS || known.len() < LEAST_KNOWN {
            continue;
        }
        let mut rng = Rng::new(0, number as u64, n as u64);
        let Some((plane, share)) = Plane::agreed(&known, &mut rng) else { continue };
        if share < PLANAR {
            continue;
        }
        for pixel in region.into_iter().filter(|p| depth[*p] <= 0.0) {
            let inverse: Option<f64> = plane.known_at(direction(pixel) as DVec3, ERROR);
            out[pixel] = inverse.map_or(0.0, |inverse| (1.0 / inverse) as f32);
        }
    }
    out
}

/// Takes back what was continued in frame `n` and more frames see through than see there. `known` and `continued` are
/// the depths of all frames before and after.
pub(super) fn checked(views: &[WorkView], known: &[Vec<f32>], continued: &[Vec<f32>], n: usize) -> Vec<f32> {
    let view = &views[n];
    let mut out = continued[n].clone();
    for pixel in (0..out.len()).filter(|p| known[n][*p] <= 0.0 && continued[n][*p] > 0.0) {
        let p = Vec2::new((pixel % view.width) as f32 + 0.5, (pixel / view.width) as f32 + 0.5);
        let point = view.centre + view.ray(p) * out[pixel];
        let mut balance = 0i32;
        for (m, other) in views.iter().enumerate().filter(|(m, _)| *m != n) {
            let Some((uv, z)) = other.project(point) else { continue };
            let found = continued[m][uv.y as usize * other.width + uv.x as usize];
            balance += match found {
                f if f <= 0.0 => 0,
                f if (f / z - 1.0).abs() < SAME => 1,
                f if f > z * (1.0 + BEHIND) => -1,
                _ => 0,
            };
        }
        if balance < 0 {
            out[pixel] = 0.0;
        }
    }
    out
}

/// The pixels of each region of even brightness.
fn regions(grey: &[f32], width: usize) -> Vec<Vec<usize>> {
    let mut edges: Vec<(f32, usize, usize)> = Vec::with_capacity(2 * grey.len());
    for pixel in 0..grey.len() {
        let right = (pixel % width + 1 < width).then_some(pixel + 1);
        let below = (pixel + width < grey.len()).then_some(pixel + width);
        let neighbours = right.into_iter().chain(below);
        edges.extend(neighbours.map(|other| ((grey[pixel] - grey[other]).abs(), pixel, other)));
    }
    edges.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let mut forest = Forest::new(grey.len());
    for (difference, a, b) in edges {
        let (a, b) = (forest.root(a), forest.root(b));
        if a != b && difference <= forest.tolerance(a).min(forest.tolerance(b)) {
            forest.join(a, b, difference);
        }
    }
    let mut members = vec![Vec::new(); grey.len()];
    (0..grey.len()).for_each(|pixel| members[forest.root(pixel)].push(pixel));
    members.retain(|region| !region.is_empty());
    members
}

/// Disjoint sets of pixels with the largest step within each.
struct Forest {
    parent: Vec<usize>,
    size: Vec<usize>,
    step: Vec<f32>,
}

impl Forest {
    fn new(pixels: usize) -> Self {
        Self { parent: (0..pixels).collect(), size: vec![1; pixels], step: vec![0.0; pixels] }
    }

    fn root(&mut self, mut pixel: usize) -> usize {
        while self.parent[pixel] != pixel {
            self.parent[pixel] = self.parent[self.parent[pixel]];
            pixel = self.parent[pixel];
        }
        pixel
    }

    fn tolerance(&self, root: usize) -> f32 {
        self.step[root] + UNEVENNESS / self.size[root] as f32
    }

    /// Joins two sets by a step that is no smaller than any before it.
    fn join(&mut self, a: usize, b: usize, step: f32) {
        let (into, from) = if self.size[a] >= self.size[b] { (a, b) } else { (b, a) };
        self.parent[from] = into;
        self.size[into] += self.size[from];
        self.step[into] = step;
    }
}

#[cfg(test)]
mod tests {
    use glam::{Mat3, Vec3};

    use super::*;

    const WIDTH: usize = 32;
    const HEIGHT: usize = 24;

    /// A dark door in a bright, textured wall.
    fn picture() -> Vec<f32> {
        let at = |n: usize| match door(n) {
            true => 60.0 + (n % 3) as f32,
            false => 170.0 + 25.0 * ((n * 7) % 5) as f32,
        };
        (0..WIDTH * HEIGHT).map(at).collect()
    }

    fn door(n: usize) -> bool {
        (8..24).contains(&(n % WIDTH)) && (4..20).contains(&(n / WIDTH))
    }

    fn view(centre: Vec3) -> WorkView {
        WorkView {
            width: WIDTH,
            height: HEIGHT,
            focal: Vec2::splat(30.0),
            principal: Vec2::new(16.0, 12.0),
            rotation: Mat3::IDENTITY,
            centre,
            grey: picture(),
        }
    }

    /// Inverse depth of a slanted wall.
    fn inverse(n: usize) -> f32 {
        0.5 + 0.01 * (n % WIDTH) as f32
    }

    #[test]
    fn a_door_is_one_region() {
        let regions = regions(&picture(), WIDTH);
        let of_door =
            regions.iter().find(|r| r.contains(&(10 * WIDTH + 12))).expect("every pixel has a region");
        assert_eq!(of_door.len(), 16 * 16);
        assert!(of_door.iter().all(|n| door(*n)));
        assert_eq!(regions.iter().map(Vec::len).sum::<usize>(), WIDTH * HEIGHT);
    }

    #[test]
    fn a_door_of_known_rim_is_filled_and_a_bent_one_is_not() {
        let rim = |n: usize| door(n) && !((10..22).contains(&(n % WIDTH)) && (6..18).contains(&(n / WIDTH)));
        let depth = |bend: f32| -> Vec<f32> {
            let of = |n: usize| 1.0 / (inverse(n) + bend * ((n / WIDTH) as f32 - 12.0).powi(2));
            (0..WIDTH * HEIGHT).map(|n| if rim(n) { of(n) } else { 0.0 }).collect()
        };
        let filled = continued(&view(Vec3::ZERO), 0, &depth(0.0));
        for n in 0..filled.len() {
            let right = (filled[n] * inverse(n) - 1.0).abs() < 1e-3;
            assert!(if door(n) { right } else { filled[n] == 0.0 }, "pixel {n}: {}", filled[n]);
        }
        let bent = depth(0.01);
        assert_eq!(continued(&view(Vec3::ZERO), 0, &bent), bent);
    }

    #[test]
    fn what_others_see_through_is_taken_back() {
        let views: Vec<WorkView> = (0..3).map(|n| view(Vec3::X * 0.01 * n as f32)).collect();
        let known = vec![vec![0.0; WIDTH * HEIGHT]; 3];
        let at = |depth: f32| vec![depth; WIDTH * HEIGHT];
        let wrong = checked(&views, &known, &[at(1.0), at(2.0), at(2.0)], 0);
        assert!(wrong.iter().filter(|d| **d == 0.0).count() > WIDTH * HEIGHT * 8 / 10);
        assert_eq!(checked(&views, &known, &[at(1.0), at(1.01), at(2.0)], 0), at(1.0));
        assert_eq!(checked(&views, &[at(1.0), at(2.0), at(2.0)], &[at(1.0), at(2.0), at(2.0)], 0), at(1.0));
    }
}
