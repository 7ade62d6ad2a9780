//! Everything that a run can be told, as plain data; the command line and `config.toml` both end up here.

use serde::{Deserialize, Serialize};

use crate::field::{EncodingKind, FieldConfig};
use crate::map::MapConfig;
use crate::semantics::SemanticsConfig;
use crate::stereo::StereoConfig;
use crate::train::TrainConfig;
use crate::train::loss::LossConfig;

/// How much time a run may take, in round numbers on two cores.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Under a minute: a first look.
    Draft,
    /// Under five minutes.
    #[default]
    Standard,
    /// Until it hardly gets better.
    Fine,
}

/// The resolved configuration of a run, stored with it as `config.toml`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Seed of everything random.
    pub seed: u64,
    /// Seconds that training may take, over all sessions; the schedule then follows the clock and not
    /// `train.steps`, so results differ from machine to machine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_budget_s: Option<f64>,
    /// The training loop.
    pub train: TrainConfig,
    /// The loss.
    pub loss: LossConfig,
    /// Depth by stereo.
    pub stereo: StereoConfig,
    /// The field.
    pub field: FieldConfig,
    /// The fields of features.
    pub semantics: SemanticsConfig,
    /// What is extracted from it.
    pub map: MapConfig,
}

/// A setting that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// Not TOML, an unknown key or a value of the wrong type.
    #[error("{origin}: {message}")]
    Syntax {
        /// File or command-line option.
        origin: String,
        /// What the parser says.
        message: String,
    },
    /// A number out of range.
    #[error("{key} = {value}: {remedy}")]
    Range {
        /// Dotted name of the setting.
        key: &'static str,
        /// What it was.
        value: String,
        /// What it must be.
        remedy: &'static str,
    },
}

impl Config {
    /// The settings of a preset.
    pub fn preset(preset: Preset) -> Self {
        let mut config = Self::default();
        match preset {
            // In a short time more steps, of fewer rays with fewer samples, teach more: poses and what moves wait for steps.
            Preset::Draft => {
                (config.train.steps, config.train.rays, config.train.samples) = (1400, 2048, 12);
                // An alignment takes as long as a hundred of its steps.
                config.train.align_at = vec![0.17, 0.3, 0.45, 0.6];
                config.train.still_sharpness = 2.0 * config.train.sharpness;
            }
            Preset::Standard => {}
            Preset::Fine => config.train.steps *= 5,
        }
        config
    }

    /// These settings with those of a TOML text laid over them; `origin` names it in errors.
    ///
    /// # Errors
    /// [`ConfigError::Syntax`] for text that is not TOML, unknown keys and wrong types.
    pub fn overlaid(&self, text: &str, origin: &str) -> Result<Self, ConfigError> {
        let syntax = |message: String| ConfigError::Syntax { origin: origin.to_owned(), message };
        let over: toml::Table = text.parse().map_err(|e: toml::de::Error| syntax(e.to_string()))?;
        let mut all = toml::Table::try_from(self).map_err(|e| syntax(e.to_string()))?;
        merge(&mut all, over);
        all.try_into().map_err(|e: toml::de::Error| syntax(e.to_string()))
    }

    /// These settings with one of them changed: `train.steps=9000`. A value that is not TOML is taken as a string:
    /// `train.streams=static`.
    ///
    /// # Errors
    /// [`ConfigError::Syntax`], in one line, for text without `=`, unknown keys and wrong types.
    pub fn with_setting(&self, setting: &str) -> Result<Self, ConfigError> {
        let origin = format!("--set {setting}");
        let Some((key, value)) = setting.split_once('=') else {
            let message = "there is no `=` in it; write it as --set train.steps=9000".to_owned();
            return Err(ConfigError::Syntax { origin, message });
        };
        let (key, value) = (key.trim(), value.trim());
        let as_is = format!("{key} = {value}");
        let text = match as_is.parse::<toml::Table>() {
            Ok(_) => as_is,
            Err(_) => format!("{key} = {}", toml::Value::String(value.to_owned())),
        };
        self.overlaid(&text, &origin).map_err(|error| match error {
            ConfigError::Syntax { origin, message } => {
                // The parser draws a picture of the line above what is wrong; a value that does not fit has its table below.
                let mut lines = message.lines();
                let line = if message.starts_with("TOML parse error") { lines.last() } else { lines.next() };
                ConfigError::Syntax { origin, message: line.unwrap_or_default().to_owned() }
            }
            other => other,
        })
    }

