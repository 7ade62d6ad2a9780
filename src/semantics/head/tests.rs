//! The gradients of a step against central differences of an f64 reference, and what training must be able to do.

use glam::Vec3;
use half::f16;

use super::cache::Sources;
use super::scale::Pyramid;
use super::step::{Bags, Group, GroupPass, HeadOptimiser, HeadStep, RayTargets};
use super::*;
use crate::field::hashgrid::{AXES, Around, Points, TIME};
use crate::semantics::config::SemanticsConfig;

/// Three streams on small lattices, part features beside a descriptor of five numbers.
fn shape() -> HeadShape {
    let persistent = HeadStreamConfig {
        levels: 2,
        coarsest: 2.0,
        finest: 6.0,
        log2_rows: 6,
        time_levels: 0,
        time_finest: 0.0,
    };
    let moving = HeadStreamConfig { time_levels: 1, time_finest: 4.0, ..persistent.clone() };
    HeadShape {
        dim: 5,
        parts: 2,
        encodings: [persistent, moving.clone(), moving],
        hidden: 8,
        layers: 1,
        extent: Vec3::new(1.0, 0.7, 0.6),
        frames: 6,
        streams: [true; 3],
        scales: None,
    }
}

/// The same with scales.
fn scaled_shape() -> HeadShape {
    HeadShape { scales: Some([0.05, 1.2]), ..shape() }
}

/// Fields whose numbers are all random.
fn random_heads(shape: HeadShape, seed: u64) -> Heads {
    let mut heads = Heads::zeros(shape);
    let mut rng = Rng::new(seed, 1, 0);
    let mut noise = || rng.uniform() - 0.5;
    heads.weights.iter_mut().flatten().for_each(|w| *w = noise());
    heads
        .tables
        .iter_mut()
        .flatten()
        .flatten()
        .for_each(|row| *row = Row::from_array([0; 4].map(|_| noise())));
    heads
}

/// Rays with up to four sources of any stream, and targets of which some lack a part.
fn random_rays(count: usize, seed: u64) -> (Sources, RayTargets) {
    let mut rng = Rng::new(seed, 2, 0);
    let mut rays = Vec::new();
    let (width, dim) = (7, 5);
    let mut targets = RayTargets { width, dim, ..RayTargets::default() };
    for n in 0..count {
        let sources = (0..1 + rng.below(4)).map(|_| {
            let p = Vec3::new(rng.uniform(), 0.7 * rng.uniform(), 0.6 * rng.uniform());
            (0.1 + rng.uniform(), rng.below(3) as u8, p)
        });
        rays.push(sources.collect());
        targets.values.extend((0..width).map(|_| f16::from_f32(rng.uniform() - 0.5)));
        targets.weights.push([(n % 3) as f32, if n % 2 == 0 { 0.4 } else { 0.0 }]);
        targets.times.push(rng.uniform());
        targets.usable.push(n as u32);
    }
    // Every ray is in one bag of twelve, beside what it should be by itself.
    for first in (0..count as u32).step_by(12) {
        let value: Vec<f32> = (0..dim).map(|_| rng.uniform() - 0.5).collect();
        targets.bags.push(first..(first + 12).min(count as u32), &value);
    }
    (Sources::of_rays(rays), targets)
}

/// The same rays with targets at three scales.
fn with_pyramid(mut targets: RayTargets, seed: u64) -> RayTargets {
    let mut rng = Rng::new(seed, 3, 0);
    let (knots, rays) = (vec![0.1, 0.25, 0.5], targets.weights.len());
    targets.values =
        (0..rays * knots.len() * targets.width).map(|_| f16::from_f32(rng.uniform() - 0.5)).collect();
    let shares = (0..rays).map(|n| if n % 3 == 0 { [0.25, 0.5] } else { [0.1, 0.5] }).collect();
    let heights = (0..rays).map(|_| 0.5 + 2.0 * rng.uniform()).collect();
    targets.pyramid = Some(Pyramid { knots, shares, heights });
    targets
}

