//! From the command line to a [`Config`]: the preset, then the file, then single settings.

use std::fs;

use divff::config::{Config, Preset};
use divff::field::EncodingKind;

use super::args::{EncodingArg, PresetArg, SettingsArgs};
use super::error::CliError;

impl From<PresetArg> for Preset {
    fn from(preset: PresetArg) -> Self {
        match preset {
            PresetArg::Draft => Self::Draft,
            PresetArg::Standard => Self::Standard,
            PresetArg::Fine => Self::Fine,
        }
    }
}

impl From<EncodingArg> for EncodingKind {
    fn from(encoding: EncodingArg) -> Self {
        match encoding {
            EncodingArg::Hash => Self::Hash,
            EncodingArg::Dense => Self::Dense,
            EncodingArg::Frequency => Self::Frequency,
        }
    }
}

/// The resolved and checked settings.
pub fn resolve(args: &SettingsArgs) -> Result<Config, CliError> {
    let mut config = Config::preset(args.preset.into());
    if let Some(path) = &args.config {
        let text = fs::read_to_string(path).map_err(|e| CliError::Input {
            path: path.clone(),
            what: e.to_string(),
            remedy: "name a TOML file with settings",
        })?;
        config = config.overlaid(&text, &path.display().to_string())?;
    }
    for setting in &args.set {
        config = config.with_setting(setting)?;
    }
    if let Some(seed) = args.seed {
        config.seed = seed;
    }
    if let Some(budget) = args.time_budget {
        config.time_budget_s = Some(budget.as_secs_f64());
    }
    if let Some(encoding) = args.encoding {
        config.field.encoding = encoding.into();
    }
    if let Some(error) = args.feature_error {
        config.semantics.compress.feature_error = error;
        config.semantics.compress.dim = None;
    }
    config.map.simplify = args.simplify.unwrap_or(config.map.simplify);
    config.validate()?;
    Ok(config)
}

#[cfg(test)]
mod tests {
    use divff::map::Simplify;
    use divff::train::StreamChoice;

    use super::*;

    #[test]
    fn values_are_toml_or_bare_strings() {
        let config = Config::default();
        assert_eq!(config.with_setting("train.steps=12").unwrap().train.steps, 12);
        assert_eq!(config.with_setting("train.streams=static").unwrap().train.streams, StreamChoice::Static);
        assert_eq!(config.with_setting("train.streams=\"all\"").unwrap().train.streams, StreamChoice::All);
        assert_eq!(config.with_setting("train.explore=[0.25, 0.5]").unwrap().train.explore, [0.25, 0.5]);
    }

    #[test]
    fn mistakes_name_the_option() {
        for wrong in ["train.steps", "train.stepz=1", "train.steps=many", "train=1", "=1"] {
            let message = Config::default().with_setting(wrong).unwrap_err().to_string();
            assert!(message.contains(&format!("--set {wrong}")), "{message}");
            assert!(!message.contains('\n'), "{message}");
        }
        let unknown = Config::default().with_setting("train.stepz=1").unwrap_err().to_string();
        assert!(unknown.contains("unknown field `stepz`"), "{unknown}");
        let unknown = Config::default().with_setting("field.encoding=fourier").unwrap_err().to_string();
        assert!(unknown.contains("`hash`, `dense`, `frequency`"), "{unknown}");
    }

    #[test]
    fn single_settings_win_over_the_file_and_the_file_over_the_preset() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.toml");
        fs::write(&path, "seed = 3\n[train]\nsteps = 10\nrays = 64\n").unwrap();
        let args = SettingsArgs {
            preset: PresetArg::Draft,
            config: Some(path),
            set: vec!["train.rays=128".into(), "field.encoding=frequency".into()],
            seed: None,
            time_budget: None,
            encoding: Some(EncodingArg::Dense),
            feature_error: Some(0.05),
            simplify: Some("5mm".parse().unwrap()),
        };
        let config = resolve(&args).unwrap();
        assert_eq!((config.seed, config.train.steps, config.train.rays), (3, 10, 128));
        let compress = &config.semantics.compress;
        assert_eq!((compress.dim, compress.feature_error), (None, 0.05));
        assert_eq!(config.field.encoding, EncodingKind::Dense);
        assert_eq!(config.map.simplify, Simplify::Within(0.005));
        assert!(resolve(&SettingsArgs { feature_error: Some(2.0), ..args }).is_err());
    }
}
