//! How features pull at geometry: against differences of an f64 loss, and what they make of two surfaces on a ray.

use glam::Vec3;
use half::f16;

use super::*;
use crate::field::mlp::Precision;
use crate::field::{Field, Stream};
use crate::render::forward::{Grids, Model, RayInput, Tracer};
use crate::render::rays::{View, pixel_directions};
use crate::render::sampler::Sampling;
use crate::scene::Frame;
use crate::semantics::SemanticsConfig;
use crate::semantics::head::HeadShape;
use crate::semantics::head::step::Bags;
use crate::train::testing;

const WIDTH: usize = 4;
const SAMPLES: usize = 10;

/// Rays of one camera through a field whose numbers are all random.
fn traced(frame: &Frame) -> (Field, Chunk) {
    let config = testing::config();
    let mut field = Field::zeros(testing::shape(&config));
    field.init(3);
    let mut rng = Rng::new(3, 1, 0);
    for row in field.tables.iter_mut().flatten().flatten() {
        *row = crate::field::hashgrid::Row::from_array(std::array::from_fn(|_| 2.0 * rng.uniform() - 1.0));
    }
    let mut grids = Grids::new(&field, 16.0);
    grids.threshold = [0.0; 3];
    let directions = pixel_directions(&frame.camera);
    let inputs: Vec<RayInput> = (0..CHUNK_RAYS)
        .map(|n| {
            let pixel = 2 * n + 40;
            let [x, y] = [pixel as u32 % frame.camera.width, pixel as u32 / frame.camera.width];
            let uv = glam::Vec2::new(x as f32 + 0.5, y as f32 + 0.5)
                / glam::Vec2::new(frame.camera.width as f32, frame.camera.height as f32);
            RayInput { view: 0, dir_cam: directions[pixel], uv, jitter: 0.5 }
        })
        .collect();
    let sampling = Sampling { count: SAMPLES, step: 1.0 / 16.0, explore: 0.5, sharpness: 1.0 };
    let mut chunk = Chunk::default();
    let (model, views) = (Model::new(&field, &grids, [true; 3]), [View::new(&field, frame)]);
    pulp::Arch::new().dispatch(TraceAll {
        chunk: &mut chunk,
        model: &model,
        views: &views,
        inputs,
        sampling,
    });
    (field, chunk)
}

struct TraceAll<'a> {
    chunk: &'a mut Chunk,
    model: &'a Model<'a>,
    views: &'a [View],
    inputs: Vec<RayInput>,
    sampling: Sampling,
}

impl WithSimd for TraceAll<'_> {
    type Output = ();

    fn with_simd<S: Simd>(self, simd: S) {
        let Self { chunk, model, views, inputs, sampling } = self;
        chunk.forward(simd, &mut Tracer::default(), model, views, &inputs, &sampling);
    }
}

fn heads(field: &Field) -> Heads {
    let mut heads = Heads::zeros(HeadShape::new(&SemanticsConfig::default(), &field.shape, 6, WIDTH, 0));
    heads.init(5);
    let mut rng = Rng::new(8, 1, 0);
    for row in heads.tables.iter_mut().flatten().flatten() {
        *row = crate::field::hashgrid::Row::from_array(std::array::from_fn(|_| 2.0 * rng.uniform() - 1.0));
    }
    heads
}

fn targets(bagged: bool) -> RayTargets {
    let mut rng = Rng::new(6, 1, 0);
    let mut value = || (0..WIDTH).map(|_| rng.uniform() - 0.5).collect::<Vec<_>>();
    let mut bags = Bags::default();
    if bagged {
        bags.push(0..CHUNK_RAYS as u32, &value());
    }
    RayTargets {
        width: WIDTH,
        dim: WIDTH,
        values: (0..CHUNK_RAYS).flat_map(|_| value()).map(f16::from_f32).collect(),
        weights: vec![[if bagged { 0.0 } else { 1.0 }, 0.0]; CHUNK_RAYS],
        usable: (0..CHUNK_RAYS as u32).collect(),
        times: vec![0.0; CHUNK_RAYS],
        bags,
        pyramid: None,
    }
}

/// What the features ask of the weights of all samples, and the loss that they say.
fn asked(heads: &Heads, targets: &RayTargets, traced: &Chunk) -> (Vec<[f32; 3]>, f64) {
    let mut weight = vec![[0.0; 3]; traced.intervals.layout.len()];
    let bags = (0..targets.bags.len() as u32).collect();
    let mut group = Group::of(targets.usable.clone(), bags);
    let model = &HeadModel::new(heads, Precision::F32);
    let plan = &JointPlan { chunks: 1, samples: 3 * SAMPLES, weight: 1.0 };
    pulp::Arch::new().dispatch(AskPass {
        group: &mut group,
        model,
        targets,
        plan,
        traced,
        weight: &mut weight,
    });
    (weight, group.loss / CHUNK_RAYS as f64)
}

