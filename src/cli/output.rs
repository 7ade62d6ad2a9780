//! Standard output that may be cut off (`divff inspect … | head` is not a failure), and standard error that may be gone.

use std::fmt;
use std::io::{self, ErrorKind, Write};

use super::error::CliError;

/// Prints a line; a closed pipe is as good as printed.
pub fn say(text: impl fmt::Display) -> Result<(), CliError> {
    let mut out = io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(CliError::Output(e)),
        _ => Ok(()),
    }
}

/// Says something on standard error. Where nobody can hear it, nothing is lost: the exit code says the rest.
pub fn tell(text: impl fmt::Display) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}
