//! What one frame says must be what others say.

use glam::Vec2;

use super::StereoConfig;
use super::rig::WorkView;
use super::sweep::RADIUS;

/// Relative difference of the inverse depths of neighbouring pixels that is no slope any more but an edge.
const JUMP: f32 = 0.05;

/// Pixels beside an edge whose window shows both sides of it, and one more.
const REACH: usize = RADIUS + 1;

/// Depth of the pixels of view `n` with which enough of its neighbours agree; 0 elsewhere.
pub(super) fn keep_agreeing(
    views: &[WorkView],
    inverse: &[&[f32]],
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

/// Forgets depth near the edges of things: where a window shows an edge, what is nearer wins, so that things come out
/// larger than they are by half a window.
pub(super) fn drop_edges(inverse: &[f32], width: usize, depth: &mut [f32]) {
    let height = inverse.len() / width;
    let jump = |a: usize, b: usize| {
        let (a, b) = (inverse[a], inverse[b]);
        a > 0.0 && b > 0.0 && (a - b).abs() > JUMP * a.max(b)
    };
    for pixel in 0..inverse.len() {
        let (x, y) = (pixel % width, pixel / width);
        let right = x + 1 < width && jump(pixel, pixel + 1);
        let below = y + 1 < height && jump(pixel, pixel + width);
        if !right && !below {
            continue;
        }
        for row in y.saturating_sub(REACH)..=(y + REACH).min(height - 1) {
            let (from, to) = (x.saturating_sub(REACH), (x + REACH).min(width - 1));
            depth[row * width + from..=row * width + to].fill(0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_forgotten_beside_edges_and_kept_on_slopes() {
        let (width, height) = (24, 9);
        // A slope of 2 % a pixel, and from column 12 on something twice as near.
        let inverse: Vec<f32> = (0..width * height)
            .map(|n| 1.02f32.powi((n % width) as i32) * if n % width < 12 { 1.0 } else { 2.0 })
            .collect();
        let mut depth: Vec<f32> = inverse.iter().map(|i| 1.0 / i).collect();
        drop_edges(&inverse, width, &mut depth);
        for (n, d) in depth.iter().enumerate() {
            let beside = (11 - REACH..=11 + REACH).contains(&(n % width));
            assert_eq!(*d == 0.0, beside, "column {}", n % width);
        }
    }
}
