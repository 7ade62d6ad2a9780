//! Alignment of the training frames with what the field shows from where they are.
//!
//! Gradients through the field's lattices move poses slowly and noisily. Where the field already shows the scene, each
//! frame can instead be registered to its own rendering: a direct, robust Gauss-Newton alignment of a few thousand
//! pixels (Kerl et al. 2013, "Robust odometry estimation for RGB-D cameras", with rendered depth in place of measured
//! depth), for all frames together with the focal length that they share.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::pixels::PixelSet;
use crate::field::Field;
use crate::render::forward::Model;
use crate::render::image::render;
use crate::render::rays::View;
use crate::render::sampler::Sampling;
use crate::scene::Camera;

/// Pixels of a frame that are compared, at most.
const PIXELS: f64 = 1000.0;

/// Gauss-Newton steps between two renderings.
const ITERATIONS: usize = 6;

/// Weight of the poses that the scene gives, as a share of what the images say.
///
/// The field follows a common drift of neighbouring frames without resistance, so that nothing but this holds the map
/// in its place; a frame that jitters against its neighbours feels the field in full.
const PRIOR: f64 = 0.2;

/// A frame that would move farther than this (rad, units) is left where it is.
const LARGEST: f64 = 0.05;

/// The same for the lens: its focal length trades against the distance of everything, its bend against nothing.
const LENS_PRIOR: [f64; SHARED] = [0.02, 0.002];

/// A frame is moved if that makes its residuals this much smaller: poses that are right stay as they are.
const WORTH_IT: f64 = 0.99;

/// Differences in luminance (0-1) above this are something else than a shifted picture.
const OUTLIER: f64 = 0.2;

/// Unknowns of a frame: rotation, translation, gain and offset of its brightness.
const UNKNOWNS: usize = 8;

/// Unknowns of the lens that all frames share: focal length and its growth with the squared distance from the axis.
const SHARED: usize = 2;

/// What an alignment changed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Alignment {
    /// Frames that moved.
    pub frames: usize,
    /// Root of the mean squared rotation, rad.
    pub rotation: f64,
    /// Root of the mean squared translation, units.
    pub translation: f64,
    /// Relative change of the focal length, and of its growth with the squared distance from the axis.
    pub lens: [f64; SHARED],
}

/// What [`align`] found; [`Correction::apply`] adds it to the field.
pub struct Correction {
    /// In numbers, for the log.
    pub report: Alignment,
    /// Change of the pose trajectory's Γ.
    poses: Vec<f32>,
}

/// Registers all frames of `pixels` to the field. Deterministic, whatever the number of threads.
pub fn align(model: &Model, pixels: &PixelSet, sampling: &Sampling) -> Correction {
    let field = model.field;
    let frames = (0..pixels.frames.len()).into_par_iter();
    let mut frames: Vec<Registration> =
        frames.map(|n| Registration::new(model, pixels, n, sampling)).collect();
    let given = |k: usize| f64::from(field.weights[field.layout.rig.start + 6 + k]);
    let mut lens = [0.0; SHARED];
    for _ in 0..ITERATIONS {
        let systems: Vec<System> = frames.par_iter().map(|f| f.system(lens)).collect();
        let shared = solve_shared(&systems, std::array::from_fn(|k| given(k) + lens[k]));
        (0..SHARED).for_each(|k| lens[k] += shared[k]);
        frames.par_iter_mut().zip(&systems).for_each(|(f, s)| f.step(s, shared));
    }
    let mut change = vec![0.0; field.layout.pose.len()];
    let mut count = vec![0.0f32; field.pose.knots.len()];
    let mut report = Alignment { lens, ..Alignment::default() };
    for f in &frames {
        let Some(delta) = f.accepted() else { continue };
        report.frames += 1;
        report.rotation += delta[..3].iter().map(|d| d * d).sum::<f64>();
        report.translation += delta[3..6].iter().map(|d| d * d).sum::<f64>();
        let knot = if f.view.knots.a.1 >= 0.5 { f.view.knots.a.0 } else { f.view.knots.b.0 };
        count[knot] += 1.0;
        for (c, d) in change[knot * 6..][..6].iter_mut().zip(&delta) {
            *c += *d as f32;
        }
    }
    for (c, n) in change.chunks_exact_mut(6).zip(&count) {
        for c in c {
            *c /= n.max(1.0);
        }
    }
    let n = report.frames.max(1) as f64;
    report.rotation = (report.rotation / n).sqrt();
    report.translation = (report.translation / n).sqrt();
    Correction { report, poses: change }
}

