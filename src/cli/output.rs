//! Standard output that may be cut off: `divff inspect … | head` is not a failure.

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
