//! Which blocks of a box exist, and which block owns a point or an edge that several blocks share.
//!
//! A block is 8³ cells and stores the values of its 9³ corners, so that it can be marched alone. A corner on
//! a block's border is stored by every block that touches it but *owned* by exactly one: it is computed there
//! and copied to the others. Edges are owned in the same way, so each mesh vertex is made once. The owner is
//! the existing block that comes last in (z, y, x) order among those that touch the point: the same answer
//! whoever asks.

/// Cells along the side of a block.
pub(crate) const CELLS: usize = 8;
/// Corners along the side of a block.
pub(crate) const CORNERS: usize = CELLS + 1;
/// Corners of a block.
pub(crate) const POINTS: usize = CORNERS * CORNERS * CORNERS;
/// "No such block" in the slot table.
const NONE: u32 = u32::MAX;

/// Index of a corner within its block, x fastest.
#[inline]
pub(crate) fn point_index(p: [usize; 3]) -> usize {
    (p[2] * CORNERS + p[1]) * CORNERS + p[0]
}

/// 0 on the low side of a block, 2 on the high side, 1 between.
#[inline]
fn side(v: usize) -> usize {
    usize::from(v != 0) + usize::from(v == CELLS)
}

#[inline]
fn class([x, y, z]: [usize; 3]) -> usize {
    (z * 3 + y) * 3 + x
}

/// A sparse set of blocks in a box, in raster order.
#[derive(Clone, Debug)]
pub(crate) struct BlockSet {
    dims: [u32; 3],
    coords: Vec<[u32; 3]>,
    slots: Vec<u32>,
    /// For each block and each of the 27 places on it (corners, edges, faces, inside): the owning block.
    owners: Vec<[u32; 27]>,
}

impl BlockSet {
    /// `coords` may be in any order and repeat; all must lie within `dims` (blocks).
    pub(crate) fn new(dims: [u32; 3], mut coords: Vec<[u32; 3]>) -> Self {
        coords.sort_unstable_by_key(|c| [c[2], c[1], c[0]]);
        coords.dedup();
        let mut set = Self { dims, slots: vec![NONE; Self::slot_count(dims)], coords, owners: Vec::new() };
        for (i, c) in set.coords.iter().enumerate() {
            let slot = (c[2] as usize * dims[1] as usize + c[1] as usize) * dims[0] as usize + c[0] as usize;
            set.slots[slot] = i as u32;
        }
        set.owners = (0..set.len()).map(|b| std::array::from_fn(|c| set.find_owner(b, c))).collect();
        set
    }

    /// Blocks that a box of `dims` blocks could hold.
    pub(crate) fn slot_count(dims: [u32; 3]) -> usize {
        dims.iter().map(|&d| d as usize).product()
    }

    pub(crate) fn len(&self) -> usize {
        self.coords.len()
    }

    /// Block coordinates (blocks from the origin), raster order.
    pub(crate) fn coords(&self) -> &[[u32; 3]] {
        &self.coords
    }

    /// The block at these block coordinates, if it exists.
    pub(crate) fn find(&self, c: [i64; 3]) -> Option<usize> {
        if (0..3).any(|a| c[a] < 0 || c[a] >= i64::from(self.dims[a])) {
            return None;
        }
        let slot =
            (c[2] as usize * self.dims[1] as usize + c[1] as usize) * self.dims[0] as usize + c[0] as usize;
        Some(self.slots[slot]).filter(|&s| s != NONE).map(|s| s as usize)
    }

    fn find_owner(&self, b: usize, class: usize) -> u32 {
        const OFFSETS: [&[i64]; 3] = [&[0, -1], &[0], &[1, 0]];
        let at = self.coords[b].map(i64::from);
        for dz in OFFSETS[class / 9] {
            for dy in OFFSETS[class / 3 % 3] {
                for dx in OFFSETS[class % 3] {
                    if let Some(owner) = self.find([at[0] + dx, at[1] + dy, at[2] + dz]) {
                        return owner as u32;
                    }
                }
            }
        }
        b as u32 // not reached: the block itself is always among the candidates
    }