/// The loss of all rays in f64; `share` is how much each source counts, `drawn` the scale of each ray.
fn reference(
    heads: &Heads,
    sources: &Sources,
    targets: &RayTargets,
    drawn: &[f32],
    share: impl Fn(f32) -> f64,
) -> f64 {
    let (mut loss, mut all) = (0.0, Vec::new());
    for ray in 0..sources.len() {
        let scale = drawn.get(ray).copied().unwrap_or(0.0);
        let size = targets.pyramid.as_ref().map_or(0.0, |p| scale * p.heights[ray]);
        let (mut rendered, mut target) = (vec![0.0; targets.width], Vec::new());
        targets.value(ray, scale, &mut target);
        for source in sources.of(ray) {
            let s = usize::from(source.stream);
            let f = evaluate(heads, s, source.position(), targets.times[ray], size);
            rendered.iter_mut().zip(f).for_each(|(r, f)| *r += share(source.share()) * f);
        }
        for (k, r) in rendered.iter().enumerate() {
            let off = r - f64::from(target[k]);
            loss += f64::from(targets.weights[ray][usize::from(k >= targets.dim)]) * off * off;
        }
        all.push(rendered);
    }
    for bag in 0..targets.bags.len() {
        let rays = targets.bags.of(bag);
        for k in 0..targets.dim {
            let mean = rays.iter().map(|r| all[*r as usize][k]).sum::<f64>() / rays.len() as f64;
            let off = mean - f64::from(targets.bags.values[bag * targets.dim + k].to_f32());
            loss += rays.len() as f64 * off * off;
        }
    }
    loss / sources.len() as f64
}

/// One point in f64, the interpolation (which is linear in the tables) aside.
fn evaluate(heads: &Heads, s: usize, p: Vec3, time: f32, size: f32) -> Vec<f64> {
    let net = heads.nets[s].as_ref().unwrap();
    let mut points: Points = [[0.5; TILE]; AXES];
    (points[0][0], points[1][0], points[2][0], points[TIME][0]) = (p.x, p.y, p.z, time);
    let mut x: Vec<f64> = Vec::new();
    for (level, table) in net.grid.levels.iter().zip(&heads.tables[s]) {
        let mut rows = [Row::ZERO; 1];
        level.encode(table, std::iter::once((&points, &mut rows[..])), &mut Around::default());
        x.extend(rows[0].to_array().map(f64::from));
    }
    if let Some([low, high]) = heads.shape.scales {
        let u = (f64::from(size) / f64::from(low)).ln() / (f64::from(high) / f64::from(low)).ln();
        x.extend((1..=4).map(|k| (f64::from(k) * std::f64::consts::PI * u.clamp(0.0, 1.0)).cos()));
    }
    let widths = net.mlp.widths().to_vec();
    x.resize(widths[0], 0.0);
    let mut at = 0;
    for (n, pair) in widths.windows(2).enumerate() {
        let (w, rest) = heads.weights[s][at..].split_at(pair[0] * pair[1]);
        let last = n + 2 == widths.len();
        let unit = |o: usize| {
            let row = &w[o * pair[0]..][..pair[0]];
            let sum: f64 = row.iter().zip(&x).map(|(w, x)| f64::from(*w) * x).sum();
            let sum = sum + f64::from(rest[o]);
            if last { sum } else { sum.max(0.0) }
        };
        x = (0..pair[1]).map(unit).collect();
        at += pair[0] * pair[1] + pair[1];
    }
    x
}

/// Gradients of the networks and tables, and the scales that were drawn.
type Gradients = ([Vec<f32>; 3], [Vec<Vec<Row>>; 3], Vec<f32>);

/// Analytic gradients.
fn gradients(heads: &Heads, sources: &Sources, targets: &RayTargets) -> Gradients {
    let model = HeadModel::new(heads, Precision::F32);
    let bags = (0..targets.bags.len() as u32).collect();
    let mut group = Group::of(targets.usable.clone(), bags);
    group.draw(&mut Rng::new(6, 4, 0), targets);
    let count = sources.len() as f32;
    pulp::Arch::new().dispatch(GroupPass { group: &mut group, model: &model, sources, targets, count });
    let tables = std::array::from_fn(|s| {
        let batch = group.batch(s);
        let levels = &heads.nets[s].as_ref().unwrap().grid.levels;
        let scattered = levels.iter().enumerate().map(|(n, level)| {
            let mut grads = vec![Row::ZERO; level.rows()];
            level.scatter(&mut grads, batch.encoded(n), &mut Around::default());
            grads
        });
        scattered.collect()
    });
    (group.gradient.clone(), tables, group.drawn().to_vec())
}

