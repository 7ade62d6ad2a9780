#![no_main]

use divff_exporters::read_glb;
use divff_fuzz::with_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(contents) = with_file("a.glb", bytes, read_glb) {
        for geometry in contents.geometries {
            geometry.validate().expect("what is read is valid");
        }
    }
});
