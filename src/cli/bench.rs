//! `bench`.

use divff::bench::{self, Options};
use divff::synth::SynthOptions;
use divff::train::StreamChoice;

use super::args::BenchArgs;
use super::demo::{DEMO_FRAMES, own_scene};
use super::error::CliError;
use super::output::say;
use super::progress::Reporter;
use super::run::open;
use super::settings;
use super::stop::StopFlag;

/// `divff bench`.
pub fn bench(args: &BenchArgs, stop: StopFlag) -> Result<(), CliError> {
    let mut config = settings::resolve(&args.settings)?;
    if args.quick {
        config = bench::quick(config);
    }
    let mut reporter = Reporter::new(stop);
    let scene = match &args.scene {
        Some(path) => open(path, &reporter)?,
        None => {
            // Things move in it, and that need not be found out.
            config.train.streams = StreamChoice::All;
            let standard = SynthOptions { seed: config.seed, ..SynthOptions::default() };
            let large = SynthOptions { frames: DEMO_FRAMES, ..standard.clone() };
            let options = if args.quick { standard } else { large };
            own_scene(&args.out.join("scene"), &options, &reporter)?
        }
    };
    let options = Options { sweeps: args.sweeps.clone(), quick: args.quick };
    let found = bench::run(&scene, &config, &args.out, &options, &mut reporter)?;
    drop(reporter);
    let Some(sweeps) = found else { return Err(CliError::Interrupted) };
    for sweep in &sweeps {
        say(format_args!("{}: {}", sweep.name, sweep.recommendation()))?;
    }
    say(format_args!("tables and plots: {}", args.out.join("index.html").display()))
}
