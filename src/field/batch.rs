//! The samples of a chunk at which one stream is evaluated, and their encoding, level by level.

use bytemuck::{cast_slice, cast_slice_mut};
use glam::Vec3;

use super::encoding::{Encoding, Level};
use super::hashgrid::{AXES, Around, FEATURES, Points, Row, Slopes, TIME};
use crate::simd::lanes::{self, Layout};
use crate::simd::{TILE, fours_of_rows, prefetch, rows_of_fours};

/// Bytes from a tile's rows of a level to the next tile's, which are needed after those of all other levels: the processor does not
/// foresee it.
const NEXT_TILE: usize = TILE * size_of::<Row>();

/// What one level says about a batch's samples; after the way back, the gradient with respect to it.
#[derive(Default)]
pub struct LevelRows {
    /// A row a lane, whole tiles; behind them is what an earlier, larger batch has left.
    pub rows: Vec<Row>,
    /// Derivatives by x, y and z of the lanes, likewise, where the batch asks for them.
    pub(super) slopes: Vec<Slopes>,
}

impl LevelRows {
    /// Writes the features of tile `tile` to `out`, a row of lanes a feature, as networks read them.
    #[inline(always)]
    pub fn read_tile(&self, tile: usize, out: &mut [f32]) {
        let (rows, out) = (&self.rows[tile * TILE..][..TILE], out.as_chunks_mut());
        prefetch_tile(rows);
        if let (Some(samples), Some(out)) = (cast_slice(rows).first_chunk(), out.0.first_chunk_mut()) {
            rows_of_fours(samples, out);
        }
    }

    /// Replaces the features of tile `tile` by the gradient `g` with respect to them, in the order of
    /// [`Self::read_tile`].
    #[inline(always)]
    pub fn write_tile(&mut self, tile: usize, g: &[f32]) {
        let rows = &mut self.rows[tile * TILE..][..TILE];
        prefetch_tile(rows);
        if let (Some(g), Some(out)) = (g.as_chunks().0.first_chunk(), cast_slice_mut(rows).first_chunk_mut())
        {
            fours_of_rows(g, out);
        }
    }
}

/// Asks for what stands a tile behind these rows of a tile.
#[inline(always)]
fn prefetch_tile(rows: &[Row]) {
    for rows in rows.as_chunks::<FEATURES>().0 {
        prefetch(rows, NEXT_TILE);
    }
}

/// The samples of a chunk at which one stream is evaluated, and their encoding.
#[derive(Default)]
pub struct StreamBatch {
    /// Which sample of the chunk each lane is.
    pub sample: Vec<u32>,
    /// Which ray each lane belongs to; lanes of a ray follow one another and share its code and view.
    pub(super) ray: Vec<u32>,
    /// Positions, tile by tile.
    pub(super) pos: Vec<Points>,
    /// The encoding, level by level.
    pub levels: Vec<LevelRows>,
    /// Whether the gradient with respect to the positions will be asked for.
    pub slopes: bool,
    /// Lanes that [`Self::retain`] leaves.
    pub(super) kept: Vec<u32>,
    put_off: PutOff,
}

/// Samples whose gradients are still in the rows of a batch's levels.
#[derive(Default)]
struct PutOff {
    pos: Vec<Points>,
    lanes: usize,
}

/// Moves what stands at the places `kept`, in increasing order, of `values` to their front.
#[inline(always)]
fn compact<T: Copy>(values: &mut [T], kept: &[u32]) {
    for (to, from) in kept.iter().enumerate() {
        values[to] = values[*from as usize];
    }
}

impl StreamBatch {
    /// Forgets all samples but for where they were, so that what the way back has left in the levels can be added to the tables
    /// right before new samples are encoded: see [`LevelTask`].
    pub fn put_off(&mut self) {
        std::mem::swap(&mut self.put_off.pos, &mut self.pos);
        self.put_off.lanes = self.len();
        self.clear();
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.sample.clear();
        self.ray.clear();
        self.pos.clear();
    }

    /// Adds sample number `sample` of the chunk, of ray number `ray`, at `p` and `time` (0–1 over the video).
    #[inline(always)]
    pub fn push(&mut self, sample: usize, ray: usize, p: Vec3, time: f32) {
        let lane = self.sample.len() % TILE;
        if lane == 0 {
            self.pos.push([[0.5; TILE]; AXES]);
        }
        let tile = self.pos.len() - 1;
        for axis in 0..3 {
            self.pos[tile][axis][lane] = p[axis];
        }
        self.pos[tile][TIME][lane] = time;
        self.sample.push(sample as u32);
        self.ray.push(ray as u32);
    }

