//! Loss and gradients of many seeds against f64: along the gradient of each kind of parameters, the loss must rise as
//! fast as the gradient says.

use super::gradient_tests::{Place, RAYS, Traced, add, trace};
use super::reference::{Numbers, Reference};
use crate::field::Stream;

/// Seeds that are looked at.
const SEEDS: u64 = 100;

/// Relative tolerance of the loss, and of the slope.
const RELATIVE: f64 = 0.01;

/// A group of parameters: where each is, and its gradient.
type Part = Vec<(Place, usize, f64)>;

/// The parameters by kind: tables, networks and codes of each stream, exposures, poses, the rig.
fn parts(traced: &Traced) -> Vec<(String, Part)> {
    let layout = &traced.field.layout;
    let dense = |range: std::ops::Range<usize>| -> Part {
        range.map(|n| (Place::Weights, n, f64::from(traced.dense[n]))).collect()
    };
    let mut parts = Vec::new();
    for s in Stream::ALL {
        let levels = traced.tables[s as usize].iter().enumerate();
        let numbers = levels.flat_map(|(level, grad)| {
            grad.iter().enumerate().map(move |(n, g)| (Place::Table(s as usize, level), n, f64::from(*g)))
        });
        parts.push((format!("tables of {}", s.name()), numbers.collect()));
        let r = &layout.streams[s as usize];
        parts.push((format!("networks of {}", s.name()), dense(r.trunk.start..r.code.end)));
    }
    parts.push(("exposures".into(), dense(layout.exposure.clone())));
    parts.push(("poses".into(), dense(layout.pose.clone())));
    parts.push(("rig".into(), dense(layout.rig.clone())));
    parts
}

/// Slope of the loss along `part`'s gradient, by a central difference of the reference with a step of length `h`.
fn slope(reference: &Reference, x: &Numbers, part: &Part, norm: f64, h: f64) -> f64 {
    let at = |h: f64| {
        let mut moved = x.clone();
        for &(place, n, g) in part {
            add(&mut moved, place, n, h * g / norm);
        }
        reference.loss(&moved)
    };
    (at(h) - at(-h)) / (2.0 * h)
}

#[test]
fn loss_and_slopes_of_a_hundred_seeds_are_within_one_per_cent_of_f64() {
    for seed in 0..SEEDS {
        let traced = trace(1000 + seed);
        let x = Numbers::of(&traced.field);
        traced.with_reference(|reference| {
            let (loss, truth) = (traced.loss / RAYS as f64, reference.loss(&x));
            assert!((loss - truth).abs() <= RELATIVE * truth.abs(), "seed {seed}: loss {loss}, f64 {truth}");
            for (name, part) in parts(&traced) {
                let norm = part.iter().map(|(_, _, g)| g * g).sum::<f64>().sqrt();
                assert!(norm.is_finite() && norm > 0.0, "seed {seed}, {name}: the gradient is {norm}");
                // A moving camera carries samples across cells, where the gradient jumps: a smaller step meets fewer.
                let h = if name == "poses" || name == "rig" { 1e-8 } else { 1e-6 };
                let truth = slope(reference, &x, &part, norm, h);
                let off = (truth - norm).abs();
                assert!(off <= RELATIVE * norm, "seed {seed}, {name}: gradient {norm:e}, slope {truth:e}");
            }
        });
    }
}
