//! Which parts of the frames few other frames show, so that rays can go there.
//!
//! With pixels drawn evenly, what a video passes in three frames gets a hundredth of the rays of what it shows all the time,
//! and its surface stays where the first fog was.

use glam::{DAffine3, DVec2};
use rayon::prelude::*;

use crate::rng::Rng;
use crate::scene::Frame;

/// Cells of a frame, along its width and height.
const CELLS: [usize; 2] = [8, 6];

/// Distances at which the middle of a cell is looked for in other frames, as shares of the scene's size.
const DISTANCES: [f64; 3] = [0.13, 0.22, 0.4];

/// Other frames that are looked at, at most.
const OTHERS: usize = 256;

/// A cell gets at most this many times its even share of the rays.
const MOST: f64 = 8.0;

/// Chances of the cells of all frames.
pub struct Novelty {
    /// Sums of the chances up to and with each cell, `[frame * cells]`; the last is 1.
    sums: Vec<f64>,
}

impl Novelty {
    /// `share` of the rays go to cells by how few frames show what is there, the others evenly; `size` is that of the scene, in
    /// world units. With a share of 0 nobody looks what frames show.
    pub fn new(frames: &[Frame], size: f64, share: f64) -> Self {
        let every = frames.len().div_ceil(OTHERS).max(1);
        let others: Vec<Other> = frames.iter().step_by(every).map(|f| (f, f.c2w.inverse())).collect();
        let rarity = |frame: &Frame| -> Vec<f64> {
            let cells = 0..CELLS[0] * CELLS[1];
            cells.map(|cell| if share > 0.0 { rarity(frame, cell, &others, size) } else { 1.0 }).collect()
        };
        let rarity: Vec<f64> = frames.par_iter().map(rarity).collect::<Vec<_>>().concat();
        let mean = rarity.iter().sum::<f64>() / rarity.len().max(1) as f64;
        let chances = rarity.iter().map(|r| 1.0 - share + share * (r / mean).min(MOST));
        let mut sums: Vec<f64> = chances
            .scan(0.0, |sum, chance| {
                *sum += chance;
                Some(*sum)
            })
            .collect();
        let total = sums.last().copied().unwrap_or(1.0);
        sums.iter_mut().for_each(|sum| *sum /= total);
        Self { sums }
    }

    /// A frame's number and a pixel of it.
    pub fn draw(&self, frames: &[Frame], rng: &mut Rng) -> (usize, usize) {
        let u = f64::from(rng.uniform());
        let cell = self.sums.partition_point(|sum| *sum <= u).min(self.sums.len().saturating_sub(1));
        let (frame, cell) = (cell / (CELLS[0] * CELLS[1]), cell % (CELLS[0] * CELLS[1]));
        let camera = &frames[frame].camera;
        let [x, y] = [(cell % CELLS[0], CELLS[0], camera.width), (cell / CELLS[0], CELLS[1], camera.height)]
            .map(|(n, cells, size)| {
                let (from, to) = (n * size as usize / cells, (n + 1) * size as usize / cells);
                (from + rng.below((to - from).max(1))).min(size as usize - 1)
            });
        (frame, y * camera.width as usize + x)
    }
}

/// A frame, and world to camera.
type Other<'a> = (&'a Frame, DAffine3);

/// One over the number of frames that show what is in the middle of a cell, at some distances; mean over those.
fn rarity(frame: &Frame, cell: usize, others: &[Other], size: f64) -> f64 {
    let camera = &frame.camera;
    let middle = DVec2::new((cell % CELLS[0]) as f64 + 0.5, (cell / CELLS[0]) as f64 + 0.5);
    let uv = middle / DVec2::new(CELLS[0] as f64, CELLS[1] as f64)
        * DVec2::new(f64::from(camera.width), f64::from(camera.height));
    let of = |distance: &f64| {
        let point = frame.c2w.transform_point3(camera.unproject(uv) * (distance * size));
        let shows = |(other, w2c): &&Other| {
            let at = w2c.transform_point3(point);
            let (width, height) = (f64::from(other.camera.width), f64::from(other.camera.height));
            other.camera.project(at).is_some_and(|p| p.x >= 0.0 && p.y >= 0.0 && p.x < width && p.y < height)
        };
        1.0 / others.iter().filter(shows).count().max(1) as f64
    };
    DISTANCES.iter().map(of).sum::<f64>() / DISTANCES.len() as f64
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat3};

    use super::*;
    use crate::render::testing::frame;

    #[test]
    fn what_one_frame_alone_shows_gets_more_rays() {
        // Nine frames look the same way, one looks back.
        let mut frames: Vec<Frame> = (0..10).map(|_| frame(0.5)).collect();
        let back = DAffine3::from_mat3(DMat3::from_rotation_y(std::f64::consts::PI));
        frames[9].c2w *= back;
        let count = |share: f64| {
            let novelty = Novelty::new(&frames, 2.0, share);
            let mut rng = Rng::new(1, 2, 3);
            let drawn: Vec<_> = (0..20_000).map(|_| novelty.draw(&frames, &mut rng)).collect();
            let camera = &frames[0].camera;
            assert!(drawn.iter().all(|(_, pixel)| *pixel < (camera.width * camera.height) as usize));
            drawn.iter().filter(|(frame, _)| *frame == 9).count() as f64 / drawn.len() as f64
        };
        assert!((count(0.0) - 0.1).abs() < 0.01, "{}", count(0.0));
        // Nine ninths and one: half of all.
        assert!((count(1.0) - 0.5).abs() < 0.02, "{}", count(1.0));
        assert!((count(0.5) - 0.3).abs() < 0.02, "{}", count(0.5));
    }
}
