//! Rendered frames as files: a PNG to look at and an EXR to measure in.

use std::io::Cursor;
use std::path::Path;

use divff_exporters::atomic::write_bytes_atomically;
use divff_exporters::{Error, ExrChannel, ExrImage, ExrSamples, write_exr};
use glam::{DVec2, Vec3};
use half::f16;
use image::{ExtendedColorType, ImageEncoder};
use serde::{Deserialize, Serialize};

use super::image::RenderedFrame;
use crate::field::Stream;
use crate::scene::{Camera, Pose};

/// What a view file can hold of the geometry and the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// `R G B A`, linear, f16; A is the opacity of all streams together.
    Rgb,
    /// `depth.Z`, f32: median depth along the camera's axis, world units; 0 where nothing is.
    Depth,
    /// `normal.X/Y/Z`, f16: unit normals of the depth in world axes, towards the camera; 0 where nothing is.
    Normal,
    /// `stream_persistent.Y`, `stream_dynamic.Y`, `stream_actor.Y`, f16: opacities.
    Stream,
}

impl Layer {
    /// All.
    pub const ALL: [Self; 4] = [Self::Rgb, Self::Depth, Self::Normal, Self::Stream];

    /// Bytes that it takes for a pixel.
    pub fn bytes_per_pixel(self) -> u64 {
        match self {
            Self::Rgb => 8,
            Self::Depth => 4,
            Self::Normal | Self::Stream => 6,
        }
    }
}

/// Writes `<stem>.png` (8-bit sRGB, the exposure of the frame) if [`Layer::Rgb`] is among the layers, and `<stem>.exr`
/// with all of them and with `extra` channels of the same size.
///
/// `camera` and `c2w` are those that `image` was rendered with, at its resolution.
///
/// # Errors
/// `Inconsistent` for layers of other sizes, `NonFinite`, `Io`.
pub fn write_view(
    folder: &Path,
    stem: &str,
    image: &RenderedFrame,
    camera: &Camera,
    c2w: &Pose,
    layers: &[Layer],
    extra: Vec<ExrChannel>,
) -> Result<(), Error> {
    if layers.contains(&Layer::Rgb) {
        write_png(&folder.join(format!("{stem}.png")), image)?;
    }
    let mut channels = extra;
    for layer in layers {
        channels.extend(layer_channels(*layer, image, camera, c2w));
    }
    if channels.is_empty() {
        return Ok(());
    }
    let exr = ExrImage { width: image.width as usize, height: image.height as usize, channels };
    write_exr(&folder.join(format!("{stem}.exr")), exr)
}

/// The picture as an 8-bit sRGB PNG.
///
/// # Errors
/// `Inconsistent` for a picture of another size than it says, `Io`.
pub fn write_png(path: &Path, image: &RenderedFrame) -> Result<(), Error> {
    let inconsistent = |reason: String| Error::Inconsistent { object: path.display().to_string(), reason };
    let bytes = quantised(&image.rgb);
    if bytes.len() != 3 * image.width as usize * image.height as usize {
        return Err(inconsistent(format!("{} bytes are no picture of its size", bytes.len())));
    }
    let mut png = Cursor::new(Vec::new());
    image::codecs::png::PngEncoder::new(&mut png)
        .write_image(&bytes, image.width, image.height, ExtendedColorType::Rgb8)
        .map_err(|e| inconsistent(format!("it cannot be stored as PNG: {e}")))?;
    write_bytes_atomically(path, png.get_ref())
}

/// sRGB 0–1 to 8 bits, rounded.
pub fn quantised(rgb: &[[f32; 3]]) -> Vec<u8> {
    rgb.iter().flatten().map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect()
}

fn layer_channels(layer: Layer, image: &RenderedFrame, camera: &Camera, c2w: &Pose) -> Vec<ExrChannel> {
    let half = |name: &str, values: &mut dyn Iterator<Item = f32>| ExrChannel {
        name: name.to_owned(),
        samples: ExrSamples::F16(values.map(f16::from_f32).collect()),
    };
    match layer {
        Layer::Rgb => {
            let mut channels: Vec<ExrChannel> = ["R", "G", "B"]
                .iter()
                .enumerate()
                .map(|(c, name)| half(name, &mut image.rgb.iter().map(|p| linear(p[c]))))
                .collect();
            let alpha = |o: &[f32; 3]| o.iter().sum::<f32>().clamp(0.0, 1.0);
            channels.push(half("A", &mut image.opacity.iter().map(alpha)));
            channels
        }
        Layer::Depth => {
            vec![ExrChannel { name: "depth.Z".into(), samples: ExrSamples::F32(image.depth.clone()) }]
        }
        Layer::Normal => {
            let normals = depth_normals(image, camera, c2w);
            let names = ["normal.X", "normal.Y", "normal.Z"];
            let axis = |(a, name): (usize, &&str)| half(name, &mut normals.iter().map(|n| n[a]));
            names.iter().enumerate().map(axis).collect()
        }
        Layer::Stream => Stream::ALL
            .iter()
            .map(|s| {
                let name = format!("stream_{}.Y", s.name());
                half(&name, &mut image.opacity.iter().map(|o| o[*s as usize].clamp(0.0, 1.0)))
            })
            .collect(),
    }
}

