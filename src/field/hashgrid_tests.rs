//! The encoding: what it is at lattice points and between them, and that its two gradients are its transpose and its
//! derivative.

use std::iter::once;

use glam::Vec3;

use super::hashgrid::{AXES, Around, HashGrid, Lattice, Points, Row, without_hashing};
use crate::rng::Rng;
use crate::simd::TILE;

type Tile = Points;

const EXTENT: Vec3 = Vec3::new(1.0, 0.75, 0.5);

/// A dense level of 4 cells a unit and a hashed one of 40, with random rows.
fn grid(seed: u64) -> (HashGrid, Vec<Vec<Row>>) {
    let grid = HashGrid::new(EXTENT, 2, Vec3::splat(4.0), Vec3::splat(40.0), 9);
    assert!(grid.levels[0].dense && !grid.levels[1].dense);
    let mut rng = Rng::new(seed, 0, 0);
    let mut number = || 2.0 * rng.uniform() - 1.0;
    let tables = grid
        .levels
        .iter()
        .map(|l| (0..l.rows).map(|_| Row::new(number(), number(), number(), number())).collect())
        .collect();
    (grid, tables)
}

fn tile(points: impl IntoIterator<Item = Vec3>) -> Tile {
    let mut out = [[0.25; TILE]; AXES];
    for (lane, p) in points.into_iter().take(TILE).enumerate() {
        for axis in 0..3 {
            out[axis][lane] = p[axis];
        }
    }
    out
}

/// Every level's features of a tile, `[level][lane]`.
fn encode(grid: &HashGrid, tables: &[Vec<Row>], pos: &Tile) -> Vec<[Row; TILE]> {
    let encode = |(level, table): (&Lattice, &Vec<Row>)| {
        let mut out = [Row::ZERO; TILE];
        level.encode(table, once((pos, &mut out[..])), &mut Around::default());
        out
    };
    grid.levels.iter().zip(tables).map(encode).collect()
}

fn random_points(seed: u64) -> Vec<Vec3> {
    let mut rng = Rng::new(seed, 1, 0);
    (0..TILE).map(|_| EXTENT * Vec3::new(rng.uniform(), rng.uniform(), rng.uniform())).collect()
}

#[test]
fn lattice_points_of_a_dense_level_get_their_own_row() {
    let (grid, tables) = grid(1);
    // 4 × 3 × 2 cells.
    let lattice: Vec<[usize; 3]> = (0..60).map(|n| [n % 5, n / 5 % 4, n / 20]).filter(|p| p[2] < 3).collect();
    assert_eq!(grid.levels[0].rows, lattice.len());
    for some in lattice.chunks(TILE) {
        let points = some.iter().map(|p| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32) / 4.0);
        let encoded = encode(&grid, &tables, &tile(points));
        for (lane, p) in some.iter().enumerate() {
            let row = tables[0][p[0] + 5 * (p[1] + 4 * p[2])];
            let error = (encoded[0][lane] - row).abs().max_element();
            // a + (b − a)·1 rounds twice; everywhere else the fraction is 0 and the row is exact.
            assert!(error <= 3e-7, "{p:?} is off by {error:e}");
        }
    }
}

#[test]
fn a_dense_level_is_linear_along_each_axis_of_a_cell() {
    let (grid, tables) = grid(2);
    let mut rng = Rng::new(2, 1, 0);
    for axis in 0..3 {
        let start = Vec3::new(0.5, 0.25, 0.25) + 0.2 * Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
        let at = |u: f32| {
            let mut p = start;
            p[axis] = [0.5, 0.25, 0.25][axis] + u * 0.25;
            p
        };
        let encoded = encode(&grid, &tables, &tile([at(0.0), at(0.3), at(0.999_999)]));
        let [a, b, c] = [0, 1, 2].map(|lane| encoded[0][lane]);
        assert!((a + 0.3 * (c - a) - b).abs().max_element() < 3e-6, "axis {axis}");
        assert!((c - a).abs().max_element() > 1e-2, "axis {axis} does not matter");
    }
}

