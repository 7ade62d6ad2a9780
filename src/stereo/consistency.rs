//! What one frame says must be what others say.

use glam::Vec2;

use super::StereoConfig;
use super::rig::WorkView;

/// Depth of the pixels of view `n` with which enough of its neighbours agree; 0 elsewhere.
pub(super) fn keep_agreeing(
    views: &[WorkView],
    inverse: &[Vec<f32>],
    n: usize,
    neighbours: &[usize],
    config: &StereoConfig,
) -> Vec<f32> {
    let view = &views[n];
    let keep = |(pixel, &inv): (usize, &f32)| {
        if inv <= 0.0 {
            return 0.0;
        }
        let p = Vec2::new((pixel % view.width) as f32 + 0.5, (pixel / view.width) as f32 + 0.5);
        let point = view.centre + view.ray(p) / inv;
        let agrees = |m: &&usize| {
            let Some((uv, z)) = views[**m].project(point) else { return false };
            let other = inverse[**m][uv.y as usize * views[**m].width + uv.x as usize];
            other > 0.0 && (other * z - 1.0).abs() < config.tolerance
        };
        let agreeing = neighbours.iter().filter(agrees).count();
        if agreeing >= config.agreeing { 1.0 / inv } else { 0.0 }
    };
    inverse[n].iter().enumerate().map(keep).collect()
}
