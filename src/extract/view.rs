//! A posed camera as the fusion and the visibility test see it: f32, relative to the grid's origin.

use glam::{DVec2, DVec3, Mat3A, Vec3A};

use super::ExtractError;
use crate::scene::{Camera, Pose};

/// Projects points that are relative to the grid's origin into one frame.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// World-to-camera rotation.
    pub(crate) rotation: Mat3A,
    /// Camera centre relative to the grid's origin.
    pub(crate) center: Vec3A,
    pub(crate) width: usize,
    pub(crate) height: usize,
    focal: [f32; 2],
    principal: [f32; 2],
    distortion: Option<[f32; 4]>,
    /// Largest squared normalised radius in the image: beyond it the distortion polynomial may fold back.
    max_radius2: f32,
}

impl View {
    /// # Errors
    /// `NonFinite` ("camera") with the frame's index, `Invalid` for an empty image.
    pub(crate) fn new(
        camera: &Camera,
        c2w: &Pose,
        origin: [f64; 3],
        index: usize,
    ) -> Result<Self, ExtractError> {
        let intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy];
        let finite = c2w.is_finite() && intrinsics.iter().chain(&camera.distortion).all(|v| v.is_finite());
        if !finite {
            return Err(ExtractError::NonFinite { stage: "camera", index });
        }
        let size = (camera.width, camera.height);
        ExtractError::require(size.0 > 0 && size.1 > 0, "image size", size, "at least one pixel")?;
        let focal = (camera.fx, camera.fy);
        ExtractError::require(focal.0 != 0.0 && focal.1 != 0.0, "focal length", focal, "other than zero")?;
        Ok(Self {
            rotation: Mat3A::from(c2w.matrix3.transpose().as_mat3()),
            // Subtract in f64: the world may be far from zero.
            center: (c2w.translation - DVec3::from_array(origin)).as_vec3a(),
            width: camera.width as usize,
            height: camera.height as usize,
            focal: [camera.fx as f32, camera.fy as f32],
            principal: [camera.cx as f32, camera.cy as f32],
            distortion: (!camera.is_pinhole()).then(|| camera.distortion.map(|k| k as f32)),
            max_radius2: max_radius2(camera),
        })
    }

    /// A point relative to the grid's origin, in camera coordinates.
    #[inline]
    pub(crate) fn to_camera(&self, p: Vec3A) -> Vec3A {
        self.rotation * (p - self.center)
    }

    /// Image point (px) of a point in camera coordinates; `None` where it is behind the camera or out of the
    /// image.
    #[inline]
    pub(crate) fn project(&self, p: Vec3A) -> Option<[f32; 2]> {
        if p.z <= 0.0 {
            return None;
        }
        let inv = 1.0 / p.z;
        let (mut x, mut y) = (p.x * inv, p.y * inv);
        if let Some([k1, k2, p1, p2]) = self.distortion {
            let r2 = x * x + y * y;
            if r2 > self.max_radius2 {
                return None;
            }
            let radial = 1.0 + r2 * (k1 + r2 * k2);
            let dx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
            y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
            x = dx;
        }
        let u = x * self.focal[0] + self.principal[0];
        let v = y * self.focal[1] + self.principal[1];
        let inside = u >= 0.0 && v >= 0.0 && u < self.width as f32 && v < self.height as f32;
        inside.then_some([u, v])
    }

    /// Whether a sphere in camera coordinates can be in the image: exact planes for a pinhole, a cone
    /// otherwise.
    pub(crate) fn may_see(&self, center: Vec3A, radius: f32) -> bool {
        if center.z + radius <= 0.0 {
            return false;
        }
        if self.distortion.is_some() {
            // Distance of the centre from the viewing cone of half-angle atan(max_radius).
            let tan2 = self.max_radius2;
            let cos = (1.0 + tan2).sqrt().recip();
            let off_axis = center.x.hypot(center.y);
            return off_axis * cos - center.z * tan2.sqrt() * cos <= radius;
        }
        let size = [self.width as f32, self.height as f32];
        (0..2).all(|a| {
            let bound = |edge: f32| (edge - self.principal[a]) / self.focal[a];
            let (b0, b1) = (bound(0.0), bound(size[a]));
            let (low, high) = (b0.min(b1), b0.max(b1));
            let distance = |slope: f32, sign: f32| sign * (center[a] - slope * center.z) / slope.hypot(1.0);
            distance(low, -1.0) <= radius && distance(high, 1.0) <= radius
        })
    }
}

/// Largest squared radius of the image's border in normalised coordinates, with a margin of a few percent.
fn max_radius2(camera: &Camera) -> f32 {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let border = (0..=16).flat_map(|i| {
        let t = f64::from(i) / 16.0;
        [DVec2::new(w * t, 0.0), DVec2::new(w * t, h), DVec2::new(0.0, h * t), DVec2::new(w, h * t)]
    });
    let largest = border.map(|uv| camera.unproject(uv).truncate().length_squared()).fold(0.0, f64::max);
    (largest * 1.05) as f32
}

/// The four pixels round the image point and the weight of each; pixel centres are at half-integers. Points
/// within half a pixel of the border repeat the border pixels.
#[inline]
pub(crate) fn bilinear(uv: [f32; 2], width: usize, height: usize) -> [(usize, f32); 4] {
    let axis = |c: f32, n: usize| {
        let c = (c - 0.5).clamp(0.0, (n - 1) as f32);
        let low = c as usize;
        (low, (low + 1).min(n - 1), c - low as f32)
    };
    let (x0, x1, fx) = axis(uv[0], width);
    let (y0, y1, fy) = axis(uv[1], height);
    let at = |x: usize, y: usize, w: f32| (y * width + x, w);
    [
        at(x0, y0, (1.0 - fx) * (1.0 - fy)),
        at(x1, y0, fx * (1.0 - fy)),
        at(x0, y1, (1.0 - fx) * fy),
        at(x1, y1, fx * fy),
    ]
}

/// The bilinear depth at an image point, where its four pixels are valid and within `max_step` of each other
/// (one surface).
#[inline]
pub(crate) fn smooth_depth(
    depth: &[f32],
    uv: [f32; 2],
    width: usize,
    height: usize,
    max_step: f32,
) -> Option<f32> {
    let taps = bilinear(uv, width, height);
    let values = taps.map(|(i, _)| depth[i]);
    let (low, high) = values.iter().fold((f32::MAX, 0f32), |(l, h), &v| (l.min(v), h.max(v)));
    let one_surface = low > 0.0 && high - low <= max_step;
    one_surface.then(|| taps.iter().zip(values).map(|((_, w), v)| w * v).sum())
}