    /// Leaves the samples of whose number in the chunk `keep` is true, encoded as they are if they are `encoded`.
    #[inline(always)]
    pub(super) fn retain(&mut self, keep: impl Fn(usize) -> bool, encoded: bool) {
        let Self { sample, ray, pos, levels, slopes, kept, .. } = self;
        kept.resize(sample.len(), 0);
        let mut count = 0;
        for (lane, sample) in sample.iter().enumerate() {
            // Whether one is kept is nothing that a processor could foresee.
            kept[count] = lane as u32;
            count += usize::from(keep(*sample as usize));
        }
        kept.truncate(count);
        let tiles = kept.len().div_ceil(TILE);
        for numbers in [sample, ray] {
            compact(numbers, kept);
            numbers.truncate(kept.len());
        }
        let layout = Layout { rows: AXES, stride: AXES * TILE };
        lanes::keep(pos.as_flattened_mut().as_flattened_mut(), layout, kept);
        pos.truncate(tiles);
        for level in levels {
            if encoded {
                compact(&mut level.rows, kept);
                level.rows[kept.len()..tiles * TILE].fill(Row::ZERO);
            }
            if *slopes {
                compact(&mut level.slopes, kept);
            }
        }
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.sample.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.sample.is_empty()
    }

    /// Positions tile by tile.
    pub fn tiles(&self) -> &[Points] {
        &self.pos
    }

    /// Rays of the lanes of tile `n`.
    pub(super) fn rays(&self, n: usize) -> &[u32] {
        &self.ray[n * TILE..self.len().min((n + 1) * TILE)]
    }

    /// Number in the chunk and position of every sample.
    #[inline(always)]
    pub fn points(&self) -> impl Iterator<Item = (usize, Vec3)> + '_ {
        let at = |n: usize| Vec3::from_array([0, 1, 2].map(|axis| self.pos[n / TILE][axis][n % TILE]));
        self.sample.iter().enumerate().map(move |(n, s)| (*s as usize, at(n)))
    }

    /// Positions tile by tile, and what level number `level` says about them, or the gradient with respect to that.
    #[cfg(test)]
    pub fn encoded(&self, level: usize) -> impl Iterator<Item = (&Points, &[Row])> {
        self.pos.iter().zip(self.levels[level].rows[..self.len()].chunks(TILE))
    }

    /// Encodes all samples.
    #[inline(always)]
    pub fn encode(&mut self, encoding: &Encoding, tables: &[Vec<Row>]) {
        let mut around = Around::default();
        for (task, table) in self.tasks(encoding).into_iter().zip(tables) {
            task.encode(table, &mut around);
        }
    }

    /// What is to be done on each level.
    pub fn tasks<'a>(&'a mut self, encoding: &'a Encoding) -> Vec<LevelTask<'a>> {
        let Self { sample, pos, levels, slopes, put_off, .. } = self;
        levels.resize_with(encoding.levels.len(), LevelRows::default);
        let parts = encoding.levels.iter().zip(levels);
        parts
            .map(|(level, out)| {
                let batch = LevelBatch { put_off, pos, lanes: sample.len(), slopes: *slopes, out };
                LevelTask { level, batches: vec![batch] }
            })
            .collect()
    }
}

/// What batches have to do on one level: to scatter what was put off, then to encode their samples.
///
/// Whoever has many batches does one level of all of them before the next: a level's table fits a core's L2, all of
/// them together do not.
pub struct LevelTask<'a> {
    level: &'a Level,
    batches: Vec<LevelBatch<'a>>,
}

/// Where one level is to say something about the samples of one batch, in the place of the gradients of those that were put off.
struct LevelBatch<'a> {
    put_off: &'a PutOff,
    pos: &'a [Points],
    lanes: usize,
    slopes: bool,
    out: &'a mut LevelRows,
}

