//! Where samples go.

use glam::Vec3;

use super::density_grid::STRIDE;
use super::rays::Ray;
use super::sampler::{Lanes, RayLanes, Sampler, Sampling, Steer};
use crate::rng::Rng;

const SAMPLING: Sampling = Sampling { count: 24, step: 1.0 / 64.0, explore: 0.2, sharpness: 1.0 };

fn ray(start: f32, end: f32) -> Ray {
    Ray { origin: Vec3::ZERO, dir: Vec3::X, dir_cam: Vec3::Z, refined_cam: Vec3::Z, range: (start, end) }
}

/// A density that depends on the distance alone.
struct Along<F>(F);

impl<F: Fn(f32) -> f32> Steer for Along<F> {
    type Cells = Lanes;

    fn find(&self, _: &[Lanes; 3], t: &Lanes) -> Lanes {
        *t
    }

    fn sigma(&self, t: &Lanes) -> [Lanes; 2] {
        [t.map(&self.0), [0.0; STRIDE]]
    }
}

/// Edges of one ray, among lanes that are none.
fn edges_of(
    sampler: &mut Sampler,
    ray: &Ray,
    sampling: &Sampling,
    jitter: f32,
    steer: &impl Steer,
) -> Vec<f32> {
    // Not the first, and with a jitter that nobody else has.
    const LANE: usize = 5;
    let (mut rays, mut jitters) = (RayLanes::default(), [0.9; STRIDE]);
    rays.set(LANE, ray);
    jitters[LANE] = jitter;
    let mut edges = vec![[f32::NAN; STRIDE]; sampling.count + 1];
    sampler.edges(&rays, sampling, &jitters, steer, &mut edges);
    assert!(edges.iter().all(|lanes| lanes[0] == 0.0), "where there is no ray there are no samples");
    edges.iter().map(|lanes| lanes[LANE]).collect()
}

fn edges(sampling: &Sampling, range: (f32, f32), jitter: f32, sigma: impl Fn(f32) -> f32) -> Vec<f32> {
    edges_of(&mut Sampler::default(), &ray(range.0, range.1), sampling, jitter, &Along(sigma))
}

#[test]
fn edges_never_decrease_and_cover_the_range() {
    let mut rng = Rng::new(1, 0, 0);
    for case in 0..2000 {
        let sampling = Sampling {
            count: 2 + rng.below(63),
            step: 0.002 + 0.1 * rng.uniform(),
            explore: rng.uniform() * 0.99,
            sharpness: 2.0 * rng.uniform(),
        };
        let start = 3.0 * rng.uniform();
        let range = (start, start + 1e-4 + 2.0 * rng.uniform());
        // Thin enough that the light is not used up before the end.
        let density = rng.uniform();
        let wave = 40.0 * rng.uniform();
        let e = edges(&sampling, range, rng.uniform(), |t| density * (1.0 + (wave * t).sin()));
        assert!(e.windows(2).all(|w| w[0] <= w[1]), "case {case}: {e:?}");
        assert_eq!(e[0], range.0, "case {case}");
        assert!((e[sampling.count] - range.1).abs() < 1e-5 * range.1, "case {case}: {e:?}");
    }
}

#[test]
fn samples_gather_where_the_grid_is_dense() {
    let e = edges(&SAMPLING, (0.0, 2.0), 0.5, |t| if (1.0..1.1).contains(&t) { 40.0 } else { 0.0 });
    let inside = e.iter().filter(|t| (0.97..1.13).contains(*t)).count();
    assert!(inside > SAMPLING.count / 2, "{inside} of {} edges at the wall: {e:?}", e.len());
    // Some look elsewhere all the same.
    assert!(e.iter().filter(|t| **t < 0.97).count() >= 2);
}

#[test]
fn an_empty_grid_gives_even_samples() {
    let e = edges(&SAMPLING, (1.0, 3.0), 0.5, |_| 0.0);
    for w in e[1..SAMPLING.count].windows(2) {
        assert!((w[1] - w[0] - 2.0 / SAMPLING.count as f32).abs() < 1e-3, "{e:?}");
    }
}

#[test]
fn nothing_is_placed_behind_a_wall() {
    let e = edges(&SAMPLING, (0.0, 2.0), 0.5, |t| if t > 0.5 { 1e6 } else { 0.0 });
    assert!(e[SAMPLING.count] < 0.6, "{e:?}");
}

#[test]
fn extreme_densities_give_finite_edges() {
    for sigma in [0.0, 1e-30, 1e30, f32::MAX] {
        let e = edges(&SAMPLING, (0.1, 1.0), 0.0, |_| sigma);
        assert!(e.iter().all(|t| t.is_finite()) && e.windows(2).all(|w| w[0] <= w[1]), "σ = {sigma}: {e:?}");
    }
}

