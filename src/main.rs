//! The command line of `divff`: parses, calls the library, tells what came of it.
#![forbid(unsafe_code)]

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
