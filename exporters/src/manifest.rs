//! `manifest.json`: what an export holds. Written last; its presence means that the export is complete.

use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::atomic::write_bytes_atomically;
use crate::axes::UpAxis;
use crate::error::{Error, Result};

/// Name of the file in the export's folder.
pub const MANIFEST_NAME: &str = "manifest.json";

/// Version of the layout that this crate writes.
pub const FORMAT_VERSION: u32 = 1;

/// Description of an export. Unknown keys are ignored on reading, so that later versions can add some.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// World units, e.g. `metre` or `arbitrary`.
    pub units: String,
    /// The world's up axis; only GLB files are turned to Y up.
    pub up_axis: UpAxis,
    /// Subtracted from world coordinates in every file; usually zero.
    #[serde(default)]
    pub offset: [f64; 3],
    /// Training coordinates → world, row-major 4×4. Already applied to everything in the export.
    pub world_from_train: [[f64; 4]; 4],
    /// What was mapped: the scene's name or a hash of it.
    pub source_id: String,
    /// Streams in the export.
    pub streams: Vec<String>,
    /// Intervals of the objects that are not always there.
    pub time_intervals: Vec<TimeInterval>,
    /// Scalar columns.
    pub attributes: Vec<AttributeEntry>,
    /// Feature columns.
    pub features: Vec<FeatureEntry>,
    /// Affordances with a score each.
    pub affordances: Vec<AffordanceEntry>,
    /// All files but this one, in the order they were added.
    pub files: Vec<FileEntry>,
    /// What the export could have held and does not, or shares, and why.
    #[serde(default)]
    pub skipped: Vec<SkippedEntry>,
    /// Meshes that have fewer triangles than the surface they stand for, and how far they are from it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub simplified: Vec<SimplifiedEntry>,
    /// Program and version.
    pub tool_version: String,
    /// Seed of the run.
    pub seed: u64,
}

/// When an object exists, in scene time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TimeInterval {
    /// Object, e.g. `dynamic_000012`.
    pub name: String,
    /// `dynamic` or `actor`.
    pub stream: String,
    /// First time.
    pub time_start: f64,
    /// Time from which it is gone.
    pub time_end: f64,
}

/// A scalar column.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AttributeEntry {
    /// Name as in PLY and NPZ.
    pub name: String,
    /// `f32`, `i32` or `u8`.
    #[serde(rename = "type")]
    pub kind: String,
    /// Smallest and largest value over the export.
    pub range: [f64; 2],
}

/// A feature matrix.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FeatureEntry {
    /// Name as in PLY and NPZ.
    pub name: String,
    /// Dimensions.
    pub dim: usize,
    /// `f32`.
    pub dtype: String,
    /// Model whose features these are.
    pub model: String,
    /// Whether rows have unit length.
    pub normalised: bool,
    /// NPZ with `mean[512]` and `basis[dim, 512]`, if compressed by a linear map.
    pub pca_file: Option<String>,
}

/// An affordance and the phrases that stand for it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AffordanceEntry {
    /// Verb: the column is `affordance_<name>`.
    pub name: String,
    /// Phrases.
    pub prompts: Vec<String>,
}

/// Something that is not in the export, or only as a copy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedEntry {
    /// Object or stream.
    pub what: String,
    /// Why.
    pub why: String,
}

/// A mesh with fewer triangles, and what that costs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SimplifiedEntry {
    /// Object that it was made for.
    pub name: String,
    /// Distance that was allowed, world units.
    pub tolerance: f64,
    /// Largest distance between the two surfaces that was found, from both sides, world units.
    pub largest_distance: f64,
    /// Triangles before.
    pub triangles_before: usize,
    /// Triangles after.
    pub triangles_after: usize,
    /// Parts that were triangulated on their own.
    pub patches: usize,
    /// Parts among them that were not: too small, or not within the tolerances; edges may have collapsed there.
    pub kept_patches: usize,
    /// Attributes that had to stay within a tolerance.
    pub deviations: Vec<DeviationEntry>,
}

/// How far an attribute is from what it was at any of the original's vertices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviationEntry {
    /// `color` (8-bit steps), a score's column, or a feature matrix (length of the difference).
    pub name: String,
    /// Deviation that was allowed.
    pub tolerance: f64,
    /// Largest that was found.
    pub largest: f64,
}

/// A file of the export.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FileEntry {
    /// Relative to the manifest, with forward slashes.
    pub path: String,
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// Vertices; 0 for pictures.
    pub vertices: usize,
    /// Triangles; 0 for clouds and pictures.
    pub faces: usize,
}

impl Manifest {
    /// Adds a finished file of the export, `relative` to its folder, with the hash of what is on disk.
    ///
    /// # Errors
    /// `Io`; `Inconsistent` for a path that leaves the folder.
    pub fn add_file(&mut self, folder: &Path, relative: &str, vertices: usize, faces: usize) -> Result<()> {
        let sha256 = sha256_of(&inside(folder, relative)?)?;
        self.files.push(FileEntry { path: relative.to_owned(), sha256, vertices, faces });
        Ok(())
    }

    /// Writes `manifest.json` into the folder. Call it last.
    ///
    /// # Errors
    /// `Inconsistent` for numbers that are not finite; `Io`.
    pub fn write(&self, folder: &Path) -> Result<()> {
        self.validate()?;
        let path = folder.join(MANIFEST_NAME);
        let mut json =
            serde_json::to_vec_pretty(self).map_err(|e| Error::inconsistent(MANIFEST_NAME, e.to_string()))?;
        json.push(b'\n');
        write_bytes_atomically(&path, &json)
    }

