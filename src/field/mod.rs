//! What is learned: encodings, small networks, the three streams; forward and backward.
//!
//! Inside, lengths are in *units*: world coordinates minus the box's smallest corner, divided by the box's longest
//! side, so that the box is `[0, extent]` with `max(extent) == 1` whatever the scene's own size and place.

pub mod batch;
pub mod codes;
pub mod config;
pub mod encoding;
pub mod hashgrid;
#[cfg(test)]
mod hashgrid_tests;
pub mod mlp;
#[cfg(test)]
mod mlp_tests;
pub mod stream;

use std::ops::Range;

use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use self::codes::Trajectory;
use self::config::Widths;
pub use self::config::{EncodingKind, FieldConfig, FrequencyConfig, StreamConfig};
use self::encoding::Encoding;
use self::hashgrid::{HashGrid, Row, without_hashing};
use self::stream::{StreamNet, StreamRanges};
use crate::scene::Aabb;

/// The three parts of an egocentric scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stream {
    /// What stays: world coordinates, no time.
    Persistent,
    /// What is moved now and then: world coordinates and time.
    Dynamic,
    /// The wearer's body: camera coordinates and time.
    Actor,
}

impl Stream {
    /// All three, in the order of every `[_; 3]`.
    pub const ALL: [Self; 3] = [Self::Persistent, Self::Dynamic, Self::Actor];

    /// Lower-case name as used in files and on the command line.
    pub fn name(self) -> &'static str {
        ["persistent", "dynamic", "actor"][self as usize]
    }
}

/// Between world coordinates and the field's units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Normalisation {
    /// World position of the unit origin.
    pub origin: DVec3,
    /// World length of one unit.
    pub scale: f64,
    /// The box in units; its largest component is 1.
    pub extent: Vec3,
}

impl Normalisation {
    /// The box mapped to `[0, extent]`.
    pub fn new(bounds: Aabb) -> Self {
        let size = bounds.max - bounds.min;
        let scale = size.max_element();
        Self { origin: bounds.min, scale, extent: (size / scale).as_vec3() }
    }

    /// World to units; f64 until the origin is subtracted.
    pub fn to_unit(&self, p: DVec3) -> Vec3 {
        ((p - self.origin) / self.scale).as_vec3()
    }

    /// Units to world.
    pub fn to_world(&self, p: Vec3) -> DVec3 {
        p.as_dvec3() * self.scale + self.origin
    }
}

/// Which part of the flat weight vector is what.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layout {
    /// Networks and codes of each stream; empty ranges for an absent stream.
    pub streams: [StreamRanges; 3],
    /// Exposure: per knot, gain (log) and offset of the three channels.
    pub exposure: Range<usize>,
    /// Pose refinement: per knot, a rotation (rad) and a translation (units) in the camera's axes.
    pub pose: Range<usize>,
    /// The rig: rotation and translation shared by all frames; relative change of the focal length, and of its growth
    /// with the squared distance from the axis.
    pub rig: Range<usize>,
    /// Length of the whole vector.
    pub len: usize,
}

/// Everything that determines a field but its learned numbers; stored with every checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldShape {
    /// How it was asked for.
    pub config: FieldConfig,
    /// World ↔ units.
    pub normalisation: Normalisation,
    /// The streams that this scene has.
    pub streams: [bool; 3],
    /// Times of the training frames: the knots of exposure and pose refinement.
    pub times: Vec<f32>,
    /// What a ray that leaves the box sees, sRGB 0–1.
    pub background: [f32; 3],
}

impl FieldShape {
    /// What a stream sees of a position: in the box, or in the camera's frustum for the actor.
    pub fn encoding(&self, stream: Stream) -> Encoding {
        let c = self.config.stream(stream);
        if self.config.encoding == EncodingKind::Frequency {
            return Encoding::frequency(self.config.frequency.bands);
        }
        let actor = stream == Stream::Actor;
        let extent = if actor { Vec3::ONE } else { self.normalisation.extent };
        let range = |coarsest, finest| match self.config.encoding {
            EncodingKind::Dense => without_hashing(extent, coarsest, finest, c.log2_rows),
            _ => (coarsest, finest),
        };
        let ([coarsest, _], [finest, _]) = range([c.coarsest, 0.0], [c.finest, 0.0]);
        let grid = HashGrid::new(extent, c.levels, Vec3::splat(coarsest), Vec3::splat(finest), c.log2_rows);
        let frames = self.times.len() as f32;
        let cells = (c.time_cells * frames).max(1.0);
        let (coarsest, finest) = range([c.coarsest, 0.125 * frames], [c.time_finest, cells]);
        grid.with_time(extent, c.time_levels, coarsest, finest, c.log2_rows).into()
    }
}