impl LevelTask<'_> {
    /// Takes the batches of `other`, which is of the same level.
    pub fn append(&mut self, mut other: Self) {
        self.batches.append(&mut other.batches);
    }

    /// Rows that it looks up and adds to, or points where there are none.
    pub fn cost(&self) -> usize {
        let lanes: usize = self.batches.iter().map(|batch| batch.put_off.lanes + batch.lanes).sum();
        lanes * self.level.corners().max(1)
    }

    /// Adds the gradients of the samples that were put off to those of the table's rows.
    #[inline(always)]
    pub fn scatter(&self, gradient: &mut [Row], around: &mut Around) {
        self.level.scatter(gradient, self.batches.iter().flat_map(LevelBatch::put_off), around);
    }

    /// Looks up the samples in the table, and interpolates.
    #[inline(always)]
    pub fn encode(self, table: &[Row], around: &mut Around) {
        let Self { level, mut batches } = self;
        batches.iter_mut().for_each(LevelBatch::make_room);
        let (steep, flat): (Vec<_>, Vec<_>) = batches.into_iter().partition(|batch| batch.slopes);
        level.encode(table, flat.into_iter().flat_map(LevelBatch::tiles), around);
        level.encode_with_slopes(table, steep.into_iter().flat_map(LevelBatch::tiles_with_slopes), around);
    }
}

impl<'a> LevelBatch<'a> {
    /// Makes room for whole tiles, of which those lanes that are nobody's are zeros.
    fn make_room(&mut self) {
        let wanted = self.pos.len() * TILE;
        // What an earlier, larger batch has left behind is of no one's concern.
        if self.out.rows.len() < wanted {
            self.out.rows.resize(wanted, Row::ZERO);
        }
        self.out.rows[self.lanes..wanted].fill(Row::ZERO);
        if self.slopes && self.out.slopes.len() < wanted {
            self.out.slopes.resize(wanted, [Row::ZERO; 3]);
        }
    }

    fn put_off(&self) -> impl Iterator<Item = (&Points, &[Row])> {
        let PutOff { pos, lanes } = self.put_off;
        pos.iter().zip(self.out.rows[..*lanes].chunks(TILE))
    }

    fn tiles(self) -> impl Iterator<Item = (&'a Points, &'a mut [Row])> {
        self.pos.iter().zip(self.out.rows[..self.lanes].chunks_mut(TILE))
    }

    fn tiles_with_slopes(self) -> impl Iterator<Item = (&'a Points, (&'a mut [Row], &'a mut [Slopes]))> {
        let LevelRows { rows, slopes } = self.out;
        self.pos.iter().zip(rows[..self.lanes].chunks_mut(TILE).zip(slopes.chunks_mut(TILE)))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::field::{EncodingKind, Field, Stream};
    use crate::rng::Rng;
    use crate::train::testing;

    /// Samples with the given numbers, five to a ray, encoded by a field of random tables.
    pub(in crate::field) fn encoded(numbers: impl Iterator<Item = usize>, slopes: bool) -> StreamBatch {
        let mut field = Field::zeros(testing::shape(&testing::config_of(EncodingKind::Hash)));
        let mut rng = Rng::new(1, 0, 0);
        for row in field.tables.iter_mut().flatten().flatten() {
            *row = Row::new(rng.uniform(), rng.uniform(), rng.uniform(), rng.uniform());
        }
        let mut batch = StreamBatch { slopes, ..StreamBatch::default() };
        for n in numbers {
            let mut rng = Rng::new(2, n as u64, 0);
            let p = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
            batch.push(n, n / 5, p, rng.uniform());
        }
        let net = field.net(Stream::Dynamic).expect("all streams are on");
        batch.encode(&net.encoding, &field.tables[Stream::Dynamic as usize]);
        batch
    }

    #[test]
    fn what_is_retained_is_as_if_there_had_been_nothing_else() {
        // None, within a tile, several tiles, all.
        for every in [1000, 90, 3, 1] {
            for slopes in [false, true] {
                let keep = |n: usize| n % every == every - 1;
                let mut batch = encoded(0..200, slopes);
                batch.retain(keep, true);
                let alone = encoded((0..200).filter(|n| keep(*n)), slopes);
                assert_eq!((&batch.sample, &batch.ray), (&alone.sample, &alone.ray));
                assert_eq!(batch.pos.len(), alone.pos.len());
                assert!(batch.points().eq(alone.points()));
                for (a, b) in batch.levels.iter().zip(&alone.levels) {
                    let rows = batch.pos.len() * TILE;
                    assert_eq!(a.rows[..rows], b.rows[..rows]);
                    let lanes = if slopes { batch.len() } else { 0 };
                    assert_eq!(a.slopes[..lanes], b.slopes[..lanes]);
                }
            }
        }
    }
}