/// Largest deviation of the analytic gradients from central differences, relative to the largest gradient.
fn worst(scales: bool, share: impl Fn(f32) -> f64 + Copy) -> f64 {
    const H: f32 = 2e-3;
    let heads = random_heads(if scales { scaled_shape() } else { shape() }, 3);
    let (sources, targets) = random_rays(60, 5); // five bags
    let targets = if scales { with_pyramid(targets, 5) } else { targets };
    let (networks, tables, drawn) = gradients(&heads, &sources, &targets);
    let loss = |heads: &Heads| reference(heads, &sources, &targets, &drawn, share);
    let mut worst = 0.0f64;
    for s in 0..3 {
        let largest = networks[s].iter().fold(0.0f32, |m, g| m.max(g.abs()));
        for n in (0..networks[s].len()).step_by(7) {
            let mut moved = heads.clone();
            moved.weights[s][n] = heads.weights[s][n] + H;
            let (up, high) = (loss(&moved), moved.weights[s][n]);
            moved.weights[s][n] = heads.weights[s][n] - H;
            let difference = (up - loss(&moved)) / f64::from(high - moved.weights[s][n]);
            worst = worst.max((difference - f64::from(networks[s][n])).abs() / f64::from(largest));
        }
        for (level, grads) in tables[s].iter().enumerate() {
            let largest = grads.iter().fold(0.0f32, |m, g| m.max(g.abs().max_element()));
            for row in (0..grads.len()).step_by(11) {
                let mut moved = heads.clone();
                moved.tables[s][level][row].y += 10.0 * H;
                let up = loss(&moved);
                moved.tables[s][level][row].y -= 20.0 * H;
                let difference = (up - loss(&moved)) / f64::from(20.0 * H);
                worst = worst.max((difference - f64::from(grads[row].y)).abs() / f64::from(largest));
            }
        }
    }
    worst
}

#[test]
fn gradients_are_those_of_the_f64_reference() {
    for scales in [false, true] {
        let off = worst(scales, f64::from);
        assert!(off < 0.01, "{off}, scales: {scales}");
    }
}

#[test]
fn the_comparison_of_gradients_notices_a_wrong_weight() {
    // The same with every source counting a tenth more: what a forgotten factor would do.
    for scales in [false, true] {
        let off = worst(scales, |share| 1.1 * f64::from(share));
        assert!(off > 0.05, "{off}, scales: {scales}");
    }
}

fn plan(step: u64) -> HeadStep {
    HeadStep {
        step,
        rays: 64,
        bag: 4,
        table_rate: 1e-2,
        network_rate: 5e-3,
        precision: Precision::F32,
        seed: 9,
    }
}

fn trained(shape: HeadShape, threads: usize, steps: u64) -> (Heads, f64) {
    let (sources, targets) = random_rays(200, 8);
    let targets = if shape.scales.is_some() { with_pyramid(targets, 8) } else { targets };
    let mut heads = Heads::zeros(shape);
    heads.init(4);
    let mut optimiser = HeadOptimiser::new(&heads);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let mut loss = 0.0;
    pool.install(|| {
        for step in 1..=steps {
            loss = optimiser.step(&mut heads, &sources, &targets, &plan(step));
        }
    });
    (heads, loss)
}

#[test]
fn training_does_not_depend_on_the_number_of_threads() {
    for shape in [shape(), scaled_shape()] {
        let [(one, _), (three, _)] = [1, 3].map(|threads| trained(shape.clone(), threads, 20));
        assert_eq!((one.weights, one.tables), (three.weights, three.tables));
    }
}

