//! Forward pass and loss of one chunk in plain f64 loops, written from the equations (docs/method.md) and not from the
//! kernels.
//!
//! Taken over from the f32 pass as constants: the distances and lengths of the intervals, which samples each stream was
//! evaluated at, and the viewing directions. Those are the constants of the gradient, too.

use glam::{DMat3, DVec2, DVec3};

use crate::field::codes::Trajectory;
use crate::field::encoding::Level;
use crate::field::hashgrid::{AXES, FEATURES, Lattice};
use crate::field::mlp::Mlp;
use crate::field::stream::BETA_MAX;
use crate::field::{FAST_CHANGE, Field, VIEW};
use crate::render::composite::RayLayout;
use crate::render::forward::{Chunk, RayInput};
use crate::render::rays::View;
use crate::train::loss::flatness::{self, Bend};
use crate::train::loss::{FAR_OFF, LossConfig, RayTarget, STEREO_ERROR};
use crate::train::moving::Volume;

/// Everything that is learned, in f64.
#[derive(Clone)]
pub struct Numbers {
    /// `[stream][level][row * FEATURES + feature]`.
    pub tables: [Vec<Vec<f64>>; 3],
    /// By the field's layout.
    pub weights: Vec<f64>,
}

impl Numbers {
    /// The field's numbers.
    pub fn of(field: &Field) -> Self {
        let wide = |t: &Vec<_>| bytemuck::cast_slice::<_, f32>(t).iter().map(|v| f64::from(*v)).collect();
        Self {
            tables: field.tables.each_ref().map(|levels| levels.iter().map(wide).collect()),
            weights: field.weights.iter().map(|w| f64::from(*w)).collect(),
        }
    }
}

/// A traced chunk whose loss is asked for as a function of the field's numbers.
pub struct Reference<'a> {
    pub field: &'a Field,
    pub views: &'a [View],
    pub times: &'a [f32],
    pub chunk: &'a Chunk,
    pub inputs: &'a [RayInput],
    pub targets: &'a [RayTarget],
    pub bends: &'a [Bend],
    pub moving: &'a Volume,
    pub config: &'a LossConfig,
}

#[derive(Clone, Copy, Default)]
struct Sample {
    sigma: f64,
    rgb: [f64; 3],
    beta: f64,
}

