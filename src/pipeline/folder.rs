//! The folder of a run: where everything is, and how a run finds its scene and settings again.

use std::fs;
use std::path::{Path, PathBuf};

use divff_exporters::atomic::{check_writable, write_bytes_atomically};
use serde::{Deserialize, Serialize};

use super::PipelineError;
use super::fingerprint::fingerprint;
use crate::config::{Config, ConfigError};
use crate::error::{BadFile, FileError};
use crate::scene::Scene;
use crate::train::Trained;

/// Version of the layout of `run.json`.
const FORMAT: u32 = 1;

/// A folder that holds, or will hold, a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunFolder {
    root: PathBuf,
}

/// `run.json`: what was trained on. The settings are in `config.toml` beside it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Version of this file's layout.
    pub format: u32,
    /// The scene, as an absolute path.
    pub scene: PathBuf,
    /// [`fingerprint()`] of the scene, hexadecimal.
    pub scene_id: String,
    /// Version of the program.
    pub tool_version: String,
}

impl RunFolder {
    /// The folder at `root`, which need not exist.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// A folder that holds a run.
    ///
    /// # Errors
    /// [`PipelineError::NotARun`] where there is no such folder, or no `run.json` in it.
    pub fn open(root: impl Into<PathBuf>) -> Result<Self, PipelineError> {
        let folder = Self::new(root);
        let what = match (folder.root.is_dir(), folder.record_path().is_file()) {
            (true, true) => return Ok(folder),
            (true, false) => "is not a run: it has no run.json",
            (false, _) if folder.root.exists() => "is a file, not the folder of a run",
            (false, _) => "does not exist",
        };
        let remedy = "give the folder that `divff run` or `divff train` made with --out";
        Err(PipelineError::NotARun(BadFile { path: folder.root, what: what.into(), remedy }))
    }

    /// The folder itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// `run.json`.
    pub fn record_path(&self) -> PathBuf {
        self.root.join("run.json")
    }

    /// `config.toml`, the resolved settings.
    pub fn config_path(&self) -> PathBuf {
        self.root.join("config.toml")
    }

    /// `log.jsonl`, one line per progress report.
    pub fn log_path(&self) -> PathBuf {
        self.root.join("log.jsonl")
    }

    /// `metrics.json`.
    pub fn metrics_path(&self) -> PathBuf {
        self.root.join("metrics.json")
    }

    /// `map/`, meshes and point clouds.
    pub fn map(&self) -> PathBuf {
        self.root.join("map")
    }

    /// `views/`, the rendered test frames.
    pub fn views(&self) -> PathBuf {
        self.root.join("views")
    }

    /// `report.html`.
    pub fn report_path(&self) -> PathBuf {
        self.root.join("report.html")
    }

    /// Whether a checkpoint is there.
    pub fn has_checkpoint(&self) -> bool {
        Trained::path(&self.root).is_file()
    }

    /// Makes the folder and checks that it can be written to, before hours of work.
    ///
    /// # Errors
    /// [`PipelineError::Io`] naming the folder.
    pub fn create(&self) -> Result<(), PipelineError> {
        create_writable(&self.root)
    }

    /// Stores what is trained on and how.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write_record(&self, scene: &Scene, config: &Config) -> Result<(), PipelineError> {
        let path = fs::canonicalize(&scene.root).map_err(FileError::at(&scene.root))?;
        let record = RunRecord {
            format: FORMAT,
            scene: path,
            scene_id: fingerprint(scene),
            tool_version: env!("CARGO_PKG_VERSION").into(),
        };
        write_json(&self.record_path(), &record)?;
        Ok(write_bytes_atomically(&self.config_path(), config.to_toml().as_bytes())?)
    }

    /// What was trained on.
    ///
    /// # Errors
    /// [`PipelineError::NotARun`] for a file that is missing, damaged or of another version.
    pub fn record(&self) -> Result<RunRecord, PipelineError> {
        let path = self.record_path();
        let bad = |what: String| PipelineError::NotARun(unusable(&path, what));
        let bytes = fs::read(&path).map_err(|e| bad(e.to_string()))?;
        let record: RunRecord = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
        match record.format {
            FORMAT => Ok(record),
            other => Err(bad(format!("its format is {other} and not {FORMAT}"))),
        }
    }

    /// The settings of the run.
    ///
    /// # Errors
    /// `config.toml` cannot be read, or holds what is not a setting.
    pub fn config(&self) -> Result<Config, PipelineError> {
        let path = self.config_path();
        let bad = |e: std::io::Error| PipelineError::NotARun(unusable(&path, e.to_string()));
        let text = fs::read_to_string(&path).map_err(bad)?;
        let config = Config::default().overlaid(&text, &path.display().to_string())?;
        config.validate().map_err(|e| PipelineError::NotARun(unusable(&path, e.to_string())))?;
        Ok(config)
    }

    /// The scene of the run: at `elsewhere` if given, else where it was when the run was made.
    ///
    /// # Errors
    /// [`PipelineError::SceneMoved`] where it is not there any more, [`PipelineError::Differs`] where it is another
    /// scene now.
    pub fn scene(&self, elsewhere: Option<&Path>) -> Result<Scene, PipelineError> {
        let record = self.record()?;
        let path = elsewhere.unwrap_or(&record.scene);
        if elsewhere.is_none() && !path.exists() {
            return Err(PipelineError::SceneMoved { run: self.root.clone(), scene: record.scene });
        }
        let scene = Scene::open(path)?;
        if fingerprint(&scene) != record.scene_id {
            return Err(PipelineError::Differs {
                run: self.root.clone(),
                what: format!("{} is not the scene that it was trained on", path.display()),
                remedy: "restore the scene, name the right one with --scene, or train again",
            });
        }
        Ok(scene)
    }

    /// The trained field.
    ///
    /// # Errors
    /// [`PipelineError::NotARun`] where training has not stored anything yet; a damaged checkpoint.
    pub fn trained(&self) -> Result<Trained, PipelineError> {
        if !self.has_checkpoint() {
            let (path, what) = (self.root.clone(), "holds no checkpoint yet".into());
            let remedy = "run `divff train` on it first";
            return Err(PipelineError::NotARun(BadFile { path, what, remedy }));
        }
        Ok(Trained::load(&self.root)?)
    }
}

