//! Every gradient of a step against central differences of the f64 reference.

use std::ops::Range;

use super::group::TrainChunk;
use super::reference::{Numbers, Reference};
use super::*;
use crate::field::encoding::Level;
use crate::field::hashgrid::{Around, FEATURES, Row};
use crate::field::mlp::Mlp;
use crate::field::{EncodingKind, Stream};
use crate::render::forward::Tracer;
use crate::rng::Rng;
use crate::stereo::StereoDepth;
use crate::train::loss::{ChunkGradient, flatness};
use crate::train::moving::{Evidence, Volume};
use crate::train::testing;

/// Rays of a chunk that are looked at: of many more, some sample is on the other side of a cell's face in f32 than in f64, and
/// has another slope there.
pub(super) const RAYS: usize = 64;

/// Relative tolerance: f32 sums of a few hundred terms, with room for cancellation in them.
const RELATIVE: f64 = 1e-3;

/// Absolute tolerance, as a share of the group's largest gradient.
const ABSOLUTE: f64 = 1e-5;

/// Parameters of each group that are looked at by size, and as many at random.
const LOOKED_AT: usize = 6;

/// One chunk of a step: buffers as the kernels left them, and the gradients.
pub(super) struct Traced {
    pub(super) field: Field,
    pixels: PixelSet,
    config: LossConfig,
    plan: StepPlan,
    chunk: TrainChunk,
    pub(super) loss: f64,
    pub(super) dense: Vec<f32>,
    pub(super) tables: [Vec<Vec<f32>>; 3],
}

/// A parameter.
#[derive(Clone, Copy)]
pub(super) enum Place {
    Table(usize, usize),
    Weights,
}

/// Traces one chunk of a field whose numbers are all random, with holes in its density grids.
pub(super) fn trace(seed: u64) -> Traced {
    trace_with(seed, Setting::default())
}

/// What is traced, and how.
#[derive(Clone)]
struct Setting {
    encoding: EncodingKind,
    precision: Precision,
    faint: f32,
    /// Added to all raw densities.
    denser: f32,
    config: LossConfig,
}

impl Default for Setting {
    fn default() -> Self {
        let (encoding, precision) = (EncodingKind::Hash, Precision::F32);
        Self { encoding, precision, faint: 0.0, denser: 0.0, config: weighed() }
    }
}

/// Weights large enough that one per cent of a term is more than the tolerance.
fn weighed() -> LossConfig {
    LossConfig {
        transient: 1.0,
        veil: 20.0,
        distortion: 40.0,
        entropy: 5.0,
        flatness: 12.0,
        exposure: 100.0,
        ..LossConfig::default()
    }
}

/// Seeds whose chunk looks at every frame, and along an even row.
fn seeds() -> impl Iterator<Item = u64> {
    let sees_all = |seed: &u64| {
        let traced = trace(*seed);
        let sees = |n| traced.chunk.inputs.iter().any(|i| i.view == n);
        let frames = traced.pixels.frames.len() as u32;
        traced.chunk.bends.iter().any(|b| b.weight > 0.2) && (0..frames).all(sees)
    };
    (1..).filter(sees_all)
}

