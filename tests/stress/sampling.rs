//! Where samples go when densities are as large and as small as f32 allows, and for any number of samples.

use divff::render::density_grid::STRIDE;
use divff::render::rays::Ray;
use divff::render::sampler::{Lanes, RayLanes, Sampler, Sampling, Steer};
use glam::Vec3;

use crate::SIZES;
use crate::rng::Rng;

/// A density at each of some stretches of the ray, and of what moves the same the other way round.
struct Stretches(Vec<f32>);

impl Steer for Stretches {
    type Cells = Lanes;

    fn find(&self, _: &[Lanes; 3], t: &Lanes) -> Lanes {
        *t
    }

    fn sigma(&self, t: &Lanes) -> [Lanes; 2] {
        let stretch = |t: f32| (t * self.0.len() as f32) as usize % self.0.len();
        [t.map(|t| self.0[stretch(t)]), t.map(|t| self.0[self.0.len() - 1 - stretch(t)])]
    }
}

/// Checks that edges along a ray of length 1 are finite, in order and on it.
fn check(sampling: &Sampling, densities: Vec<f32>, jitter: f32) {
    let range = (0.25, 1.25);
    let ray = Ray { origin: Vec3::ZERO, dir: Vec3::X, dir_cam: Vec3::Z, refined_cam: Vec3::Z, range };
    let mut rays = RayLanes::default();
    rays.set(3, &ray);
    let mut edges = vec![[f32::NAN; STRIDE]; sampling.count + 1];
    let what = format!("{sampling:?}, {densities:?}");
    Sampler::default().edges(&rays, sampling, &[jitter; STRIDE], &Stretches(densities), &mut edges);
    let edges: Vec<f32> = edges.iter().map(|lanes| lanes[3]).collect();
    assert!(edges.iter().all(|t| t.is_finite()), "{what}: {edges:?}");
    assert!(edges.windows(2).all(|w| w[0] <= w[1]), "{what}: {edges:?}");
    assert!(edges[0] == range.0 && edges[sampling.count] <= range.1 * (1.0 + 1e-6), "{what}: {edges:?}");
}

#[test]
fn edges_are_in_order_for_any_density_and_any_number_of_samples() {
    let mut rng = Rng::new(1, 0, 0);
    for count in [1, 2, 24, 100_000] {
        for explore in [0.0, 0.1, 0.99] {
            for sharpness in [0.0, 0.3, 1.0] {
                let sampling = Sampling { count, step: 1.0 / 128.0, explore, sharpness };
                for size in SIZES {
                    check(&sampling, vec![size], rng.uniform());
                    check(&sampling, vec![0.0, size, 1.0], rng.uniform());
                }
                if count < 1000 {
                    let mixed = (0..24).map(|_| SIZES[rng.below(SIZES.len())]).collect();
                    check(&sampling, mixed, rng.uniform());
                }
            }
        }
    }
}

#[test]
fn steps_longer_and_shorter_than_any_ray_are_settled() {
    for step in [1e-30, 1e-6, 10.0, 1e30] {
        check(&Sampling { count: 8, step, explore: 0.2, sharpness: 0.3 }, vec![1.0, 0.0], 0.5);
    }
}
