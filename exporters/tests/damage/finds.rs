//! Files that readers once got wrong, by the seed that damaged them.

use crate::kit::{Sample, assert_refused};
use crate::mutate::mutate;
use crate::samples;

fn damaged(samples: &[Sample], name: &str, seed: u64) -> Vec<u8> {
    let sample = samples.iter().find(|sample| sample.name == name).expect("a sample of this name");
    (sample.wrap)(mutate(&sample.content, seed))
}

/// The offset of a block was beyond what a file can have, and the system's refusal to go there passed for a fault of the
/// disk.
#[test]
fn exr_blocks_beyond_any_file_are_the_files_fault() {
    assert_refused("a.exr", &damaged(&samples::exr(), "plain lines", 495), crate::exr);
}