fn trace_with(seed: u64, setting: Setting) -> Traced {
    let Setting { encoding, precision, faint, denser, config } = setting;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut pixels =
        PixelSet::load(testing::frames(folder.path()), 2.0, 0.5).expect("frames that were just written");
    let settings = testing::config_of(encoding);
    let mut field = Field::zeros(testing::shape(&settings));
    field.init(seed);
    let mut rng = Rng::new(seed, 1, 0);
    for row in field.tables.iter_mut().flatten().flatten() {
        *row = Row::from_slice(&testing::noise(&mut rng, FEATURES, 0.5));
    }
    for net in field.nets.iter_mut().flatten() {
        net.density_bias += denser;
    }
    let layout = field.layout.clone();
    let mut shake = |range: Range<usize>, size: f32| {
        let noise = testing::noise(&mut rng, range.len(), size);
        for (w, n) in field.weights[range].iter_mut().zip(noise) {
            *w += n;
        }
    };
    for r in &layout.streams {
        // Biases, too, must not be zero.
        shake(r.trunk.start..r.code.end, 0.1);
    }
    shake(layout.exposure.clone(), 0.1);
    shake(layout.pose.clone(), 0.01);
    shake(layout.rig.clone(), 0.01);
    // In the middle of the box, so that rays end in front of it, within its error and behind it.
    pixels.stereo = pixels.frames.iter().map(|f| StereoDepth::flat(&f.camera, 0.3)).collect();
    // In that plane every other column shows something that moves.
    let cameras = pixels.refined_cameras(&field);
    let evidence = pixels.frames.iter().enumerate().map(|(n, frame)| Evidence {
        frame,
        c2w: cameras[n].1,
        directions: pixels.directions(n),
        depth: &pixels.stereo[n],
        seen_through: (0..pixels.stereo[n].depth.len() as i32).map(|k| 20 * (k % 2)).collect(),
    });
    pixels.moving = Volume::of_depths(field.normalisation.extent, &evidence.collect::<Vec<_>>());
    let mut grids = Grids::new(&field, settings.train.grid_cells);
    for sigma in grids.streams.iter_mut().flat_map(|g| &mut g.sigma) {
        *sigma = if rng.uniform() < 0.2 { 0.0 } else { 0.1 + 4.0 * rng.uniform() };
    }
    grids.threshold = [0.05; 3];
    // Every fourth chunk refines poses: the first one does at a step that is a multiple of four.
    let mut plan = settings.train.plan(settings.field.encoding, 4, 0.5, [true; 3]);
    plan.precision = precision;
    plan.faint = faint;
    // Patches that have rows of three, and as many of them as fit into a chunk.
    plan.patch = 3;
    plan.pose_rate = 1.0;
    plan.rig_rate = 1.0;
    let (chunk, dense, tables) = (TrainChunk::default(), vec![0.0; layout.len], Default::default());
    let mut traced = Traced { field, pixels, config, plan, chunk, loss: 0.0, dense, tables };
    traced.run(&grids, seed);
    traced
}

/// What a group does with one chunk.
struct ChunkPass<'a> {
    context: &'a Context<'a>,
    chunk: &'a mut TrainChunk,
    dense: &'a mut [f32],
}

impl WithSimd for ChunkPass<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let Self { context, chunk, dense } = self;
        let (mut tracer, mut gradient) = (Tracer::default(), ChunkGradient::default());
        chunk.choose_rays(context, 0);
        let TrainChunk { inputs, targets, bends, .. } = &mut *chunk;
        inputs.truncate(RAYS);
        targets.truncate(RAYS);
        flatness::find(inputs, targets, context.plan.patch as usize, bends);
        chunk.place(context, &mut tracer, 0);
        for (s, batch) in chunk.traced.batches.iter_mut().enumerate() {
            let field = context.model.field;
            batch.encode(&field.nets[s].as_ref().expect("all streams are on").encoding, &field.tables[s]);
        }
        let loss = chunk.evaluate(simd, context, &mut tracer, &mut gradient, 0);
        chunk.backward(simd, context, &mut tracer, &gradient, dense);
        group::finish(simd, context, &mut tracer, dense);
        loss.total
    }
}

impl Traced {
    fn run(&mut self, grids: &Grids, seed: u64) {
        let Self { field, pixels, config, plan, chunk, loss, dense, tables } = self;
        let views: Vec<View> = pixels.frames.iter().map(|f| View::new(field, f)).collect();
        let model = Model::with_precision(field, grids, plan.streams, plan.precision);
        let (rays, companion) = (RAYS, None);
        let context = Context { model: &model, pixels, views: &views, config, plan, seed, rays, companion };
        *loss = pulp::Arch::new().dispatch(ChunkPass { context: &context, chunk, dense });
        for s in 0..3 {
            let batch = &chunk.traced.batches[s];
            let levels = field.nets[s].as_ref().expect("all streams are on").encoding.levels.iter();
            tables[s] = levels
                .enumerate()
                .map(|(n, level)| {
                    let mut grad = vec![Row::ZERO; level.rows()];
                    level.scatter(&mut grad, batch.encoded(n), &mut Around::default());
                    bytemuck::cast_slice(&grad).to_vec()
                })
                .collect();
        }
    }

    /// Calls `f` with the loss as a function of the field's numbers.
    pub(super) fn with_reference<T>(&self, f: impl FnOnce(&Reference) -> T) -> T {
        let frames = &self.pixels.frames;
        let views: Vec<View> = frames.iter().map(|f| View::new(&self.field, f)).collect();
        let times: Vec<f32> = frames.iter().map(|f| f.time as f32).collect();
        f(&Reference {
            field: &self.field,
            views: &views,
            times: &times,
            chunk: &self.chunk.traced,
            inputs: &self.chunk.inputs,
            targets: &self.chunk.targets,
            bends: &self.chunk.bends,
            moving: &self.pixels.moving,
            config: &self.config,
        })
    }

