//! Settings of the extraction, and which times are asked for.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::config::ConfigError;
use crate::field::Stream;

/// How the persistent surface is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceMethod {
    /// Rendered median depth of all training frames, fused into a signed distance and marched at 0.
    Tsdf,
    /// The same, and the density where no depth was fused.
    #[default]
    Both,
    /// The density on a grid, marched where a voxel's opacity is one half.
    Density,
}

/// Times of the dynamic and actor geometry: `auto`, `all`, or a list such as `0.1,0.5` or `frame:12,frame:40`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Times {
    /// Those of the scene's ground-truth meshes, else eight spread evenly over the video.
    #[default]
    Auto,
    /// Every frame.
    All,
    /// These.
    List(Vec<TimePoint>),
}

/// One time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimePoint {
    /// Scene time 0–1; the nearest frame stands for it.
    Time(f64),
    /// `frame_index` of a frame of the scene.
    Frame(u32),
}

impl FromStr for Times {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let point = |part: &str| {
            let part = part.trim();
            let time = match part.strip_prefix("frame:") {
                Some(index) => index.trim().parse().ok().map(TimePoint::Frame),
                None => {
                    let time = part.parse().ok().filter(|t| (0.0..=1.0).contains(t));
                    time.map(TimePoint::Time)
                }
            };
            time.ok_or_else(|| {
                format!("`{part}` is no time; give auto, all, numbers from 0 to 1, or frame:12")
            })
        };
        match text.trim() {
            "auto" => Ok(Self::Auto),
            "all" => Ok(Self::All),
            list => list.split(',').map(point).collect::<Result<_, _>>().map(Self::List),
        }
    }
}

impl TryFrom<String> for Times {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Times> for String {
    fn from(times: Times) -> Self {
        times.to_string()
    }
}

impl fmt::Display for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::All => f.write_str("all"),
            Self::List(points) => {
                let names: Vec<String> = points.iter().map(ToString::to_string).collect();
                f.write_str(&names.join(","))
            }
        }
    }
}

impl fmt::Display for TimePoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Time(t) => write!(f, "{t}"),
            Self::Frame(n) => write!(f, "frame:{n}"),
        }
    }
}

/// How far simplified meshes may be from the full ones: `none`, or a length: `5mm`, `0.5cm`, `0.01m`, or in world units
/// `0.005`. With a metric unit, a world unit is taken for a metre.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Length", into = "String")]
pub enum Simplify {
    /// Meshes keep all their triangles.
    #[default]
    None,
    /// Largest distance, world units.
    Within(f64),
}

/// A length as it may stand in a file: text or a bare number.
#[derive(Deserialize)]
#[serde(untagged)]
enum Length {
    Number(f64),
    Text(String),
}

impl FromStr for Simplify {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let trimmed = text.trim();
        if trimmed == "none" {
            return Ok(Self::None);
        }
        let units = [("mm", 1000.0), ("cm", 100.0), ("m", 1.0)];
        let unit = units.iter().find_map(|(unit, parts)| Some((trimmed.strip_suffix(unit)?, *parts)));
        let (number, parts) = unit.unwrap_or((trimmed, 1.0));
        let length = number.trim_end().parse::<f64>().map(|n| n / parts);
        let length = length.ok().filter(|l| l.is_finite() && *l > 0.0);
        length.map(Self::Within).ok_or_else(|| {
            format!("`{text}` is no tolerance; give none, or a length such as 5mm, 0.5cm or 0.005")
        })
    }
}

impl TryFrom<Length> for Simplify {
    type Error = String;

    fn try_from(length: Length) -> Result<Self, String> {
        match length {
            Length::Number(n) => n.to_string().parse(),
            Length::Text(text) => text.parse(),
        }
    }
}

impl fmt::Display for Simplify {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Within(length) => write!(f, "{length}"),
        }
    }
}

impl From<Simplify> for String {
    fn from(simplify: Simplify) -> Self {
        simplify.to_string()
    }
}

/// Settings of the extraction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapConfig {
    /// Side of a voxel, world units; absent: 1/350 of the box's diagonal (2 cm for a kitchen).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voxel_size: Option<f64>,
    /// How the persistent surface is found.
    pub method: SurfaceMethod,
    /// Times of dynamic and actor geometry.
    pub times: Times,
    /// Streams that are extracted.
    pub streams: Vec<Stream>,
    /// Points of the point cloud.
    pub points: usize,
    /// Most rays that are traced for depth, over all frames; frames are reduced to stay below.
    pub depth_rays: usize,
    /// Samples on each of these rays.
    pub depth_samples: usize,
    /// Least fused weight of a voxel, in confident views from the mean distance.
    pub min_views: f32,
    /// Frames nearest in time from which the dynamic surface of a time is fused.
    pub dynamic_views: usize,
    /// Truncation of the signed distance, voxels.
    pub truncation_voxels: f64,
    /// A density surface lies where this many voxels of it stop half of the light.
    pub opaque_voxels: f32,
    /// Components with a shorter bounding-box diagonal are dropped, voxels.
    pub min_component_voxels: f32,
    /// Iterations of smoothing; no vertex moves by more than half a voxel.
    pub smoothing: u32,
    /// Views that must have seen at least one vertex of a triangle.
    pub min_observations: u32,
    /// Whether meshes get fewer triangles, and how far they may be from the full ones.
    pub simplify: Simplify,
    /// How far simplified colours may be off: length of the difference, 8-bit steps.
    pub simplify_color: f32,
    /// How far simplified scores may be off.
    pub simplify_score: f32,
    /// How far simplified features may be off, as a share of the features' root-mean-square length.
    pub simplify_feature: f32,
    /// Playing time of the animation in `scene.glb`, seconds.
    pub animation_seconds: f64,
}

