//! Where the map lies in the world: the grid, the common offset, the up axis.

use divff_exporters::UpAxis;
use glam::DVec3;

use crate::extract::GridSpec;
use crate::field::Normalisation;
use crate::scene::Scene;

/// Voxels along the diagonal of the box, unless a size is given.
const VOXELS_PER_DIAGONAL: f64 = 350.0;

/// The mean up vector must agree with an axis to this cosine (30°) for the axis to count as up.
const UP_COSINE: f64 = 0.866;

/// The default voxel size, world units.
pub fn default_voxel(n: &Normalisation) -> f64 {
    n.extent.as_dvec3().length() * n.scale / VOXELS_PER_DIAGONAL
}

/// A grid over the whole box; its origin is that of the normalisation, so that relative positions are units times
/// scale.
pub(super) fn grid(n: &Normalisation, voxel: f64) -> GridSpec {
    let max = n.origin + n.extent.as_dvec3() * n.scale;
    GridSpec::covering(n.origin.to_array(), max.to_array(), voxel)
}

/// What is subtracted from world coordinates in files: nothing where f32 resolves a tenth of a voxel all over the box,
/// else the middle of the box in whole units (or whole voxels, where those are finer).
pub(super) fn offset(n: &Normalisation, voxel: f64) -> [f64; 3] {
    let size = n.extent.as_dvec3() * n.scale;
    let farthest = n.origin.abs().max((n.origin + size).abs()).max_element();
    if farthest * f64::from(f32::EPSILON) <= 0.1 * voxel {
        return [0.0; 3];
    }
    let grain = if size.max_element() > 4.0 { 1.0 } else { voxel };
    ((n.origin + 0.5 * size) / grain).round().to_array().map(|c| c * grain)
}

/// The world axis that the cameras hold up, and whether they agree on one that glTF can express.
///
/// glTF is Y up; a Z-up world is turned. Any other world (Y down is common) is left as it is.
pub(super) fn up_axis(scene: &Scene) -> (UpAxis, bool) {
    // Image rows run downwards, so −y of the camera is up.
    let mean: DVec3 = scene.frames.iter().map(|f| -f.c2w.matrix3.y_axis).sum();
    let up = mean.normalize_or_zero();
    if up.z > UP_COSINE { (UpAxis::Z, true) } else { (UpAxis::Y, up.y > UP_COSINE) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Aabb;

    fn at(origin: f64, size: f64) -> Normalisation {
        Normalisation::new(Aabb { min: DVec3::splat(origin), max: DVec3::splat(origin + size) })
    }

    #[test]
    fn only_scenes_that_f32_cannot_resolve_are_shifted() {
        assert_eq!(offset(&at(-2.0, 4.0), 0.02), [0.0; 3]);
        assert_eq!(offset(&at(1000.0, 4.0), 0.02), [0.0; 3]);
        assert_eq!(offset(&at(1e6, 6.0), 0.02), [1_000_003.0; 3]);
        let tiny = at(1.0, 1e-6);
        let shift = offset(&tiny, default_voxel(&tiny));
        assert!((shift[0] - 1.000_000_5).abs() < 1e-8, "{shift:?}");
    }

    #[test]
    fn a_grid_covers_its_box() {
        let n = at(5.0, 3.0);
        let spec = grid(&n, default_voxel(&n));
        assert_eq!(spec.origin, [5.0; 3]);
        assert!(spec.dims.iter().all(|&d| f64::from(d) * spec.voxel >= 3.0 - 1e-9));
    }
}
