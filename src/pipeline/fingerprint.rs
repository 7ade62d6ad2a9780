//! A short name for what a scene holds, to notice that a run is continued on another one.

use crate::scene::{Scene, Split};

/// Hash of everything that training reads from a scene's lists: frames, cameras, poses, times, splits, bounds, and
/// the sizes of the image files. The folder's name is not part of it: a scene may be moved.
///
/// 16 hexadecimal digits, the same on every machine.
pub fn fingerprint(scene: &Scene) -> String {
    let mut hash = Fnv::new();
    for frame in &scene.frames {
        hash.bytes(frame.stem.as_bytes());
        hash.bytes(&[0]);
        let c = &frame.camera;
        hash.bytes(&c.width.to_le_bytes());
        hash.bytes(&c.height.to_le_bytes());
        for v in [c.fx, c.fy, c.cx, c.cy].into_iter().chain(c.distortion) {
            hash.bytes(&v.to_le_bytes());
        }
        for v in frame.c2w.to_cols_array() {
            hash.bytes(&v.to_le_bytes());
        }
        hash.bytes(&frame.time.to_le_bytes());
        hash.bytes(&frame.frame_index.to_le_bytes());
        hash.bytes(&[u8::from(frame.split == Split::Train), u8::from(frame.mask_path.is_some())]);
        let size = std::fs::metadata(&frame.image_path).map_or(0, |m| m.len());
        hash.bytes(&size.to_le_bytes());
    }
    for v in scene.bounds.min.to_array().into_iter().chain(scene.bounds.max.to_array()) {
        hash.bytes(&v.to_le_bytes());
    }
    format!("{:016x}", hash.0)
}

/// FNV-1a, 64 bits: the standard library's hasher may change between versions of Rust.
struct Fnv(u64);

impl Fnv {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn bytes(&mut self, bytes: &[u8]) {
        for b in bytes {
            self.0 = (self.0 ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From the reference tables of the FNV authors.
    #[test]
    fn fnv_matches_its_published_values() {
        let hash = |text: &str| {
            let mut h = Fnv::new();
            h.bytes(text.as_bytes());
            h.0
        };
        assert_eq!(hash(""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(hash("a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(hash("foobar"), 0x8594_4171_f739_67e8);
    }
}
