//! Pinhole cameras with optional OPENCV lens distortion.
//!
//! Axes: x right, y down, z forward (OpenCV). Pixel (0, 0) is the top-left pixel and its centre is at (0.5, 0.5), so
//! an image of width `w` spans `[0, w]` in `u`.

use glam::{DAffine3, DVec2, DVec3};

/// Intrinsics of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image width, px.
    pub width: u32,
    /// Image height, px.
    pub height: u32,
    /// Focal length along x, px.
    pub fx: f64,
    /// Focal length along y, px.
    pub fy: f64,
    /// Principal point, px.
    pub cx: f64,
    /// Principal point, px.
    pub cy: f64,
    /// OPENCV `k1 k2 p1 p2`; all zero for a pinhole.
    pub distortion: [f64; 4],
}

impl Camera {
    /// Whether the lens is a plain pinhole.
    pub fn is_pinhole(&self) -> bool {
        self.distortion == [0.0; 4]
    }

    /// Direction in camera coordinates (z = 1, not normalised) through the image point `uv` (px).
    ///
    /// Inverts the OPENCV distortion by Newton's method; exact for a pinhole.
    pub fn unproject(&self, uv: DVec2) -> DVec3 {
        let target = DVec2::new((uv.x - self.cx) / self.fx, (uv.y - self.cy) / self.fy);
        if self.is_pinhole() {
            return target.extend(1.0);
        }
        let mut p = target;
        for _ in 0..20 {
            let residual = self.distort(p) - target;
            if residual.length_squared() < 1e-24 {
                break;
            }
            // Numeric Jacobian: four polynomial evaluations, no second set of formulas to keep in step.
            let h = 1e-6;
            let dx = (self.distort(p + DVec2::X * h) - self.distort(p - DVec2::X * h)) / (2.0 * h);
            let dy = (self.distort(p + DVec2::Y * h) - self.distort(p - DVec2::Y * h)) / (2.0 * h);
            let det = dx.x * dy.y - dx.y * dy.x;
            if det.abs() < 1e-12 {
                break;
            }
            p -= DVec2::new(
                (dy.y * residual.x - dy.x * residual.y) / det,
                (dx.x * residual.y - dx.y * residual.x) / det,
            );
        }
        p.extend(1.0)
    }

    /// Image point (px) of a point in camera coordinates; `None` behind the camera.
    pub fn project(&self, p: DVec3) -> Option<DVec2> {
        if p.z <= 0.0 {
            return None;
        }
        let d = self.distort(p.truncate() / p.z);
        Some(DVec2::new(d.x * self.fx + self.cx, d.y * self.fy + self.cy))
    }

    /// OpenCV's radial-tangential model on normalised coordinates.
    fn distort(&self, p: DVec2) -> DVec2 {
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = p.length_squared();
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        DVec2::new(
            p.x * radial + 2.0 * p1 * p.x * p.y + p2 * (r2 + 2.0 * p.x * p.x),
            p.y * radial + p1 * (r2 + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
        )
    }
}

/// A camera-to-world pose: OpenCV camera axes to the scene's own world frame and units.
pub type Pose = DAffine3;
