//! The cameras as training has refined them: where the field's surfaces really are seen from.

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::rays::View;
use crate::field::Field;
use crate::scene::{Camera, Frame, Pose};

/// Intrinsics and pose (camera-to-world, world units) that a frame's rays follow after refinement.
///
/// A ray of [`View::ray`] at distance `t` is at depth `t * dir_cam.z` along this camera's axis, up to the second-order
/// effect of the refinement.
pub fn refined_camera(field: &Field, frame: &Frame) -> (Camera, Pose) {
    let view = View::new(field, frame);
    let [rx, ry, rz, tx, ty, tz] = view.refinement.map(f64::from);
    let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(rx, ry, rz)));
    let shift = DVec3::new(tx, ty, tz) * field.normalisation.scale;
    let c2w = DAffine3 {
        matrix3: frame.c2w.matrix3 * turn,
        translation: frame.c2w.translation + frame.c2w.matrix3 * shift,
    };
    // Directions are stretched by `zoom` off the axis, so the same pixel belongs to a longer focal length's inverse;
    // the lens polynomial is in normalised coordinates and is rescaled with them.
    let [focal, radial] = view.lens.map(f64::from);
    let zoom = 1.0 + focal;
    let [k1, k2, p1, p2] = frame.camera.distortion;
    // Directions that are stretched by `radial r²` more belong to a lens that pulls them in by as much.
    let k1 = k1 - radial / zoom;
    let camera = Camera {
        fx: frame.camera.fx / zoom,
        fy: frame.camera.fy / zoom,
        distortion: [k1 / zoom.powi(2), k2 / zoom.powi(4), p1 / zoom, p2 / zoom],
        ..frame.camera
    };
    (camera, c2w)
}

/// The camera whose pixels are squares of `stride` pixels a side of the given one; what is left over at the right and
/// lower border is cut off.
pub fn reduced(camera: &Camera, stride: u32) -> Camera {
    let by = f64::from(stride);
    Camera {
        width: (camera.width / stride).max(1),
        height: (camera.height / stride).max(1),
        fx: camera.fx / by,
        fy: camera.fy / by,
        cx: camera.cx / by,
        cy: camera.cy / by,
        distortion: camera.distortion,
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, Vec3};

    use super::*;
    use crate::render::rays::pixel_directions;
    use crate::render::testing::{field, frame};

    #[test]
    fn points_on_a_refined_ray_project_to_its_pixel_at_its_depth() {
        let mut field = field([true, false, false]);
        let pose = field.layout.pose.clone();
        for (k, w) in field.weights[pose].iter_mut().enumerate() {
            *w = 1e-3 * ((k * 7 % 5) as f32 - 2.0);
        }
        let rig = field.layout.rig.clone();
        field.weights[rig].copy_from_slice(&[2e-3, -1e-3, 1e-3, 1e-3, 2e-3, -2e-3, 0.01, 0.004]);
        let mut frame = frame(0.3);
        frame.camera.distortion = [0.05, -0.01, 0.002, -0.001];
        let view = View::new(&field, &frame);
        let (camera, c2w) = refined_camera(&field, &frame);
        let directions = pixel_directions(&frame.camera);
        for (x, y) in [(0, 0), (5, 3), (15, 11)] {
            let dir = directions[y * frame.camera.width as usize + x];
            let ray = view.ray(dir, Vec3::ONE, 0.0);
            let p = field.normalisation.to_world(ray.origin + ray.dir * 0.4);
            let at = c2w.inverse().transform_point3(p);
            let uv = camera.project(at).unwrap();
            let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            assert!(uv.distance(pixel) < 0.01, "{uv} {pixel}");
            let depth = 0.4 * f64::from(dir.z) * field.normalisation.scale;
            assert!((at.z - depth).abs() < 1e-4 * depth, "{} {depth}", at.z);
        }
    }

    #[test]
    fn reduced_pixels_look_through_the_middle_of_their_squares() {
        let camera = frame(0.0).camera;
        let half = reduced(&camera, 2);
        let at = half.unproject(DVec2::new(2.5, 1.5));
        assert!((at - camera.unproject(DVec2::new(5.0, 3.0))).length() < 1e-12);
    }
}
