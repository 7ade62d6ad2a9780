//! From a pixel to a ray in the field's units.

use glam::{DVec2, Mat3, Vec3};

use crate::field::codes::Knots;
use crate::field::{Field, Normalisation};
use crate::scene::{Camera, Frame};

/// Unit directions in camera axes through every pixel centre of a camera, `[height * width]`.
pub type PixelDirections = Vec<Vec3>;

/// Directions of all pixels.
pub fn pixel_directions(camera: &Camera) -> PixelDirections {
    (0..camera.height)
        .flat_map(|y| (0..camera.width).map(move |x| (x, y)))
        .map(|(x, y)| pixel_direction(camera, x, y))
        .collect()
}

/// Unit direction in camera axes through the centre of a pixel; the lens is undone here and nowhere else.
pub fn pixel_direction(camera: &Camera, x: u32, y: u32) -> Vec3 {
    let uv = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
    camera.unproject(uv).normalize().as_vec3()
}

/// A frame's pose in units, with the refinement that training has found for its time.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// Camera centre, units, as the scene says.
    pub centre: Vec3,
    /// Camera axes to units, as the scene says.
    pub rotation: Mat3,
    /// Small rotation (rad) and translation (units) in camera axes.
    pub refinement: [f32; 6],
    /// Relative change of the focal length, and of its growth with the squared distance from the axis.
    pub lens: [f32; 2],
    /// Place in the pose and exposure trajectories.
    pub knots: Knots,
    /// When it is, in [0, 1] over the video.
    pub time: f32,
    /// Place in the code trajectories of each stream.
    pub code_knots: [Option<Knots>; 3],
}

/// A ray in units.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Start, units.
    pub origin: Vec3,
    /// Direction; a unit vector up to the (second-order) effect of the refinement.
    pub dir: Vec3,
    /// The direction in camera axes before refinement.
    pub dir_cam: Vec3,
    /// The direction in camera axes after refinement; `t * refined_cam.z` is the z-depth in units.
    pub refined_cam: Vec3,
    /// First and last distance inside the box.
    pub range: (f32, f32),
}

impl Ray {
    /// The point at distance `t`.
    #[inline]
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.dir * t
    }
}

impl View {
    /// The pose of a frame with the field's refinement at its time.
    pub fn new(field: &Field, frame: &Frame) -> Self {
        let time = frame.time as f32;
        let knots = field.pose.locate(time);
        let mut refinement = [0.0; 6];
        field.pose.evaluate(&field.weights[field.layout.pose.clone()], knots, &mut refinement);
        let rig = &field.weights[field.layout.rig.clone()];
        for (r, shared) in refinement.iter_mut().zip(rig) {
            *r += shared;
        }
        let n: &Normalisation = &field.normalisation;
        Self {
            centre: n.to_unit(frame.c2w.translation),
            rotation: frame.c2w.matrix3.as_mat3(),
            refinement,
            lens: [rig[6], rig[7]],
            knots,
            time,
            code_knots: field.codes.each_ref().map(|c| c.as_ref().map(|c| c.locate(time))),
        }
    }

    /// The same camera with the scene as it is at another time.
    pub fn at_time(self, field: &Field, time: f32) -> Self {
        let code_knots = field.codes.each_ref().map(|c| c.as_ref().map(|c| c.locate(time)));
        Self { code_knots, time, ..self }
    }

    /// The ray through a pixel whose direction in camera axes is `dir_cam`.
    pub fn ray(&self, dir_cam: Vec3, extent: Vec3, near: f32) -> Ray {
        let [rx, ry, rz, tx, ty, tz] = self.refinement;
        let turned = dir_cam + Vec3::new(rx, ry, rz).cross(dir_cam);
        let [focal, radial] = self.lens;
        let zoom = focal + radial * off_axis(dir_cam);
        let refined_cam = turned + zoom * Vec3::new(dir_cam.x, dir_cam.y, 0.0);
        let origin = self.centre + self.rotation * Vec3::new(tx, ty, tz);
        let dir = self.rotation * refined_cam;
        Ray { origin, dir, dir_cam, refined_cam, range: clip(origin, dir, extent, near) }
    }

    /// Gradient with respect to (rotation, translation) and the lens of a loss with the given gradient with respect to
    /// the ray's origin and direction.
    pub fn backward(&self, ray: &Ray, d_origin: Vec3, d_dir: Vec3) -> ([f32; 6], [f32; 2]) {
        let translation = self.rotation.transpose() * d_origin;
        let d_cam = self.rotation.transpose() * d_dir;
        let rotation = ray.dir_cam.cross(d_cam);
        let focal = d_cam.x * ray.dir_cam.x + d_cam.y * ray.dir_cam.y;
        let pose = [rotation.x, rotation.y, rotation.z, translation.x, translation.y, translation.z];
        (pose, [focal, focal * off_axis(ray.dir_cam)])
    }
}

/// Squared distance from the optical axis in the plane at depth 1.
fn off_axis(dir: Vec3) -> f32 {
    (dir.x * dir.x + dir.y * dir.y) / (dir.z * dir.z)
}

/// The part of a ray inside `[0, extent]` and beyond `near`; empty (start ≥ end) if it misses the box.
fn clip(origin: Vec3, dir: Vec3, extent: Vec3, near: f32) -> (f32, f32) {
    let (mut start, mut end) = (near, f32::MAX);
    for axis in 0..3 {
        if dir[axis].abs() < 1e-12 {
            if origin[axis] < 0.0 || origin[axis] > extent[axis] {
                return (near, near);
            }
            continue;
        }
        let a = -origin[axis] / dir[axis];
        let b = (extent[axis] - origin[axis]) / dir[axis];
        start = start.max(a.min(b));
        end = end.min(a.max(b));
    }
    if start < end { (start, end) } else { (near, near) }
}
