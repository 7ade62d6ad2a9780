#![no_main]

use divff_exporters::read_exr;
use divff_fuzz::with_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(image) = with_file("a.exr", bytes, read_exr) {
        assert!(image.width * image.height > 0 && !image.channels.is_empty());
    }
});