/// The field: three streams, frame codes, exposure and pose refinement.
#[derive(Clone, Debug)]
pub struct Field {
    /// What it was built from.
    pub shape: FieldShape,
    /// World ↔ units.
    pub normalisation: Normalisation,
    /// The streams that this scene has; `None` for one that is absent.
    pub nets: [Option<StreamNet>; 3],
    /// Trajectories of the frame codes (persistent: none).
    pub codes: [Option<Trajectory>; 3],
    /// Per-frame exposure, width 6.
    pub exposure: Trajectory,
    /// Per-frame pose refinement, width 6.
    pub pose: Trajectory,
    /// Where the dense parameters are.
    pub layout: Layout,
    /// Tables `[stream][level][row]`; those of levels without anything to learn are empty.
    pub tables: [Vec<Vec<Row>>; 3],
    /// Networks, codes, exposure and poses, by `layout`.
    pub weights: Vec<f32>,
    /// Closest distance that is rendered, units.
    pub near: f32,
    /// Farthest the actor reaches, units.
    pub actor_far: f32,
    /// What a ray that leaves the box sees, sRGB 0–1.
    pub background: Vec3,
}

/// Width of the view encoding: spherical harmonics of degree 1 to 4.
///
/// What a glossy door mirrors changes fast with the direction; what the colours of its surface cannot say is put behind it.
pub const VIEW: usize = 24;

/// Width of the trunk's output above lattices: raw density, then geometry features for the head.
const GEOMETRY: usize = 16;

impl Field {
    /// An untrained field with all numbers zero; see [`Self::init`].
    pub fn zeros(shape: FieldShape) -> Self {
        let (config, normalisation, streams) = (&shape.config, shape.normalisation, shape.streams);
        let extent = normalisation.extent;
        let times = &shape.times;
        let net = |stream: Stream| {
            let c = config.stream(stream);
            let view = if stream == Stream::Persistent { VIEW } else { 0 };
            let widths = config.widths(stream);
            StreamNet::new(shape.encoding(stream), &widths, c.code, view, c.density_bias)
        };
        let code = |stream: Stream| {
            let c = config.stream(stream);
            (c.code > 0).then(|| match c.knots {
                0 => Trajectory::at(times.clone(), c.code),
                n => Trajectory::even(n, c.code),
            })
        };
        let nets = Stream::ALL.map(|s| streams[s as usize].then(|| net(s)));
        let codes = Stream::ALL.map(|s| if streams[s as usize] { code(s) } else { None });
        let exposure = Trajectory::at(times.clone(), 6);
        let pose = Trajectory::at(times.clone(), 6);
        let layout = Layout::new(&nets, &codes, &exposure, &pose);
        let diagonal = extent.length();
        Self {
            normalisation,
            tables: nets.each_ref().map(|n| n.as_ref().map_or(Vec::new(), empty_tables)),
            weights: vec![0.0; layout.len],
            nets,
            codes,
            exposure,
            pose,
            layout,
            near: config.near * diagonal,
            actor_far: config.actor_reach * diagonal,
            background: Vec3::from(shape.background),
            shape,
        }
    }

    /// The network of a stream, if the scene has it.
    pub fn net(&self, stream: Stream) -> Option<&StreamNet> {
        self.nets[stream as usize].as_ref()
    }

    /// Gives all weights their random start.
    pub fn init(&mut self, seed: u64) {
        let mut rng = crate::rng::Rng::new(seed, 0, 0);
        for s in Stream::ALL {
            let Some(net) = &self.nets[s as usize] else { continue };
            let r = &self.layout.streams[s as usize];
            self.weights[r.trunk.clone()].copy_from_slice(&net.trunk.init(|| rng.uniform()));
            self.weights[r.head.clone()].copy_from_slice(&net.head.init(|| rng.uniform()));
            for w in &mut self.weights[r.code.clone()] {
                *w = 0.1 * (2.0 * rng.uniform() - 1.0);
            }
            for row in self.tables[s as usize].iter_mut().flatten() {
                *row = Row::from_array(std::array::from_fn(|_| 1e-2 * (2.0 * rng.uniform() - 1.0)));
            }
        }
    }
}

