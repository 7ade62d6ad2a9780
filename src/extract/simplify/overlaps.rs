//! Where a patch lies over itself: above an overhang its rim crosses itself in the plane.

use glam::DVec2;

/// A side of a patch's triangle, projected to the patch's plane.
#[derive(Clone, Copy, Debug)]
pub(super) struct RimSide {
    /// Vertices of the mesh.
    pub(super) vertices: [u32; 2],
    pub(super) ends: [DVec2; 2],
}

impl RimSide {
    fn low(&self) -> DVec2 {
        self.ends[0].min(self.ends[1])
    }

    fn high(&self) -> DVec2 {
        self.ends[0].max(self.ends[1])
    }

    /// Whether two sides without a common vertex have a point in common.
    fn crosses(&self, other: &Self) -> bool {
        if self.vertices.iter().any(|v| other.vertices.contains(v)) {
            return false;
        }
        let [a, b] = self.ends;
        let [c, d] = other.ends;
        let apart = |p: DVec2, q: DVec2, r: DVec2, s: DVec2| {
            let (x, y) = ((q - p).perp_dot(r - p), (q - p).perp_dot(s - p));
            x > 0.0 && y > 0.0 || x < 0.0 && y < 0.0
        };
        !apart(a, b, c, d) && !apart(c, d, a, b)
    }
}

/// All pairs of sides that cross, by a sweep along the first axis.
pub(super) fn crossings(sides: &[RimSide]) -> Vec<[usize; 2]> {
    let mut order: Vec<usize> = (0..sides.len()).collect();
    order.sort_by(|&i, &j| sides[i].low().x.total_cmp(&sides[j].low().x).then(i.cmp(&j)));
    let mut found = Vec::new();
    for (n, &i) in order.iter().enumerate() {
        let (low, high) = (sides[i].low(), sides[i].high());
        for &j in order[n + 1..].iter().take_while(|&&j| sides[j].low().x <= high.x) {
            let beside = sides[j].low().y <= high.y && low.y <= sides[j].high().y;
            if beside && sides[i].crosses(&sides[j]) {
                found.push([i, j]);
            }
        }
    }
    found
}

/// The sides of loops that run counter-clockwise, as only the outermost one of a connected patch may; `next` is the side
/// after each side.
pub(super) fn inverted(sides: &[RimSide], next: &[usize]) -> Vec<usize> {
    let mut seen = vec![false; sides.len()];
    let mut loops: Vec<(f64, Vec<usize>)> = Vec::new();
    for first in 0..sides.len() {
        let (mut area, mut parts, mut at) = (0.0, Vec::new(), first);
        while !std::mem::replace(&mut seen[at], true) {
            // About a point of the loop, to lose no digits far from the frame's origin.
            let [a, b] = sides[at].ends.map(|p| p - sides[first].ends[0]);
            area += a.perp_dot(b);
            parts.push(at);
            at = next[at];
        }
        loops.push((area, parts));
    }
    let outermost = loops.iter().map(|l| l.0).fold(0.0, f64::max);
    loops.into_iter().filter(|l| l.0 > 0.0 && l.0 < outermost).flat_map(|l| l.1).collect()
}
