//! Pixels of a frame: colour, depth and mask.

use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageReader};

use super::error::SceneError;
use super::{Frame, header};

/// A decoded frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RgbImage {
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// 8-bit sRGB, `[height * width]`, row by row from the top.
    pub pixels: Vec<[u8; 3]>,
}

impl Frame {
    /// Decodes the frame's image to 8-bit sRGB.
    ///
    /// Grey becomes equal channels, 16 bits are rounded to 8, alpha is dropped (what shall not be used
    /// belongs in the mask). Pixels are taken as stored: an EXIF orientation is not applied, because the poses
    /// are of the stored pixels; opening the scene warns of it.
    ///
    /// # Errors
    /// [`SceneError::Io`], or [`SceneError::Image`] if the file is damaged, cut short or not of the camera's
    /// size.
    pub fn load_rgb(&self) -> Result<RgbImage, SceneError> {
        let pixels = self.decode(&self.image_path, "image")?.into_rgb8();
        let pixels = pixels.pixels().map(|p| p.0).collect();
        Ok(RgbImage { width: self.camera.width, height: self.camera.height, pixels })
    }

    /// Decodes the frame's depth: `[height * width]` planar depth along the camera's z axis in world units, 0
    /// where there is none. `unit` is [`super::Scene::depth_unit`]. `None` if the frame has no depth.
    ///
    /// # Errors
    /// [`SceneError::Io`], or [`SceneError::Image`] if the file is damaged, not a grey PNG or not of the
    /// camera's size.
    pub fn load_depth(&self, unit: f64) -> Result<Option<Vec<f32>>, SceneError> {
        let Some(path) = &self.depth_path else { return Ok(None) };
        let stored = match self.decode(path, "depth")? {
            DynamicImage::ImageLuma16(image) => image.into_raw(),
            // Eight bits are read as they are: 0 to 255 units.
            DynamicImage::ImageLuma8(image) => image.into_raw().into_iter().map(u16::from).collect(),
            other => {
                return Err(SceneError::image(
                    path,
                    &self.stem,
                    format!("its depth is stored as {:?}, not as 16-bit grey", other.color()),
                    "write depth as a 16-bit grey PNG, 0 where it is unknown",
                ));
            }
        };
        Ok(Some(stored.into_iter().map(|d| (f64::from(d) * unit) as f32).collect()))
    }

    /// Decodes the frame's mask: `[height * width]`, true where the pixel may be used (any channel but alpha
    /// is not zero). `None` if the frame has no mask.
    ///
    /// # Errors
    /// [`SceneError::Io`], or [`SceneError::Image`] if the file is damaged or not of the camera's size.
    pub fn load_mask(&self) -> Result<Option<Vec<bool>>, SceneError> {
        let Some(path) = &self.mask_path else { return Ok(None) };
        let mask = self.decode(path, "mask")?.into_rgb8();
        Ok(Some(mask.pixels().map(|p| p.0 != [0; 3]).collect()))
    }

    /// Decodes a file of this frame and checks that it has the camera's size.
    fn decode(&self, path: &Path, kind: &str) -> Result<DynamicImage, SceneError> {
        let bytes = std::fs::read(path).map_err(|e| SceneError::io(path, e))?;
        let damaged = |what: String| {
            SceneError::image(path, &self.stem, what, "the file is damaged or cut short; write it again")
        };
        if bytes.starts_with(&[0xff, 0xd8]) && !header::jpeg_is_complete(&bytes) {
            return Err(damaged(format!("the {kind} ends too early ({} bytes)", bytes.len())));
        }
        let cannot = |e: String| damaged(format!("the {kind} cannot be decoded: {e}"));
        let decoder = decoder(&bytes).map_err(cannot)?;
        // Before decoding: a damaged header must not decide how much is allocated.
        let (width, height) = decoder.dimensions();
        let camera = (self.camera.width, self.camera.height);
        if (width, height) != camera {
            return Err(SceneError::image(
                path,
                &self.stem,
                format!("the {kind} is {width}×{height}, the camera {}×{}", camera.0, camera.1),
                "resize it to the size of the frame's image",
            ));
        }
        DynamicImage::from_decoder(decoder).map_err(|e| cannot(e.to_string()))
    }
}

/// Most bytes of pixels that a byte of a file stands for: 1032 in deflate (PNG), some 1400 in a JPEG whose blocks are
/// one bit each.
const MOST_EXPANSION: u64 = 2048;

/// A decoder of a JPEG or PNG that has read the header and no pixel. A header that promises more pixels than the file
/// can hold is refused, so that it does not decide how much is allocated.
///
/// # Errors
/// What is wrong.
pub(crate) fn decoder(bytes: &[u8]) -> Result<impl ImageDecoder + '_, String> {
    let reader = ImageReader::new(std::io::Cursor::new(bytes));
    let reader = reader.with_guessed_format().map_err(|e| e.to_string())?;
    let decoder = reader.into_decoder().map_err(|e| e.to_string())?;
    if decoder.total_bytes() > MOST_EXPANSION * bytes.len() as u64 {
        let (width, height) = decoder.dimensions();
        return Err(format!(
            "{width}×{height} pixels are announced, which {} bytes cannot hold",
            bytes.len()
        ));
    }
    Ok(decoder)
}
