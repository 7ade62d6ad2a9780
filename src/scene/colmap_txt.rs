//! COLMAP's text files: one record a line (images: two), `#` starts a comment line.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use glam::DVec3;

use super::Camera;
use super::colmap::{self, Model, PosedImage};
use super::error::{Place, SceneError};

/// Reads `cameras.txt`, `images.txt` and, if it is there, `points3D.txt`.
pub(crate) fn read(folder: &Path) -> Result<Model, SceneError> {
    let points = folder.join("points3D.txt");
    Ok(Model {
        cameras: read_cameras(&folder.join("cameras.txt"))?,
        images: read_images(&folder.join("images.txt"))?,
        points: if points.is_file() { read_points(&points)? } else { Vec::new() },
    })
}

fn text(path: &Path) -> Result<String, SceneError> {
    std::fs::read_to_string(path).map_err(|e| SceneError::io(path, e))
}

/// Lines with their numbers from 1, trimmed.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()))
}

fn is_record(line: &str) -> bool {
    !line.is_empty() && !line.starts_with('#')
}

/// The words of one line, taken from the front.
struct Words<'a> {
    path: &'a Path,
    line: usize,
    rest: &'a str,
}

impl<'a> Words<'a> {
    fn word(&mut self) -> &'a str {
        let rest = self.rest.trim_start();
        let end = rest.find(char::is_whitespace).unwrap_or(rest.len());
        self.rest = &rest[end..];
        &rest[..end]
    }

    fn number<T: FromStr>(&mut self, what: &str) -> Result<T, SceneError> {
        let word = self.word();
        word.parse().map_err(|_| {
            let what = format!("`{word}` is not {what}");
            SceneError::invalid(
                self.path,
                Place::Line(self.line),
                what,
                "the line is damaged or cut short: export the model from COLMAP again",
            )
        })
    }

    fn reals<const N: usize>(&mut self, what: &str) -> Result<[f64; N], SceneError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number(what)?;
        }
        Ok(values)
    }
}

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`
fn read_cameras(path: &Path) -> Result<BTreeMap<u32, Camera>, SceneError> {
    let mut cameras = BTreeMap::new();
    for (line, rest) in lines(&text(path)?).filter(|l| is_record(l.1)) {
        let mut words = Words { path, line, rest };
        let id = words.number("a camera id")?;
        let model = words.word();
        let size = [words.number("a width")?, words.number("a height")?];
        let mut params = Vec::new();
        while !words.rest.trim().is_empty() {
            params.push(words.number("a camera parameter")?);
        }
        cameras.insert(id, colmap::camera(path, Place::Line(line), model, size, &params)?);
    }
    Ok(cameras)
}

/// `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then a line of observations, which may be empty.
fn read_images(path: &Path) -> Result<Vec<PosedImage>, SceneError> {
    let text = text(path)?;
    let mut lines = lines(&text);
    let mut images = Vec::new();
    while let Some((line, rest)) = lines.next() {
        if !is_record(rest) {
            continue;
        }
        let mut words = Words { path, line, rest };
        let _id: u32 = words.number("an image id")?;
        let pose = words.reals("a number of the pose")?;
        let camera_id = words.number("a camera id")?;
        let name = words.rest.trim().to_owned();
        if name.is_empty() {
            let remedy = "the line is damaged or cut short: export the model from COLMAP again";
            return Err(SceneError::invalid(path, Place::Line(line), "the image has no name", remedy));
        }
        images.push(PosedImage { name, pose, camera_id, at: Place::Line(line) });
        lines.next();
    }
    Ok(images)
}

/// `POINT3D_ID X Y Z R G B ERROR TRACK[]`
fn read_points(path: &Path) -> Result<Vec<DVec3>, SceneError> {
    let mut points = Vec::new();
    for (line, rest) in lines(&text(path)?).filter(|l| is_record(l.1)) {
        let mut words = Words { path, line, rest };
        let _id: u64 = words.number("a point id")?;
        points.push(DVec3::from(words.reals::<3>("a coordinate")?));
    }
    Ok(points)
}
