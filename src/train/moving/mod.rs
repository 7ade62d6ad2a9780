//! Where things are that move, although they may be at rest for most of the video.
//!
//! Colours do not tell: a persistent stream may show a thing in all its places at once, with the dynamic stream painting
//! over those where it is not. What tells is that other frames see through it ([`crate::stereo::seen_through`]). That
//! finds parts of surfaces; masks complete them to things, and a mask's descriptor finds the same thing where nothing
//! happens to look through it ([`masks`]). The places of all these surfaces are a volume in which persistent light has a
//! price ([`crate::train::loss::LossConfig::moving`]).

pub mod masks;

use glam::{DAffine3, UVec3, Vec3};

use crate::scene::Frame;
use crate::simd::floor_within;
use crate::stereo::StereoDepth;

/// Cells of a volume along the longest side of the box; 1.6 cm in a room of 4 m.
const CELLS: f32 = 256.0;

/// Cells along each edge of a block.
const BLOCK: u32 = 8;

/// How far the surface of what moves is marked to both sides along the ray, cells.
const THICKNESS: i32 = 1;

/// Frames that must say that something moves in a cell: what passes by for a moment, like a hand, is the actor's.
const AGREEING: u8 = 3;

/// Of the frames that see a surface in a cell, the share that must say so: masks are wrong now and then.
const MAJORITY: f32 = 0.25;

/// Evidence from which a surface moves where no mask confirms it.
const LONE_EVIDENCE: i32 = 10;

/// A frame, where it was taken from, its stereo depth and what the other frames say of each of that depth's pixels.
pub struct Evidence<'a> {
    /// The frame.
    pub frame: &'a Frame,
    /// Camera to units.
    pub c2w: DAffine3,
    /// Directions of its pixels, camera axes.
    pub directions: &'a [Vec3],
    /// Its depth.
    pub depth: &'a StereoDepth,
    /// By pixel of the depth.
    pub seen_through: Vec<i32>,
}

impl Evidence<'_> {
    /// Number of the depth's pixel behind a pixel of the frame, and the depth there; `None` where it is not known.
    fn depth_at(&self, pixel: usize) -> Option<(usize, f32)> {
        let seen = self.depth.seen(self.directions[pixel])?;
        let depth = self.depth.depth[seen];
        (depth > 0.0).then_some((seen, depth))
    }

    /// Adds the cells where a pixel ends at depth `z`, and up to `thickness` cells before and behind, to `cells`.
    fn surface(&self, volume: &Volume, pixel: usize, z: f32, thickness: i32, cells: &mut Vec<usize>) {
        let dir = self.directions[pixel];
        let ray = self.c2w.matrix3.as_mat3() * (dir / dir.z);
        let step = volume.cell / ray.length();
        let origin = self.c2w.translation.as_vec3();
        let along = (-thickness..=thickness).map(|n| origin + ray * (z + n as f32 * step));
        cells.extend(along.filter_map(|p| volume.index(p)));
    }
}

/// What one frame says of cells, in any order and as often as they come.
#[derive(Default)]
struct Opinion {
    /// Something is there that moves.
    moving: Vec<usize>,
    /// Something is there that does not.
    resting: Vec<usize>,
}

/// Cells of the box that hold surfaces of things that move, at some time.
#[derive(Clone, Default)]
pub struct Volume {
    bits: Vec<u64>,
    /// Whether any of the cells of a block is among them: few blocks are, and these bits stay in the nearest cache.
    blocks: Vec<u64>,
    size: UVec3,
    cell: f32,
}

impl Volume {
    /// An empty volume for a box of `extent` units.
    pub fn new(extent: Vec3) -> Self {
        let cell = extent.max_element() / CELLS;
        let size = (extent / cell).ceil().as_uvec3().max(UVec3::ONE);
        let cells = size.as_u64vec3().element_product() as usize;
        let blocks = (size / BLOCK + 1).element_product() as usize;
        Self { bits: vec![0; cells.div_ceil(64)], blocks: vec![0; blocks.div_ceil(64)], size, cell }
    }

    /// What is clearly seen through, pixel by pixel.
    pub fn of_depths(extent: Vec3, evidence: &[Evidence]) -> Self {
        let empty = Self::new(extent);
        let opinions = evidence.iter().map(|e| {
            let mut opinion = Opinion::default();
            for pixel in 0..e.directions.len() {
                match e.depth_at(pixel) {
                    Some((seen, z)) if e.seen_through[seen] >= LONE_EVIDENCE => {
                        e.surface(&empty, pixel, z, THICKNESS, &mut opinion.moving);
                    }
                    Some((_, z)) => e.surface(&empty, pixel, z, 0, &mut opinion.resting),
                    None => {}
                }
            }
            opinion
        });
        empty.clone().agreed(opinions)
    }

