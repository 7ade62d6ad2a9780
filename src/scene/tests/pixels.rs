//! Pixels come out as they were stored, and damaged files are errors instead of grey.

use std::fs;

use image::{DynamicImage, ExtendedColorType, ImageEncoder};
use serde_json::json;

use super::super::{Frame, SceneError};
use super::*;

/// The first frame of a scene whose image is `image.<ext>` with the given content.
fn frame_with(ext: &str, bytes: &[u8]) -> (Folder, Frame) {
    let folder = Folder::nerfstudio(|_| {});
    let mut frame = folder.open().unwrap().frames.remove(0);
    folder.write(&format!("image.{ext}"), bytes);
    frame.image_path = folder.path(&format!("image.{ext}"));
    (folder, frame)
}

fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

fn jpeg() -> Vec<u8> {
    let rgb = image::RgbImage::from_fn(12, 8, |x, y| image::Rgb([x as u8 * 20, y as u8 * 30, 90]));
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95);
    encoder.write_image(&rgb, 12, 8, ExtendedColorType::Rgb8).unwrap();
    bytes
}

#[test]
fn grey_alpha_and_sixteen_bits_become_eight_bit_rgb() {
    let cases = [
        png(image::GrayImage::from_pixel(12, 8, image::Luma([77]))),
        png(image::RgbaImage::from_pixel(12, 8, image::Rgba([77, 77, 77, 0]))),
        png(image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(12, 8, image::Luma([77u16 * 257]))),
        png(image::ImageBuffer::<image::Rgb<u16>, _>::from_pixel(12, 8, image::Rgb([77u16 * 257; 3]))),
    ];
    for (i, bytes) in cases.iter().enumerate() {
        let (_folder, frame) = frame_with("png", bytes);
        let rgb = frame.load_rgb().unwrap();
        assert_eq!((rgb.width, rgb.height), (12, 8));
        assert_eq!(rgb.pixels, vec![[77; 3]; 96], "case {i}");
    }
}

#[test]
fn pixels_are_rows_from_the_top() {
    let rgb = Folder::nerfstudio(|_| {}).open().map(|s| s.frames[2].load_rgb().unwrap()).unwrap();
    assert_eq!(rgb.pixels[3 * 12 + 5], [100, 90, 50]);
}

#[test]
fn jpeg_rejects_every_truncation() {
    let whole = jpeg();
    let (folder, frame) = frame_with("jpg", &whole);
    let rgb = frame.load_rgb().unwrap();
    assert!(rgb.pixels[8].iter().zip([160u8, 0, 90]).all(|(a, b)| a.abs_diff(b) < 30), "{:?}", rgb.pixels[8]);
    for length in 0..whole.len() {
        folder.write("image.jpg", &whole[..length]);
        let error = frame.load_rgb().expect_err("a cut image was decoded");
        assert!(matches!(error, SceneError::Image { .. }), "{error}");
        assert!(error.to_string().contains("image.jpg, frame frame_000000"), "{error}");
    }
    // Phones append data of their own.
    folder.write("image.jpg", [&whole[..], b"trailer"].concat());
    frame.load_rgb().unwrap();
}

#[test]
fn png_rejects_every_truncation_of_its_pixels() {
    let whole = png(image::RgbImage::from_fn(12, 8, |x, y| image::Rgb([x as u8 * 20, y as u8 * 30, 9])));
    let (folder, frame) = frame_with("png", &whole);
    let pixels_end = whole.windows(4).position(|w| w == b"IEND").unwrap() - 4;
    for length in 0..pixels_end {
        folder.write("image.png", &whole[..length]);
        assert!(frame.load_rgb().is_err(), "{length} of {} bytes were decoded", whole.len());
    }
}

#[test]
fn image_headers_reject_every_truncation_when_a_scene_is_opened() {
    let folder = Folder::nerfstudio(|v| v["frames"][0]["file_path"] = json!("images/frame_000000.jpg"));
    let whole = jpeg();
    let pixels = whole.windows(2).position(|w| w == [0xff, 0xc0]).unwrap() + 9;
    for length in 0..pixels {
        folder.write("images/frame_000000.jpg", &whole[..length]);
        let message = folder.error();
        assert!(message.contains("frame images/frame_000000.jpg") && message.contains("header"), "{message}");
    }
}