impl Correction {
    /// Moves the poses and the lens of a field; what all frames have in common goes to the rig.
    pub fn apply(&self, field: &mut Field) {
        let (pose, rig) = (field.layout.pose.clone(), field.layout.rig.start);
        for (w, c) in field.weights[pose.clone()].iter_mut().zip(&self.poses) {
            *w += c;
        }
        for (w, change) in field.weights[rig + 6..].iter_mut().zip(self.report.lens) {
            *w += change as f32;
        }
        let (width, knots) = (field.pose.width, field.pose.knots.len() as f32);
        for k in 0..width {
            let column = pose.clone().skip(k).step_by(width);
            let mean = column.clone().map(|n| field.weights[n]).sum::<f32>() / knots;
            for n in column {
                field.weights[n] -= mean;
            }
            field.weights[rig + k] += mean;
        }
    }
}

/// One frame, its rendering and what has been found out about it.
struct Registration<'a> {
    view: View,
    camera: &'a Camera,
    grey: Grey,
    points: Vec<Point>,
    unknowns: [f64; UNKNOWNS],
    /// What of the refinement all frames share.
    rig: [f64; 6],
    start: f64,
    last: f64,
}

/// A rendered point.
struct Point {
    /// In given camera axes from the refined camera centre, units.
    position: DVec3,
    /// Luminance of the rendering, 0–1.
    grey: f64,
}

/// Normal equations of one frame: its own unknowns, the shared lens and their coupling.
struct System {
    own: [[f64; UNKNOWNS]; UNKNOWNS],
    right: [f64; UNKNOWNS],
    coupling: [[f64; UNKNOWNS]; SHARED],
    shared: [[f64; SHARED]; SHARED],
    shared_right: [f64; SHARED],
    /// Mean size of the residuals, outliers cut off.
    cost: f64,
}

impl<'a> Registration<'a> {
    fn new(model: &Model, pixels: &'a PixelSet, n: usize, sampling: &Sampling) -> Self {
        let field = model.field;
        let frame = &pixels.frames[n];
        let camera = &frame.camera;
        let view = View::new(field, frame);
        let area = f64::from(camera.width) * f64::from(camera.height);
        let stride = (area / PIXELS).sqrt().ceil().max(1.0) as u32;
        let image = render(model, frame, sampling, stride);
        let directions = pixels.directions(n);
        let scale = field.normalisation.scale;
        let points = (0..image.depth.len())
            .filter_map(|k| {
                let (x, y) = (k as u32 % image.width * stride, k as u32 / image.width * stride);
                let pixel = y * camera.width + x;
                let depth = f64::from(image.depth[k]) / scale;
                if depth <= 0.0 || !pixels.is_usable(n, pixel) {
                    return None;
                }
                let ray = view.ray(directions[pixel as usize], field.normalisation.extent, field.near);
                let along = ray.refined_cam.as_dvec3();
                Some(Point { position: along * (depth / along.z), grey: luminance(image.rgb[k]) })
            })
            .collect();
        Self {
            view,
            camera,
            grey: Grey::new(&pixels.images[n], camera),
            points,
            unknowns: [0.0; UNKNOWNS],
            rig: std::array::from_fn(|k| f64::from(field.weights[field.layout.rig.start + k])),
            start: f64::INFINITY,
            last: f64::INFINITY,
        }
    }

    /// Where the frame's image shows a point if its pose were changed by the unknowns found so far.
    fn project(&self, bend: &Bend, shift: DVec3, point: DVec3) -> Option<(DVec3, DVec2)> {
        let p = bend.undo(point - shift)?;
        Some((p, self.camera.project(p)?))
    }