    /// Name, place and range of every group of parameters.
    fn groups(&self) -> Vec<(String, Place, Range<usize>)> {
        let mut groups = Vec::new();
        let layout = &self.field.layout;
        for s in Stream::ALL {
            let net = self.field.net(s).expect("all streams are on");
            let learned = net.encoding.levels.iter().enumerate().filter(|(_, l)| l.rows() > 0);
            for (n, level) in learned {
                let name = format!("table {n} of {}", s.name());
                groups.push((name, Place::Table(s as usize, n), 0..level.rows() * FEATURES));
            }
            let r = &layout.streams[s as usize];
            for (part, net, start) in
                [("trunk", &net.trunk, r.trunk.start), ("head", &net.head, r.head.start)]
            {
                for (layer, [weights, biases]) in layers(net, start).into_iter().enumerate() {
                    for (kind, range) in [("weights", weights), ("biases", biases)] {
                        let name = format!("{kind} of {part} layer {layer} of {}", s.name());
                        groups.push((name, Place::Weights, range));
                    }
                }
            }
            if !r.code.is_empty() {
                groups.push((format!("codes of {}", s.name()), Place::Weights, r.code.clone()));
            }
        }
        let mut six = |name: &str, range: &Range<usize>, parts: [&str; 2]| {
            for (part, first) in parts.iter().zip([0, 3]) {
                for start in range.clone().step_by(6) {
                    let range = start + first..start + first + 3;
                    groups.push((format!("{name}: {part} {range:?}"), Place::Weights, range));
                }
            }
        };
        six("exposure", &layout.exposure, ["gain", "offset"]);
        six("pose", &layout.pose, ["rotation", "translation"]);
        six("rig", &(layout.rig.start..layout.rig.start + 6), ["rotation", "translation"]);
        groups.push(("lens".into(), Place::Weights, layout.rig.start + 6..layout.rig.end));
        groups
    }

    fn gradient(&self, place: Place, range: Range<usize>) -> &[f32] {
        match place {
            Place::Table(s, n) => &self.tables[s][n][range],
            Place::Weights => &self.dense[range],
        }
    }

    /// How far a group's gradient is from another one, as a share of the length of that one.
    fn off(&self, other: &Self, place: Place, range: Range<usize>) -> f64 {
        let length = |v: &mut dyn Iterator<Item = f32>| v.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        let (a, b) = (self.gradient(place, range.clone()), other.gradient(place, range));
        length(&mut a.iter().zip(b).map(|(a, b)| a - b)) / length(&mut b.iter().copied())
    }
}

/// Ranges of every layer's weights and biases.
fn layers(net: &Mlp, mut start: usize) -> Vec<[Range<usize>; 2]> {
    net.shapes()
        .map(|[n_in, n_out]| {
            let (a, b) = (start + n_in * n_out, start + n_in * n_out + n_out);
            let layer = [start..a, a..b];
            start = b;
            layer
        })
        .collect()
}

fn number(x: &mut Numbers, place: Place, n: usize) -> &mut f64 {
    match place {
        Place::Table(s, level) => &mut x.tables[s][level][n],
        Place::Weights => &mut x.weights[n],
    }
}

/// Adds to one number.
pub(super) fn add(x: &mut Numbers, place: Place, n: usize, by: f64) {
    *number(x, place, n) += by;
}

/// Central difference of the loss by one number.
fn difference(reference: &Reference, x: &mut Numbers, place: Place, n: usize, h: f64) -> f64 {
    let before = *number(x, place, n);
    *number(x, place, n) = before + h;
    let above = reference.loss(x);
    *number(x, place, n) = before - h;
    let below = reference.loss(x);
    *number(x, place, n) = before;
    (above - below) / (2.0 * h)
}

/// Indices of the largest gradients, and some at random.
fn choose(gradient: &[f32], rng: &mut Rng) -> Vec<usize> {
    let mut order: Vec<usize> = (0..gradient.len()).collect();
    order.sort_by(|&a, &b| gradient[b].abs().total_cmp(&gradient[a].abs()));
    order.truncate(LOOKED_AT);
    order.extend((0..LOOKED_AT).map(|_| rng.below(gradient.len())));
    order
}

/// Panics, naming the group, where a gradient and its finite difference disagree, or where nothing was compared because
/// all are zero.
fn assert_gradients_agree(group: &str, gradient: &[f64], numeric: &[f64]) {
    let largest = numeric.iter().chain(gradient).fold(0.0f64, |m, v| m.max(v.abs()));
    assert!(largest > 0.0, "{group}: all gradients are zero");
    for (n, (g, d)) in gradient.iter().zip(numeric).enumerate() {
        let allowed = RELATIVE * d.abs() + ABSOLUTE * largest;
        assert!((g - d).abs() <= allowed, "{group}[{n}]: gradient {g:e}, finite difference {d:e}");
    }
}

