//! Settings of the fields of features: `[semantics]` in `config.toml`.

use serde::{Deserialize, Serialize};

use super::compress::{CompressConfig, CompressError};
use super::relevancy::LERF_TEMPERATURE;
use super::targets::{ImageTargetConfig, VideoTargetConfig};
use crate::field::Stream;

/// Size of the encoding of one stream's features.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadStreamConfig {
    /// Lattices over space.
    pub levels: usize,
    /// Cells along the longest side of the box at the coarsest of them.
    pub coarsest: f32,
    /// Cells along the longest side of the box at the finest of them.
    pub finest: f32,
    /// At most 2^this rows a level.
    pub log2_rows: u32,
    /// Lattices over space and time (dynamic, actor).
    pub time_levels: usize,
    /// Cells along the longest side of the box at the finest of them.
    pub time_finest: f32,
}

/// The fields of features and how they are trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SemanticsConfig {
    /// Whether features are trained at all.
    pub enabled: bool,
    /// What the image-language field is trained on.
    pub image: ImageTargetConfig,
    /// What the video-language field is trained on.
    pub video: VideoTargetConfig,
    /// Rays whose mean is held against the descriptor of a patch, or of the clip in its hotspot: it describes them
    /// together. 0: every ray by itself, as in the paper.
    pub pooled_rays: usize,
    /// Weight of the part features that regularise the video-language field; 0: none.
    pub part_weight: f32,
    /// Numbers per compressed part feature.
    pub part_dim: usize,
    /// How descriptors are compressed.
    pub compress: CompressConfig,
    /// τ of relevancies.
    pub temperature: f32,
    /// Sizes that are tried for a phrase, where features depend on one (`scaled-patches`).
    pub query_scales: usize,
    /// Encoding of what stays.
    pub persistent: HeadStreamConfig,
    /// Encoding of what moves.
    pub dynamic: HeadStreamConfig,
    /// Encoding of the wearer.
    pub actor: HeadStreamConfig,
    /// Width of the hidden layers.
    pub hidden: usize,
    /// Hidden layers.
    pub layers: usize,
    /// Training steps of each space, at frozen geometry.
    pub steps: u64,
    /// Steps after that in which geometry is trained with them; 0: it stays as it was.
    pub joint_steps: u64,
    /// Weight of the features' loss where it pulls at geometry then.
    pub joint_weight: f32,
    /// Rays a step.
    pub rays: usize,
    /// Rays that are traced once and kept, over all frames.
    pub cached_rays: usize,
    /// Samples that are kept of a ray: those that it owes most of its light to.
    pub samples: usize,
    /// Learning rate of the tables before cosine annealing.
    pub table_rate: f32,
    /// Learning rate of the networks before cosine annealing.
    pub network_rate: f32,
}

impl Default for SemanticsConfig {
    fn default() -> Self {
        let persistent = HeadStreamConfig {
            levels: 6,
            coarsest: 8.0,
            finest: 128.0,
            log2_rows: 16,
            time_levels: 0,
            time_finest: 0.0,
        };
        let dynamic = HeadStreamConfig {
            levels: 3,
            finest: 48.0,
            time_levels: 2,
            time_finest: 32.0,
            ..persistent.clone()
        };
        let actor = HeadStreamConfig { finest: 24.0, time_finest: 24.0, ..dynamic.clone() };
        Self {
            enabled: true,
            image: ImageTargetConfig::default(),
            video: VideoTargetConfig::default(),
            pooled_rays: 64,
            part_weight: 0.1,
            part_dim: 16,
            // What is beyond the first components of descriptors of single masks is mostly noise, which views average
            // out, so an error target would ask for dimensions that hold nothing.
            compress: CompressConfig { dim: Some(32), ..CompressConfig::default() },
            temperature: LERF_TEMPERATURE,
            query_scales: 15,
            persistent,
            dynamic,
            actor,
            hidden: 64,
            layers: 1,
            steps: 1500,
            joint_steps: 60,
            joint_weight: 20.0,
            rays: 4096,
            cached_rays: 800_000,
            samples: 8,
            table_rate: 1e-2,
            network_rate: 2e-3,
        }
    }
}

