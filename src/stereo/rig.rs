//! Reduced pinhole images with their poses, and which of them to compare.

use glam::{DVec2, Mat3, Vec2, Vec3};

use super::sweep::Planes;
use super::{StereoConfig, StereoFrame};

/// Angle between two rays to a point at which they tell its depth best, rad; below it depth is vague, above it the
/// views look too different (Yao et al. 2018, MVSNet, section 3.1, with a wider upper side for short videos).
const BEST_ANGLE: f32 = 0.12;
const SPREAD_BELOW: f32 = 0.06;
const SPREAD_ABOVE: f32 = 0.2;

/// Frames compared with one another must look the same way at least this much (cosine).
const LEAST_COSINE: f32 = 0.5;

/// A grey pinhole image.
pub(super) struct WorkView {
    pub width: usize,
    pub height: usize,
    pub focal: Vec2,
    pub principal: Vec2,
    /// Camera to world.
    pub rotation: Mat3,
    /// Camera centre.
    pub centre: Vec3,
    /// Luminance 0–255, `[height * width]`.
    pub grey: Vec<f32>,
}

impl WorkView {
    /// Reduces a frame to at most `size` px on its longer side and undoes its lens.
    pub fn new(frame: &StereoFrame, size: u32) -> Self {
        let c = frame.camera;
        let reduce = (f64::from(c.width.max(c.height)) / f64::from(size)).max(1.0);
        let (width, height) =
            ((f64::from(c.width) / reduce).round().max(1.0), (f64::from(c.height) / reduce).round().max(1.0));
        let scale = DVec2::new(width / f64::from(c.width), height / f64::from(c.height));
        let focal = DVec2::new(c.fx, c.fy) * scale;
        let principal = DVec2::new(c.cx, c.cy) * scale;
        let source = |x: f64, y: f64| {
            let dir = ((DVec2::new(x, y) - principal) / focal).extend(1.0);
            c.project(dir).unwrap_or(DVec2::NAN)
        };
        // Enough taps a pixel that every source pixel is looked at.
        let taps = reduce.ceil() as usize;
        let (w, h) = (width as usize, height as usize);
        let mut grey = Vec::with_capacity(w * h);
        for y in 0..h {
            for x in 0..w {
                let mut sum = 0.0;
                for k in 0..taps * taps {
                    let sub = |n: usize| (n as f64 + 0.5) / taps as f64;
                    sum += luminance(frame, source(x as f64 + sub(k % taps), y as f64 + sub(k / taps)));
                }
                grey.push(sum / (taps * taps) as f32);
            }
        }
        Self {
            width: w,
            height: h,
            focal: focal.as_vec2(),
            principal: principal.as_vec2(),
            rotation: frame.c2w.matrix3.as_mat3(),
            centre: frame.c2w.translation.as_vec3(),
            grey,
        }
    }

    /// Direction (z = 1) in world axes through an image point.
    #[inline(always)]
    pub fn ray(&self, p: Vec2) -> Vec3 {
        self.rotation * ((p - self.principal) / self.focal).extend(1.0)
    }

    /// Image point and depth of a world point; `None` behind the camera or outside the image.
    #[inline(always)]
    pub fn project(&self, p: Vec3) -> Option<(Vec2, f32)> {
        let q = self.rotation.transpose() * (p - self.centre);
        if q.z <= 0.0 {
            return None;
        }
        let uv = q.truncate() / q.z * self.focal + self.principal;
        let size = Vec2::new(self.width as f32, self.height as f32);
        (uv.cmpge(Vec2::ZERO).all() && uv.cmplt(size).all()).then_some((uv, q.z))
    }
}

/// Bilinear luminance; 0 outside.
fn luminance(frame: &StereoFrame, p: DVec2) -> f32 {
    let (w, h) = (frame.camera.width as usize, frame.camera.height as usize);
    let q = p - 0.5;
    if !(q.x > -1.0 && q.y > -1.0 && q.x < w as f64 && q.y < h as f64) {
        return 0.0;
    }
    let at = |x: f64, y: f64| {
        let (x, y) = ((x.max(0.0) as usize).min(w - 1), (y.max(0.0) as usize).min(h - 1));
        let [r, g, b] = frame.rgb[y * w + x].map(f32::from);
        0.299 * r + 0.587 * g + 0.114 * b
    };
    let (x, y) = (q.x.floor(), q.y.floor());
    let (fx, fy) = ((q.x - x) as f32, (q.y - y) as f32);
    let top = at(x, y) * (1.0 - fx) + at(x + 1.0, y) * fx;
    let bottom = at(x, y + 1.0) * (1.0 - fx) + at(x + 1.0, y + 1.0) * fx;
    top * (1.0 - fy) + bottom * fy
}

/// The frames that tell most about the depth of frame `n`, best first.
pub(super) fn neighbours(views: &[WorkView], n: usize, planes: &Planes, config: &StereoConfig) -> Vec<usize> {
    let mut scored: Vec<(f32, usize)> = (0..views.len())
        .filter(|m| *m != n)
        .map(|m| (usefulness(&views[n], &views[m], planes), m))
        .filter(|(score, _)| *score > 0.0)
        .collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    // One after the other, each with a penalty for looking like those already chosen: four times the same
    // view says nothing four times.
    let mut chosen: Vec<usize> = Vec::new();
    scored.truncate(8 * config.neighbours);
    while chosen.len() < config.neighbours && !scored.is_empty() {
        let novelty = |m: usize| {
            let distance = |c: &usize| views[m].centre.distance(views[*c].centre);
            let nearest = chosen.iter().map(distance).fold(f32::INFINITY, f32::min);
            let base = views[m].centre.distance(views[n].centre);
            (nearest / (0.5 * base)).min(1.0)
        };
        let best = (0..scored.len())
            .max_by(|a, b| {
                let value = |k: &usize| scored[*k].0 * novelty(scored[*k].1);
                value(a).total_cmp(&value(b)).then(b.cmp(a))
            })
            .unwrap_or(0);
        chosen.push(scored.remove(best).1);
    }
    chosen
}

/// Mean over points in front of `a` of how well `b` sees them and from how good an angle.
fn usefulness(a: &WorkView, b: &WorkView, planes: &Planes) -> f32 {
    if (a.rotation * Vec3::Z).dot(b.rotation * Vec3::Z) < LEAST_COSINE {
        return 0.0;
    }
    let (mut sum, mut count) = (0.0, 0.0);
    for y in 0..4 {
        for x in 0..5 {
            let p =
                Vec2::new((x as f32 + 0.5) / 5.0 * a.width as f32, (y as f32 + 0.5) / 4.0 * a.height as f32);
            for fraction in [0.1, 0.25, 0.4] {
                let point = a.centre + a.ray(p) / planes.inverse_at(fraction);
                count += 1.0;
                if b.project(point).is_none() {
                    continue;
                }
                let angle = (a.centre - point).angle_between(b.centre - point);
                let spread = if angle < BEST_ANGLE { SPREAD_BELOW } else { SPREAD_ABOVE };
                sum += (-0.5 * ((angle - BEST_ANGLE) / spread).powi(2)).exp();
            }
        }
    }
    sum / count
}
