//! Round trips and damaged files.

use std::fs;
use std::path::PathBuf;

use super::*;
use crate::samples::{assert_every_truncation_fails, assert_no_damage_panics};

fn temp_file() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    (folder, path)
}

fn half(name: &str, value: impl Fn(usize) -> f32, pixels: usize) -> ExrChannel {
    let samples = ExrSamples::F16((0..pixels).map(|i| f16::from_f32(value(i))).collect());
    ExrChannel { name: name.into(), samples }
}

/// 37 lines: two whole blocks of 16 and one of 5.
fn view() -> ExrImage {
    let (width, height) = (19, 37);
    let pixels = width * height;
    let mut channels: Vec<_> = ["R", "G", "B", "relevancy_the_red_cup.Y", "clip_000.R", "clip_000.A"]
        .into_iter()
        .enumerate()
        .map(|(c, name)| half(name, move |i| (i * (c + 1)) as f32 / 4000.0, pixels))
        .collect();
    let depth = (0..pixels).map(|i| 0.1 + i as f32 * 1e-3).collect();
    channels.push(ExrChannel { name: "depth.Z".into(), samples: ExrSamples::F32(depth) });
    ExrImage { width, height, channels }
}

#[test]
fn a_view_survives_bit_for_bit_and_by_name() {
    let (_folder, path) = temp_file();
    let view = view();
    write_exr(&path, view.clone()).unwrap();
    let read = read_exr(&path).unwrap();
    assert_eq!((read.width, read.height), (view.width, view.height));
    assert_eq!(read.channels.len(), view.channels.len());
    for channel in &view.channels {
        assert_eq!(read.channel(&channel.name), Some(&channel.samples), "{}", channel.name);
    }
    assert!(read.channel("A").is_none());
}

#[test]
fn other_compressions_lose_nothing_but_the_last_digits_of_pxr24() {
    let (_folder, path) = temp_file();
    let view = view();
    for compression in [ExrCompression::None, ExrCompression::Zip, ExrCompression::Piz, ExrCompression::Pxr24]
    {
        write_exr_with(&path, view.clone(), compression).unwrap();
        let read = read_exr(&path).unwrap();
        for channel in &view.channels {
            let found = read.channel(&channel.name).unwrap();
            match (found, &channel.samples) {
                (ExrSamples::F32(found), ExrSamples::F32(samples))
                    if compression == ExrCompression::Pxr24 =>
                {
                    let close = |(a, b): (&f32, &f32)| (a - b).abs() <= b.abs() * 2f32.powi(-15);
                    assert!(found.iter().zip(samples).all(close));
                }
                (found, samples) => assert_eq!(found, samples, "{compression:?} {}", channel.name),
            }
        }
    }
}

#[test]
fn a_file_is_one_unnamed_part_of_zip_scan_lines_in_increasing_order() {
    let (_folder, path) = temp_file();
    write_exr(&path, view()).unwrap();
    let meta = ::exr::meta::MetaData::read_from_file(&path, true).unwrap();
    let [header] = &meta.headers[..] else { panic!("{} parts", meta.headers.len()) };
    assert_eq!(header.own_attributes.layer_name, None);
    assert_eq!(header.compression, x::Compression::ZIP16);
    assert_eq!(header.line_order, x::LineOrder::Increasing);
    assert!(!header.blocks.has_tiles());
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let (_folder, path) = temp_file();
    let files: Vec<Vec<u8>> = [1, 3]
        .into_iter()
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| write_exr(&path, view())).unwrap();
            fs::read(&path).unwrap()
        })
        .collect();
    assert!(files[0] == files[1]);
}

#[test]
fn exr_rejects_every_truncation_and_no_damage_panics() {
    let (_folder, path) = temp_file();
    let mut view = view();
    view.channels.truncate(2);
    write_exr(&path, view).unwrap();
    assert_every_truncation_fails(&path, read_exr);
    assert_no_damage_panics(&path, read_exr);
}

#[test]
fn a_header_that_claims_a_huge_picture_is_rejected_at_once() {
    let (_folder, path) = temp_file();
    write_exr(&path, view()).unwrap();
    let mut file = fs::read(&path).unwrap();
    let key = b"dataWindow\0box2i\0";
    let at = file.windows(key.len()).position(|w| w == key).unwrap() + key.len() + 4 + 8;
    file[at..at + 8].copy_from_slice(&[0xff, 0xff, 0x0f, 0, 0xff, 0xff, 0x0f, 0]);
    fs::write(&path, file).unwrap();
    assert!(matches!(read_exr(&path), Err(Error::Invalid { .. })));
}

#[test]
fn pictures_that_break_an_invariant_are_refused() {
    let (_folder, path) = temp_file();
    let complaint = |change: fn(&mut ExrImage)| {
        let mut view = view();
        change(&mut view);
        write_exr(&path, view).unwrap_err().to_string()
    };
    assert!(complaint(|v| v.width = 18).contains("one per pixel"));
    assert!(complaint(|v| v.height = 0).contains("no picture size"));
    assert!(complaint(|v| v.channels.clear()).contains("no channels"));
    assert!(complaint(|v| v.channels[1].name = "R".into()).contains("two channels `R`"));
    assert!(complaint(|v| v.channels[1].name = "".into()).contains("no channel name"));
    assert!(
        complaint(|v| v.channels[6].samples = ExrSamples::F32(vec![f32::NAN; 19 * 37])).contains("depth.Z")
    );
    assert!(
        complaint(|v| v.channels[0].samples = ExrSamples::F16(vec![f16::INFINITY; 19 * 37])).contains("`R`")
    );
    assert!(!path.exists());
}
