//! The kernels of a training step, each beside the least time that the machine allows for it.
//!
//! `cargo bench --bench kernels`. The floors come from what one thread of the machine can do at most, measured first.

use std::hint::black_box;
use std::sync::LazyLock;

use criterion::{Criterion, Throughput, criterion_main};
use divff::field::hashgrid::{AXES, Around, HashGrid, Lattice, Points, Row};
use divff::field::mlp::{Activations, Mlp, Packed, Precision};
use divff::render::composite::{self, Intervals, RayLayout, Weights};
use divff::render::density_grid::{DensityGrid, STRIDE};
use divff::render::rays::Ray;
use divff::render::sampler::{Lanes, RayLanes, Sampler, Sampling, Steer};
use divff::simd::TILE;
use divff::simd::floats::Floats;
use divff::simd::matrix::Unit;
use divff::train::adam::{StepSize, TableState};
use glam::Vec3;
use pulp::{Simd, WithSimd};

mod machine;
use machine::{LEVEL_ROWS, Machine};

/// Bytes of a level's table.
const TABLE_BYTES: usize = size_of::<Row>() * LEVEL_ROWS;

static MACHINE: LazyLock<Machine> = LazyLock::new(|| Machine::measure(1, 3 * TABLE_BYTES));

/// Tiles of a chunk of 32 rays.
const TILES: usize = 13;

/// Samples of the table kernels: as many reads of a table as a step of 4096 rays makes.
const POINTS: usize = 20 * 4096;

/// Prints the least time for `work` at `per_second`.
fn floor(kernel: &str, work: f64, per_second: f64) {
    println!("{kernel}: floor {:.2} µs", 1e6 * work / per_second);
}

/// Numbers in [0, 1), the same in every run.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }
}

/// One of the passes over a chunk's tiles.
#[derive(Clone, Copy)]
enum Pass {
    Forward,
    Backward,
}

struct NetworkPass<'a> {
    pass: Pass,
    net: &'a Mlp,
    packed: &'a Packed,
    activations: &'a mut Activations,
    gradient: &'a mut [f32],
}

impl WithSimd for NetworkPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { pass, net, packed, activations, gradient } = self;
        let unit = Unit::detect();
        match pass {
            // Loops and not closures, which would be compiled without the vector features.
            Pass::Forward => {
                for n in 0..TILES {
                    net.forward(simd, &unit, packed, activations, n);
                }
            }
            Pass::Backward => {
                net.reserve_backward::<S>(TILES, activations);
                for n in 0..TILES {
                    activations.output_grad().fill(0.01);
                    net.backward(simd, &unit, packed, activations, n);
                }
                net.finish(simd, packed, activations, gradient);
            }
        }
    }
}

fn networks(c: &mut Criterion) {
    let mut numbers = Numbers(1);
    let net = Mlp::new(&[40, 64, 64, 16]);
    let params = net.init(|| numbers.next());
    let flops = 2.0 * (net.multiply_adds() * TILES * TILE) as f64;
    for (precision, peak) in [(Precision::F32, MACHINE.flops), (Precision::Bf16, MACHINE.bf16_flops)] {
        let packed = net.pack(&params, precision);
        let mut activations = Activations::default();
        net.reserve(&packed, TILES, &mut activations);
        (0..TILES).for_each(|n| activations.input(n).fill_with(|| numbers.next()));
        let mut gradient = vec![0.0; net.parameters()];
        // Backward, the gradients of inputs and of weights take as much as forward each.
        let passes = [("forward", Pass::Forward, 1.0), ("backward", Pass::Backward, 2.0)];
        for (name, pass, times) in passes {
            let name = format!("network {precision:?} {name}");
            floor(&name, times * flops, peak);
            let mut group = c.benchmark_group("network");
            group.throughput(Throughput::Elements((TILES * TILE) as u64));
            group.bench_function(name, |b| {
                b.iter(|| {
                    pulp::Arch::new().dispatch(NetworkPass {
                        pass,
                        net: &net,
                        packed: &packed,
                        activations: &mut activations,
                        gradient: &mut gradient,
                    });
                });
            });
        }
    }
}

