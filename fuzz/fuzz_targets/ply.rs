#![no_main]

use divff_exporters::{read_ply, read_ply_positions};
use divff_fuzz::with_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    with_file("a.ply", bytes, |path| {
        let _ = read_ply_positions(path);
        if let Ok(geometry) = read_ply(path) {
            geometry.validate().expect("what is read is valid");
        }
    });
});