/// Settings that decide what is trained; the others may change between two sessions.
const TRAINING_KEYS: [&str; 5] = ["seed", "time_budget_s", "train", "loss", "field"];

/// The first training setting in which two configurations differ: `train.steps is 700, not 4500`.
///
/// # Errors
/// [`ConfigError::Syntax`] if one of them cannot be told as TOML.
pub fn first_difference(stored: &Config, asked: &Config) -> Result<Option<String>, ConfigError> {
    let table = |c: &Config| {
        toml::Table::try_from(c)
            .map_err(|e| ConfigError::Syntax { origin: "config.toml".into(), message: e.to_string() })
    };
    let (stored, asked) = (table(stored)?, table(asked)?);
    Ok(TRAINING_KEYS.iter().find_map(|key| difference(key, stored.get(*key), asked.get(*key))))
}

fn difference(key: &str, stored: Option<&toml::Value>, asked: Option<&toml::Value>) -> Option<String> {
    use toml::Value::Table;
    if let (Some(Table(a)), Some(Table(b))) = (stored, asked) {
        let keys = a.keys().chain(b.keys().filter(|k| !a.contains_key(*k)));
        let mut inside = keys.map(|k| difference(&format!("{key}.{k}"), a.get(k), b.get(k)));
        return inside.find_map(|d| d);
    }
    let text = |v: Option<&toml::Value>| v.map_or("not set".to_owned(), ToString::to_string);
    // `checkpoint_seconds` changes nothing but when checkpoints are written.
    (stored != asked && key != "train.checkpoint_seconds")
        .then(|| format!("{key} is {} there and {} now", text(stored), text(asked)))
}

/// Makes a folder, with its parents, and checks that a file can be written to it.
///
/// # Errors
/// [`PipelineError::Io`] naming the folder.
pub fn create_writable(folder: &Path) -> Result<(), PipelineError> {
    let io = |source| PipelineError::Unwritable { path: folder.to_owned(), source };
    fs::create_dir_all(folder).map_err(io)?;
    check_writable(folder).map_err(io)
}

fn unusable(path: &Path, what: String) -> BadFile {
    let remedy = "train again with --fresh, or into another folder";
    BadFile { path: path.to_owned(), what, remedy }
}

/// Writes a value as indented JSON, atomically.
///
/// # Errors
/// The file cannot be written.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), PipelineError> {
    let mut json = serde_json::to_vec_pretty(value).map_err(|e| FileError::at(path)(e.into()))?;
    json.push(b'\n');
    Ok(write_bytes_atomically(path, &json)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn differences_name_the_setting() {
        let (a, mut b) = (Config::preset(Preset::Draft), Config::preset(Preset::Draft));
        b.train.checkpoint_seconds = 1.0;
        assert_eq!(first_difference(&a, &b).unwrap(), None);
        b.train.rays = 64;
        let rays = format!("train.rays is {} there and 64 now", a.train.rays);
        assert_eq!(first_difference(&a, &b).unwrap().unwrap(), rays);
        b = a.clone();
        b.time_budget_s = Some(90.0);
        assert_eq!(first_difference(&a, &b).unwrap().unwrap(), "time_budget_s is not set there and 90.0 now");
    }

    #[test]
    fn a_folder_without_run_json_is_not_a_run() {
        let dir = tempfile::tempdir().unwrap();
        let error = RunFolder::open(dir.path()).unwrap_err().to_string();
        assert!(error.contains("no run.json") && error.contains("divff run"), "{error}");
        let error = RunFolder::open(dir.path().join("nowhere")).unwrap_err().to_string();
        assert!(error.contains("does not exist"), "{error}");
    }
}