#[test]
fn what_moves_is_learned_where_it_is_at_each_time() {
    // One place, two times: what was put down is gone later.
    let shape = HeadShape { dim: 4, parts: 0, ..shape() };
    let place = Vec3::new(0.3, 0.4, 0.2);
    let mut targets = RayTargets { width: 4, dim: 4, ..RayTargets::default() };
    let rays = (0..64).map(|_| vec![(1.0, Stream::Dynamic as u8, place)]).collect();
    for n in 0..64u32 {
        let late = n % 2 == 1;
        targets.values.extend([1.0, 0.0, 0.5, 0.0].map(|v| f16::from_f32(if late { -v } else { v })));
        targets.weights.push([1.0, 0.0]);
        targets.times.push(if late { 0.9 } else { 0.1 });
        targets.usable.push(n);
    }
    let sources = Sources::of_rays(rays);
    let mut heads = Heads::zeros(shape);
    heads.init(1);
    let mut optimiser = HeadOptimiser::new(&heads);
    for step in 1..=300 {
        optimiser.step(&mut heads, &sources, &targets, &plan(step));
    }
    let model = HeadModel::new(&heads, Precision::F32);
    let at = |time| {
        let mut out = vec![0.0; 4];
        model.features(Stream::Dynamic, &[place], time, 0.0, &mut out);
        out[0]
    };
    assert!((at(0.1) - 1.0).abs() < 0.05 && (at(0.9) + 1.0).abs() < 0.05, "{} {}", at(0.1), at(0.9));
    let mut nothing = vec![1.0; 4];
    let still = HeadShape { streams: [true, false, false], ..shape_of(&heads) };
    let heads = Heads::zeros(still);
    let model = HeadModel::new(&heads, Precision::F32);
    model.features(Stream::Dynamic, &[place], 0.1, 0.0, &mut nothing);
    assert_eq!(nothing, [0.0; 4], "a stream that is not there has no feature");
}

#[test]
fn descriptors_of_mixtures_are_taken_apart() {
    // Two things that are never seen alone: three bags tell how much of each is in them, and what the mixture is.
    let shape = HeadShape { dim: 4, parts: 0, ..shape() };
    let places = [Vec3::new(0.2, 0.2, 0.2), Vec3::new(0.8, 0.5, 0.4)];
    let rays = (0..8).map(|n| vec![(1.0, Stream::Persistent as u8, places[n / 4])]).collect();
    let mut bags = Bags::default();
    for (first, last) in [(0u32, 6u32), (2, 8), (1, 7)] {
        // Rays 0 to 3 see the first thing (1), the others the second (-1).
        let mean = (first..last).map(|n| if n < 4 { 1.0 } else { -1.0 }).sum::<f32>() / (last - first) as f32;
        bags.push(first..last, &[mean, 0.0, 0.0, 0.0]);
    }
    let targets = RayTargets {
        width: 4,
        dim: 4,
        values: vec![f16::ZERO; 8 * 4],
        weights: vec![[0.0; 2]; 8],
        usable: (0..8).collect(),
        times: vec![0.5; 8],
        bags,
        pyramid: None,
    };
    let sources = Sources::of_rays(rays);
    let mut heads = Heads::zeros(shape);
    heads.init(2);
    let mut optimiser = HeadOptimiser::new(&heads);
    for step in 1..=400 {
        let plan = HeadStep { rays: 1024, bag: 64, ..plan(step) };
        optimiser.step(&mut heads, &sources, &targets, &plan);
    }
    let model = HeadModel::new(&heads, Precision::F32);
    let mut out = vec![0.0; 8];
    model.features(Stream::Persistent, &places, 0.5, 0.0, &mut out);
    assert!(out[0] > 0.75 && out[4] < -0.75, "{} {}", out[0], out[4]);
}

#[test]
fn what_depends_on_size_is_learned_at_every_distance() {
    // One place seen from two distances: patches that show more than 0.3 units are one thing, smaller ones another.
    let place = Vec3::new(0.3, 0.4, 0.2);
    let rays = (0..64).map(|_| vec![(1.0, Stream::Persistent as u8, place)]).collect();
    let heights: Vec<f32> = (0..64).map(|n| if n % 2 == 0 { 1.0 } else { 2.0 }).collect();
    let knots: Vec<f32> = (1..=8).map(|n| 0.075 * n as f32).collect();
    let of = |size: f32| if size > 0.31 { 1.0 } else { -1.0 };
    let values = heights.iter().flat_map(|h| knots.iter().map(move |k| [of(k * h), 0.0, 0.0, 0.0])).flatten();
    let targets = RayTargets {
        width: 4,
        dim: 4,
        values: values.map(f16::from_f32).collect(),
        weights: vec![[1.0, 0.0]; 64],
        usable: (0..64).collect(),
        times: vec![0.5; 64],
        bags: Bags::default(),
        pyramid: Some(Pyramid { knots, shares: vec![[0.075, 0.6]; 64], heights }),
    };
    let range = targets.pyramid.as_ref().unwrap().sizes(&targets.usable);
    assert_eq!(range, [0.075, 1.2]);
    let shape = HeadShape { dim: 4, parts: 0, scales: Some(range), ..shape() };
    let sources = Sources::of_rays(rays);
    let mut heads = Heads::zeros(shape.clone());
    heads.init(1);
    let mut optimiser = HeadOptimiser::new(&heads);
    for step in 1..=400 {
        optimiser.step(&mut heads, &sources, &targets, &plan(step));
    }
    let model = HeadModel::new(&heads, Precision::F32);
    let at = |size| {
        let mut out = vec![0.0; 4];
        model.features(Stream::Persistent, &[place], 0.5, size, &mut out);
        // Sources keep positions to a 65535th.
        let rendered = render_features(&model, &sources, 0.5, |_| size).values[0];
        assert!((rendered - out[0]).abs() < 1e-3, "one source alone: {rendered}, {}", out[0]);
        out[0]
    };
    for size in [0.08, 0.15, 0.2, 0.5, 0.8, 1.1] {
        assert!((at(size) - of(size)).abs() < 0.25, "{size}: {}", at(size));
    }
    let tried = shape.other_sizes(5);
    assert!(tried.len() == 4 && tried[0] == range[0] && (tried[3] - range[1]).abs() < 1e-5, "{tried:?}");
    assert!(shape.middle_size() > tried[1] && shape.middle_size() < tried[2], "it is not tried twice");
}

