#![no_main]

use divff_exporters::npz::read_npz_matrices;
use divff_exporters::read_npz;
use divff_fuzz::with_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    with_file("a.npz", bytes, |path| {
        let _ = read_npz_matrices(path);
        if let Ok(geometry) = read_npz(path) {
            geometry.validate().expect("what is read is valid");
        }
    });
});
