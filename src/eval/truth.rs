//! Reads a scene's ground-truth images.

use std::path::Path;

use image::DynamicImage;

use super::images::check_size;
use super::{EvalError, surface::DepthView};
use crate::scene::{Frame, Scene};

/// What is known about one frame; layers are row-major `[height * width]`.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTruth {
    /// The frame's own pixels, sRGB.
    pub rgb: Vec<[u8; 3]>,
    /// Depth along the camera's z axis, world units; 0 where unknown.
    pub depth: Option<Vec<f32>>,
    /// 0 persistent, 1 dynamic, 2 actor; other values count for none.
    pub streams: Option<Vec<u8>>,
}

impl FrameTruth {
    /// Reads the frame's image, its depth and `gt/streams/<stem>.png`, the latter two if there are any.
    ///
    /// # Errors
    /// Unreadable files, wrong sizes and wrong pixel types.
    pub fn read(scene: &Scene, frame: &Frame) -> Result<Self, EvalError> {
        let rgb: Vec<[u8; 3]> = open(&frame.image_path)?.to_rgb8().pixels().map(|p| p.0).collect();
        check_size(frame, "image", rgb.len())?;
        Ok(Self { rgb, depth: depth(scene, frame)?, streams: streams(scene, frame)? })
    }
}

/// The frame's depth in world units, if it has one.
pub(super) fn depth(scene: &Scene, frame: &Frame) -> Result<Option<Vec<f32>>, EvalError> {
    let Some(path) = &frame.depth_path else { return Ok(None) };
    let image = open(path)?;
    // `to_luma16` would rescale 8-bit values without a word.
    let DynamicImage::ImageLuma16(image) = image else {
        return Err(pixel_type(path, &image, "16-bit grey"));
    };
    check_size(frame, "depth", image.as_raw().len())?;
    let unit = scene.depth_unit;
    Ok(Some(image.as_raw().iter().map(|&d| (f64::from(d) * unit) as f32).collect()))
}

/// A frame with depth as a witness of which surfaces can be seen.
pub(super) fn depth_view(scene: &Scene, frame: &Frame) -> Result<Option<DepthView>, EvalError> {
    Ok(depth(scene, frame)?.map(|depth| DepthView::new(frame.camera, frame.c2w, depth)))
}

fn streams(scene: &Scene, frame: &Frame) -> Result<Option<Vec<u8>>, EvalError> {
    let path = scene.root.join("gt").join("streams").join(format!("{}.png", frame.stem));
    if !path.exists() {
        return Ok(None);
    }
    let image = open(&path)?;
    let DynamicImage::ImageLuma8(image) = image else {
        return Err(pixel_type(&path, &image, "8-bit grey"));
    };
    check_size(frame, "true stream image", image.as_raw().len())?;
    Ok(Some(image.into_raw()))
}

fn open(path: &Path) -> Result<DynamicImage, EvalError> {
    image::open(path).map_err(|source| EvalError::Image { path: path.to_path_buf(), source })
}

fn pixel_type(path: &Path, image: &DynamicImage, expected: &'static str) -> EvalError {
    EvalError::PixelType { path: path.to_path_buf(), got: format!("{:?}", image.color()), expected }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::scene::{Aabb, Camera, Pose, Split};
    use glam::DVec3;

    /// A test frame without files: identity pose, 90° wide.
    pub(in crate::eval) fn frame(width: u32, height: u32) -> Frame {
        let (w, h) = (f64::from(width), f64::from(height));
        let camera = Camera {
            width,
            height,
            fx: w / 2.0,
            fy: w / 2.0,
            cx: w / 2.0,
            cy: h / 2.0,
            distortion: [0.0; 4],
        };
        Frame {
            stem: "000004".into(),
            image_path: "missing.png".into(),
            camera,
            c2w: Pose::IDENTITY,
            time: 0.0,
            frame_index: 4,
            split: Split::Test,
            depth_path: None,
            mask_path: None,
        }
    }

    fn scene(root: &Path) -> Scene {
        Scene {
            root: root.to_path_buf(),
            frames: vec![],
            bounds: Aabb { min: DVec3::ZERO, max: DVec3::ONE },
            depth_unit: 0.001,
            depth_is_ground_truth: true,
            points: vec![],
            warnings: vec![],
        }
    }

    #[test]
    fn depth_is_read_in_world_units() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("d.png");
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(2, 1, vec![0u16, 1500])
            .unwrap()
            .save(&path)
            .unwrap();
        let mut f = frame(2, 1);
        f.depth_path = Some(path);
        assert_eq!(depth(&scene(dir.path()), &f).unwrap().unwrap(), vec![0.0, 1.5]);
    }

    #[test]
    fn eight_bit_depth_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("d.png");
        image::GrayImage::new(2, 1).save(&path).unwrap();
        let mut f = frame(2, 1);
        f.depth_path = Some(path);
        assert!(matches!(depth(&scene(dir.path()), &f), Err(EvalError::PixelType { .. })));
    }

    #[test]
    fn missing_image_names_its_path() {
        let error = FrameTruth::read(&scene(Path::new(".")), &frame(2, 1)).unwrap_err();
        assert!(error.to_string().contains("missing.png"));
    }
}
