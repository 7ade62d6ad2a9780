//! The command line: arguments in, a few library calls, one message and an exit code out.

mod args;
mod bench;
mod demo;
mod error;
mod inspect;
mod output;
mod progress;
mod query;
mod run;
mod settings;
mod stop;

use std::process::ExitCode;

use args::{Cli, Command};
use clap::Parser;
use error::CliError;
use output::tell;
use stop::StopFlag;

/// Parses the command line and does what it says.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    // What was odd but could be worked with goes to standard error; RUST_LOG=off silences it.
    let filter = tracing_subscriber::EnvFilter::builder()
        .with_default_directive(tracing_subscriber::filter::LevelFilter::WARN.into())
        .from_env_lossy();
    let warnings = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    warnings.without_time().with_target(false).with_ansi(false).init();
    match dispatch(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            match error.hint() {
                Some(hint) => tell(format_args!("error: {error}; {hint}")),
                None => tell(format_args!("error: {error}")),
            }
            error.exit_code()
        }
    }
}

fn dispatch(cli: Cli) -> Result<(), CliError> {
    if let Some(threads) = cli.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|e| CliError::Start(e.to_string()))?;
    }
    // What can be stopped midway asks the flag; everything else is over before anyone could press a key.
    let stop = StopFlag::install;
    match &cli.command {
        Command::Demo(args) => demo::demo(args, stop()?),
        Command::Synth(args) => demo::synth(args),
        Command::Run(args) => run::run(args, stop()?),
        Command::Train(args) => run::train(args, stop()?),
        Command::Export(args) => run::export(args, stop()?),
        Command::Render(args) => run::render(args, stop()?),
        Command::Query(args) => query::query(args),
        Command::Eval(args) => run::eval(args, stop()?),
        Command::Bench(args) => bench::bench(args, stop()?),
        Command::Inspect(args) => inspect::inspect(args),
    }
}
