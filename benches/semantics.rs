//! Scores and features of a million points, each beside the least time that the machine allows for it and the most that
//! it may take (the bar).
//!
//! `cargo bench --bench semantics`. The floors come from what the machine can do at most, measured on two cores of a
//! Xeon of the Sapphire Rapids family; another machine's figures are given by the environment:
//! `DIVFF_F32_GFLOPS`, `DIVFF_MROWS` (random 16-byte reads of a 2 MiB table a second, in millions), `DIVFF_GBPS` (read).

use std::hint::black_box;
use std::time::Duration;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_main};
use divff::field::Stream;
use divff::field::mlp::Precision;
use divff::scene::features::Space;
use divff::semantics::SemanticsConfig;
use divff::semantics::head::{HeadModel, HeadShape, Heads};
use divff::semantics::relevancy::{Points, Queries};
use glam::Vec3;
use half::f16;

const POINTS: usize = 1_000_000;

/// Descriptors as models give them.
const FULL: usize = 512;

/// Canonical phrases of a space.
const CANONICAL: usize = 5;

/// Phrases that a map's vertices have a column for, at most.
const PHRASES: usize = 24;

/// Rows that are repeated until there are as many as points; generating all would take longer than measuring.
const DISTINCT: usize = 1000;

fn rate(name: &str, default: f64) -> f64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default)
}

/// Seconds for so many operations and bytes, whichever takes longer.
fn roofline(flops: f64, bytes: f64) -> f64 {
    let (gflops, gbps) = (rate("DIVFF_F32_GFLOPS", 140.0), rate("DIVFF_GBPS", 17.0));
    (flops / (1e9 * gflops)).max(bytes / (1e9 * gbps))
}

fn announce(name: &str, floor: f64, bar_ms: f64) {
    println!("{name}: floor {:.1} ms, bar {bar_ms} ms", 1e3 * floor);
}

/// Numbers in [−1, 1), the same in every run.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    fn list(&mut self, count: usize) -> Vec<f32> {
        (0..count).map(|_| self.next()).collect()
    }
}

fn queries(phrases: usize, dim: usize) -> Queries {
    let mut numbers = Numbers(2);
    let (q, c) = (numbers.list(phrases * dim), numbers.list(CANONICAL * dim));
    let rows = |v| <[f32]>::chunks_exact(v, dim).collect::<Vec<_>>();
    Queries::new(Space::Clip, &rows(&q), &rows(&c), 10.0).expect("embeddings of unit width are fine")
}

/// One phrase held against a million descriptors, short and as models give them.
fn relevancy(c: &mut Criterion) {
    let mut group = c.benchmark_group("relevancy");
    group.throughput(Throughput::Elements(POINTS as u64));
    group.sample_size(10).measurement_time(Duration::from_secs(3));
    for (dim, half, bar_ms) in
        [(32, false, 15.0), (32, true, 15.0), (FULL, false, 150.0), (FULL, true, 150.0)]
    {
        let wide: Vec<f32> = Numbers(1).list(DISTINCT * dim);
        let (mut single, mut double): (Vec<f32>, Vec<f16>) = (Vec::new(), Vec::new());
        match half {
            true => {
                double = wide.iter().map(|v| f16::from_f32(*v)).collect::<Vec<_>>().repeat(POINTS / DISTINCT)
            }
            false => single = wide.repeat(POINTS / DISTINCT),
        }
        let points = || if half { Points::F16(&double) } else { Points::F32(&single) };
        let queries = queries(1, dim);
        let name = format!("{dim} numbers, {}", if half { "f16" } else { "f32" });
        // The phrase, the canonical ones and the point's own length; score and coverage are written.
        let numbers = (POINTS * dim) as f64;
        let bytes = numbers * if half { 2.0 } else { 4.0 } + 8.0 * POINTS as f64;
        announce(&name, roofline(2.0 * (CANONICAL + 2) as f64 * numbers, bytes), bar_ms);
        group.bench_function(name, |b| {
            b.iter(|| black_box(queries.score(points()).expect("all points are finite")));
        });
    }
}

/// Fields of the default settings with random weights; part features are outputs of the video-language one.
fn fields(space: Space) -> Heads {
    let config = SemanticsConfig::default();
    let shape = HeadShape {
        dim: config.compress.dim.expect("the default names a width"),
        parts: if space == Space::Egovideo { config.part_dim } else { 0 },
        encodings: Stream::ALL.map(|s| config.stream(s).clone()),
        hidden: config.hidden,
        layers: config.layers,
        extent: Vec3::new(1.0, 0.75, 0.6),
        frames: 200,
        streams: [true; 3],
        scales: None,
    };
    let mut heads = Heads::zeros(shape);
    heads.init(space as u64);
    heads
}

/// Vertices of walls as marching leaves them: neighbours follow each other.
fn vertices(extent: Vec3) -> Vec<Vec3> {
    let mut numbers = Numbers(3);
    let side = (POINTS as f64).sqrt() as usize;
    let place = |n: usize| {
        let (u, v) = ((n % side) as f32 / side as f32, (n / side) as f32 / side as f32);
        // Four walls one after the other, rough by some millimetres.
        let (wall, v) = ((4.0 * v) as usize, (4.0 * v).fract());
        let rough = 0.5 + 0.001 * numbers.next();
        extent
            * [Vec3::new(u, v, rough), Vec3::new(u, rough, v), Vec3::new(rough, u, v), Vec3::new(u, v, 0.0)]
                [wall]
    };
    (0..POINTS).map(place).collect()
}

/// Features of both spaces and the scores of their phrases at the vertices of a map.
fn annotation(c: &mut Criterion) {
    const BAR_MS: f64 = 5000.0;
    let spaces = Space::ALL.map(|space| (fields(space), queries(PHRASES, 32)));
    let points = vertices(spaces[0].0.shape.extent);
    let mut group = c.benchmark_group("annotate both spaces");
    group.throughput(Throughput::Elements(POINTS as u64));
    group.sample_size(10).measurement_time(Duration::from_secs(8));
    for stream in Stream::ALL {
        let floor: f64 = spaces.iter().map(|(heads, _)| floor_of(heads, stream)).sum();
        announce(stream.name(), floor, BAR_MS);
        group.bench_with_input(BenchmarkId::from_parameter(stream.name()), &stream, |b, stream| {
            b.iter(|| {
                for (heads, queries) in &spaces {
                    let mut values = vec![0.0; points.len() * heads.shape.dim];
                    HeadModel::new(heads, Precision::F32).features(*stream, &points, 0.4, 0.0, &mut values);
                    black_box(queries.score(Points::F32(&values)).expect("features are finite"));
                }
            });
        });
    }
}

/// Seconds of one space: reads of the tables, the network, the products with the phrases, and what is written.
fn floor_of(heads: &Heads, stream: Stream) -> f64 {
    let (shape, count) = (&heads.shape, POINTS as f64);
    let Some(net) = &heads.nets[stream as usize] else { return 0.0 };
    let config = &shape.encodings[stream as usize];
    let lookups = (8 * config.levels + 16 * config.time_levels) as f64;
    let products = net.mlp.multiply_adds() + shape.dim * (PHRASES + CANONICAL + 1);
    let bytes = 4.0 * (2 * shape.dim + PHRASES + 1) as f64;
    count * lookups / (1e6 * rate("DIVFF_MROWS", 600.0))
        + roofline(2.0 * products as f64 * count, bytes * count)
}

#[allow(missing_docs)]
mod groups {
    criterion::criterion_group!(benches, super::relevancy, super::annotation);
}
criterion_main!(groups::benches);
