//! The one place where errors become exit codes.

use std::error::Error;
use std::io::{self, ErrorKind};
use std::path::PathBuf;
use std::process::ExitCode;

use divff::config::ConfigError;
use divff::eval::EvalError;
use divff::map::MapError;
use divff::pipeline::PipelineError;
use divff::scene::SceneError;
use divff::semantics::SemanticsError;
use divff::synth::SynthError;
use divff::train::TrainError;

/// Why a command did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    /// A stage of a run failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// No scene was made.
    #[error(transparent)]
    Synth(#[from] SynthError),
    /// An option cannot be used.
    #[error("{option}: {what}; {remedy}")]
    Usage {
        /// The option.
        option: String,
        /// What is wrong with it.
        what: String,
        /// What to do.
        remedy: &'static str,
    },
    /// What was named is nothing that `divff` knows.
    #[error("{}: {what}; {remedy}", path.display())]
    Input {
        /// The path.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
        /// What to do.
        remedy: &'static str,
    },
    /// Ctrl-C.
    #[error("stopped after {step} steps; the same command goes on from there")]
    Stopped {
        /// Training steps taken.
        step: u64,
    },
    /// Ctrl-C while nothing can be continued.
    #[error("stopped; nothing was left half-written")]
    Interrupted,
    /// Standard output cannot be written to, e.g. because it goes to a full disk.
    #[error("standard output: {0}")]
    Output(std::io::Error),
    /// The system gave no thread pool or signal handler.
    #[error("cannot start: {0}")]
    Start(String),
}

impl From<SceneError> for CliError {
    fn from(error: SceneError) -> Self {
        Self::Pipeline(error.into())
    }
}

impl From<SemanticsError> for CliError {
    fn from(error: SemanticsError) -> Self {
        Self::Pipeline(error.into())
    }
}

impl From<ConfigError> for CliError {
    fn from(error: ConfigError) -> Self {
        Self::Pipeline(error.into())
    }
}

impl From<divff_exporters::Error> for CliError {
    fn from(error: divff_exporters::Error) -> Self {
        Self::Pipeline(error.into())
    }
}

impl CliError {
    /// What to do, where the system's own word does not say it.
    pub fn hint(&self) -> Option<&'static str> {
        let mut cause: Option<&(dyn Error + 'static)> = Some(self);
        while let Some(error) = cause {
            if let Some(io) = error.downcast_ref::<io::Error>() {
                return match io.kind() {
                    ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
                        Some("make room on that disk and give the same command again")
                    }
                    _ => None,
                };
            }
            cause = error.source();
        }
        None
    }

    /// 2 where the usage or the input is at fault, 1 for everything else.
    pub fn exit_code(&self) -> ExitCode {
        let input_is_bad = match self {
            Self::Pipeline(error) => is_input(error),
            Self::Synth(error) => matches!(error, SynthError::Option { .. } | SynthError::NotEmpty { .. }),
            Self::Usage { .. } | Self::Input { .. } => true,
            Self::Stopped { .. } | Self::Interrupted | Self::Output(_) | Self::Start(_) => false,
        };
        ExitCode::from(if input_is_bad { 2 } else { 1 })
    }
}

fn is_input(error: &PipelineError) -> bool {
    use PipelineError as E;
    match error {
        E::Scene(_) | E::Config(_) | E::NotARun(_) | E::SceneMoved { .. } | E::Differs { .. } => true,
        E::Train(error) => matches!(
            **error,
            TrainError::Scene(_) | TrainError::Config(_) | TrainError::NoPixels | TrainError::Checkpoint(_)
        ),
        E::Map(error) => {
            matches!(**error, MapError::Scene(_) | MapError::Config(_) | MapError::NoSuchFrame { .. })
        }
        E::Semantics(error) => matches!(
            **error,
            SemanticsError::Feature(_)
                | SemanticsError::Scene(_)
                | SemanticsError::Compress(_)
                | SemanticsError::Relevancy(_)
                | SemanticsError::Text(_)
                | SemanticsError::NoFeatures { .. }
                | SemanticsError::Stored(_)
        ),
        E::Eval(error) => !matches!(**error, EvalError::NonFinite { .. } | EvalError::Render { .. }),
        _ => false,
    }
}