    fn system(&self, lens: [f64; SHARED]) -> System {
        let u = &self.unknowns;
        let r = &self.view.refinement;
        let turn = DVec3::new(f64::from(r[0]) + u[0], f64::from(r[1]) + u[1], f64::from(r[2]) + u[2]);
        let bend = Bend { turn, lens: std::array::from_fn(|k| f64::from(self.view.lens[k]) + lens[k]) };
        let shift = DVec3::new(u[3], u[4], u[5]);
        let rows: Vec<Row> = self
            .points
            .iter()
            .filter_map(|point| {
                let (p, uv) = self.project(&bend, shift, point.position)?;
                let (value, gradient) = self.grey.at(uv)?;
                let residual = value - ((1.0 + u[6]) * point.grey + u[7]);
                let along_x = gradient.x * self.camera.fx / p.z;
                let along_y = gradient.y * self.camera.fy / p.z;
                // d(image value) = g · dp, dp = −shift' − turn' × p − zoom' (x, y, 0).
                let g = DVec3::new(along_x, along_y, -(along_x * p.x + along_y * p.y) / p.z);
                let by_turn = g.cross(p);
                Some(Row {
                    residual,
                    by: [by_turn.x, by_turn.y, by_turn.z, -g.x, -g.y, -g.z, -point.grey, -1.0],
                    by_lens: [1.0, off_axis(p)].map(|r| -r * (g.x * p.x + g.y * p.y)),
                })
            })
            .collect();
        let moved = std::array::from_fn(|k| u[k] + f64::from(r[k]) - self.rig[k]);
        System::new(&rows, &moved, u)
    }

    fn step(&mut self, system: &System, lens: [f64; SHARED]) {
        if self.start.is_infinite() {
            self.start = system.cost;
        }
        self.last = system.cost;
        let through = |k: usize| (0..SHARED).map(|j| system.coupling[j][k] * lens[j]).sum::<f64>();
        let right = std::array::from_fn(|k| system.right[k] - through(k));
        let Some(step) = solve(&system.own, right) else { return };
        for (u, s) in self.unknowns.iter_mut().zip(step) {
            *u += s;
        }
    }

    /// The change of pose, if it is believable and the image fits better with it.
    fn accepted(&self) -> Option<[f64; 6]> {
        let delta: [f64; 6] = std::array::from_fn(|k| self.unknowns[k]);
        let small = delta.iter().all(|d| d.is_finite() && d.abs() <= LARGEST);
        (small && self.last <= WORTH_IT * self.start).then_some(delta)
    }
}

/// How refinement changes a pixel's direction v: v + turn × v + (lens₀ + lens₁ r²) (v_x, v_y, 0).
struct Bend {
    turn: DVec3,
    lens: [f64; SHARED],
}

impl Bend {
    /// The direction that the refinement turns into `p`; `None` where there is none in front of the camera.
    fn undo(&self, p: DVec3) -> Option<DVec3> {
        let t = self.turn;
        let skew = DMat3::from_cols(t.cross(DVec3::X), t.cross(DVec3::Y), t.cross(DVec3::Z));
        let mut v = p;
        // r² changes little by what is undone: the second round is exact to 1e-6 for any lens of a camera.
        for _ in 0..3 {
            let zoom = self.lens[0] + self.lens[1] * off_axis(v);
            v = (DMat3::IDENTITY + skew + DMat3::from_diagonal(DVec3::new(zoom, zoom, 0.0))).inverse() * p;
        }
        (v.is_finite() && v.z > 0.0).then_some(v)
    }
}

/// Squared distance from the optical axis in the plane at depth 1.
fn off_axis(p: DVec3) -> f64 {
    (p.x * p.x + p.y * p.y) / (p.z * p.z)
}

/// One pixel's equation.
struct Row {
    residual: f64,
    by: [f64; UNKNOWNS],
    by_lens: [f64; SHARED],
}

