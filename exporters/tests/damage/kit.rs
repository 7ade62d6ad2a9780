//! What must hold of a reader, whatever the bytes.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use divff_exporters::Result;

use crate::mutate::mutate;
use crate::{MEMORY, blames_the_file};

/// Memory is counted for the whole program, so one reader is tried at a time.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

const MOST_TIME: Duration = Duration::from_secs(1);
const MEMORY_PER_BYTE: usize = 4;
const MEMORY_ALWAYS: usize = 64 << 20;

/// Mutated files of each reader, unless `DIVFF_MUTATIONS` says otherwise.
const MUTATIONS: u64 = 10_000;

/// A valid file.
pub struct Sample {
    pub name: &'static str,
    /// What is damaged: the file, or what `wrap` makes a file of.
    pub content: Vec<u8>,
    /// Puts damaged content where a reader gets to see it: with the lengths and checksums that belong to it.
    pub wrap: fn(Vec<u8>) -> Vec<u8>,
    /// Whether each beginning of the file is incomplete. Text may lose its last characters and still be a file.
    pub needs_every_byte: bool,
}

impl Sample {
    /// A file that is damaged as it is.
    pub fn plain(name: &'static str, content: Vec<u8>) -> Self {
        Self { name, content, wrap: |content| content, needs_every_byte: true }
    }
}

/// A folder with the file under trial.
pub struct Bench {
    pub path: PathBuf,
    _folder: tempfile::TempDir,
}

impl Bench {
    pub fn new(file: &str) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        Self { path: folder.path().join(file), _folder: folder }
    }

    /// Reads the bytes as a file and asserts everything but the outcome, which it returns.
    pub fn try_bytes(&self, bytes: &[u8], read: fn(&Self) -> Result<()>, what: &str) -> Result<()> {
        fs::write(&self.path, bytes).expect("the folder is writable");
        // A busy machine may take its time once, a reader that is slow is so every time.
        for is_last in [false, false, true] {
            let before = MEMORY.current_usage();
            MEMORY.reset_peak_usage();
            let start = Instant::now();
            let outcome = catch_unwind(AssertUnwindSafe(|| read(self)));
            let time = start.elapsed();
            let memory = MEMORY.peak_usage().saturating_sub(before);
            let Ok(outcome) = outcome else { panic!("{what}: the reader panicked") };
            let most = MEMORY_PER_BYTE * bytes.len() + MEMORY_ALWAYS;
            assert!(memory <= most, "{what}: {memory} bytes of memory for a file of {}", bytes.len());
            if let Err(error) = &outcome {
                assert!(blames_the_file(error), "{what}: {error:?} does not blame the file");
            }
            if time <= MOST_TIME {
                return outcome;
            }
            assert!(!is_last, "{what}: {time:?}");
        }
        unreachable!("the last try returns or panics")
    }
}

/// Every truncation and many seeded mutations of every sample.
pub fn assert_survives_damage(file: &str, samples: &[Sample], read: fn(&Bench) -> Result<()>) {
    let _guard = ONE_AT_A_TIME.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let bench = Bench::new(file);
    for Sample { name, content, wrap, needs_every_byte } in samples {
        let whole = wrap(content.clone());
        bench.try_bytes(&whole, read, name).unwrap_or_else(|error| panic!("{name}: {error}"));
        for length in 0..whole.len() {
            let what = format!("the first {length} bytes of {name}");
            let outcome = bench.try_bytes(&whole[..length], read, &what);
            assert!(outcome.is_err() || !needs_every_byte, "{what} were read");
        }
    }
    let count = std::env::var("DIVFF_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(MUTATIONS);
    let mut refused = 0;
    for seed in 0..count {
        let sample = &samples[seed as usize % samples.len()];
        let damaged = (sample.wrap)(mutate(&sample.content, seed));
        let what = format!("{}, seed {seed}", sample.name);
        refused += u64::from(bench.try_bytes(&damaged, read, &what).is_err());
    }
    println!("{file}: {refused} of {count} damaged files refused, the others are valid");
    assert!(refused > count / 4, "hardly any damage was noticed: was any done?");
}

/// A find of earlier mutations, kept as a file of its own.
pub fn assert_refused(file: &str, bytes: &[u8], read: fn(&Bench) -> Result<()>) {
    let _guard = ONE_AT_A_TIME.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let outcome = Bench::new(file).try_bytes(bytes, read, file);
    assert!(outcome.is_err(), "{file} was read");
}