impl Default for MapConfig {
    fn default() -> Self {
        Self {
            voxel_size: None,
            method: SurfaceMethod::Both,
            times: Times::Auto,
            streams: Stream::ALL.to_vec(),
            points: 200_000,
            depth_rays: 1_500_000,
            depth_samples: 32,
            min_views: 0.5,
            dynamic_views: 12,
            truncation_voxels: 3.0,
            opaque_voxels: 2.0,
            min_component_voxels: 12.0,
            smoothing: 2,
            min_observations: 1,
            simplify: Simplify::None,
            simplify_color: 48.0,
            simplify_score: 0.1,
            simplify_feature: 0.25,
            animation_seconds: 10.0,
        }
    }
}

impl MapConfig {
    /// Checks every number's range.
    ///
    /// # Errors
    /// [`ConfigError::Range`] names the first setting that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let range = |key, value: String, ok: bool, remedy| match ok {
            true => Ok(()),
            false => Err(ConfigError::Range { key, value, remedy }),
        };
        if let Some(v) = self.voxel_size {
            range("map.voxel_size", v.to_string(), v.is_finite() && v > 0.0, "must be a positive length")?;
        }
        let n = self.depth_samples;
        range("map.depth_samples", n.to_string(), (4..=256).contains(&n), "must be 4 to 256")?;
        range("map.depth_rays", self.depth_rays.to_string(), self.depth_rays > 0, "must be at least 1")?;
        for (key, value) in [
            ("map.min_views", f64::from(self.min_views)),
            ("map.min_component_voxels", f64::from(self.min_component_voxels)),
        ] {
            range(key, value.to_string(), value >= 0.0 && value.is_finite(), "must be a number from 0")?;
        }
        for (key, value) in [
            ("map.truncation_voxels", self.truncation_voxels),
            ("map.opaque_voxels", f64::from(self.opaque_voxels)),
            ("map.simplify_color", f64::from(self.simplify_color)),
            ("map.simplify_score", f64::from(self.simplify_score)),
            ("map.simplify_feature", f64::from(self.simplify_feature)),
            ("map.animation_seconds", self.animation_seconds),
        ] {
            range(key, value.to_string(), value > 0.0 && value.is_finite(), "must be positive")?;
        }
        Ok(())
    }

    /// Whether a stream is asked for.
    pub fn wants(&self, stream: Stream) -> bool {
        self.streams.contains(&stream)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_survive_their_text() {
        for text in ["auto", "all", "0.1,0.5", "frame:12", "frame:12,0.25"] {
            assert_eq!(text.parse::<Times>().unwrap().to_string(), text);
        }
        let spaced = " 0.1 , frame: 7 ".parse::<Times>().unwrap();
        assert_eq!(spaced, Times::List(vec![TimePoint::Time(0.1), TimePoint::Frame(7)]));
        for bad in ["", "1.5", "-0.1", "NaN", "frame:", "frame:-1", "some", "0.1,,0.2"] {
            assert!(bad.parse::<Times>().is_err(), "{bad}");
        }
    }

    #[test]
    fn tolerances_are_lengths_with_or_without_a_unit() {
        for text in ["5mm", " 0.5 cm", "0.005", "0.005m", "5e-3"] {
            assert_eq!(text.parse::<Simplify>(), Ok(Simplify::Within(0.005)), "{text}");
        }
        assert_eq!("none".parse(), Ok(Simplify::None));
        for bad in ["", "mm", "0", "-5mm", "5km", "inf", "NaN", "5 mmm", "none5"] {
            assert!(bad.parse::<Simplify>().is_err(), "{bad}");
        }
        for toml in ["simplify = 0.005", "simplify = \"5mm\"", "simplify = \"0.005\""] {
            assert_eq!(toml::from_str::<MapConfig>(toml).unwrap().simplify, Simplify::Within(0.005));
        }
        let config = MapConfig { simplify: Simplify::Within(0.003), ..MapConfig::default() };
        assert_eq!(toml::from_str::<MapConfig>(&toml::to_string(&config).unwrap()).unwrap(), config);
        assert!(MapConfig { simplify_color: 0.0, ..config }.validate().is_err());
    }

    #[test]
    fn settings_survive_toml_and_unknown_ones_are_refused() {
        let config = MapConfig { voxel_size: Some(0.02), ..MapConfig::default() };
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<MapConfig>(&text).unwrap(), config);
        assert!(toml::from_str::<MapConfig>("voxel = 0.02").is_err());
        assert!(toml::from_str::<MapConfig>("times = \"frame:x\"").is_err());
        assert!(MapConfig { voxel_size: Some(0.0), ..config.clone() }.validate().is_err());
        assert!(MapConfig { min_views: f32::NAN, ..config }.validate().is_err());
    }
}
