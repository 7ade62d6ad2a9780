//! COLMAP's binary files, little-endian. Counts are not trusted: nothing is reserved for what is not there.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use glam::DVec3;

use super::colmap::{self, Model, PosedImage};
use super::error::{Place, SceneError};

/// Reads `cameras.bin`, `images.bin` and, if it is there, `points3D.bin`.
pub(crate) fn read(folder: &Path) -> Result<Model, SceneError> {
    let points = folder.join("points3D.bin");
    Ok(Model {
        cameras: read_cameras(&folder.join("cameras.bin"))?,
        images: read_images(&folder.join("images.bin"))?,
        points: if points.is_file() { read_points(&points)? } else { Vec::new() },
    })
}

fn read_cameras(path: &Path) -> Result<BTreeMap<u32, super::Camera>, SceneError> {
    let mut file = Reader::open(path)?;
    let mut cameras = BTreeMap::new();
    for _ in 0..file.u64()? {
        let at = file.place();
        let id = file.u32()?;
        let (model, count) =
            colmap::model_by_id(file.u32()?).map_err(|m| colmap::unsupported_model(path, at.clone(), &m))?;
        let size = [file.size()?, file.size()?];
        let mut params = [0.0; 8];
        for p in &mut params[..count] {
            *p = file.f64()?;
        }
        cameras.insert(id, colmap::camera(path, at, model, size, &params[..count])?);
    }
    Ok(cameras)
}

fn read_images(path: &Path) -> Result<Vec<PosedImage>, SceneError> {
    let mut file = Reader::open(path)?;
    let mut images = Vec::new();
    for _ in 0..file.u64()? {
        let at = file.place();
        let _id = file.u32()?;
        let mut pose = [0.0; 7];
        for x in &mut pose {
            *x = file.f64()?;
        }
        let camera_id = file.u32()?;
        let name = file.name()?;
        let observations = file.u64()?;
        file.skip(observations.saturating_mul(24))?;
        images.push(PosedImage { name, pose, camera_id, at });
    }
    Ok(images)
}

fn read_points(path: &Path) -> Result<Vec<DVec3>, SceneError> {
    let mut file = Reader::open(path)?;
    let mut points = Vec::new();
    for _ in 0..file.u64()? {
        file.skip(8)?; // id
        points.push(DVec3::new(file.f64()?, file.f64()?, file.f64()?));
        file.skip(3 + 8)?; // colour, error
        let track = file.u64()?;
        file.skip(track.saturating_mul(8))?;
    }
    Ok(points)
}

/// A file with the offset that has been read to.
struct Reader {
    path: PathBuf,
    file: BufReader<File>,
    at: u64,
    length: u64,
}

impl Reader {
    fn open(path: &Path) -> Result<Self, SceneError> {
        let file = File::open(path).map_err(|e| SceneError::io(path, e))?;
        let length = file.metadata().map_err(|e| SceneError::io(path, e))?.len();
        Ok(Reader { path: path.to_owned(), file: BufReader::new(file), at: 0, length })
    }

    fn place(&self) -> Place {
        Place::Byte(self.at)
    }

    fn invalid(&self, what: impl Into<String>) -> SceneError {
        SceneError::invalid(
            &self.path,
            self.place(),
            what,
            "the file is damaged or cut short: export the model from COLMAP again",
        )
    }

    fn need(&self, count: u64) -> Result<(), SceneError> {
        if count > self.length - self.at {
            return Err(
                self.invalid(format!("{count} bytes are announced, {} are left", self.length - self.at))
            );
        }
        Ok(())
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], SceneError> {
        self.need(N as u64)?;
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes).map_err(|e| SceneError::io(&self.path, e))?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn skip(&mut self, count: u64) -> Result<(), SceneError> {
        self.need(count)?;
        // Files are far below 2^63 bytes, and `count` is within the file.
        self.file.seek_relative(count as i64).map_err(|e| SceneError::io(&self.path, e))?;
        self.at += count;
        Ok(())
    }

    fn u32(&mut self) -> Result<u32, SceneError> {
        Ok(u32::from_le_bytes(self.bytes()?))
    }

    fn u64(&mut self) -> Result<u64, SceneError> {
        Ok(u64::from_le_bytes(self.bytes()?))
    }

    fn f64(&mut self) -> Result<f64, SceneError> {
        Ok(f64::from_le_bytes(self.bytes()?))
    }

    /// A width or height, stored in eight bytes.
    fn size(&mut self) -> Result<u32, SceneError> {
        let size = self.u64()?;
        u32::try_from(size).map_err(|_| self.invalid(format!("an image {size} pixels wide or high")))
    }

    /// A text that ends with a zero byte.
    fn name(&mut self) -> Result<String, SceneError> {
        let mut name = Vec::new();
        loop {
            match self.bytes::<1>()? {
                [0] => break,
                [byte] => name.push(byte),
            }
        }
        String::from_utf8(name).map_err(|_| self.invalid("the name of an image is not UTF-8"))
    }
}
