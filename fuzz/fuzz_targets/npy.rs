#![no_main]

use divff_exporters::{read_npy, read_npy_header};
use divff_fuzz::with_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    with_file("a.npy", bytes, |path| {
        let header = read_npy_header(path);
        if let Ok(array) = read_npy(path) {
            assert_eq!(header.expect("the array has one"), array.header);
            let _ = (array.to_f32(), array.to_i64());
        }
    });
});
