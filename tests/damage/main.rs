//! Damaged input files: whatever a reader is given, it returns in time, in little memory, with a sound value or an
//! error that names a file.
//!
//! Every beginning of a valid file and a fixed list of damaged ones are tried ([`DAMAGED`] a file, more where
//! `DIVFF_MUTATIONS` says so). A find is kept as a test of its own in `finds`.

mod finds;
mod mutation;
#[allow(dead_code)]
#[path = "../../src/rng.rs"]
mod rng;
mod scenes;
mod subject;
#[allow(dead_code)]
#[path = "../support/mod.rs"]
mod support;
mod trial;

use peak_alloc::PeakAlloc;

use crate::subject::Subject;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Damaged files of every valid one.
const DAMAGED: u64 = 1500;

fn mutations() -> u64 {
    let asked = std::env::var("DIVFF_MUTATIONS").ok();
    asked.map_or(DAMAGED, |n| n.parse().expect("DIVFF_MUTATIONS is a number"))
}

fn check(subjects: &[Subject]) {
    for subject in subjects {
        trial::survives(subject, mutations());
    }
}

#[test]
fn lists_of_frames() {
    check(&[
        Subject::new("transforms.json", scenes::nerfstudio, subject::scene),
        Subject::new("meta.json", scenes::epic_diff, subject::scene),
        Subject::new("P01_01.json", scenes::epic_fields, subject::scene),
        Subject::new("points.ply", scenes::nerfstudio, subject::scene),
    ]);
}

#[test]
fn colmap_models() {
    for part in ["cameras", "images", "points3D"] {
        check(&[
            Subject::new(&format!("sparse/0/{part}.bin"), scenes::colmap_bin, subject::scene),
            Subject::new(&format!("sparse/0/{part}.txt"), scenes::colmap_txt, subject::scene),
        ]);
    }
}

#[test]
fn pictures() {
    check(&[
        Subject::new("images/frame_000001.png", scenes::nerfstudio, subject::pixels),
        Subject::new("images/frame_000002.jpg", scenes::nerfstudio, subject::pixels),
        Subject::new("depth/frame_000001.png", scenes::nerfstudio, subject::pixels),
        Subject::new("masks/frame_000001.png", scenes::nerfstudio, subject::pixels),
        Subject::new("hotspots/frame_000000.png", scenes::nerfstudio, subject::features),
    ]);
}

#[test]
fn features() {
    let files = [
        "language_features/frame_000000_s.npy",
        "language_features/frame_000000_f.npy",
        "language_features/frame_000000_b.npy",
        "language_features/frame_000000_p0.npy",
        "language_features/meta.json",
        "video_features/frame_000000_p.npy",
        "video_features/frame_000000_g.npy",
        "dino_features/frame_000000.npy",
        "text/clip.npy",
        "text/clip.txt",
    ];
    check(&files.map(|file| Subject::new(file, scenes::nerfstudio, subject::features)));
}

#[test]
fn runs() {
    check(&[
        Subject::new("checkpoint/field.safetensors", scenes::run, subject::checkpoint),
        Subject::new("config.toml", scenes::run, subject::config),
        Subject::new("run.json", scenes::run, subject::record),
        Subject::new("log.jsonl", scenes::run, subject::log),
    ]);
}