impl System {
    /// Huber-weighted normal equations in units of the residuals' own spread.
    fn new(rows: &[Row], moved: &[f64; 6], unknowns: &[f64; UNKNOWNS]) -> Self {
        let mut sizes: Vec<f64> = rows.iter().map(|r| r.residual.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let spread = sizes.get(sizes.len() / 2).map_or(1.0, |m| (1.4826 * m).max(1e-3));
        let mut s = Self {
            own: [[0.0; UNKNOWNS]; UNKNOWNS],
            right: [0.0; UNKNOWNS],
            coupling: [[0.0; UNKNOWNS]; SHARED],
            shared: [[0.0; SHARED]; SHARED],
            shared_right: [0.0; SHARED],
            cost: rows.iter().map(|r| r.residual.abs().min(OUTLIER)).sum::<f64>() / rows.len().max(1) as f64,
        };
        for row in rows {
            let weight = (1.5 * spread / row.residual.abs().max(1e-12)).min(1.0) / (spread * spread);
            for i in 0..UNKNOWNS {
                for j in 0..UNKNOWNS {
                    s.own[i][j] += weight * row.by[i] * row.by[j];
                }
                s.right[i] -= weight * row.by[i] * row.residual;
                (0..SHARED).for_each(|j| s.coupling[j][i] += weight * row.by[i] * row.by_lens[j]);
            }
            for i in 0..SHARED {
                (0..SHARED).for_each(|j| s.shared[i][j] += weight * row.by_lens[i] * row.by_lens[j]);
                s.shared_right[i] -= weight * row.by_lens[i] * row.residual;
            }
        }
        for k in 0..6 {
            let prior = PRIOR * s.own[k][k] + 1e-6;
            s.own[k][k] += prior;
            s.right[k] -= prior * moved[k];
        }
        s.own[6][6] += 1.0 / (0.2 * 0.2);
        s.own[7][7] += 1.0 / (0.1 * 0.1);
        s.right[6] -= unknowns[6] / (0.2 * 0.2);
        s.right[7] -= unknowns[7] / (0.1 * 0.1);
        s
    }
}

/// The change of the lens that suits all frames (Schur complement of their own unknowns); `total` is what it is by now.
fn solve_shared(systems: &[System], total: [f64; SHARED]) -> [f64; SHARED] {
    let (mut h, mut b) = ([[0.0; SHARED]; SHARED], [0.0; SHARED]);
    for k in 0..SHARED {
        let prior = LENS_PRIOR[k] * systems.iter().map(|s| s.shared[k][k]).sum::<f64>();
        (h[k][k], b[k]) = (prior, -prior * total[k]);
    }
    for s in systems {
        let Some(own) = solve(&s.own, s.right) else { continue };
        for i in 0..SHARED {
            let Some(through) = solve(&s.own, s.coupling[i]) else { continue };
            for j in 0..SHARED {
                h[i][j] += s.shared[i][j] - dot(&s.coupling[j], &through);
            }
            b[i] += s.shared_right[i] - dot(&s.coupling[i], &own);
        }
    }
    solve(&h, b).unwrap_or_default()
}

fn dot(a: &[f64; UNKNOWNS], b: &[f64; UNKNOWNS]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Solves a symmetric positive definite system by Cholesky's method; `None` if it is not.
fn solve<const N: usize>(matrix: &[[f64; N]; N], right: [f64; N]) -> Option<[f64; N]> {
    let mut l = [[0.0; N]; N];
    for i in 0..N {
        for j in 0..=i {
            let sum = matrix[i][j] - (0..j).map(|k| l[i][k] * l[j][k]).sum::<f64>();
            if i == j {
                if sum.is_nan() || sum <= 0.0 {
                    return None;
                }
                l[i][i] = sum.sqrt();
            } else {
                l[i][j] = sum / l[j][j];
            }
        }
    }
    let mut x = right;
    for i in 0..N {
        x[i] = (x[i] - (0..i).map(|k| l[i][k] * x[k]).sum::<f64>()) / l[i][i];
    }
    for i in (0..N).rev() {
        x[i] = (x[i] - (i + 1..N).map(|k| l[k][i] * x[k]).sum::<f64>()) / l[i][i];
    }
    Some(x)
}

fn luminance([r, g, b]: [f32; 3]) -> f64 {
    f64::from(0.299 * r + 0.587 * g + 0.114 * b)
}

/// A slightly blurred luminance image: its slope then reaches as far as poses are off.
struct Grey {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Grey {
    fn new(rgb: &[[u8; 3]], camera: &Camera) -> Self {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let values: Vec<f32> =
            rgb.iter().map(|c| luminance(c.map(|v| f32::from(v) / 255.0)) as f32).collect();
        let blur = |values: &[f32], step: usize, length: usize, position: &dyn Fn(usize) -> usize| {
            (0..values.len())
                .map(|n| {
                    let at = position(n);
                    let before = if at > 0 { values[n - step] } else { values[n] };
                    let after = if at + 1 < length { values[n + step] } else { values[n] };
                    0.25 * before + 0.5 * values[n] + 0.25 * after
                })
                .collect::<Vec<f32>>()
        };
        let mut values = values;
        for _ in 0..2 {
            values = blur(&values, 1, width, &|n| n % width);
            values = blur(&values, width, height, &|n| n / width);
        }
        Self { width, height, values }
    }

    /// Value and slope (per px) at an image point; `None` near the border and outside.
    fn at(&self, uv: DVec2) -> Option<(f64, DVec2)> {
        let p = uv - 0.5;
        let inside =
            p.x >= 1.0 && p.y >= 1.0 && p.x < self.width as f64 - 2.0 && p.y < self.height as f64 - 2.0;
        if !inside {
            return None;
        }
        let (x, y) = (p.x as usize, p.y as usize);
        let (fx, fy) = (p.x - x as f64, p.y - y as f64);
        let v = |dx: usize, dy: usize| f64::from(self.values[(y + dy - 1) * self.width + x + dx - 1]);
        // Bilinear mix of the value and of central differences.
        let mix = |of: &dyn Fn(usize, usize) -> f64| {
            let top = of(1, 1) + (of(2, 1) - of(1, 1)) * fx;
            let bottom = of(1, 2) + (of(2, 2) - of(1, 2)) * fx;
            top + (bottom - top) * fy
        };
        let value = mix(&|i, j| v(i, j));
        let dx = mix(&|i, j| 0.5 * (v(i + 1, j) - v(i - 1, j)));
        let dy = mix(&|i, j| 0.5 * (v(i, j + 1) - v(i, j - 1)));
        Some((value, DVec2::new(dx, dy)))
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, Mat3, Vec3};

    use super::*;
    use crate::field::codes::Knots;
    use crate::rng::Rng;

    const CAMERA: Camera = Camera {
        width: 96,
        height: 64,
        fx: 80.0,
        fy: 82.0,
        cx: 47.0,
        cy: 33.0,
        distortion: [0.05, -0.02, 0.001, -0.002],
    };

    /// Any smooth picture.
    fn texture(uv: DVec2) -> f64 {
        let wave = |k: f64, phase: f64| (0.11 * k * (uv.x + 0.7 * uv.y) + phase).sin();
        0.5 + 0.15 * wave(1.0, 0.3) + 0.1 * (0.17 * uv.y).cos() + 0.1 * (0.23 * uv.x - 0.05 * uv.y).sin()
    }

    /// A frame whose picture was taken from `turn` and `shift` away from where its pose says; a share of its points
    /// is of something else.
    fn displaced(turn: DVec3, shift: DVec3, outliers: f32) -> Registration<'static> {
        let rgb: Vec<[u8; 3]> = (0..CAMERA.width * CAMERA.height)
            .map(|n| {
                let uv = DVec2::new(f64::from(n % CAMERA.width), f64::from(n / CAMERA.width)) + 0.5;
                [(255.0 * texture(uv)).round() as u8; 3]
            })
            .collect();
        let mut rng = Rng::new(1, 2, 3);
        let to_camera = DMat3::from_quat(DQuat::from_scaled_axis(turn)).transpose();
        let points = (0..900)
            .filter_map(|_| {
                let uv = DVec2::new(96.0 * f64::from(rng.uniform()), 64.0 * f64::from(rng.uniform()));
                let position = CAMERA.unproject(uv) * (0.2 + 0.5 * f64::from(rng.uniform()));
                let seen_at = CAMERA.project(to_camera * (position - shift))?;
                let wrong = rng.uniform() < outliers;
                let grey = if wrong { f64::from(rng.uniform()) } else { texture(seen_at) };
                Some(Point { position, grey })
            })
            .collect();
        let knots = Knots { a: (0, 1.0), b: (0, 0.0) };
        let view = View {
            centre: Vec3::ZERO,
            rotation: Mat3::IDENTITY,
            refinement: [0.0; 6],
            lens: [0.0; 2],
            knots,
            time: 0.0,
            code_knots: [None; 3],
        };
        let grey = Grey::new(&rgb, &CAMERA);
        let (start, last) = (f64::INFINITY, f64::INFINITY);
        Registration {
            view,
            camera: &CAMERA,
            grey,
            points,
            unknowns: [0.0; UNKNOWNS],
            rig: [0.0; 6],
            start,
            last,
        }
    }

    fn register(mut frame: Registration) -> Option<[f64; 6]> {
        for _ in 0..ITERATIONS {
            let system = frame.system([0.0; 2]);
            frame.step(&system, [0.0; 2]);
        }
        frame.accepted()
    }

    #[test]
    fn a_displaced_frame_finds_its_place_but_for_what_the_prior_holds_back() {
        let (turn, shift) = (DVec3::new(0.012, -0.008, 0.01), DVec3::new(0.004, -0.006, 0.005));
        for outliers in [0.0, 0.15] {
            let found = register(displaced(turn, shift, outliers)).expect("the picture fits better");
            // What a point at the typical distance moves by in the picture counts, not each number: turning
            // right and stepping right look alike.
            for corner in [DVec2::new(10.0, 10.0), DVec2::new(90.0, 20.0), DVec2::new(40.0, 60.0)] {
                let p = CAMERA.unproject(corner) * 0.45;
                let moved = |turn: DVec3, shift: DVec3| {
                    let q = DMat3::from_quat(DQuat::from_scaled_axis(turn)).transpose() * (p - shift);
                    CAMERA.project(q).expect("in front of the camera")
                };
                let [a, b, c, d, e, f] = found;
                let found = moved(DVec3::new(a, b, c), DVec3::new(d, e, f));
                let (truth, before) = (moved(turn, shift), CAMERA.project(p).expect("in front"));
                let (left, whole) = (found.distance(truth), before.distance(truth));
                assert!(left < 0.4 * whole, "{outliers}: {left} px of {whole} px are left");
            }
        }
    }

    #[test]
    fn a_frame_that_is_where_it_belongs_stays() {
        let moved = register(displaced(DVec3::ZERO, DVec3::ZERO, 0.1)).unwrap_or_default();
        assert!(moved.iter().all(|m| m.abs() < 3e-4), "{moved:?}");
    }

    #[test]
    fn frames_that_see_nothing_stay_and_do_not_break_the_others() {
        let mut blind = displaced(DVec3::ZERO, DVec3::ZERO, 0.0);
        blind.points.clear();
        let systems = [blind.system([0.0; 2]), displaced(DVec3::ZERO, DVec3::ZERO, 0.0).system([0.0; 2])];
        assert!(solve_shared(&systems, [0.0; 2]).iter().all(|l| l.abs() < 1e-3));
        assert!(register(blind).is_none_or(|moved| moved == [0.0; 6]));
    }

    #[test]
    fn another_lens_is_found() {
        for truth in [[0.02, 0.0], [0.01, 0.05]] {
            let mut frame = displaced(DVec3::ZERO, DVec3::ZERO, 0.0);
            for p in &mut frame.points {
                // Directions were stretched by too little.
                let zoom = 1.0 + truth[0] + truth[1] * off_axis(p.position);
                p.position *= DVec3::new(zoom, zoom, 1.0);
            }
            let mut lens = [0.0; SHARED];
            for _ in 0..ITERATIONS {
                let system = frame.system(lens);
                let step = solve_shared(std::slice::from_ref(&system), lens);
                (0..SHARED).for_each(|k| lens[k] += step[k]);
                frame.step(&system, step);
            }
            let off = |r2: f64| lens[0] - truth[0] + (lens[1] - truth[1]) * r2;
            assert!(off(0.1).abs() < 0.006 && off(0.3).abs() < 0.006, "{lens:?} is not {truth:?}");
        }
    }
}
