//! The 256 cases of marching cubes, derived instead of copied.
//!
//! Corner `c` of a cell sits at (c & 1, c >> 1 & 1, c >> 2). A case is the set of corners that are inside. On
//! each face the surface runs between the two cuts of every run of inside corners; two diagonal inside
//! corners are separate runs. That depends on nothing but the face, so both cells at a face agree and the
//! surface has no cracks. The cuts of a cell chain up into loops, and each loop is triangulated **without a
//! diagonal that lies in a face**: the cell at the other side might choose the same diagonal, and four
//! triangles would meet there. With that rule an edge of the mesh has two triangles at most, and the
//! triangles round a vertex form one fan.

use std::sync::LazyLock;

/// One triangle: three cell edges, counter-clockwise seen from outside.
type Triangle = [u8; 3];

/// The axis of each cell edge and the offset of its lower end. Edges are numbered 4·axis + 2·(later other
/// axis) + (earlier other axis).
pub(crate) const EDGES: [(usize, [usize; 3]); 12] = [
    (0, [0, 0, 0]),
    (0, [0, 1, 0]),
    (0, [0, 0, 1]),
    (0, [0, 1, 1]),
    (1, [0, 0, 0]),
    (1, [1, 0, 0]),
    (1, [0, 0, 1]),
    (1, [1, 0, 1]),
    (2, [0, 0, 0]),
    (2, [1, 0, 0]),
    (2, [0, 1, 0]),
    (2, [1, 1, 0]),
];

/// The faces' corners, counter-clockwise seen from outside the cell: x = 0, x = 1, y = 0, y = 1, z = 0, z =
/// 1.
const FACES: [[u8; 4]; 6] =
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// Triangles of each case.
pub(crate) struct McTable {
    start: [u16; 257],
    triangles: Vec<Triangle>,
}

impl McTable {
    /// Triangles of `case` (bit c set = corner c inside).
    #[inline]
    pub(crate) fn triangles(&self, case: u8) -> &[Triangle] {
        let case = usize::from(case);
        &self.triangles[usize::from(self.start[case])..usize::from(self.start[case + 1])]
    }
}

/// The table, built on first use (microseconds).
pub(crate) static TABLE: LazyLock<McTable> = LazyLock::new(|| {
    let mut table = McTable { start: [0; 257], triangles: Vec::new() };
    for case in 0..=255u8 {
        for cycle in loops(case) {
            // A test holds that every loop of every case has such a triangulation.
            table.triangles.extend(triangulate(&cycle, false).unwrap_or_default());
        }
        table.start[usize::from(case) + 1] = table.triangles.len() as u16;
    }
    table
});

fn edge_between(a: u8, b: u8) -> u8 {
    let (axis, low) = ((a ^ b).trailing_zeros() as usize, a.min(b));
    let corner = [low & 1, low >> 1 & 1, low >> 2].map(usize::from);
    EDGES.iter().position(|&e| e == (axis, corner)).map_or(0, |e| e as u8)
}

/// The closed loops of cut edges in a cell, each with the outside on its counter-clockwise side.
fn loops(case: u8) -> Vec<Vec<u8>> {
    let mut next = [None::<u8>; 12];
    for face in FACES {
        let inside = |i: usize| case >> face[i % 4] & 1 == 1;
        for first in (0..4).filter(|&i| inside(i) && !inside(i + 3)) {
            let length = (1..4).find(|&n| !inside(first + n)).unwrap_or(4);
            let enters = edge_between(face[(first + 3) % 4], face[first]);
            let leaves = edge_between(face[(first + length - 1) % 4], face[(first + length) % 4]);
            next[usize::from(enters)] = Some(leaves);
        }
    }
    let mut found = Vec::new();
    for start in 0..12u8 {
        let mut cycle = Vec::new();
        let mut at = start;
        while let Some(to) = next[usize::from(at)].take() {
            cycle.push(at);
            at = to;
        }
        if !cycle.is_empty() {
            found.push(cycle);
        }
    }
    found
}

/// Whether two cell edges border a common face.
fn share_face(a: u8, b: u8) -> bool {
    let on_face = |e: u8, axis: usize, at: usize| {
        let (along, corner) = EDGES[usize::from(e)];
        along != axis && corner[axis] == at
    };
    (0..3).any(|axis| (0..2).any(|at| on_face(a, axis, at) && on_face(b, axis, at)))
}

