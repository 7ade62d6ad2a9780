//! Faults on demand: the N-th create, write, sync or rename on behalf of a path fails.

use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// What is to fail. Planned by path, because writers hand their file to threads of the pool.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fault {
    /// Operations that still succeed.
    pub(crate) after: usize,
    pub(crate) kind: io::ErrorKind,
    /// Whether everything fails from then on, as on a full disk, or the one operation only.
    pub(crate) lasts: bool,
}

/// A fault, and whether it has happened.
static PLANNED: Mutex<Option<HashMap<PathBuf, (Fault, bool)>>> = Mutex::new(None);

fn with_planned<T>(act: impl FnOnce(&mut HashMap<PathBuf, (Fault, bool)>) -> T) -> T {
    act(PLANNED.lock().expect("no test panics in here").get_or_insert_default())
}

/// Runs `write` with a fault planned for `path`; also says whether the fault happened.
pub(crate) fn with_fault<T>(path: &Path, fault: Fault, write: impl FnOnce() -> T) -> (T, bool) {
    with_planned(|planned| planned.insert(path.to_owned(), (fault, false)));
    let outcome = write();
    let planned = with_planned(|planned| planned.remove(path));
    (outcome, planned.is_some_and(|(_, happened)| happened))
}

/// Called before each operation on behalf of `target`.
pub(super) fn check(target: &Path) -> io::Result<()> {
    with_planned(|planned| {
        let Some((fault, happened)) = planned.get_mut(target) else { return Ok(()) };
        if fault.after > 0 {
            fault.after -= 1;
            return Ok(());
        }
        if *happened && !fault.lasts {
            return Ok(());
        }
        *happened = true;
        Err(fault.kind.into())
    })
}