impl Reference<'_> {
    /// Mean loss of the rays.
    pub fn loss(&self, x: &Numbers) -> f64 {
        let mut samples = vec![[Sample::default(); 3]; self.layout().len()];
        for s in 0..3 {
            for &k in &self.chunk.batches[s].sample {
                samples[k as usize][s] = self.evaluate(s, k as usize, x);
            }
        }
        let rays = self.inputs.len();
        let mut sum = 0.0;
        let mut disparity = vec![0.0; rays];
        for r in 0..rays {
            sum += self.ray_loss(r, &samples, x, &mut disparity[r]);
        }
        (sum + self.bend_loss(&disparity)) / rays as f64
    }

    fn layout(&self) -> RayLayout {
        self.chunk.intervals.layout
    }

    fn bend_loss(&self, disparity: &[f64]) -> f64 {
        let constant = flatness::disparities(pulp::Scalar::new(), self.chunk);
        let price = |bend: &Bend| {
            let [a, b, c] = bend.rays.map(|r| disparity[r]);
            let level = flatness::level(bend.rays.map(|r| constant[r]));
            let [small, large] = [flatness::SMALL, flatness::LARGE].map(f64::from);
            let size = ((a - 2.0 * b + c) / f64::from(level)).hypot(small);
            f64::from(bend.weight) * (size - small) / (size + large)
        };
        f64::from(self.config.flatness) * self.bends.iter().map(price).sum::<f64>()
    }

    fn ray_loss(&self, r: usize, samples: &[[Sample; 3]], x: &Numbers, disparity: &mut f64) -> f64 {
        let c = self.config;
        let mut light = 1.0;
        let mut weights = Vec::new();
        let (mut rgb, mut beta, mut transient, mut entropy) = ([0.0; 3], f64::from(c.beta_min), 0.0, 0.0);
        let (mut price, mut cover) = (0.0, [0.0; 3]);
        for k in self.layout().of_ray(r) {
            let (i, sample) = (self.chunk.intervals.at(k), &samples[k]);
            let delta = f64::from(i.delta);
            let sum: f64 = sample.iter().map(|s| s.sigma).sum();
            let prices = c.prices(
                self.moving.contains(&self.chunk.rays[r].ray.at(i.t).to_array().map(|x| [x])) == [true],
            );
            let alpha = 1.0 - (-sum * delta).exp();
            let mut total = 0.0;
            for (s, sample) in sample.iter().enumerate() {
                let w = if sum > 0.0 { light * alpha * sample.sigma / sum } else { 0.0 };
                total += w;
                for (o, v) in rgb.iter_mut().zip(sample.rgb) {
                    *o += w * v;
                }
                if s > 0 {
                    beta += w * sample.beta;
                    transient += sample.sigma * delta;
                }
                price += f64::from(prices[s]) * w;
                cover[s] += w;
            }
            let (t, depth) = (f64::from(i.t), f64::from(self.targets[r].depth));
            if depth > 0.0 {
                let [free, whole] = [STEREO_ERROR, FAR_OFF].map(f64::from);
                let wrong = (((t - depth).abs() / depth - free) / (whole - free)).clamp(0.0, 1.0);
                price += f64::from(c.depth) * wrong * total;
            }
            *disparity += total / (t.max(1e-6) * f64::from(self.chunk.rays[r].ray.refined_cam.z));
            entropy += light * alpha * (1.0 - alpha);
            weights.push((total, f64::from(i.t), delta));
            light *= 1.0 - alpha;
        }
        let exposure = self.trajectory(&self.field.exposure, &self.field.layout.exposure, r, x);
        let target = &self.targets[r];
        let squared: f64 = (0..3)
            .map(|k| {
                let raw = rgb[k] + light * f64::from(target.background[k]);
                (exposure[k].exp() * raw + exposure[3 + k] - f64::from(target.rgb[k])).powi(2)
            })
            .sum();
        let mut distortion = 0.0;
        for (w, t, delta) in &weights {
            distortion += w * w * delta / 3.0;
            distortion += weights.iter().map(|(v, u, _)| w * v * (t - u).abs()).sum::<f64>();
        }
        0.5 * squared / (beta * beta)
            + beta.ln()
            + price
            + f64::from(c.veil) * cover[1..].iter().map(|a| a * (1.0 - a)).sum::<f64>()
            + f64::from(c.transient) * transient
            + f64::from(c.distortion) * distortion
            + f64::from(c.entropy) * entropy
            + f64::from(c.exposure) * 0.5 * exposure.iter().map(|e| e * e).sum::<f64>()
    }

    fn evaluate(&self, s: usize, k: usize, x: &Numbers) -> Sample {
        let field = self.field;
        let net = field.nets[s].as_ref().expect("only streams that exist are evaluated");
        let ranges = &field.layout.streams[s];
        let r = self.layout().ray(k);
        let p = self.position(s, k, x);
        let mut input = Vec::new();
        let extent = if s == 2 { DVec3::ONE } else { field.normalisation.extent.as_dvec3() };
        let time = f64::from(self.views[self.inputs[r].view as usize].time);
        let (p, extent) = ([p.x, p.y, p.z, time], [extent.x, extent.y, extent.z, 1.0]);
        for (level, table) in net.encoding.levels.iter().zip(&x.tables[s]) {
            input.extend(features(level, table, p, extent));
        }
        if let Some(code) = &field.codes[s] {
            input.extend(self.trajectory(code, &ranges.code, r, x));
        }
        let geometry = network(&net.trunk, &x.weights[ranges.trunk.clone()], input);
        let mut input = geometry.clone();
        if net.view > 0 {
            input.extend(harmonics(self.chunk.rays[r].ray.dir.as_dvec3().normalize()));
        }
        let out = network(&net.head, &x.weights[ranges.head.clone()], input);
        Sample {
            sigma: (geometry[0] + f64::from(net.density_bias)).exp(),
            rgb: [0, 1, 2].map(|c| 1.0 / (1.0 + (-out[c]).exp())),
            beta: f64::from(BETA_MAX) / (1.0 + (-out[3]).exp()),
        }
    }

    /// World (persistent, dynamic) or frustum (actor) coordinates of sample `k`.
    fn position(&self, s: usize, k: usize, x: &Numbers) -> DVec3 {
        let field = self.field;
        let r = self.layout().ray(k);
        let input = &self.inputs[r];
        let t = f64::from(self.chunk.intervals.t[k]);
        let dir = input.dir_cam.as_dvec3();
        if s == 2 {
            let (near, far) = (0.5 * f64::from(field.near), f64::from(field.actor_far));
            let inverse = |z: f64| (1.0 / near - 1.0 / z) / (1.0 / near - 1.0 / far);
            let uv: DVec2 = input.uv.as_dvec2();
            return uv.extend(inverse(t * dir.z).clamp(0.0, 1.0));
        }
        let view = &self.views[input.view as usize];
        let rig = &x.weights[field.layout.rig.clone()];
        let mut pose = self.trajectory(&field.pose, &field.layout.pose, r, x);
        for (p, shared) in pose.iter_mut().zip(rig) {
            *p += shared;
        }
        let zoom = 1.0 + rig[6] + rig[7] * (dir.x * dir.x + dir.y * dir.y) / (dir.z * dir.z);
        let zoomed = DVec3::new(dir.x * zoom, dir.y * zoom, dir.z);
        let turn = DVec3::new(pose[0], pose[1], pose[2]).cross(dir);
        let axes: DMat3 = view.rotation.as_dmat3();
        view.centre.as_dvec3() + axes * DVec3::new(pose[3], pose[4], pose[5]) + axes * (zoomed + turn) * t
    }

    /// z(t) = B(t) Γ for ray `r`, with B the hat functions, constant outside the knots.
    fn trajectory(&self, of: &Trajectory, at: &std::ops::Range<usize>, r: usize, x: &Numbers) -> Vec<f64> {
        let knots: Vec<f64> = of.knots.iter().map(|k| f64::from(*k)).collect();
        let time =
            f64::from(self.times[self.inputs[r].view as usize]).clamp(knots[0], knots[knots.len() - 1]);
        let mut out = vec![0.0; of.width];
        for (k, row) in x.weights[at.clone()].chunks_exact(of.width).enumerate() {
            let rise = if k > 0 { (time - knots[k - 1]) / (knots[k] - knots[k - 1]) } else { 1.0 };
            let fall =
                if k + 1 < knots.len() { (knots[k + 1] - time) / (knots[k + 1] - knots[k]) } else { 1.0 };
            let hat = rise.min(fall).clamp(0.0, 1.0);
            for (o, v) in out.iter_mut().zip(row) {
                *o += hat * v;
            }
        }
        out
    }
}