#[test]
fn all_levels_are_continuous_across_cells() {
    let (grid, tables) = grid(3);
    for (level, l) in grid.levels.iter().enumerate() {
        for axis in 0..3 {
            let mut points = random_points(level as u64);
            for (n, p) in points.chunks_exact_mut(2).enumerate() {
                let border = (1.0 + n as f32 % 5.0).min(l.scale[axis] * EXTENT[axis] - 1.0) / l.scale[axis];
                p[1] = p[0];
                p[0][axis] = border - 1e-6;
                p[1][axis] = border + 1e-6;
            }
            let encoded = encode(&grid, &tables, &tile(points));
            for lane in (0..TILE).step_by(2) {
                let jump = encoded[level][lane + 1] - encoded[level][lane];
                // 2e-6 of 40 cells a unit, rows up to 2 apart.
                assert!(jump.abs().max_element() < 2e-4, "level {level}, axis {axis}: jump of {jump}");
            }
        }
    }
}

#[test]
fn tiles_after_one_another_are_as_each_of_them_alone() {
    let (grid, tables) = grid(7);
    let tiles: Vec<Tile> = (0..5).map(|n| tile(random_points(70 + n))).collect();
    // The second and the last are not full.
    let lanes = [TILE, 7, TILE, TILE, 1];
    for (level, table) in grid.levels.iter().zip(&tables) {
        let (mut rows, mut alone) = ([[Row::ZERO; TILE]; 5], [[Row::ZERO; TILE]; 5]);
        let (mut flat, mut slopes) = ([[Row::ZERO; TILE]; 5], [[[Row::ZERO; 3]; TILE]; 5]);
        let outs = rows.iter_mut().zip(lanes).map(|(rows, lanes)| &mut rows[..lanes]);
        level.encode(table, tiles.iter().zip(outs), &mut Around::default());
        let outs = flat.iter_mut().zip(lanes).map(|(rows, lanes)| &mut rows[..lanes]);
        let outs = outs.zip(slopes.iter_mut().map(|slopes| &mut slopes[..]));
        level.encode_with_slopes(table, tiles.iter().zip(outs), &mut Around::default());
        let [mut sums, mut sums_alone] = [0; 2].map(|_| vec![Row::ZERO; level.rows]);
        level.scatter(
            &mut sums,
            tiles.iter().zip(rows.iter().zip(lanes).map(|(g, lanes)| &g[..lanes])),
            &mut Around::default(),
        );
        for ((tile, alone), lanes) in tiles.iter().zip(&mut alone).zip(lanes) {
            level.encode(table, once((tile, &mut alone[..lanes])), &mut Around::default());
            level.scatter(&mut sums_alone, once((tile, &alone[..lanes])), &mut Around::default());
        }
        assert_eq!((&rows, &flat, &sums), (&alone, &alone, &sums_alone));
    }
}

#[test]
fn scatter_is_the_transpose_of_encode() {
    let (grid, tables) = grid(4);
    let pos = tile(random_points(4));
    let encoded = encode(&grid, &tables, &pos);
    let mut rng = Rng::new(4, 2, 0);
    for (level, l) in grid.levels.iter().enumerate() {
        let g: Vec<Row> = (0..TILE).map(|_| Row::splat(2.0 * rng.uniform() - 1.0)).collect();
        let mut scattered = vec![Row::ZERO; l.rows];
        l.scatter(&mut scattered, once((&pos, &g[..])), &mut Around::default());
        let dot = |a: Row, b: Row| f64::from(a.dot(b));
        let left: f64 = (0..TILE).map(|n| dot(encoded[level][n], g[n])).sum();
        let right: f64 = scattered.iter().zip(&tables[level]).map(|(a, b)| dot(*a, *b)).sum();
        assert!(
            (left - right).abs() < 1e-5 * (1.0 + left.abs()),
            "<encode(T), g> = {left}, <T, scatter(g)> = {right}"
        );
        assert!(left.abs() > 1e-3);
    }
}

