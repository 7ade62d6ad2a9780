#![no_main]

use divff_exporters::Manifest;
use divff_exporters::manifest::MANIFEST_NAME;
use divff_fuzz::with_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    with_file(MANIFEST_NAME, bytes, |path| {
        let folder = path.parent().expect("the file is in a folder");
        if let Ok(manifest) = Manifest::read(folder) {
            let _ = manifest.verify(folder);
        }
    });
});