/// The features of one level.
fn features(level: &Level, table: &[f64], p: [f64; AXES], extent: [f64; AXES]) -> [f64; FEATURES] {
    match *level {
        Level::Lattice(ref lattice) => interpolate(lattice, table, p, extent),
        Level::Position => [p[0], p[1], p[2], 0.0],
        Level::Waves { axis, half_turns } => {
            let angle = f64::from(half_turns) * std::f64::consts::PI * p[axis];
            [angle.sin(), angle.cos(), (2.0 * angle).sin(), (2.0 * angle).cos()]
        }
    }
}

/// Trilinear interpolation of one level's rows.
fn interpolate(level: &Lattice, table: &[f64], p: [f64; AXES], extent: [f64; AXES]) -> [f64; FEATURES] {
    let scale = [level.scale.x, level.scale.y, level.scale.z, level.time_scale];
    let (mut cell, mut frac, mut points) = ([0u64; AXES], [0.0; AXES], [1u64; AXES]);
    for axis in (0..AXES).filter(|&a| scale[a] > 0.0) {
        // The lattice is laid out in f32.
        let cells = (extent[axis] as f32 * scale[axis]).ceil().max(1.0) as u64;
        let q = p[axis] * f64::from(scale[axis]);
        cell[axis] = (q.floor().max(0.0) as u64).min(cells - 1);
        frac[axis] = (q - cell[axis] as f64).clamp(0.0, 1.0);
        points[axis] = cells + 1;
    }
    let mut out = [0.0; FEATURES];
    for corner in 0..16u64 {
        let step: [u64; AXES] = std::array::from_fn(|a| corner >> a & 1);
        let at: [u64; AXES] = std::array::from_fn(|a| cell[a] + step[a]);
        let row = if level.dense {
            at[0] + points[0] * (at[1] + points[1] * (at[2] + points[2] * at[3]))
        } else {
            // Instant-ngp's hash with a prime for time, modulo a power of two.
            let hash = at[0] ^ (at[1] * 2_654_435_761) ^ (at[2] * 805_459_861) ^ (at[3] * 3_674_653_429);
            hash % level.rows as u64
        };
        let weight: f64 = (0..AXES).map(|a| if step[a] == 1 { frac[a] } else { 1.0 - frac[a] }).product();
        if weight == 0.0 {
            continue;
        }
        for (o, v) in out.iter_mut().zip(&table[row as usize * FEATURES..]) {
            *o += weight * v;
        }
    }
    out
}

