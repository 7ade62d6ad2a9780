//! One damaged file after the other, with an eye on the clock and on memory.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::MEMORY;
use crate::mutation::damaged;
use crate::rng::Rng;
use crate::subject::{Outcome, Subject};

/// Longest that a reader may take.
const SECONDS: Duration = Duration::from_secs(1);

/// Memory that any reader may use, beside four times the file.
const MEMORY_BYTES: usize = 64 << 20;

/// Files up to this size are cut after every byte. Larger ones, which take longer to read, are cut and damaged less.
const SMALL: usize = 16_384;

/// Where a file of `len` bytes is cut: everywhere, or all over its head and at some hundred places behind.
fn lengths(len: usize) -> impl Iterator<Item = usize> {
    let (head, step) = if len > SMALL { (SMALL / 16, len / 256) } else { (len, 1) };
    (0..head).chain((head..len).step_by(step))
}

/// Memory is counted for the whole process: one trial at a time.
pub fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Reads all beginnings of a file, and `count` damaged ones. Panics on the first that the reader does not survive.
pub fn survives(subject: &Subject, count: u64) {
    let _alone = alone();
    let folder = tempfile::tempdir().unwrap();
    (subject.make)(folder.path());
    let path = folder.path().join(&subject.file);
    let whole = fs::read(&path).unwrap();
    (subject.read)(folder.path()).unwrap_or_else(|e| panic!("{} is not valid: {e}", subject.file));
    let mut refused = 0;
    for length in lengths(whole.len()) {
        refused += u64::from(try_one(subject, folder.path(), &whole[..length], &format!("cut at {length}")));
    }
    let count = if whole.len() > SMALL { count / 8 } else { count };
    for seed in 0..count {
        let bytes = damaged(&whole, &mut Rng::new(seed, 0, 0));
        refused += u64::from(try_one(subject, folder.path(), &bytes, &format!("mutation {seed}")));
    }
    assert!(refused > 0 || subject.file == "log.jsonl", "{}: no damage is noticed", subject.file);
}

/// Reads `bytes` in the place of the subject's file; whether they were refused. Panics, with the bytes kept, where the
/// reader panics, takes too long or too much, or does not say which file is at fault.
fn try_one(subject: &Subject, folder: &Path, bytes: &[u8], name: &str) -> bool {
    fs::write(folder.join(&subject.file), bytes).unwrap();
    match outcome(subject, folder, bytes.len()) {
        Ok(outcome) => outcome.is_err(),
        Err(what) => {
            let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join("damage");
            fs::create_dir_all(&kept).unwrap();
            let kept = kept.join(format!("{name} {}", subject.file.replace('/', "_")));
            fs::write(&kept, bytes).unwrap();
            panic!("{}, {name}: {what}; see {}", subject.file, kept.display());
        }
    }
}

/// What the reader says of the folder, or what it did wrong.
pub fn outcome(subject: &Subject, folder: &Path, file: usize) -> Result<Outcome, String> {
    let limit = 4 * file + MEMORY_BYTES;
    let attempt = || {
        MEMORY.reset_peak_usage();
        let (before, start) = (MEMORY.current_usage(), Instant::now());
        let read = catch_unwind(AssertUnwindSafe(|| (subject.read)(folder)));
        (read, start.elapsed(), MEMORY.peak_usage().saturating_sub(before))
    };
    let (mut read, mut took, used) = attempt();
    if took > SECONDS {
        // The machine may have been busy with something else.
        (read, took, _) = attempt();
    }
    let outcome = read.map_err(|_| "the reader panicked (see above)".to_owned())?;
    if took > SECONDS {
        return Err(format!("it took {took:?}"));
    }
    if used > limit {
        return Err(format!("{used} bytes of memory for a file of {file}"));
    }
    match &outcome {
        Err(message) if !message.contains(&*folder.to_string_lossy()) => {
            Err(format!("the message names no file: {message}"))
        }
        _ => Ok(outcome),
    }
}
