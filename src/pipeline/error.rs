//! What can go wrong in a run, over all stages.

use std::path::PathBuf;

use crate::config::ConfigError;
use crate::error::{BadFile, FileError};
use crate::eval::EvalError;
use crate::map::MapError;
use crate::scene::SceneError;
use crate::semantics::SemanticsError;
use crate::train::TrainError;

/// Why a run stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The scene cannot be used.
    #[error(transparent)]
    Scene(#[from] Box<SceneError>),
    /// A setting cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Training failed.
    #[error(transparent)]
    Train(#[from] Box<TrainError>),
    /// Features cannot be trained or asked.
    #[error(transparent)]
    Semantics(#[from] Box<SemanticsError>),
    /// The map cannot be built or written.
    #[error(transparent)]
    Map(#[from] Box<MapError>),
    /// The result cannot be compared with the truth.
    #[error(transparent)]
    Eval(#[from] Box<EvalError>),
    /// The report cannot be made.
    #[error(transparent)]
    Report(#[from] crate::report::ReportError),
    /// A folder or file is not (part of) a run.
    #[error(transparent)]
    NotARun(BadFile),
    /// The scene of a run is not where it was.
    #[error("{}: its scene {} is not there any more; say where it is with --scene", run.display(), scene.display())]
    SceneMoved {
        /// The run.
        run: PathBuf,
        /// Where the scene was.
        scene: PathBuf,
    },
    /// The folder holds another run.
    #[error("{}: cannot go on with this run: {what}; {remedy}", run.display())]
    Differs {
        /// The run.
        run: PathBuf,
        /// What differs.
        what: String,
        /// What to do.
        remedy: &'static str,
    },
    /// Results cannot be stored in a folder.
    #[error("{}: cannot be written to: {source}; choose another --out", path.display())]
    Unwritable {
        /// The folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A file cannot be read or written.
    #[error(transparent)]
    Io(#[from] FileError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] divff_exporters::Error),
}

// Boxed: these errors are large, and every result here would carry their size.
impl From<SceneError> for PipelineError {
    fn from(error: SceneError) -> Self {
        Self::Scene(Box::new(error))
    }
}

impl From<TrainError> for PipelineError {
    fn from(error: TrainError) -> Self {
        Self::Train(Box::new(error))
    }
}

impl From<SemanticsError> for PipelineError {
    fn from(error: SemanticsError) -> Self {
        Self::Semantics(Box::new(error))
    }
}

impl From<MapError> for PipelineError {
    fn from(error: MapError) -> Self {
        Self::Map(Box::new(error))
    }
}

impl From<EvalError> for PipelineError {
    fn from(error: EvalError) -> Self {
        Self::Eval(Box::new(error))
    }
}