    /// The owner of the place `p` of block `b`, and `p` in the owner's own corner coordinates. `along` is the
    /// axis of an edge that starts at `p`; a point has none.
    #[inline]
    pub(crate) fn owner(&self, b: usize, p: [usize; 3], along: Option<usize>) -> (usize, [usize; 3]) {
        let mut sides = p.map(side);
        if let Some(axis) = along {
            sides[axis] = 1;
        }
        let owner = self.owners[b][class(sides)] as usize;
        if owner == b {
            return (b, p);
        }
        let (from, to) = (self.coords[b], self.coords[owner]);
        (owner, std::array::from_fn(|a| p[a] + CELLS * from[a] as usize - CELLS * to[a] as usize))
    }

    /// Bits `x` of the corners in row (y, z) that block `b` owns.
    pub(crate) fn owned_points(&self, b: usize, y: usize, z: usize) -> u16 {
        self.owned_row(b, side(y), side(z))
    }

    /// Bits `x` of the edges along `axis` that start in row (y, z) and that block `b` owns.
    pub(crate) fn owned_edges(&self, b: usize, axis: usize, y: usize, z: usize) -> u16 {
        match axis {
            0 if self.owners[b][class([1, side(y), side(z)])] as usize == b => 0xff,
            1 if y < CELLS => self.owned_row(b, 1, side(z)),
            2 if z < CELLS => self.owned_row(b, side(y), 1),
            _ => 0,
        }
    }

    fn owned_row(&self, b: usize, y_side: usize, z_side: usize) -> u16 {
        const BITS: [u16; 3] = [1, 0xfe, 0x100];
        let owned = |x: usize| self.owners[b][class([x, y_side, z_side])] as usize == b;
        (0..3).filter(|&x| owned(x)).map(|x| BITS[x]).sum()
    }

    /// Copies every corner from its owner to the other blocks that store it. `values` is `[blocks * POINTS]`.
    pub(crate) fn share_borders<T: Copy>(&self, values: &mut [T]) {
        let border: Vec<[usize; 3]> = (0..POINTS)
            .map(|i| [i % CORNERS, i / CORNERS % CORNERS, i / (CORNERS * CORNERS)])
            .filter(|p| p.contains(&CELLS))
            .collect();
        for b in 0..self.len() {
            for &p in &border {
                let (owner, q) = self.owner(b, p, None);
                if owner != b {
                    values[b * POINTS + point_index(p)] = values[owner * POINTS + point_index(q)];
                }
            }
        }
    }

    /// Memory held, bytes.
    pub(crate) fn bytes(&self) -> usize {
        self.slots.len() * 4 + self.coords.len() * (12 + 27 * 4)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    #[test]
    fn every_shared_corner_has_exactly_one_owner() {
        // A sparse pattern with face, edge and corner contacts.
        let all = (0..64u32).map(|i| [i % 4, i / 4 % 4, i / 16]);
        let coords: Vec<_> =
            all.filter(|c| (c[0] * 7 + c[1] * 5 + c[2] * 3 + c[0] * c[1]) % 3 != 0).collect();
        let set = BlockSet::new([4, 4, 4], coords);
        let mut owners: HashMap<[usize; 3], Vec<usize>> = HashMap::new();
        for b in 0..set.len() {
            for i in 0..POINTS {
                let p = [i % CORNERS, i / CORNERS % CORNERS, i / 81];
                let world = |b: usize, p: [usize; 3]| -> [usize; 3] {
                    std::array::from_fn(|a| set.coords()[b][a] as usize * CELLS + p[a])
                };
                let (owner, q) = set.owner(b, p, None);
                assert_eq!(world(b, p), world(owner, q), "owner looks at the same point");
                let claims = set.owned_points(b, p[1], p[2]) >> p[0] & 1 == 1;
                assert_eq!(claims, owner == b);
                owners.entry(world(b, p)).or_default().push(owner);
            }
        }
        assert!(owners.values().all(|o| o.iter().all(|x| x == &o[0])));
        assert!(owners.values().any(|o| o.len() > 3), "the pattern shares corners");
    }
}