/// Compares all groups of one traced chunk.
fn check(traced: &Traced, seed: u64) {
    let mut rng = Rng::new(seed, 2, 0);
    let mut x = Numbers::of(&traced.field);
    traced.with_reference(|reference| {
        let loss = traced.loss / RAYS as f64;
        let truth = reference.loss(&x);
        assert!((loss - truth).abs() < 1e-4 * truth.abs(), "loss {loss}, reference {truth}");
        for (name, place, range) in traced.groups() {
            let gradient = traced.gradient(place, range.clone());
            let chosen = choose(gradient, &mut rng);
            // A moving pose carries samples across cells, where the gradient jumps: the smaller step meets fewer.
            let h = if range.start >= traced.field.layout.pose.start { 1e-8 } else { 1e-6 };
            let numeric: Vec<f64> =
                chosen.iter().map(|&n| difference(reference, &mut x, place, range.start + n, h)).collect();
            let gradient: Vec<f64> = chosen.iter().map(|&n| f64::from(gradient[n])).collect();
            assert_gradients_agree(&format!("seed {seed}, {name}"), &gradient, &numeric);
        }
    });
}

#[test]
fn every_gradient_matches_finite_differences() {
    for seed in seeds().take(3) {
        let traced = trace(seed);
        let [p, d, a] = traced.chunk.traced.batches.each_ref().map(|b| b.len());
        let placed = traced.chunk.traced.intervals.layout.len();
        assert!(p < placed && d < placed && a < placed, "some samples must be left out");
        assert!(p.min(d).min(a) > placed / 8, "each stream must be evaluated somewhere");
        check(&traced, seed);
    }
}

#[test]
fn every_gradient_of_the_other_encodings_matches_finite_differences() {
    // With the first two, a network on frequencies has a sample beside a kink, where f32 and f64 have other slopes.
    for seed in seeds().skip(2).take(2) {
        for encoding in [EncodingKind::Dense, EncodingKind::Frequency] {
            check(&trace_with(seed, Setting { encoding, ..Setting::default() }), seed);
        }
    }
}

/// Waves that are one per cent too short in the reference must make the gradients of some trunk disagree.
#[test]
#[should_panic(expected = "finite difference")]
fn frequencies_that_are_off_by_one_per_cent_are_found() {
    let seed = seeds().next().expect("there is one");
    let mut traced = trace_with(seed, Setting { encoding: EncodingKind::Frequency, ..Setting::default() });
    for net in traced.field.nets.iter_mut().flatten() {
        for level in &mut net.encoding.levels {
            if let Level::Waves { half_turns, .. } = level {
                *half_turns *= 1.01;
            }
        }
    }
    // The loss itself would already tell.
    traced.with_reference(|reference| {
        let mut x = Numbers::of(&traced.field);
        for (name, place, range) in traced.groups().into_iter().filter(|(name, ..)| name.contains("trunk")) {
            let gradient = traced.gradient(place, range.clone());
            let chosen = choose(gradient, &mut Rng::new(seed, 2, 0));
            let numeric: Vec<f64> =
                chosen.iter().map(|&n| difference(reference, &mut x, place, range.start + n, 1e-6)).collect();
            let gradient: Vec<f64> = chosen.iter().map(|&n| f64::from(gradient[n])).collect();
            assert_gradients_agree(&name, &gradient, &numeric);
        }
    });
}

#[test]
fn directions_of_odd_cameras_project_back_to_their_pixels() {
    let traced = trace(4);
    for input in &traced.chunk.inputs {
        let camera = &traced.pixels.frames[input.view as usize].camera;
        let back = camera.project(input.dir_cam.as_dvec3()).expect("in front of the camera");
        let pixel = input.uv.as_dvec2() * glam::DVec2::new(camera.width.into(), camera.height.into());
        assert!((back - pixel).length() < 1e-3, "{pixel} came back as {back}");
    }
}

#[test]
#[should_panic(expected = "finite difference")]
fn a_gradient_that_is_off_by_two_per_mille_is_found() {
    assert_gradients_agree("negative control", &[1.0, 0.5 * 1.002, 0.1], &[1.0, 0.5, 0.1]);
}

#[test]
#[should_panic(expected = "finite difference")]
fn a_gradient_that_is_missing_is_found() {
    assert_gradients_agree("negative control", &[1.0, 0.0], &[1.0, 1e-3]);
}