/// What is done with a level's table.
enum Table<'a> {
    Encode(&'a [Row], &'a mut [Row]),
    Scatter(&'a mut [Row], &'a [Row]),
    Update(&'a mut TableState, &'a mut [Row], &'a mut [Row], &'a mut Vec<u32>),
}

struct TablePass<'a>(&'a Lattice, &'a [Points], Table<'a>);

impl WithSimd for TablePass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self(level, points, table) = self;
        match table {
            Table::Encode(table, out) => {
                level.encode(table, points.iter().zip(out.chunks_mut(TILE)), &mut Around::default())
            }
            Table::Scatter(table, g) => {
                level.scatter(table, points.iter().zip(g.chunks(TILE)), &mut Around::default())
            }
            Table::Update(state, table, gradient, lines) => {
                state.update(simd, table, gradient, StepSize::new(1e-3, 10), lines);
            }
        }
    }
}

fn tables(c: &mut Criterion) {
    let mut numbers = Numbers(2);
    let grid = HashGrid::new(Vec3::ONE, 1, Vec3::splat(256.0), Vec3::splat(256.0), 17);
    let level = &grid.levels[0];
    // Patches of 16 neighbours, as the rays of a step are.
    let mut at = Vec3::ZERO;
    let mut points = vec![[[0.0; TILE]; AXES]; POINTS.div_ceil(TILE)];
    for (n, tile) in points.iter_mut().enumerate() {
        for lane in 0..TILE {
            if (n * TILE + lane).is_multiple_of(16) {
                at = Vec3::new(numbers.next(), numbers.next(), numbers.next());
            }
            for axis in 0..3 {
                tile[axis][lane] = at[axis] + 0.01 * numbers.next();
            }
        }
    }
    let mut table = vec![Row::splat(0.1); level.rows];
    let mut state = TableState::new(level.rows);
    let (mut gradient, mut lines) = (vec![Row::ZERO; level.rows], Vec::new());
    let mut rows = vec![Row::ONE; points.len() * TILE];
    let lookups = 8.0 * (points.len() * TILE) as f64;
    let mut group = c.benchmark_group("table");
    group.throughput(Throughput::Elements(POINTS as u64));
    group.sample_size(30);
    let [read, added] = MACHINE.rows(LEVEL_ROWS);
    floor("encode", lookups, read);
    group.bench_function("encode", |b| {
        b.iter(|| {
            pulp::Arch::new().dispatch(TablePass(level, &points, Table::Encode(&table, &mut rows)));
        });
    });
    floor("scatter", lookups, added);
    group.bench_function("scatter", |b| {
        b.iter(|| {
            pulp::Arch::new().dispatch(TablePass(level, &points, Table::Scatter(&mut gradient, &rows)));
        });
    });
    // Values and two moments are read and written; gradients need not leave a near cache.
    floor("adam", 6.0 * TABLE_BYTES as f64, MACHINE.bytes);
    group.bench_function("adam", |b| {
        b.iter(|| {
            gradient.fill(Row::ONE);
            pulp::Arch::new().dispatch(TablePass(
                level,
                &[],
                Table::Update(&mut state, &mut table, &mut gradient, &mut lines),
            ));
        });
    });
}

/// A wall in a density grid.
struct Wall(DensityGrid);

impl Steer for Wall {
    type Cells = [u32; STRIDE];

    #[inline(always)]
    fn find(&self, points: &[Lanes; 3], _: &Lanes) -> [u32; STRIDE] {
        let cells = self.0.indices(points, &[0; STRIDE]);
        self.0.fetch(&cells);
        cells
    }

