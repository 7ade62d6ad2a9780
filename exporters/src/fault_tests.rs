//! Every writer, with every single operation on the disk failing in turn.

use std::fs;
use std::io;
use std::path::Path;

use half::f16;

use crate::atomic::faults::{Fault, with_fault};
use crate::manifest::{FORMAT_VERSION, MANIFEST_NAME};
use crate::samples::tetrahedron;
use crate::*;

/// Big enough for several writes beyond the buffer.
fn big_cloud() -> Geometry {
    let vertices = 30_000;
    Geometry {
        name: "points".into(),
        positions: (0..vertices).map(|v| [v as f32, 0.5, -1.0]).collect(),
        triangles: (0..vertices).map(|v| [v, (v + 1) % vertices, (v + 2) % vertices]).collect(),
        features: vec![Features {
            name: "clip".into(),
            dim: 32,
            values: (0..32 * vertices).map(|v| v as f32).collect(),
        }],
        ..Geometry::default()
    }
}

/// Creating, one write, syncing, renaming, syncing the folder.
const FEWEST_OPERATIONS: usize = 5;

/// Fails each operation of `write` with each error, and asserts that the error is told as it was, that the old file is
/// untouched (the new one is there whole, when only the folder could not be synced), and that nothing else is left.
fn assert_every_fault_is_survived(name: &str, write: impl Fn(&Path) -> Result<()>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    write(folder.path()).unwrap();
    let new = fs::read(&path).unwrap();
    for (kind, lasts) in [
        (io::ErrorKind::StorageFull, true),
        (io::ErrorKind::StorageFull, false),
        (io::ErrorKind::PermissionDenied, false),
    ] {
        let mut operations = 0;
        loop {
            fs::write(&path, "old").unwrap();
            let fault = Fault { after: operations, kind, lasts };
            let (outcome, happened) = with_fault(&path, fault, || write(folder.path()));
            let left = fs::read(&path).unwrap();
            let names: Vec<_> =
                fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
            assert_eq!(names, [name], "after {fault:?}");
            if !happened {
                outcome.unwrap();
                assert!(left == new);
                break;
            }
            match outcome {
                Err(Error::Io { path: named, source }) => {
                    assert_eq!((named, source.kind()), (path.clone(), kind), "after {fault:?}");
                }
                other => panic!("{name}: {fault:?} led to {other:?}"),
            }
            operations += 1;
            // Whether this was the last operation, the folder's sync, shows in the file alone.
            assert!(left == b"old" || left == new, "{name}: {fault:?} left {} bytes", left.len());
            if left == new {
                let fault = Fault { after: operations, kind, lasts };
                let (outcome, happened) = with_fault(&path, fault, || write(folder.path()));
                assert!(outcome.is_ok() && !happened, "{name}: the file was there before the last operation");
            }
        }
        assert!(operations >= FEWEST_OPERATIONS, "{name}: only {operations} operations were tried");
    }
}

#[test]
fn ply_survives_every_fault() {
    let cloud = big_cloud();
    assert_every_fault_is_survived("a.ply", |folder| {
        write_ply(&folder.join("a.ply"), &cloud, &PlyOptions::default())
    });
}

#[test]
fn glb_survives_every_fault() {
    let cloud = big_cloud();
    let options = GlbOptions { features: true, ..GlbOptions::default() };
    assert_every_fault_is_survived("a.glb", |folder| write_glb(&folder.join("a.glb"), &cloud, &options));
}

#[test]
fn npz_survives_every_fault() {
    let cloud = big_cloud();
    assert_every_fault_is_survived("a.npz", |folder| {
        write_npz(&folder.join("a.npz"), &cloud, NpzCompression::Stored)
    });
    let small = tetrahedron();
    assert_every_fault_is_survived("b.npz", |folder| {
        write_npz(&folder.join("b.npz"), &small, NpzCompression::Deflated)
    });
    assert_every_fault_is_survived("c.npz", |folder| {
        npz::write_npz_matrices(&folder.join("c.npz"), &[("mean", 2, &[1.0; 6])])
    });
}

#[test]
fn npy_survives_every_fault() {
    let values = vec![0.5; 100_000];
    assert_every_fault_is_survived("a.npy", |folder| write_npy(&folder.join("a.npy"), &[100_000], &values));
    assert_every_fault_is_survived("b.npy", |folder| {
        npy::write_npy_i32(&folder.join("b.npy"), &[3], &[1, 2, 3])
    });
}

#[test]
fn exr_survives_every_fault() {
    let noise = (0..200 * 200).map(|i: u32| f16::from_bits((i.wrapping_mul(2_654_435_761) >> 18) as u16));
    let channel = ExrChannel { name: "R".into(), samples: ExrSamples::F16(noise.collect()) };
    let image = ExrImage { width: 200, height: 200, channels: vec![channel] };
    assert_every_fault_is_survived("a.exr", |folder| write_exr(&folder.join("a.exr"), image.clone()));
}

#[test]
fn manifest_survives_every_fault() {
    let manifest = Manifest { format_version: FORMAT_VERSION, ..Manifest::default() };
    assert_every_fault_is_survived(MANIFEST_NAME, |folder| manifest.write(folder));
}