#[test]
fn slopes_are_the_derivatives() {
    let (grid, tables) = grid(5);
    // In the middle of a cell, so that the difference stays inside it, where the encoding is linear along each axis.
    let middle = |p: Vec3| ((p * 40.0).floor() + 0.5) / 40.0;
    let points: Vec<Vec3> = random_points(5).into_iter().map(middle).collect();
    let pos = tile(points.clone());
    for (n, (level, table)) in grid.levels.iter().zip(&tables).enumerate() {
        let (mut rows, mut slopes) = ([Row::ZERO; TILE], [[Row::ZERO; 3]; TILE]);
        let tiles = once((&pos, (&mut rows[..], &mut slopes[..])));
        level.encode_with_slopes(table, tiles, &mut Around::default());
        assert_eq!(rows, encode(&grid, &tables, &pos)[n]);
        for axis in 0..3 {
            let mut h = Vec3::ZERO;
            h[axis] = 1.0 / 256.0;
            let above = encode(&grid, &tables, &tile(points.iter().map(|p| *p + h)));
            let below = encode(&grid, &tables, &tile(points.iter().map(|p| *p - h)));
            for lane in 0..TILE {
                let difference = (above[n][lane] - below[n][lane]) * 128.0;
                let error = (difference - slopes[lane][axis]).abs().max_element();
                // Values of order 1 are rounded to 1e-7 and divided by 1/128.
                assert!(error < 1e-4, "level {n}, axis {axis}: off by {error:e}");
            }
        }
    }
}

#[test]
fn points_outside_the_box_or_not_finite_are_harmless() {
    let (grid, tables) = grid(6);
    let odd = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 2.0, f32::MAX, f32::MIN, -0.0];
    let points: Vec<Vec3> = odd.iter().flat_map(|&v| [Vec3::splat(v), Vec3::new(v, 0.1, 0.1)]).collect();
    let pos = tile(points.clone());
    let encoded = encode(&grid, &tables, &pos);
    for (lane, p) in points.iter().enumerate() {
        if !p.is_nan() {
            let f = encoded[0][lane].abs().max_element();
            assert!(f <= 1.0 + 1e-6, "{p} gives {f}");
        }
    }
    for level in &grid.levels {
        let tiles = once((&pos, &[Row::ONE; TILE][..]));
        level.scatter(&mut vec![Row::ZERO; level.rows], tiles, &mut Around::default());
    }
    for (level, table) in grid.levels.iter().zip(&tables) {
        let (mut rows, mut slopes) = ([Row::ZERO; TILE], [[Row::ZERO; 3]; TILE]);
        let tiles = once((&pos, (&mut rows[..], &mut slopes[..])));
        level.encode_with_slopes(table, tiles, &mut Around::default());
    }
    let clamped = encode(&grid, &tables, &tile([EXTENT, Vec3::ZERO]));
    let outside = encode(&grid, &tables, &tile([EXTENT * 3.0, -EXTENT]));
    assert_eq!(clamped, outside, "a point outside is seen at the nearest point of the box");
}

#[test]
fn without_hashing_every_level_fits_its_table_and_is_as_fine_as_that_allows() {
    let grid = |coarsest: [f32; 2], finest: [f32; 2], log2_rows: u32| {
        let ([a, t], [b, u]) = without_hashing(EXTENT, coarsest, finest, log2_rows);
        assert!(a <= b && t <= u && b <= finest[0] && u <= finest[1]);
        match finest[1] > 0.0 {
            false => HashGrid::new(EXTENT, 4, Vec3::splat(a), Vec3::splat(b), log2_rows),
            true => HashGrid { levels: Vec::new() }.with_time(EXTENT, 4, [a, t], [b, u], log2_rows),
        }
    };
    for (coarsest, finest) in
        [([4.0, 0.0], [512.0, 0.0]), ([4.0, 3.0], [64.0, 30.0]), ([40.0, 9.0], [41.0, 9.0])]
    {
        for log2_rows in [4, 5, 9, 17] {
            let levels = grid(coarsest, finest, log2_rows).levels;
            assert!(levels.iter().all(|l| l.dense && l.rows <= 1 << log2_rows), "2^{log2_rows}: {levels:?}");
            // One cell more along each axis would be too many: (n + 2)^4 is less than 2.2 (n + 1)^4 from n = 5 on.
            let finest = levels[levels.len() - 1].rows;
            assert!(log2_rows < 17 || finest > (1 << 17) * 10 / 22, "{finest} rows");
            assert!(levels.windows(2).all(|l| l[0].rows <= l[1].rows));
        }
    }
    // What fits is left as it was asked for.
    assert_eq!(without_hashing(EXTENT, [3.0, 0.0], [20.0, 0.0], 17), ([3.0, 0.0], [20.0, 0.0]));
}
