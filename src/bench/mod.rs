//! Run time against error, as somebody who has to choose settings would weigh them.
//!
//! A sweep is a list of settings and what is measured with each. In the folder: `<sweep>.csv`, its plots as SVG with the
//! front of what no other setting beats, `bench.md` and `index.html` with all of it, and `runs/` with what was trained,
//! which is taken as it is when the same command is given again.

mod exports;
mod features;
pub mod fields;
mod front;
mod maps;
mod page;
pub mod peers;
mod runs;
mod simplify;
mod table;

use std::fmt;
use std::path::Path;
use std::rc::Rc;
use std::str::FromStr;

use divff_exporters::atomic::write_bytes_atomically;

pub use self::front::{Point, front, recommended};
use self::runs::Measured;
pub use self::table::{Better, Cell, Plot, Row, Sweep};
use crate::config::Config;
use crate::pipeline::folder::create_writable;
use crate::pipeline::{Event, Observer, PipelineError};
use crate::report::chart::standalone;
use crate::scene::Scene;
use crate::train::StreamChoice;

/// What is varied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// How long is trained.
    Training,
    /// How positions are encoded.
    Encoding,
    /// Side of a voxel.
    Voxel,
    /// How the surface is found.
    Method,
    /// How far simplification may go.
    Simplify,
    /// Width and storage of compressed features.
    Features,
    /// File format and storage.
    Export,
}

impl Kind {
    /// All, in the order in which they are run.
    pub const ALL: [Self; 7] = [
        Self::Training,
        Self::Encoding,
        Self::Voxel,
        Self::Method,
        Self::Simplify,
        Self::Features,
        Self::Export,
    ];

    /// Name on the command line and of the files.
    pub fn name(self) -> &'static str {
        ["training", "encoding", "voxel", "method", "simplify", "features", "export"][self as usize]
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|k| k.name() == text);
        found.ok_or_else(|| format!("`{text}` is no sweep; there are {names}"))
    }
}

/// What is swept, and how thoroughly.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Which sweeps.
    pub sweeps: Vec<Kind>,
    /// Fewer settings; see [`quick`] for the runs' own settings.
    pub quick: bool,
}

/// `config` cut down so that all quick sweeps together take less than five minutes on two cores.
pub fn quick(mut config: Config) -> Config {
    // A short training learns by steps, not by rays: 400 of 2048 take three quarters of the time and leave fog.
    config.train.steps = config.train.steps.min(1400);
    config.train.rays = config.train.rays.min(512);
    if config.train.streams == StreamChoice::Auto {
        // So few steps are too few to find out whether something moves.
        config.train.streams = StreamChoice::All;
    }
    let semantics = &mut config.semantics;
    semantics.steps = semantics.steps.min(200);
    semantics.joint_steps = semantics.joint_steps.min(10);
    semantics.rays = semantics.rays.min(2048);
    semantics.cached_rays = semantics.cached_rays.min(150_000);
    config.map.depth_rays = config.map.depth_rays.min(300_000);
    config.map.points = config.map.points.min(50_000);
    config
}

/// A benchmark under way.
struct Bench<'a> {
    scene: &'a Scene,
    config: &'a Config,
    out: &'a Path,
    quick: bool,
    observer: &'a mut dyn Observer,
    /// The run with the settings as they are, which most sweeps share.
    base: Option<Rc<Measured>>,
}

impl Bench<'_> {
    /// Says what is measured next.
    fn announce(&mut self, sweep: Kind, setting: &str) {
        self.observer.event(&Event::Setting { sweep: sweep.name(), setting });
    }

    /// `config` with some settings changed.
    fn with(&self, overrides: &[String]) -> Result<Config, PipelineError> {
        let mut config = self.config.clone();
        for setting in overrides {
            config = config.with_setting(setting)?;
        }
        config.validate()?;
        Ok(config)
    }

    /// Those of two lists that are wanted.
    fn choose<T>(&self, quick: T, full: T) -> T {
        if self.quick { quick } else { full }
    }

    fn sweep(&mut self, kind: Kind) -> Result<Option<Vec<Sweep>>, PipelineError> {
        let found = match kind {
            Kind::Training => runs::training(self),
            Kind::Encoding => runs::encoding(self),
            Kind::Voxel => maps::voxel(self),
            Kind::Method => maps::method(self),
            Kind::Simplify => simplify::simplify(self),
            Kind::Features => features::features(self),
            Kind::Export => return exports::export(self),
        };
        Ok(found?.map(|sweep| vec![sweep]))
    }
}

/// Runs the sweeps on a scene and writes what they found to `out`, each as soon as it is complete.
///
/// `None` if the observer said stop; the same call then goes on from what was trained.
///
/// # Errors
/// [`PipelineError`]: the first thing that went wrong.
pub fn run(
    scene: &Scene,
    config: &Config,
    out: &Path,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Option<Vec<Sweep>>, PipelineError> {
    create_writable(out)?;
    let mut bench = Bench { scene, config, out, quick: options.quick, observer, base: None };
    let mut found = Vec::new();
    for kind in Kind::ALL.into_iter().filter(|k| options.sweeps.contains(k)) {
        let Some(sweeps) = bench.sweep(kind)? else { return Ok(None) };
        for sweep in sweeps {
            write_bytes_atomically(&out.join(format!("{}.csv", sweep.name)), sweep.csv().as_bytes())?;
            for (name, svg) in sweep.pictures() {
                write_bytes_atomically(&out.join(format!("{name}.svg")), standalone(&svg).as_bytes())?;
            }
            found.push(sweep);
        }
        // After each, so that what there is can be looked at.
        write_bytes_atomically(&out.join("bench.md"), page::markdown(scene, &found).as_bytes())?;
        write_bytes_atomically(&out.join("index.html"), page::html(scene, &found).as_bytes())?;
    }
    Ok(Some(found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sweeps_are_named_as_they_are_asked_for() {
        for kind in Kind::ALL {
            assert_eq!(kind.name().parse::<Kind>(), Ok(kind));
        }
        assert!("speed".parse::<Kind>().unwrap_err().contains("training, encoding"));
    }

    #[test]
    fn quick_settings_are_never_more_than_those_asked_for() {
        let mut config = Config::default();
        config.train.steps = 7;
        config.train.streams = StreamChoice::Static;
        let quick = quick(config.clone());
        assert_eq!((quick.train.steps, quick.train.streams), (7, StreamChoice::Static));
        assert!(quick.semantics.steps < config.semantics.steps);
        quick.validate().unwrap();
    }
}