/// A setting of `[semantics]` out of range: its name, what it was and what it must be.
pub type OutOfRange = (&'static str, String, &'static str);

impl SemanticsConfig {
    /// The encoding of one stream.
    pub fn stream(&self, stream: Stream) -> &HeadStreamConfig {
        [&self.persistent, &self.dynamic, &self.actor][stream as usize]
    }

    /// # Errors
    /// The first setting that is out of range.
    pub fn check(&self) -> Result<(), OutOfRange> {
        let range =
            |key, value: String, ok: bool, remedy| if ok { Ok(()) } else { Err((key, value, remedy)) };
        let t = self.temperature;
        range("semantics.temperature", t.to_string(), t > 0.0 && t <= 1e6, "must be above 0 and up to 1e6")?;
        let n = self.query_scales;
        range("semantics.query_scales", n.to_string(), (1..=256).contains(&n), "must be 1 to 256")?;
        let p = self.part_weight;
        range("semantics.part_weight", p.to_string(), (0.0..=100.0).contains(&p), "must be 0 to 100")?;
        let n = self.pooled_rays;
        range("semantics.pooled_rays", n.to_string(), n <= 4096, "must be 0 to 4096")?;
        let d = self.part_dim;
        range("semantics.part_dim", d.to_string(), (1..=512).contains(&d), "must be 1 to 512")?;
        let b = self.image.box_weight;
        range("semantics.image.box_weight", b.to_string(), (0.0..=1.0).contains(&b), "must be 0 to 1")?;
        let h = self.hidden;
        range("semantics.hidden", h.to_string(), (4..=512).contains(&h), "must be 4 to 512")?;
        let l = self.layers;
        range("semantics.layers", l.to_string(), (1..=8).contains(&l), "must be 1 to 8")?;
        let j = self.joint_weight;
        range("semantics.joint_weight", j.to_string(), (0.0..=1e3).contains(&j), "must be 0 to 1000")?;
        range("semantics.steps", self.steps.to_string(), self.steps > 0, "must be at least 1")?;
        let n = self.rays;
        range("semantics.rays", n.to_string(), (1..=1 << 20).contains(&n), "must be 1 to 1048576")?;
        let n = self.cached_rays;
        range("semantics.cached_rays", n.to_string(), (1..=1 << 24).contains(&n), "must be 1 to 16777216")?;
        let n = self.samples;
        range("semantics.samples", n.to_string(), (1..=32).contains(&n), "must be 1 to 32")?;
        let rates =
            [("semantics.table_rate", self.table_rate), ("semantics.network_rate", self.network_rate)];
        for (key, rate) in rates {
            range(key, rate.to_string(), rate.is_finite() && rate >= 0.0, "must be finite and not negative")?;
        }
        let streams = [
            ("semantics.persistent", &self.persistent),
            ("semantics.dynamic", &self.dynamic),
            ("semantics.actor", &self.actor),
        ];
        for (key, c) in streams {
            let remedy = "levels 1-16, log2_rows 1-24, 1 <= coarsest <= finest and time_finest <= 4096, \
                          time_levels 0-8";
            let space = (1..=16).contains(&c.levels) && (1..=24).contains(&c.log2_rows);
            let scale = c.coarsest >= 1.0 && c.finest >= c.coarsest && c.finest <= 4096.0;
            let time = c.time_levels == 0
                || c.time_levels <= 8 && c.time_finest >= c.coarsest && c.time_finest <= 4096.0;
            range(key, format!("{c:?}"), space && scale && time, remedy)?;
        }
        match self.compress.validate() {
            Err(CompressError::Setting { value, remedy, .. }) => Err(("semantics.compress", value, remedy)),
            _ => Ok(()),
        }
    }
}