#[test]
fn a_ray_that_misses_the_box_places_nothing() {
    assert!(edges(&SAMPLING, (1.0, 1.0), 0.5, |_| 1.0).iter().all(|t| *t == 0.0));
}

/// Density of what stands and of what moves.
struct Two<F, G>(F, G);

impl<F: Fn(f32) -> f32, G: Fn(f32) -> f32> Steer for Two<F, G> {
    type Cells = Lanes;

    fn find(&self, _: &[Lanes; 3], t: &Lanes) -> Lanes {
        *t
    }

    fn sigma(&self, t: &Lanes) -> [Lanes; 2] {
        [t.map(&self.0), t.map(&self.1)]
    }
}

#[test]
fn what_is_behind_something_that_moves_is_looked_at_all_the_same() {
    let slab = |at: f32| move |t: f32| if (at..at + 0.1).contains(&t) { 400.0 } else { 0.0 };
    let near = |from: f32| {
        let steer = Two(slab(1.4), slab(0.5));
        let edges = edges_of(&mut Sampler::default(), &ray(0.0, 2.0), &SAMPLING, 0.5, &steer);
        edges.iter().filter(|t| (from - 0.03..from + 0.13).contains(*t)).count()
    };
    let (hand, wall) = (near(0.5), near(1.4));
    assert!(hand > SAMPLING.count / 3, "{hand} edges at what moves");
    assert!(wall >= SAMPLING.count / 8, "{wall} edges at what stands behind it");
}

#[test]
fn nothing_that_shows_lies_behind_the_cut() {
    let mut rng = Rng::new(3, 0, 0);
    let mut cut_off = 0;
    for case in 0..200 {
        let sampling = Sampling { step: 0.004 + 0.02 * rng.uniform(), ..SAMPLING };
        let (wall, density) = (0.2 + 1.5 * rng.uniform(), 300.0 * rng.uniform());
        let sigma = |t: f32| if t > wall { density } else { 0.3 };
        let (mut with, mut without) = (Sampler::default(), Sampler::without_cut());
        let edges = [&mut with, &mut without]
            .map(|sampler| edges_of(sampler, &ray(0.0, 2.0), &sampling, 0.5, &Along(sigma)));
        assert_eq!(without.spared, 0, "case {case}");
        let [cut, end] = edges.each_ref().map(|e| e[SAMPLING.count]);
        if with.spared == 0 {
            assert_eq!(edges[0], edges[1], "case {case}: the same samples where nothing is cut off");
            continue;
        }
        cut_off += 1;
        let steps = (end - cut) / (2.0 / (2.0 / sampling.step).ceil());
        assert!(
            (steps - with.spared as f32).abs() < 0.1,
            "case {case}: {steps} steps, {} spared",
            with.spared
        );
        // All colours behind the cut together have this weight.
        let depth = 0.3 * cut.min(wall) + density * (cut - wall).max(0.0);
        assert!(
            (-depth).exp() <= 1.01e-4,
            "case {case}: {} of the light goes on behind the cut",
            (-depth).exp()
        );
    }
    assert!(cut_off > 50, "{cut_off} rays were cut off");
}

#[test]
fn rays_side_by_side_are_as_if_each_were_alone() {
    // Of different lengths, some cut off, one that misses the box.
    let steer = Along(|t: f32| if t > 1.0 { 80.0 } else { 0.4 * t });
    let of_lane =
        |n: usize| (ray(0.1 * n as f32, if n == 3 { 0.0 } else { 0.2 + 0.15 * n as f32 }), 0.06 * n as f32);
    let (mut rays, mut jitters) = (RayLanes::default(), [0.0; STRIDE]);
    for n in 0..STRIDE {
        let (ray, jitter) = of_lane(n);
        rays.set(n, &ray);
        jitters[n] = jitter;
    }
    let mut together = vec![[f32::NAN; STRIDE]; SAMPLING.count + 1];
    let mut sampler = Sampler::default();
    sampler.edges(&rays, &SAMPLING, &jitters, &steer, &mut together);
    let mut alone = Sampler::default();
    for n in 0..STRIDE {
        let (ray, jitter) = of_lane(n);
        assert_eq!(rays.hits(n), n != 3);
        let edges = edges_of(&mut alone, &ray, &SAMPLING, jitter, &steer);
        assert!(edges.iter().eq(together.iter().map(|lanes| &lanes[n])), "lane {n}");
    }
    assert_eq!((sampler.taken, sampler.spared), (alone.taken, alone.spared));
    assert!(sampler.spared > 0);
}