#[test]
#[should_panic(expected = "all gradients are zero")]
fn a_group_without_gradient_is_found() {
    assert_gradients_agree("negative control", &[0.0; 2], &[0.0; 2]);
}

/// Each term of the loss, weighted 1 % differently in the reference, must make some group disagree.
#[test]
fn a_term_that_is_off_by_one_per_cent_is_found() {
    let traced = trace(seeds().next().expect("there is one"));
    let wrong: [fn(&mut LossConfig); 10] = [
        |c| c.beta_min *= 1.01,
        |c| c.transient *= 1.01,
        |c| c.transient_opacity[0] *= 1.01,
        |c| c.transient_opacity[1] *= 1.01,
        |c| c.veil *= 1.01,
        |c| c.depth *= 1.01,
        |c| c.flatness *= 1.01,
        |c| c.distortion *= 1.01,
        |c| c.entropy *= 1.01,
        |c| c.exposure *= 1.01,
    ];
    let mut x = Numbers::of(&traced.field);
    for (term, wrong) in wrong.iter().enumerate() {
        let mut config = traced.config.clone();
        wrong(&mut config);
        let found = traced.with_reference(|reference| {
            let reference = Reference { config: &config, ..*reference };
            traced.groups().into_iter().any(|(name, place, range)| {
                // Biases and exposures see every term, and there are few of them.
                if !(name.starts_with("biases") || name.starts_with("exposure")) {
                    return false;
                }
                let gradient = traced.gradient(place, range.clone());
                let mut differs = |(n, g): (usize, &f32)| {
                    let d = difference(&reference, &mut x, place, range.start + n, 1e-6);
                    let largest = gradient.iter().fold(0.0f64, |m, v| m.max(f64::from(*v).abs()));
                    (f64::from(*g) - d).abs() > RELATIVE * d.abs() + ABSOLUTE * largest
                };
                gradient.iter().enumerate().any(&mut differs)
            })
        });
        assert!(found, "term {term} could be wrong without anyone noticing");
    }
}

/// bf16 rounds every factor by up to 2⁻⁹; through seven layers, an exponential (the density) and ReLUs that flip, that
/// comes to some per cent of each group's gradient in the mean over its numbers; more for the few numbers of a camera,
/// which are sums over a whole picture whose terms mostly cancel.
#[test]
fn bf16_gradients_agree_with_f32_ones() {
    for seed in seeds().take(3) {
        // Bends are differences of rounded numbers: at the weight that training gives them.
        let config = LossConfig { flatness: LossConfig::default().flatness, transient: 0.1, ..weighed() };
        let setting = Setting { config, ..Setting::default() };
        let [exact, rounded] = [Precision::F32, Precision::Bf16]
            .map(|precision| trace_with(seed, Setting { precision, ..setting.clone() }));
        assert!((exact.loss - rounded.loss).abs() < 1e-2 * exact.loss.abs());
        for (name, place, range) in exact.groups() {
            let camera = range.start >= exact.field.layout.exposure.start;
            let bound = if matches!(place, Place::Weights) && camera { 0.5 } else { 0.15 };
            let off = rounded.off(&exact, place, range);
            assert!(off < bound, "seed {seed}, {name}: off by {off:e} of its length");
        }
    }
}

/// What a sample gives to its pixel is what it learns from it.
#[test]
fn faint_samples_teach_next_to_nothing() {
    for seed in seeds().take(3) {
        // So dense that little light is left behind the first samples.
        let [all, bright] =
            [0.0, 1e-4].map(|faint| trace_with(seed, Setting { faint, denser: 4.0, ..Setting::default() }));
        let [before, after] = [&all, &bright].map(|t| t.chunk.traced.batches.each_ref().map(|b| b.len()));
        let fewer = after.iter().sum::<usize>() < before.iter().sum();
        assert!(fewer && after.iter().all(|n| *n > 0), "{before:?} → {after:?}");
        let placed = |t: &Traced| t.chunk.traced.cells.each_ref().map(Vec::len);
        assert_eq!((placed(&all), placed(&bright)), (before, before), "densities are looked at everywhere");
        let [a, b] = [&all, &bright].map(|t| &t.chunk.traced.weights);
        for n in 0..all.chunk.traced.intervals.layout.len() {
            assert_eq!((a.at(n), a.transmittance[n]), (b.at(n), b.transmittance[n]));
        }
        assert!((all.loss - bright.loss).abs() < 1e-2 * all.loss.abs());
        for (name, place, range) in all.groups() {
            let off = bright.off(&all, place, range);
            assert!(off < 0.05, "seed {seed}, {name}: off by {off:e} of its length");
        }
    }
}
