//! Which streams a scene needs: whether anything moves that the persistent one leaves unexplained.

use super::Trainer;
use crate::render::forward::Model;
use crate::render::image::render;
use crate::train::config::StreamChoice;
use crate::train::pixels::PixelSet;

/// Frames that are looked at to decide whether anything moves, at most.
const LOOK_AT_FRAMES: usize = 24;

/// Every how many pixels they are looked at, and how many of those make a block's side.
const LOOK_STRIDE: u32 = 4;
const LOOK_BLOCK: u32 = 4;

/// Mean colour error of a block (0-1) that blur and noise do not explain.
const WRONG_COLOUR: f32 = 0.12;

/// Steps after which a persistent stream is sharp enough for that.
const SETTLE_AFTER: u64 = 500;

/// Share of such blocks above which something moves: of held-out frames, rooms where nothing moves have 1 to 2 %,
/// kitchens with someone at work 9 to 20 %.
const MOVING_SHARE: f64 = 0.04;

impl Trainer {
    /// Whether the persistent stream has had its time alone. A short training gives it more than its share, up to double
    /// and half of all, since what is still blurred looks like something that has moved.
    pub(super) fn stands(&self, fraction: f64) -> bool {
        let share = self.config.train.static_until;
        let late = (2.0 * share).min(0.5).max(share);
        fraction >= share && (self.trained.progress.step >= SETTLE_AFTER || fraction >= late)
    }

    /// Decides which streams the scene needs, once the persistent one has had its time alone.
    pub(super) fn settle_streams(&mut self) {
        self.settle();
        if self.config.train.streams == StreamChoice::Auto {
            let unexplained = self.unexplained();
            self.trained.progress.unexplained = Some(unexplained);
            if unexplained < MOVING_SHARE {
                self.trained.keep_streams([true, false, false]);
                self.optimiser.keep_streams(&self.trained.field);
            }
        }
        self.streams = self.trained.field.shape.streams;
        self.trained.progress.streams_settled = true;
    }

    /// Share of image blocks whose mean colour the persistent stream gets wrong.
    ///
    /// Blur, noise and misplaced edges average out over a block; a hand or an object that has moved does not.
    ///
    /// Held-out frames tell, where there are any: a cloud in front of each camera explains whatever moves in a frame that was
    /// learned from, but shows in the others.
    fn unexplained(&self) -> f64 {
        let pixels = if self.test.frames.is_empty() { &self.pixels } else { &self.test };
        let model = Model::new(&self.trained.field, &self.trained.grids, [true, false, false]);
        let every = pixels.frames.len().div_ceil(LOOK_AT_FRAMES).max(1);
        let (wrong, blocks) = (0..pixels.frames.len()).step_by(every).fold((0, 0), |sum, n| {
            let frame = self.wrong_blocks(&model, pixels, n);
            (sum.0 + frame.0, sum.1 + frame.1)
        });
        wrong as f64 / blocks.max(1) as f64
    }

    /// Numbers of blocks of frame `n`: those whose mean colour `model` gets wrong, and all; without those that a mask takes pixels away from.
    fn wrong_blocks(&self, model: &Model, pixels: &PixelSet, n: usize) -> (usize, usize) {
        let frame = &pixels.frames[n];
        let image = render(model, frame, &self.config.train.look_sampling(), LOOK_STRIDE);
        let (columns, rows) = (image.width / LOOK_BLOCK, image.height / LOOK_BLOCK);
        let (mut wrong, mut blocks) = (0, 0);
        for block in 0..columns * rows {
            let (bx, by) = (block % columns, block / columns);
            let mut sum = [0.0f32; 3];
            let mut usable = true;
            for k in 0..LOOK_BLOCK * LOOK_BLOCK {
                let (x, y) = (bx * LOOK_BLOCK + k % LOOK_BLOCK, by * LOOK_BLOCK + k / LOOK_BLOCK);
                let pixel = y * LOOK_STRIDE * frame.camera.width + x * LOOK_STRIDE;
                usable &= pixels.is_usable(n, pixel);
                let (rgb, truth) =
                    (image.rgb[(y * image.width + x) as usize], pixels.images[n][pixel as usize]);
                for c in 0..3 {
                    sum[c] += rgb[c] - f32::from(truth[c]) / 255.0;
                }
            }
            let mean = sum.map(|s| (s / (LOOK_BLOCK * LOOK_BLOCK) as f32).abs());
            let error = mean.into_iter().fold(0.0, f32::max);
            wrong += usize::from(usable && error > WRONG_COLOUR);
            blocks += usize::from(usable);
        }
        (wrong, blocks)
    }
}