impl FieldConfig {
    /// The configuration of one stream.
    pub fn stream(&self, stream: Stream) -> &StreamConfig {
        [&self.persistent, &self.dynamic, &self.actor][stream as usize]
    }

    /// Widths of the networks of one stream.
    pub fn widths(&self, stream: Stream) -> Widths {
        let (c, f) = (self.stream(stream), &self.frequency);
        match self.encoding {
            EncodingKind::Hash | EncodingKind::Dense => {
                Widths { hidden: c.hidden, layers: c.layers, skip: None, geometry: GEOMETRY, head: c.hidden }
            }
            EncodingKind::Frequency => Widths {
                hidden: f.hidden,
                layers: f.layers,
                skip: Some(f.layers / 2 + 1),
                geometry: f.hidden,
                head: f.head,
            },
        }
    }
}

impl Layout {
    /// Everything that moves cameras: poses and rig.
    pub fn refinement(&self) -> Range<usize> {
        self.pose.start..self.rig.end
    }

    fn new(
        nets: &[Option<StreamNet>; 3],
        codes: &[Option<Trajectory>; 3],
        exposure: &Trajectory,
        pose: &Trajectory,
    ) -> Self {
        let mut len = 0;
        let mut take = |n: usize| {
            len += n;
            len - n..len
        };
        let streams = std::array::from_fn(|s| {
            let net = nets[s].as_ref();
            StreamRanges {
                trunk: take(net.map_or(0, |n| n.trunk.parameters())),
                head: take(net.map_or(0, |n| n.head.parameters())),
                code: take(codes[s].as_ref().map_or(0, Trajectory::parameters)),
            }
        });
        let exposure = take(exposure.parameters());
        let pose = take(pose.parameters());
        let rig = take(8);
        Self { streams, exposure, pose, rig, len }
    }
}

fn empty_tables(net: &StreamNet) -> Vec<Vec<Row>> {
    net.encoding.levels.iter().map(|l| vec![Row::ZERO; l.rows()]).collect()
}

/// What degrees 3 and 4 of the view encoding are multiplied by: colours that change fast with the direction are learned slowly, and
/// so only of what is seen from many directions. At full size, few views would be explained by them and not by geometry.
pub const FAST_CHANGE: [f32; 2] = [0.6, 0.5];

/// Real spherical harmonics of degree 1 to 4 of a unit direction, without their constants' signs; degrees 3 and 4 times
/// [`FAST_CHANGE`].
pub fn view_encoding(d: Vec3) -> [f32; VIEW] {
    let Vec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut encoding = [
        0.488_602_5 * y,
        0.488_602_5 * z,
        0.488_602_5 * x,
        1.092_548_4 * x * y,
        1.092_548_4 * y * z,
        0.315_391_57 * (3.0 * z * z - 1.0),
        1.092_548_4 * x * z,
        0.546_274_2 * (xx - yy),
        0.590_043_6 * y * (3.0 * xx - yy),
        2.890_611_4 * x * y * z,
        0.457_045_8 * y * (5.0 * zz - 1.0),
        0.373_176_34 * z * (5.0 * zz - 3.0),
        0.457_045_8 * x * (5.0 * zz - 1.0),
        1.445_305_7 * z * (xx - yy),
        0.590_043_6 * x * (xx - 3.0 * yy),
        2.503_342_9 * x * y * (xx - yy),
        1.770_130_8 * y * z * (3.0 * xx - yy),
        0.946_174_7 * x * y * (7.0 * zz - 1.0),
        0.669_046_5 * y * z * (7.0 * zz - 3.0),
        0.105_785_55 * (35.0 * zz * zz - 30.0 * zz + 3.0),
        0.669_046_5 * x * z * (7.0 * zz - 3.0),
        0.473_087_35 * (xx - yy) * (7.0 * zz - 1.0),
        1.770_130_8 * x * z * (xx - 3.0 * yy),
        0.625_835_7 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    ];
    encoding[8..15].iter_mut().for_each(|v| *v *= FAST_CHANGE[0]);
    encoding[15..].iter_mut().for_each(|v| *v *= FAST_CHANGE[1]);
    encoding
}