    #[inline(always)]
    fn sigma(&self, cells: &[u32; STRIDE]) -> [Lanes; 2] {
        [self.0.of(cells), [0.0; STRIDE]]
    }
}

const SAMPLING: Sampling = Sampling { count: 20, step: 1.0 / 128.0, explore: 0.1, sharpness: 0.3 };

struct SamplerPass<'a>(&'a mut Sampler, &'a Wall, &'a [Ray], &'a mut [Lanes]);

impl WithSimd for SamplerPass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let Self(sampler, wall, rays, edges) = self;
        for together in rays.chunks(STRIDE) {
            let mut rays = RayLanes::default();
            together.iter().enumerate().for_each(|(n, ray)| rays.set(n, ray));
            sampler.edges(&rays, &SAMPLING, &[0.5; STRIDE], wall, edges);
            black_box(&edges);
        }
    }
}

struct CompositePass<'a> {
    intervals: &'a Intervals,
    weights: &'a mut Weights,
}

impl WithSimd for CompositePass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { intervals, weights } = self;
        weights.find(simd, intervals);
        for rays in 0..intervals.layout.vectors::<S>() {
            let mut gradient = [[Floats::new(simd, 0.1); 3]; SAMPLING.count];
            composite::backward(simd, intervals, weights, rays, &mut gradient, Floats::new(simd, 0.1));
            black_box(&gradient);
        }
    }
}

fn rays(c: &mut Criterion) {
    let mut numbers = Numbers(3);
    let mut wall = Wall(DensityGrid::new(Vec3::ONE, Vec3::splat(1.0 / 128.0), 1, 0.1));
    let cells = wall.0.sigma.len();
    wall.0.sigma[cells * 3 / 4..].fill(500.0);
    let rays: Vec<Ray> = (0..32)
        .map(|_| {
            let origin = Vec3::new(0.5 * numbers.next(), 0.5 * numbers.next(), 0.0);
            let dir = Vec3::new(0.3 * numbers.next(), 0.3 * numbers.next(), 1.0);
            Ray { origin, dir, dir_cam: Vec3::Z, refined_cam: Vec3::Z, range: (0.01, 0.99) }
        })
        .collect();
    let mut edges = vec![[0.0; STRIDE]; SAMPLING.count + 1];
    let mut sampler = Sampler::default();
    let mut group = c.benchmark_group("rays");
    group.throughput(Throughput::Elements((rays.len() * SAMPLING.count) as u64));
    // A quarter of the way is behind the wall; neighbouring steps share cache lines, so that a step is one load.
    floor("sampler", 32.0 * 0.75 * 128.0, MACHINE.rows(LEVEL_ROWS)[0]);
    group.bench_function("sampler", |b| {
        b.iter(|| pulp::Arch::new().dispatch(SamplerPass(&mut sampler, &wall, &rays, &mut edges)));
    });
    let (mut intervals, mut weights) = (Intervals::default(), Weights::default());
    intervals.reset(RayLayout { rays: rays.len(), samples: SAMPLING.count });
    let layout = intervals.layout;
    for (n, k) in (0..rays.len()).flat_map(|ray| layout.of_ray(ray).zip(0u8..)) {
        (0..3).for_each(|s| intervals.sigma[s][n] = [f32::from(k), 0.1, 0.2][s]);
        (intervals.delta[n], intervals.t[n]) = (0.02, 0.02 * f32::from(k));
    }
    // Two exponentials of some twenty operations, and as many again to mix three streams forward and backward.
    floor("composite", 80.0 * layout.len() as f64, MACHINE.flops);
    group.bench_function("composite", |b| {
        b.iter(|| {
            pulp::Arch::new().dispatch(CompositePass { intervals: &intervals, weights: &mut weights });
        });
    });
}

#[allow(missing_docs)]
mod groups {
    criterion::criterion_group!(benches, super::networks, super::tables, super::rays);
}
criterion_main!(groups::benches);