/// sRGB's transfer function undone (IEC 61966-2-1).
fn linear(v: f32) -> f32 {
    if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Normals of the depth map in world axes: cross product of the differences to whichever neighbour is nearer in depth,
/// so that the edge of an object does not bend them.
fn depth_normals(image: &RenderedFrame, camera: &Camera, c2w: &Pose) -> Vec<Vec3> {
    let (width, height) = (image.width as usize, image.height as usize);
    let point = |x: usize, y: usize| {
        let z = image.depth[y * width + x];
        let ray = camera.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
        (z > 0.0).then(|| (ray * f64::from(z)).as_vec3())
    };
    let points: Vec<Option<Vec3>> = (0..width * height).map(|n| point(n % width, n / width)).collect();
    let rotation = c2w.matrix3.as_mat3();
    let difference = |here: Vec3, before: Option<usize>, after: Option<usize>| {
        let back = before.and_then(|n| points[n]).map(|p| here - p);
        let forth = after.and_then(|n| points[n]).map(|p| p - here);
        match (back, forth) {
            (Some(b), Some(f)) => Some(if b.z.abs() < f.z.abs() { b } else { f }),
            (one, other) => one.or(other),
        }
    };
    (0..width * height)
        .map(|n| {
            let (x, y) = (n % width, n / width);
            let normal = points[n].and_then(|here| {
                let dx = difference(here, (x > 0).then(|| n - 1), (x + 1 < width).then(|| n + 1))?;
                let dy = difference(here, (y > 0).then(|| n - width), (y + 1 < height).then(|| n + width))?;
                // x right, y down, z forward: dy × dx points back to the camera.
                Some(rotation * dy.cross(dx).normalize_or_zero())
            });
            normal.unwrap_or(Vec3::ZERO)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use divff_exporters::read_exr;
    use glam::{DAffine3, DMat3};

    use super::*;

    fn camera() -> Camera {
        Camera { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0, distortion: [0.0; 4] }
    }

    fn picture() -> RenderedFrame {
        RenderedFrame {
            width: 8,
            height: 6,
            rgb: (0..48).map(|n| [n as f32 / 47.0, 0.5, 1.0]).collect(),
            depth: vec![2.0; 48],
            opacity: vec![[0.5, 0.25, 0.125]; 48],
        }
    }

    #[test]
    fn a_view_survives_the_disk() {
        let folder = tempfile::tempdir().unwrap();
        let layers = [Layer::Rgb, Layer::Depth, Layer::Normal, Layer::Stream];
        let mine = ExrChannel { name: "relevancy_cup.Y".into(), samples: ExrSamples::F32(vec![0.25; 48]) };
        // A camera that looks along world -x.
        let turn = DMat3::from_cols(glam::DVec3::Y, -glam::DVec3::Z, -glam::DVec3::X);
        let c2w = DAffine3 { matrix3: turn, translation: glam::DVec3::ZERO };
        write_view(folder.path(), "000007", &picture(), &camera(), &c2w, &layers, vec![mine]).unwrap();
        let exr = read_exr(&folder.path().join("000007.exr")).unwrap();
        let half = |name: &str, n: usize| match exr.channel(name) {
            Some(ExrSamples::F16(v)) => v[n].to_f32(),
            other => panic!("{name}: {other:?}"),
        };
        assert!((half("G", 0) - 0.214_041).abs() < 2e-4, "0.5 in linear light");
        assert!((half("A", 0) - 0.875).abs() < 1e-3);
        assert_eq!(half("stream_dynamic.Y", 3), 0.25);
        assert!((half("normal.X", 20) - 1.0).abs() < 1e-3, "a wall in front faces the camera");
        assert_eq!(exr.channel("depth.Z"), Some(&ExrSamples::F32(vec![2.0; 48])));
        assert_eq!(exr.channel("relevancy_cup.Y"), Some(&ExrSamples::F32(vec![0.25; 48])));
        let png = image::open(folder.path().join("000007.png")).unwrap().into_rgb8();
        assert_eq!(png.into_raw(), quantised(&picture().rgb));
    }

    #[test]
    fn a_layer_is_the_same_whatever_else_is_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let write = |stem: &str, layers: &[Layer]| {
            let c2w = DAffine3::IDENTITY;
            write_view(folder.path(), stem, &picture(), &camera(), &c2w, layers, vec![]).unwrap();
            read_exr(&folder.path().join(format!("{stem}.exr"))).unwrap().channels
        };
        let all = write("all", &Layer::ALL);
        let size = |channel: &ExrChannel| match channel.samples {
            ExrSamples::F16(_) => 2,
            ExrSamples::F32(_) => 4,
        };
        for (n, layer) in Layer::ALL.into_iter().enumerate() {
            let alone = write(&n.to_string(), &[layer]);
            assert!(alone.iter().all(|channel| all.contains(channel)), "{layer:?}");
            assert_eq!(alone.iter().map(size).sum::<u64>(), layer.bytes_per_pixel(), "{layer:?}");
        }
        let bytes = |stem: &str| std::fs::read(folder.path().join(format!("{stem}.png"))).unwrap();
        assert_eq!(bytes("all"), bytes("0"));
    }

    #[test]
    fn only_what_is_asked_for_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let c2w = DAffine3::IDENTITY;
        write_view(folder.path(), "a", &picture(), &camera(), &c2w, &[Layer::Depth], vec![]).unwrap();
        assert!(!folder.path().join("a.png").exists());
        assert_eq!(read_exr(&folder.path().join("a.exr")).unwrap().channels.len(), 1);
        let wrong = RenderedFrame { width: 7, ..picture() };
        assert!(write_png(&folder.path().join("b.png"), &wrong).is_err());
    }
}
