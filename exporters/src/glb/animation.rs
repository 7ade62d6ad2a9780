//! Time in a GLB scene: every node with an interval is scaled to nothing outside it, by STEP keys.
//!
//! Blender turns these into constant keys at its frame rate. `KHR_node_visibility` would say it more
//! directly, but Blender ignores it and shows all intervals on top of each other.

use gltf_json::animation::{Animation, Channel, Interpolation, Property, Sampler, Target};
use gltf_json::validation::Checked::Valid;
use gltf_json::{Index, scene};

use super::document::{Document, Piece};
use super::{GlbNode, Interval};

/// Adds the animation and sets the rest pose: of each stream, what is there first.
pub(super) fn animate(
    document: &mut Document,
    nodes: &[GlbNode],
    indices: &[Index<scene::Node>],
    seconds: f64,
) {
    let mut channels = Vec::new();
    let mut samplers = Vec::new();
    for (node, &index) in nodes.iter().zip(indices) {
        let Some(interval) = node.interval else { continue };
        let shown_at_rest = interval.time_start <= first_start(nodes, node);
        if !shown_at_rest {
            document.root.nodes[index.value()].scale = Some([0.0; 3]);
        }
        let (times, scales) = keys(interval, last_end(nodes), seconds);
        let sampler = Sampler {
            extensions: None,
            extras: None,
            input: document.push(Piece::Seconds(times)),
            interpolation: Valid(Interpolation::Step),
            output: document.push(Piece::Scales(scales)),
        };
        channels.push(Channel {
            sampler: Index::push(&mut samplers, sampler),
            target: Target { extensions: None, extras: None, node: index, path: Valid(Property::Scale) },
            extensions: None,
            extras: None,
        });
    }
    if !channels.is_empty() {
        let name = Some("time".to_owned());
        document.root.push(Animation { extensions: None, extras: None, channels, name, samplers });
    }
}

/// When the node's stream begins.
fn first_start(nodes: &[GlbNode], node: &GlbNode) -> f64 {
    let of_stream = nodes.iter().filter(|other| other.stream == node.stream);
    of_stream
        .filter_map(|other| other.interval)
        .map(|interval| interval.time_start)
        .fold(f64::INFINITY, f64::min)
}

fn last_end(nodes: &[GlbNode]) -> f64 {
    nodes.iter().filter_map(|node| node.interval).map(|i| i.time_end).fold(f64::NEG_INFINITY, f64::max)
}

/// Hidden, shown, hidden. Times strictly increase, as glTF demands, even where f32 rounds two of them
/// together.
fn keys(interval: Interval, last_end: f64, seconds: f64) -> (Vec<f32>, Vec<[f32; 3]>) {
    let start = (interval.time_start * seconds) as f32;
    let end = (interval.time_end * seconds) as f32;
    let (mut times, mut scales) = (vec![start], vec![[1.0; 3]]);
    if start > 0.0 {
        times.insert(0, 0.0);
        scales.insert(0, [0.0; 3]);
    }
    if interval.time_end < last_end {
        times.push(end.max(start.next_up()));
        scales.push([0.0; 3]);
    }
    (times, scales)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_hide_a_node_outside_its_interval_and_the_last_one_stays() {
        let interval = Interval { time_start: 0.25, time_end: 0.5 };
        assert_eq!(keys(interval, 1.0, 4.0), (vec![0.0, 1.0, 2.0], vec![[0.0; 3], [1.0; 3], [0.0; 3]]));
        assert_eq!(keys(interval, 0.5, 4.0), (vec![0.0, 1.0], vec![[0.0; 3], [1.0; 3]]));
        let first = Interval { time_start: 0.0, time_end: 0.5 };
        assert_eq!(keys(first, 1.0, 4.0), (vec![0.0, 2.0], vec![[1.0; 3], [0.0; 3]]));
    }

    #[test]
    fn key_times_increase_where_f32_cannot_tell_start_from_end() {
        let interval = Interval { time_start: 0.5, time_end: 0.5 + 1e-12 };
        let (times, _) = keys(interval, 1.0, 10.0);
        assert!(times.windows(2).all(|pair| pair[0] < pair[1]), "{times:?}");
    }
}