#[test]
fn exif_orientation_is_ignored_with_a_warning() {
    let folder = Folder::nerfstudio(|v| v["frames"][0]["file_path"] = json!("images/frame_000000.jpg"));
    let exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
    let length = (exif.len() as u16 + 2).to_be_bytes();
    let whole = jpeg();
    let turned = [&whole[..2], &[0xff, 0xe1], &length, &exif[..], &whole[2..]].concat();
    folder.write("images/frame_000000.jpg", turned);
    let scene = folder.open().unwrap();
    assert!(scene.warnings.iter().any(|w| w.contains("EXIF")), "{:?}", scene.warnings);
    let rgb = scene.frames[0].load_rgb().unwrap();
    assert_eq!((rgb.width, rgb.height), (12, 8));
}

#[test]
fn portrait_images_keep_their_shape() {
    let folder = Folder::nerfstudio(|v| {
        for i in 0..9 {
            v["frames"][i]["file_path"] = json!(format!("tall/{}", name(i)));
        }
        (v["w"], v["h"], v["cx"], v["cy"]) = (json!(8), json!(12), json!(4.0), json!(6.0));
    });
    for i in 0..9 {
        let tall = image::RgbImage::from_fn(8, 12, |x, y| image::Rgb([x as u8, y as u8, 0]));
        folder.write(&format!("tall/{}", name(i)), png(tall));
    }
    let rgb = folder.open().unwrap().frames[0].load_rgb().unwrap();
    assert_eq!((rgb.width, rgb.height, rgb.pixels[7 * 8 + 3]), (8, 12, [3, 7, 0]));
}

#[test]
fn depth_is_in_world_units_and_masks_are_flags() {
    let folder = Folder::nerfstudio(|v| {
        v["frames"][0]["depth_file_path"] = json!("depth.png");
        v["frames"][0]["mask_path"] = json!("mask.png");
        v["depth_unit_scale_factor"] = json!(0.5);
    });
    let depth = image::ImageBuffer::<image::Luma<u16>, _>::from_fn(12, 8, |x, _| image::Luma([x as u16]));
    folder.write("depth.png", png(depth));
    folder.write("mask.png", png(image::GrayImage::from_fn(12, 8, |_, y| image::Luma([u8::from(y == 3)]))));
    let scene = folder.open().unwrap();
    let depth = scene.frames[0].load_depth(scene.depth_unit).unwrap().unwrap();
    assert_eq!(&depth[12..16], [0.0, 0.5, 1.0, 1.5]);
    let mask = scene.frames[0].load_mask().unwrap().unwrap();
    assert_eq!((mask[35], mask[36], mask[47], mask[48]), (false, true, true, false));
    assert!(scene.frames[1].load_depth(0.5).unwrap().is_none());
    assert!(scene.frames[1].load_mask().unwrap().is_none());
}

#[test]
fn depth_and_masks_of_another_size_are_errors() {
    let folder = Folder::nerfstudio(|v| {
        v["frames"][0]["depth_file_path"] = json!("depth.png");
        v["frames"][0]["mask_path"] = json!("mask.png");
    });
    folder.write("depth.png", png(image::RgbImage::new(12, 8)));
    folder.write("mask.png", png(image::GrayImage::new(6, 4)));
    let frame = folder.open().unwrap().frames.remove(0);
    let message = frame.load_mask().unwrap_err().to_string();
    assert!(message.contains("6×4") && message.contains("12×8"), "{message}");
    let message = frame.load_depth(1.0).unwrap_err().to_string();
    assert!(message.contains("16-bit grey"), "{message}");
    fs::remove_file(folder.path("mask.png")).unwrap();
    assert!(matches!(frame.load_mask(), Err(SceneError::Io { .. })));
}