#[test]
fn fields_without_scales_know_nothing_of_them() {
    let plain = shape();
    let json = serde_json::to_string(&plain).unwrap();
    assert!(!json.contains("scales"), "files are what they were: {json}");
    assert_eq!(serde_json::from_str::<HeadShape>(&json).unwrap(), plain);
    let scaled = serde_json::to_string(&scaled_shape()).unwrap();
    assert_eq!(serde_json::from_str::<HeadShape>(&scaled).unwrap(), scaled_shape());
    assert!(plain.other_sizes(9).is_empty());
    for (stream, net) in Stream::ALL.into_iter().zip(&Heads::zeros(plain.clone()).nets) {
        assert_eq!(net.as_ref().unwrap().mlp.widths()[0], plain.grid(stream).width());
    }
    // A pyramid whose scales are all alike teaches them the same, bit by bit: drawing disturbs no other number.
    let (sources, targets) = random_rays(200, 8);
    let pyramid = Pyramid { knots: vec![0.3], shares: vec![[0.3; 2]; 200], heights: vec![1.0; 200] };
    let drawn = RayTargets { pyramid: Some(pyramid), ..targets.clone() };
    let [one, two] = [targets, drawn].map(|targets| {
        let mut heads = Heads::zeros(shape());
        heads.init(4);
        let mut optimiser = HeadOptimiser::new(&heads);
        for step in 1..=5 {
            optimiser.step(&mut heads, &sources, &targets, &plan(step));
        }
        (heads.weights, heads.tables)
    });
    assert_eq!(one, two);
}

fn shape_of(heads: &Heads) -> HeadShape {
    heads.shape.clone()
}

#[test]
fn sources_keep_the_largest_shares_and_sum_to_one() {
    let p = Vec3::new(0.25, 0.5, 1.0);
    let rays = vec![vec![(0.1, 0, p), (0.6, 1, p), (0.001, 2, p), (0.3, 0, p)], vec![]];
    let sources = Sources::of_rays(rays);
    let shares: Vec<f32> = sources.of(0).iter().map(|s| s.share()).collect();
    assert_eq!(shares.len(), 3, "what gives next to nothing is left out");
    assert!(shares.is_sorted_by(|a, b| a >= b) && (shares.iter().sum::<f32>() - 1.0).abs() < 1e-4);
    assert_eq!(sources.of(0)[0].stream, 1);
    assert!((sources.of(0)[0].position() - p).length() < 1e-4);
    assert!(sources.of(1).is_empty() && sources.len() == 2);
}

#[test]
fn settings_out_of_range_are_named() {
    let mut config = SemanticsConfig::default();
    assert!(config.check().is_ok());
    config.temperature = f32::NAN;
    assert_eq!(config.check().unwrap_err().0, "semantics.temperature");
    config = SemanticsConfig { samples: 0, ..SemanticsConfig::default() };
    assert_eq!(config.check().unwrap_err().0, "semantics.samples");
    config = SemanticsConfig::default();
    config.dynamic.time_finest = 1.0;
    assert_eq!(config.check().unwrap_err().0, "semantics.dynamic");
    config = SemanticsConfig::default();
    config.compress.dim = Some(0);
    assert_eq!(config.check().unwrap_err().0, "semantics.compress");
}
