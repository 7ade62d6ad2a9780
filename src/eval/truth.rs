//! Reads a scene's ground-truth images.

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
        let depth = frame.load_depth(scene.depth_unit)?;
        Ok(Self { rgb: frame.load_rgb()?.pixels, depth, streams: streams(scene, frame)? })
    }
}

/// A frame with depth as a witness of which surfaces can be seen.
pub(super) fn depth_view(scene: &Scene, frame: &Frame) -> Result<Option<DepthView>, EvalError> {
    Ok(frame.load_depth(scene.depth_unit)?.map(|depth| DepthView::new(frame.camera, frame.c2w, depth)))
}

fn streams(scene: &Scene, frame: &Frame) -> Result<Option<Vec<u8>>, EvalError> {
    let path = scene.root.join("gt").join("streams").join(format!("{}.png", frame.stem));
    if !path.exists() {
        return Ok(None);
    }
    let image = image::open(&path).map_err(|source| EvalError::Image { path: path.clone(), source })?;
    let DynamicImage::ImageLuma8(image) = image else {
        return Err(EvalError::PixelType { path, got: format!("{:?}", image.color()) });
    };
    check_size(frame, "true stream image", image.as_raw().len())?;
    Ok(Some(image.into_raw()))
}

#[cfg(test)]
pub(super) mod tests {
    use std::path::Path;

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
    fn sixteen_bit_streams_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("gt/streams");
        std::fs::create_dir_all(&folder).unwrap();
        let wide = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(2, 1, vec![0u16, 1]).unwrap();
        wide.save(folder.join("000004.png")).unwrap();
        let read = streams(&scene(dir.path()), &frame(2, 1));
        assert!(matches!(read, Err(EvalError::PixelType { .. })));
    }

    #[test]
    fn missing_image_names_its_path() {
        let error = FrameTruth::read(&scene(Path::new(".")), &frame(2, 1)).unwrap_err();
        assert!(error.to_string().contains("missing.png"));
    }
}