/// A sample's ray, number, stream and feature.
type Lit = (usize, usize, usize, Vec<f32>);

fn features(heads: &Heads, traced: &Chunk) -> Vec<Lit> {
    let model = HeadModel::new(heads, Precision::F32);
    let mut lit = Vec::new();
    for (s, batch) in traced.batches.iter().enumerate() {
        let (numbers, points): (Vec<usize>, Vec<Vec3>) = batch.points().unzip();
        let mut out = vec![0.0; points.len() * WIDTH];
        model.features(Stream::ALL[s], &points, 0.0, 0.0, &mut out);
        let samples = numbers.iter().zip(out.chunks_exact(WIDTH));
        lit.extend(samples.map(|(k, f)| (traced.intervals.layout.ray(*k), *k, s, f.to_vec())));
    }
    lit
}

/// The loss in f64, with the weight of sample `k` in stream `s` changed by `by`.
fn loss(lit: &[Lit], traced: &Chunk, targets: &RayTargets, (k, s, by): (usize, usize, f64)) -> f64 {
    let mut rendered = vec![[0.0f64; WIDTH + 1]; CHUNK_RAYS];
    let all: Vec<f64> = (0..CHUNK_RAYS)
        .map(|r| traced.intervals.layout.of_ray(r).map(|n| f64::from(traced.weights.total(n))).sum())
        .collect();
    for (ray, sample, stream, f) in lit {
        let mut w = f64::from(traced.weights.weight[*stream][*sample]);
        // What is next to nothing is left out.
        if w < 0.005 * all[*ray] || all[*ray] < f64::from(DIM) {
            continue;
        }
        if (*sample, *stream) == (k, s) {
            w += by;
        }
        rendered[*ray].iter_mut().zip(f).for_each(|(r, f)| *r += w * f64::from(*f));
        rendered[*ray][WIDTH] += w;
    }
    let mean = |r: &[f64; WIDTH + 1], c: usize| if r[WIDTH] > 0.0 { r[c] / r[WIDTH] } else { 0.0 };
    let mut sum = 0.0;
    for (ray, r) in rendered.iter().enumerate() {
        for c in 0..WIDTH {
            let off = mean(r, c) - f64::from(targets.values[ray * WIDTH + c].to_f32());
            sum += f64::from(targets.weights[ray][0]) * off * off;
        }
    }
    for bag in 0..targets.bags.len() {
        for c in 0..WIDTH {
            let all = rendered.iter().map(|r| mean(r, c)).sum::<f64>() / CHUNK_RAYS as f64;
            let off = all - f64::from(targets.bags.values[bag * WIDTH + c].to_f32());
            sum += CHUNK_RAYS as f64 * off * off;
        }
    }
    sum / CHUNK_RAYS as f64
}

/// Largest deviation from central differences, relative to the largest gradient; `factor` falsifies what was asked.
fn worst(bagged: bool, factor: f64) -> f64 {
    const H: f64 = 1e-4;
    let folder = tempfile::tempdir().unwrap();
    let (field, traced) = traced(&testing::frames(folder.path())[0]);
    let (heads, targets) = (heads(&field), targets(bagged));
    let (weight, said) = asked(&heads, &targets, &traced);
    let lit = features(&heads, &traced);
    let at = |moved| loss(&lit, &traced, &targets, moved);
    let unmoved = at((0, 0, 0.0));
    assert!((said - unmoved).abs() < 1e-4 * unmoved, "{said} {unmoved}");
    let largest = f64::from(weight.iter().flatten().fold(0.0f32, |m, g| m.max(g.abs())));
    assert!(largest > 0.0);
    let kept = lit.iter().filter(|(_, k, s, _)| weight[*k][*s] != 0.0);
    let off = kept.map(|(_, k, s, _)| {
        let difference = (at((*k, *s, H)) - at((*k, *s, -H))) / (2.0 * H);
        (difference - factor * f64::from(weight[*k][*s])).abs() / largest
    });
    off.fold(0.0, f64::max)
}

#[test]
fn what_features_ask_of_weights_is_the_gradient_of_their_loss() {
    for bagged in [false, true] {
        let off = worst(bagged, 1.0);
        assert!(off < 2e-3, "{bagged}: {off}");
    }
}

#[test]
fn the_comparison_notices_one_per_cent() {
    for bagged in [false, true] {
        let off = worst(bagged, 1.01);
        assert!(off > 5e-3, "{bagged}: {off}");
    }
}