    /// Reads `manifest.json` of the folder.
    ///
    /// # Errors
    /// `Io` (no manifest: the export is not complete); `Invalid`; `Unsupported` for a later format version.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join(MANIFEST_NAME);
        let json = fs::read(&path).map_err(|source| Error::io(&path, source))?;
        let manifest: Self =
            serde_json::from_slice(&json).map_err(|error| Error::invalid(&path, error.to_string()))?;
        if manifest.format_version != FORMAT_VERSION {
            return Err(Error::Unsupported {
                path,
                what: format!("manifest format version {}", manifest.format_version),
                remedy: "read it with the version that wrote it, or export again",
            });
        }
        Ok(manifest)
    }

    /// Compares every file with its recorded hash.
    ///
    /// # Errors
    /// `Io` for a missing file, `Invalid` for one that changed since.
    pub fn verify(&self, folder: &Path) -> Result<()> {
        for file in &self.files {
            let path = inside(folder, &file.path)?;
            if sha256_of(&path)? != file.sha256 {
                return Err(Error::invalid(&path, "it changed since the manifest was written"));
            }
        }
        Ok(())
    }

    /// JSON has no NaN: serde would write `null` and nobody could read the manifest again.
    fn validate(&self) -> Result<()> {
        let matrix = self.world_from_train.as_flattened().iter();
        let ranges = self.attributes.iter().flat_map(|attribute| &attribute.range);
        let times =
            self.time_intervals.iter().flat_map(|interval| [&interval.time_start, &interval.time_end]);
        let errors = self.simplified.iter().flat_map(|s| {
            let columns = s.deviations.iter().flat_map(|d| [&d.tolerance, &d.largest]);
            [&s.tolerance, &s.largest_distance].into_iter().chain(columns)
        });
        let all = matrix.chain(&self.offset).chain(ranges).chain(times).chain(errors);
        if all.copied().all(f64::is_finite) {
            Ok(())
        } else {
            Err(Error::inconsistent(
                MANIFEST_NAME,
                "the transform, offset, ranges, times and errors must be finite",
            ))
        }
    }
}

/// Joins a manifest's path to its folder; refuses paths that would lead out of it.
fn inside(folder: &Path, relative: &str) -> Result<PathBuf> {
    let stays = Path::new(relative).components().all(|c| matches!(c, std::path::Component::Normal(_)));
    if relative.is_empty() || !stays {
        return Err(Error::inconsistent(MANIFEST_NAME, format!("`{relative}` is no path inside the export")));
    }
    Ok(folder.join(relative))
}

fn sha256_of(path: &Path) -> Result<String> {
    let mut file = File::open(path).map_err(|source| Error::io(path, source))?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        let read = file.read(&mut buffer).map_err(|source| Error::io(path, source))?;
        if read == 0 {
            return Ok(hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect());
        }
        hasher.update(&buffer[..read]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_manifest_survives_the_disk_and_notices_changed_files() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("abc.ply"), b"abc").unwrap();
        let mut manifest = Manifest {
            format_version: FORMAT_VERSION,
            units: "metre".into(),
            simplified: vec![SimplifiedEntry {
                name: "persistent".into(),
                tolerance: 0.005,
                largest_distance: 0.004,
                triangles_before: 100,
                triangles_after: 10,
                patches: 2,
                kept_patches: 1,
                deviations: vec![DeviationEntry { name: "color".into(), tolerance: 16.0, largest: 15.5 }],
            }],
            attributes: vec![AttributeEntry { name: "label".into(), kind: "i32".into(), range: [-1.0, 7.0] }],
            ..Manifest::default()
        };
        manifest.add_file(folder.path(), "abc.ply", 3, 1).unwrap();
        // FIPS 180-2, appendix B.1.
        let known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(manifest.files[0].sha256, known);
        manifest.write(folder.path()).unwrap();
        let read = Manifest::read(folder.path()).unwrap();
        assert_eq!(read, manifest);
        read.verify(folder.path()).unwrap();
        fs::write(folder.path().join("abc.ply"), b"abd").unwrap();
        assert!(read.verify(folder.path()).unwrap_err().to_string().contains("abc.ply"));
    }

    #[test]
    fn what_could_not_be_read_back_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let manifest = Manifest { offset: [f64::NAN, 0.0, 0.0], ..Manifest::default() };
        assert!(manifest.write(folder.path()).is_err());
        let far = SimplifiedEntry { largest_distance: f64::INFINITY, ..SimplifiedEntry::default() };
        assert!(Manifest { simplified: vec![far], ..Manifest::default() }.write(folder.path()).is_err());
        assert!(!folder.path().join(MANIFEST_NAME).exists());
    }

    #[test]
    fn paths_that_leave_the_folder_and_later_versions_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut manifest = Manifest::default();
        for path in ["../a.ply", "/etc/hostname", "", "a/../../b"] {
            assert!(manifest.add_file(folder.path(), path, 0, 0).is_err(), "{path}");
        }
        manifest.format_version = FORMAT_VERSION + 1;
        manifest.write(folder.path()).unwrap();
        assert!(matches!(Manifest::read(folder.path()), Err(Error::Unsupported { .. })));
    }
}
