//! A tiny scene with every kind of feature, for tests.

use std::path::PathBuf;

use divff_exporters::npy::{write_npy, write_npy_i32};

use super::FeatureStore;
use crate::scene::Scene;
use crate::scene::tests::{Folder, name};

/// Numbers per descriptor of the scene's image and video features.
pub(crate) const DIM: usize = 4;

/// Nine frames of 12 × 8 px; frame 0 has everything, frame 1 the clip's descriptor, the others nothing.
pub(crate) struct FeatureScene {
    folder: Folder,
    pub(crate) scene: Scene,
}

/// Index map of frame 0: mask 0 in the left third, mask 2 in the middle, none on the right.
pub(crate) fn map() -> Vec<i32> {
    (0..8 * 12).map(|n| [0, 2, -1][n % 12 / 4]).collect()
}

/// A unit vector along axis `n`.
pub(crate) fn axis(n: usize) -> [f32; DIM] {
    std::array::from_fn(|i| if i == n { 1.0 } else { 0.0 })
}

fn rows(axes: &[usize]) -> Vec<f32> {
    axes.iter().flat_map(|n| axis(*n)).collect()
}

impl FeatureScene {
    pub(crate) fn new() -> Self {
        let folder = Folder::nerfstudio(|_| {});
        let scene = folder.open().unwrap();
        let this = Self { folder, scene };
        for name in ["language_features", "video_features", "dino_features", "hotspots", "text"] {
            std::fs::create_dir_all(this.folder.path(name)).unwrap();
        }
        let mut file = this.stem(0);
        file.insert_str(0, "language_features/");
        this.integers(&format!("{file}_s.npy"), &[1, 8, 12], &map());
        this.floats(&format!("{file}_f.npy"), &[3, DIM], &rows(&[0, 1, 2]));
        this.floats(&format!("{file}_b.npy"), &[3, DIM], &rows(&[3, 3, 3]));
        // Two patches side by side, 8 px wide, from 0 and from 4: centres at 4 and 8.
        this.floats(&format!("{file}_p0.npy"), &[1, 2, DIM], &rows(&[0, 1]));
        this.floats(&format!("{file}_p1.npy"), &[1, 1, DIM], &rows(&[2]));
        this.write(
            "language_features/meta.json",
            r#"{"model": "toy", "dim": 4, "image_size": [12, 8], "patches": [
                {"file": "p0", "size_px": [8, 4], "stride_px": 4},
                {"file": "p1", "size_px": [12, 8], "stride_px": 4, "origin_px": [0, 0]}]}"#,
        );
        this.floats(&format!("video_features/{}_p.npy", this.stem(0)), &[1, 2, DIM], &rows(&[0, 1]));
        for n in 0..2 {
            this.floats(&format!("video_features/{}_g.npy", this.stem(n)), &[DIM], &axis(2 + n));
        }
        let cells: Vec<f32> = (0..2 * 3 * 2).map(|n| 1.0 + n as f32).collect();
        this.floats(&format!("dino_features/{}.npy", this.stem(0)), &[2, 3, 2], &cells);
        let hotspot = image::GrayImage::from_fn(12, 8, |x, y| image::Luma([u8::from(x < 6 && y < 4) * 255]));
        hotspot.save(this.path(&format!("hotspots/{}.png", this.stem(0)))).unwrap();
        this.floats("text/clip.npy", &[2, DIM], &[3.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0]);
        this.write("text/clip.txt", "red mug\nobject\n");
        this
    }

    pub(crate) fn stem(&self, n: usize) -> String {
        name(n).strip_suffix(".png").unwrap().to_owned()
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path(name)
    }

    pub(crate) fn write(&self, name: &str, content: &str) {
        self.folder.write(name, content);
    }

    pub(crate) fn floats(&self, name: &str, shape: &[usize], values: &[f32]) {
        write_npy(&self.path(name), shape, values).unwrap();
    }

    pub(crate) fn integers(&self, name: &str, shape: &[usize], values: &[i32]) {
        write_npy_i32(&self.path(name), shape, values).unwrap();
    }

    pub(crate) fn store(&self) -> FeatureStore {
        FeatureStore::open(&self.scene).unwrap()
    }
}