/// Triangles of the polygon without diagonals in a face; `None` if there is no such triangulation.
/// `closing_is_new` says that the side from the last to the first vertex is itself a diagonal.
fn triangulate(polygon: &[u8], closing_is_new: bool) -> Option<Vec<Triangle>> {
    let (&first, &last) = (polygon.first()?, polygon.last()?);
    if closing_is_new && share_face(first, last) {
        return None;
    }
    if polygon.len() == 2 {
        return Some(Vec::new());
    }
    (1..polygon.len() - 1).find_map(|apex| {
        let mut triangles = triangulate(&polygon[..=apex], apex > 1)?;
        triangles.extend(triangulate(&polygon[apex..], apex + 2 < polygon.len())?);
        triangles.push([first, polygon[apex], last]);
        Some(triangles)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directed_edges(case: u8) -> Vec<(u8, u8)> {
        TABLE.triangles(case).iter().flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])]).collect()
    }

    /// Directed mesh edges of a case that are not matched by their reverse within the cell.
    fn boundary(case: u8) -> Vec<(u8, u8)> {
        let all = directed_edges(case);
        all.iter().filter(|&&(a, b)| !all.contains(&(b, a))).copied().collect()
    }

    #[test]
    fn every_loop_has_a_triangulation_without_face_diagonals() {
        for case in 0..=255u8 {
            for cycle in loops(case) {
                assert!(cycle.len() >= 3, "case {case}: {cycle:?}");
                assert!(triangulate(&cycle, false).is_some(), "case {case}: {cycle:?}");
            }
        }
    }

    #[test]
    fn exactly_the_cut_edges_are_used_and_no_directed_edge_twice() {
        for case in 0..=255u8 {
            for (e, &(axis, corner)) in EDGES.iter().enumerate() {
                let low = corner[0] | corner[1] << 1 | corner[2] << 2;
                let cut = (case >> low & 1) != (case >> (low | 1 << axis) & 1);
                assert_eq!(cut, TABLE.triangles(case).iter().flatten().any(|&u| usize::from(u) == e));
            }
            let mut edges = directed_edges(case);
            let count = edges.len();
            edges.sort_unstable();
            edges.dedup();
            assert_eq!(edges.len(), count, "case {case}");
        }
    }

    /// All pairs of cells that agree on their common face: 3 axes × 16 faces × 16 × 16 cells.
    #[test]
    fn neighbours_match_edge_by_edge_and_never_share_a_diagonal() {
        for axis in 0..3usize {
            let shift = |e: u8| {
                let (along, mut corner) = EDGES[usize::from(e)];
                corner[axis] ^= 1;
                EDGES.iter().position(|&x| x == (along, corner)).unwrap() as u8
            };
            let on =
                |e: u8, at: usize| EDGES[usize::from(e)].0 != axis && EDGES[usize::from(e)].1[axis] == at;
            for a in 0..=255u8 {
                for b in 0..=255u8 {
                    let agrees = (0..8u8)
                        .filter(|c| c >> axis & 1 == 1)
                        .all(|c| (a >> c & 1) == (b >> (c & !(1 << axis)) & 1));
                    if !agrees {
                        continue;
                    }
                    let low: Vec<_> =
                        directed_edges(a).into_iter().filter(|&(p, q)| on(p, 1) && on(q, 1)).collect();
                    let mut high: Vec<_> = directed_edges(b)
                        .into_iter()
                        .filter(|&(p, q)| on(p, 0) && on(q, 0))
                        .map(|(p, q)| (shift(q), shift(p)))
                        .collect();
                    let mut low_sorted = low.clone();
                    low_sorted.sort_unstable();
                    high.sort_unstable();
                    assert_eq!(low_sorted, high, "axis {axis} cases {a} {b}");
                }
            }
        }
        // Every unmatched edge lies in a face, so a closed arrangement of cells has none.
        assert!((0..=255).all(|case| boundary(case).iter().all(|&(p, q)| share_face(p, q))));
    }

    #[test]
    fn triangles_face_away_from_the_inside_corner() {
        let middle = |e: u8| {
            let (axis, corner) = EDGES[usize::from(e)];
            let mut p = glam::Vec3::from_array(corner.map(|c| c as f32));
            p[axis] += 0.5;
            p
        };
        for corner in 0..8u8 {
            let at =
                glam::Vec3::new(f32::from(corner & 1), f32::from(corner >> 1 & 1), f32::from(corner >> 2));
            let [a, b, c] = TABLE.triangles(1 << corner)[0].map(middle);
            assert!((b - a).cross(c - a).dot(a - at) > 0.0, "corner {corner}");
        }
    }
}