    /// As TOML, as it stands in `config.toml`.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(self).unwrap_or_else(|e| unreachable!("plain data is TOML: {e}"))
    }

    /// Checks every number's range.
    ///
    /// # Errors
    /// [`ConfigError::Range`] names the first setting that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let t = &self.train;
        let range = |key, value: String, ok: bool, remedy| match ok {
            true => Ok(()),
            false => Err(ConfigError::Range { key, value, remedy }),
        };
        let budget = self.time_budget_s.unwrap_or(1.0);
        let ok = budget.is_finite() && budget > 0.0;
        range("time_budget_s", budget.to_string(), ok, "must be a positive number of seconds")?;
        range("train.steps", t.steps.to_string(), t.steps > 0, "must be at least 1")?;
        range("train.rays", t.rays.to_string(), (1..=1 << 20).contains(&t.rays), "must be 1 to 1048576")?;
        let samples = (2..=256).contains(&t.samples);
        range("train.samples", t.samples.to_string(), samples, "must be 2 to 256")?;
        range("train.patch", t.patch.to_string(), [1, 2, 4].contains(&t.patch), "must be 1, 2 or 4")?;
        let samples = (1..=1024).contains(&t.render_samples);
        range("train.render_samples", t.render_samples.to_string(), samples, "must be 1 to 1024")?;
        let cells = (8.0..=1024.0).contains(&t.grid_cells);
        range("train.grid_cells", t.grid_cells.to_string(), cells, "must be 8 to 1024")?;
        let l = &self.loss;
        for (key, size) in [
            ("train.table_rate", t.table_rate),
            ("train.network_rate", t.network_rate),
            ("train.frequency_rate", t.frequency_rate),
            ("train.exposure_rate", t.exposure_rate),
            ("train.pose_rate", t.pose_rate),
            ("train.rig_rate", t.rig_rate),
            ("train.sharpness", t.sharpness),
            ("train.still_sharpness", t.still_sharpness),
            ("loss.transient", l.transient),
            ("loss.transient_opacity", l.transient_opacity[0]),
            ("loss.transient_opacity", l.transient_opacity[1]),
            ("loss.moving", l.moving),
            ("loss.veil", l.veil),
            ("loss.distortion", l.distortion),
            ("loss.entropy", l.entropy),
            ("loss.depth", l.depth),
            ("loss.flatness", l.flatness),
            ("loss.exposure", l.exposure),
        ] {
            range(key, size.to_string(), size.is_finite() && size >= 0.0, "must be finite and not negative")?;
        }
        for (key, share) in [
            ("train.stereo_at", t.stereo_at),
            ("train.static_until", t.static_until),
            ("train.refine_from", t.refine_from),
            ("train.skip_from", t.skip_from),
            ("train.faint", f64::from(t.faint)),
            ("train.grid_rate", f64::from(t.grid_rate)),
        ] {
            range(key, share.to_string(), (0.0..=1.0).contains(&share), "must be 0 to 1")?;
        }
        let explore = t.explore.iter().all(|e| (0.0..1.0).contains(e));
        range("train.explore", format!("{:?}", t.explore), explore, "must be from 0 to below 1")?;
        let seconds = t.checkpoint_seconds;
        range("train.checkpoint_seconds", seconds.to_string(), seconds >= 0.0, "must not be negative")?;
        let sorted = t.align_at.is_sorted() && t.align_at.iter().all(|a| (0.0..=1.0).contains(a));
        range("train.align_at", format!("{:?}", t.align_at), sorted, "must be rising numbers from 0 to 1")?;
        self.stereo.validate()?;
        let (near, reach) = (self.field.near, self.field.actor_reach);
        let ordered = near > 0.0 && reach > near && reach.is_finite();
        range("field.near", format!("{near} and actor_reach {reach}"), ordered, "0 < near < actor_reach")?;
        let b = l.beta_min;
        range("loss.beta_min", b.to_string(), b.is_finite() && b > 0.0, "must be positive")?;
        let f = &self.field.frequency;
        let ok = (2..=16).contains(&f.bands)
            && f.bands.is_multiple_of(2)
            && (4..=512).contains(&f.hidden)
            && (1..=8).contains(&f.layers)
            && (4..=512).contains(&f.head);
        let remedy = "bands 2-16 and even, hidden and head 4-512, layers 1-8";
        range("field.frequency", format!("{f:?}"), ok, remedy)?;
        // A row for each corner of one cell of space and time.
        let fewest_rows = if self.field.encoding == EncodingKind::Dense { 4 } else { 1 };
        for (key, c) in [
            ("field.persistent", &self.field.persistent),
            ("field.dynamic", &self.field.dynamic),
            ("field.actor", &self.field.actor),
        ] {
            let ok = (1..=16).contains(&c.levels)
                && (fewest_rows..=24).contains(&c.log2_rows)
                && c.coarsest >= 1.0
                && c.finest >= c.coarsest
                && c.finest <= 65536.0
                && (4..=512).contains(&c.hidden)
                && (1..=8).contains(&c.layers)
                && c.code <= 64
                && c.knots <= 65536
                && (c.time_levels == 0 || c.time_levels <= 8 && (1.0..=65536.0).contains(&c.time_finest))
                && (0.0..=1.0).contains(&c.time_cells)
                && c.density_bias.abs() <= 15.0;
            let remedy = "levels 1-16, log2_rows 1-24 (4-24 without hashing), 1 <= coarsest <= finest <= 65536, hidden 4-512, layers 1-8, \
                          code <= 64, knots <= 65536, time_levels <= 8, 1 <= time_finest <= 65536, \
                          0 <= time_cells <= 1, \
                          density_bias within 15";
            range(key, format!("{c:?}"), ok, remedy)?;
        }
        let semantics = self.semantics.check();
        semantics.map_err(|(key, value, remedy)| ConfigError::Range { key, value, remedy })?;
        self.map.validate()
    }
}

fn merge(into: &mut toml::Table, over: toml::Table) {
    for (key, value) in over {
        match (into.get_mut(&key), value) {
            (Some(toml::Value::Table(a)), toml::Value::Table(b)) => merge(a, b),
            (_, value) => {
                into.insert(key, value);
            }
        }
    }
}
