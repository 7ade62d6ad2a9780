//! Which triangles meet at which side.

use rayon::prelude::*;

use crate::extract::TriMesh;

/// Beyond the side there is nothing.
pub(super) const BORDER: u32 = u32::MAX;
/// The side belongs to more than two triangles, to two that disagree about the outside, or to one without area.
pub(super) const SINGULAR: u32 = u32::MAX - 1;

pub(super) struct Topology {
    /// `[triangles][side]`: the triangle beyond the side from corner `k` to corner `k + 1`, [`BORDER`] or [`SINGULAR`].
    pub(super) across: Vec<[u32; 3]>,
    /// Triangles without area, which stay as they are.
    pub(super) frozen: Vec<bool>,
}

/// Both ends of side `k`, in the triangle's direction.
pub(super) fn side(t: &[u32; 3], k: usize) -> [u32; 2] {
    [t[k], t[(k + 1) % 3]]
}

/// A triangle's side: smaller vertex, larger vertex, number (3 · triangle + side).
type Side = (u32, u32, u32);

/// All sides of the triangles, those of one edge after each other.
pub(super) fn sorted_sides(triangles: &[[u32; 3]]) -> Vec<Side> {
    let sides = |(n, t): (usize, &[u32; 3])| {
        let t = *t;
        (0..3).map(move |k| {
            let [a, b] = side(&t, k);
            (a.min(b), a.max(b), (3 * n + k) as u32)
        })
    };
    let mut all: Vec<Side> = triangles.par_iter().enumerate().flat_map_iter(sides).collect();
    all.par_sort_unstable();
    all
}

impl Topology {
    pub(super) fn new(mesh: &TriMesh) -> Self {
        let triangles = &mesh.triangles;
        let flat = |t: usize| {
            let [a, b, c] = mesh.triangles[t];
            let area = mesh.area_normal(t).length_squared();
            a == b || b == c || c == a || !(area > 0.0 && area.is_finite())
        };
        let frozen: Vec<bool> = (0..triangles.len()).into_par_iter().map(flat).collect();
        let mut across = vec![[SINGULAR; 3]; triangles.len()];
        for edge in sorted_sides(triangles).chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
            let from = |s: &Side| triangles[s.2 as usize / 3][s.2 as usize % 3];
            let thaw = |s: &Side| !frozen[s.2 as usize / 3];
            match edge {
                [x] if thaw(x) => across[x.2 as usize / 3][x.2 as usize % 3] = BORDER,
                [x, y] if thaw(x) && thaw(y) && from(x) != from(y) => {
                    across[x.2 as usize / 3][x.2 as usize % 3] = y.2 / 3;
                    across[y.2 as usize / 3][y.2 as usize % 3] = x.2 / 3;
                }
                _ => {}
            }
        }
        Self { across, frozen }
    }

    /// The triangles beyond the sides of `t`.
    pub(super) fn neighbours(&self, t: u32) -> impl Iterator<Item = u32> {
        self.across[t as usize].into_iter().filter(|&n| n < SINGULAR)
    }
}