/// A fully connected network with ReLU between its layers; a short input is padded with zeros, and follows what a layer
/// gets where that takes more.
pub fn network(net: &Mlp, params: &[f64], mut input: Vec<f64>) -> Vec<f64> {
    input.resize(net.input(), 0.0);
    let mut x = input.clone();
    let mut rest = params;
    let layers: Vec<[usize; 2]> = net.shapes().collect();
    for (n, &[n_in, n_out]) in layers.iter().enumerate() {
        if x.len() < n_in {
            x.extend_from_slice(&input);
        }
        assert_eq!(x.len(), n_in);
        let (weights, after) = rest.split_at(n_in * n_out);
        let (bias, after) = after.split_at(n_out);
        rest = after;
        let row = |o: usize| weights[o * n_in..][..n_in].iter().zip(&x).map(|(a, b)| a * b).sum::<f64>();
        let y: Vec<f64> = (0..n_out).map(|o| row(o) + bias[o]).collect();
        let last = n + 1 == layers.len();
        x = if last { y } else { y.into_iter().map(|v| v.max(0.0)).collect() };
    }
    x
}

/// Real spherical harmonics of degree 1 to 4 by their definition: associated Legendre functions of the polar angle times
/// sines and cosines of the azimuth, from order −l to l, without the Condon–Shortley sign; times their share.
fn harmonics(d: DVec3) -> [f64; VIEW] {
    let azimuth = d.y.atan2(d.x);
    let mut out = [0.0; VIEW];
    let mut n = 0;
    for l in 1..=4i32 {
        for m in -l..=l {
            let order = m.abs();
            let factorial = |k: i32| (1..=k).map(f64::from).product::<f64>();
            let norm = f64::from(2 * l + 1) / (4.0 * std::f64::consts::PI) * factorial(l - order)
                / factorial(l + order);
            let turn = match m {
                0 => 1.0,
                _ if m > 0 => std::f64::consts::SQRT_2 * (f64::from(order) * azimuth).cos(),
                _ => std::f64::consts::SQRT_2 * (f64::from(order) * azimuth).sin(),
            };
            let share = if l > 2 { f64::from(FAST_CHANGE[l as usize - 3]) } else { 1.0 };
            out[n] = share * norm.sqrt() * legendre(l, order, d.z) * turn;
            n += 1;
        }
    }
    out
}

/// The associated Legendre function of degree `l` and order `m`, by recurrence in the degree.
fn legendre(l: i32, m: i32, z: f64) -> f64 {
    let odd = (1..=m).map(|k| f64::from(2 * k - 1)).product::<f64>();
    let (mut below, mut value) = (0.0, odd * (1.0 - z * z).max(0.0).sqrt().powi(m));
    for k in m + 1..=l {
        let next = (f64::from(2 * k - 1) * z * value - f64::from(k + m - 1) * below) / f64::from(k - m);
        (below, value) = (value, next);
    }
    value
}