    /// With the cells of which enough frames say that something moves there.
    fn agreed(mut self, opinions: impl Iterator<Item = Opinion>) -> Self {
        let cells = 64 * self.bits.len();
        let [mut moving, mut resting] = [vec![0u8; cells], vec![0u8; cells]];
        for Opinion { moving: for_it, resting: against } in opinions {
            for (votes, mut named) in [(&mut moving, for_it), (&mut resting, against)] {
                named.sort_unstable();
                named.dedup();
                named.into_iter().for_each(|n| votes[n] = votes[n].saturating_add(1));
            }
        }
        let agreed = |n: usize| {
            let [moving, resting] = [moving[n], resting[n]].map(f32::from);
            moving >= f32::from(AGREEING) && moving >= MAJORITY * (moving + resting)
        };
        for (word, bits) in self.bits.iter_mut().enumerate() {
            *bits = (0..64).filter(|n| agreed(64 * word + n)).fold(0, |bits, n| bits | 1 << n);
        }
        for n in (0..self.size.element_product() as usize).filter(|n| is_set(&self.bits, *n)) {
            let (row, [w, h]) = (n as u32 / self.size.x, [self.size.x, self.size.y]);
            let block = self.block(UVec3::new(n as u32 % w, row % h, row / h));
            self.blocks[block / 64] |= 1 << (block % 64);
        }
        self
    }

    /// Whether points (units; x, y, z rows) are in one of the cells.
    #[inline(always)]
    pub fn contains<const N: usize>(&self, points: &[[f32; N]; 3]) -> [bool; N] {
        let mut found = [false; N];
        if self.bits.is_empty() {
            return found;
        }
        let (per_unit, size, blocks) = (1.0 / self.cell, self.size, self.size / BLOCK + 1);
        let [mut cells, mut in_blocks] = [[0u32; N]; 2];
        let mut inside = [true; N];
        for n in 0..N {
            let [x, y, z] = [points[0][n] * per_unit, points[1][n] * per_unit, points[2][n] * per_unit];
            inside[n] = (x >= 0.0)
                & (y >= 0.0)
                & (z >= 0.0)
                & (x < size.x as f32)
                & (y < size.y as f32)
                & (z < size.z as f32);
            let (x, _) = floor_within(x, (size.x - 1) as f32);
            let (y, _) = floor_within(y, (size.y - 1) as f32);
            let (z, _) = floor_within(z, (size.z - 1) as f32);
            cells[n] = (z * size.y + y) * size.x + x;
            in_blocks[n] = (z / BLOCK * blocks.y + y / BLOCK) * blocks.x + x / BLOCK;
        }
        for n in 0..N {
            found[n] = inside[n]
                && is_set(&self.blocks, in_blocks[n] as usize)
                && is_set(&self.bits, cells[n] as usize);
        }
        found
    }

    /// Whether there are no cells.
    pub fn is_empty(&self) -> bool {
        self.blocks.iter().all(|b| *b == 0)
    }

    /// Cells.
    pub fn len(&self) -> usize {
        self.bits.iter().map(|b| b.count_ones() as usize).sum()
    }

    /// Number of the cell that holds a point.
    fn index(&self, p: Vec3) -> Option<usize> {
        let (c, size) = ((p * (1.0 / self.cell)).as_uvec3(), self.size);
        let inside = p.cmpge(Vec3::ZERO).all() && c.cmplt(size).all();
        inside.then_some((c.z as usize * size.y as usize + c.y as usize) * size.x as usize + c.x as usize)
    }

    /// Number of the block that a cell is in.
    #[inline]
    fn block(&self, c: UVec3) -> usize {
        let (size, c) = (self.size / BLOCK + 1, c / BLOCK);
        ((c.z * size.y + c.y) * size.x + c.x) as usize
    }
}

/// Bit number `n`.
#[inline]
fn is_set(bits: &[u64], n: usize) -> bool {
    bits[n / 64] >> (n % 64) & 1 == 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_volume_holds_the_cells_that_enough_frames_name() {
        let empty = Volume::new(Vec3::new(1.0, 0.5, 0.25));
        let p = Vec3::new(0.501, 0.25, 0.2);
        let cell = empty.index(p).expect("the point is inside");
        let holds = |volume: &Volume, p: Vec3| volume.contains(&p.to_array().map(|x| [x])) == [true];
        assert!(!holds(&empty, p));
        let says = |moving: Vec<usize>, resting: Vec<usize>| Opinion { moving, resting };
        let frames = |count: usize| (0..count).map(move |_| says(vec![cell, 7, cell], vec![9]));
        let agreeing = usize::from(AGREEING);
        assert!(!holds(&empty.clone().agreed(frames(agreeing - 1)), p), "twice in a frame is once");
        let volume = empty.clone().agreed(frames(agreeing));
        assert!(holds(&volume, p) && holds(&volume, p + 0.001));
        assert!(!holds(&volume, p + 0.01) && volume.len() == 2);
        assert_eq!(empty.clone().agreed(frames(1000)).len(), 2);
        let against = |count: usize| (0..count).map(move |_| says(vec![], vec![cell]));
        let most = (agreeing as f32 * (1.0 / MAJORITY - 1.0)) as usize;
        assert!(holds(&empty.clone().agreed(frames(agreeing).chain(against(most))), p));
        assert!(!holds(&empty.clone().agreed(frames(agreeing).chain(against(most + 1))), p));
        for outside in [Vec3::splat(-0.1), Vec3::splat(9.0), Vec3::NAN, Vec3::INFINITY] {
            assert!(!holds(&volume, outside), "{outside}");
        }
        assert!(!holds(&Volume::default(), p), "nothing moves before that was looked for");
    }
}
