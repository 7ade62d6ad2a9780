//! Ctrl-C: the first one asks to stop, the second one does not ask.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::CliError;
use super::output::tell;

/// What shells report for a program that Ctrl-C ended: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// Set by the first Ctrl-C.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// Listens for Ctrl-C and SIGTERM from now on.
    pub fn install() -> Result<Self, CliError> {
        let flag = Self::default();
        let handler = flag.clone();
        ctrlc::set_handler(move || {
            if handler.0.swap(true, Ordering::SeqCst) {
                std::process::exit(INTERRUPTED);
            }
            tell("stopping … (Ctrl-C again stops at once, without storing anything)");
        })
        .map_err(|e| CliError::Start(format!("no handler for Ctrl-C: {e}")))?;
        Ok(flag)
    }

    /// Whether to stop.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}
