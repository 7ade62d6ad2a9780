//! Checks that a matrix is a rigid camera pose.

use glam::{DAffine3, DMat3, DMat4, DVec3};

use super::Pose;

/// Largest entry of |RᵀR − I| that is repaired rather than refused: the rounding of poses that were written
/// with four decimals, and no more; a pose that is further off was scaled, sheared or read with other
/// conventions.
const REPAIRABLE: f64 = 1e-3;

/// OpenGL camera axes (y up, looking along −z) to ours (OpenCV: y down, looking along +z), on the camera's
/// side.
pub(crate) fn from_opengl(c2w: DMat4) -> DMat4 {
    c2w * DMat4::from_scale(DVec3::new(1.0, -1.0, -1.0))
}

/// Inverse of a rigid transform that is not yet checked; what is not rigid stays so and is found by
/// [`checked`].
pub(crate) fn inverse_rigid(rotation: DMat3, translation: DVec3) -> DMat4 {
    let r = rotation.transpose();
    DMat4::from_cols(
        r.x_axis.extend(0.0),
        r.y_axis.extend(0.0),
        r.z_axis.extend(0.0),
        (-(r * translation)).extend(1.0),
    )
}

/// The rigid pose in `m`, its rotation made exactly orthonormal.
///
/// # Errors
/// What is wrong and what to do, in words.
pub(crate) fn checked(m: DMat4) -> Result<Pose, (String, &'static str)> {
    if !m.is_finite() {
        return Err((
            "the pose holds NaN or an infinite number".into(),
            "remove the frame or run the reconstruction again",
        ));
    }
    let last_row = m.row(3);
    if (last_row - glam::DVec4::W).abs().max_element() > 1e-6 {
        return Err((
            format!("the last row of the pose is {last_row}, not [0, 0, 0, 1]"),
            "write the matrix row by row, not column by column",
        ));
    }
    let r = DMat3::from_mat4(m);
    let det = r.determinant();
    if det == 0.0 || r.x_axis.length().min(r.y_axis.length()).min(r.z_axis.length()) < 1e-12 {
        return Err((
            "the rotation of the pose is singular".into(),
            "remove the frame or run the reconstruction again",
        ));
    }
    let deviation = (r.transpose() * r - DMat3::IDENTITY).to_cols_array().map(f64::abs);
    let deviation = deviation.into_iter().fold(0.0, f64::max);
    if deviation > REPAIRABLE {
        return Err((
            format!("the rotation of the pose is not a rotation (RᵀR differs from 1 by {deviation:.2e})"),
            "a scaled pose must be divided by its scale; otherwise run the reconstruction again",
        ));
    }
    if det < 0.0 {
        return Err((
            "the pose is left-handed (determinant −1)".into(),
            "convert it to a right-handed frame: flip one axis of both the world and the camera",
        ));
    }
    Ok(DAffine3 { matrix3: nearest_rotation(r), translation: m.w_axis.truncate() })
}

/// The rotation nearest to `r` (polar decomposition) by Newton's iteration, which converges quadratically.
fn nearest_rotation(mut r: DMat3) -> DMat3 {
    for _ in 0..4 {
        r = (r + r.inverse().transpose()) * 0.5;
    }
    r
}
