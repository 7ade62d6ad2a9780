//! A bounding-volume hierarchy over triangles: nearest surface point (for `eval`) and ray casting (for
//! `synth`).
//!
//! Binary tree built with the binned surface-area heuristic (Wald, "On fast construction of SAH-based
//! bounding volume hierarchies", 2007). Own code because the crates that offer both queries bring a physics
//! engine's linear algebra with them. The tree depends on the triangles alone, not on the number of threads
//! that build it.

use glam::{Vec3, Vec3A};

/// Triangles per leaf at most. Four fill about two cache lines; smaller leaves cost more nodes than they
/// save tests.
const LEAF_SIZE: usize = 4;
/// Bins per split; more gain nothing measurable.
const BINS: usize = 16;
/// Below this depth nodes are halved by count, so that no input can make the tree deeper than `STACK`.
const SAH_DEPTH: usize = 40;
/// `SAH_DEPTH` + log2 of the largest triangle count (2^32) + one slot for the sibling.
const STACK: usize = 80;
/// Subtrees smaller than this are built on the thread that reached them.
const PARALLEL_SIZE: usize = 16_384;

/// A node: a box, and either a range of triangles (`count > 0`) or two children.
#[derive(Clone, Copy, Debug)]
struct Node {
    min: Vec3A,
    max: Vec3A,
    /// First triangle of a leaf; the right child of an inner node (its left child follows it directly).
    first: u32,
    count: u32,
}

/// Where a ray first meets the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Ray parameter: the point is `origin + t * dir`.
    pub t: f32,
    /// Index into the triangles that the tree was built from.
    pub triangle: u32,
    /// Barycentric weights of the triangle's second and third corner.
    pub uv: [f32; 2],
}

/// The point of the surface that is nearest to a query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// Distance to it, in the units of the positions.
    pub distance: f32,
    /// Index into the triangles that the tree was built from.
    pub triangle: u32,
}

/// The hierarchy. Positions are copied in, in the order in which leaves hold them.
#[derive(Clone, Debug)]
pub struct TriangleBvh {
    nodes: Vec<Node>,
    corners: Vec<[Vec3; 3]>,
    ids: Vec<u32>,
}

/// A triangle while the tree is built.
#[derive(Clone, Copy)]
struct Item {
    min: Vec3A,
    max: Vec3A,
    id: u32,
}

impl Item {
    /// Twice the centre of the box: the factor cancels in every comparison.
    fn centre2(&self) -> Vec3A {
        self.min + self.max
    }
}

#[derive(Clone, Copy)]
struct Bounds {
    min: Vec3A,
    max: Vec3A,
}

impl Bounds {
    const EMPTY: Self = Self { min: Vec3A::INFINITY, max: Vec3A::NEG_INFINITY };

    fn grow(&mut self, min: Vec3A, max: Vec3A) {
        self.min = self.min.min(min);
        self.max = self.max.max(max);
    }

    fn half_area(&self) -> f32 {
        let d = (self.max - self.min).max(Vec3A::ZERO);
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

impl TriangleBvh {
    /// Builds the tree. `triangle` gives the corners of triangle `i` for `i < len`; corners must be finite.
    /// A triangle may be degenerate: three equal corners stand for a point.
    pub fn new(len: usize, triangle: impl Fn(usize) -> [Vec3; 3]) -> Self {
        let mut items: Vec<Item> = (0..len)
            .map(|i| {
                let [a, b, c] = triangle(i).map(Vec3A::from);
                Item { min: a.min(b).min(c), max: a.max(b).max(c), id: i as u32 }
            })
            .collect();
        let nodes = if len == 0 { Vec::new() } else { build(&mut items, 0, 0) };
        Self {
            nodes,
            corners: items.iter().map(|item| triangle(item.id as usize)).collect(),
            ids: items.iter().map(|item| item.id).collect(),
        }
    }

    /// The nearest point of the surface; `None` when there is no triangle.
    pub fn nearest(&self, query: Vec3) -> Option<Nearest> {
        let query = Vec3A::from(query);
        let mut best = (f32::INFINITY, u32::MAX);
        let mut stack = [(0.0f32, 0u32); STACK];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let (box_distance, index) = stack[depth];
            if box_distance >= best.0 {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for i in node.first..node.first + node.count {
                    let d = distance_squared(query, self.corners[i as usize].map(Vec3A::from));
                    if d < best.0 {
                        best = (d, self.ids[i as usize]);
                    }
                }
                continue;
            }
            let left = (self.box_distance(index + 1, query), index + 1);
            let right = (self.box_distance(node.first, query), node.first);
            let (near, far) = if left.0 <= right.0 { (left, right) } else { (right, left) };
            for child in [far, near] {
                if child.0 < best.0 {
                    stack[depth] = child;
                    depth += 1;
                }
            }
        }
        (best.1 != u32::MAX).then(|| Nearest { distance: best.0.sqrt(), triangle: best.1 })
    }

    /// Whether a point of the surface is at most `distance` from the query.
    pub fn within(&self, query: Vec3, distance: f32) -> bool {
        let (query, limit) = (Vec3A::from(query), distance * distance);
        let mut stack = [0u32; STACK];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let index = stack[depth];
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                let mut leaf = self.corners[node.first as usize..(node.first + node.count) as usize].iter();
                if leaf.any(|corners| distance_squared(query, corners.map(Vec3A::from)) <= limit) {
                    return true;
                }
                continue;
            }
            let left = (self.box_distance(index + 1, query), index + 1);
            let right = (self.box_distance(node.first, query), node.first);
            let (near, far) = if left.0 <= right.0 { (left, right) } else { (right, left) };
            for (box_distance, child) in [far, near] {
                if box_distance <= limit {
                    stack[depth] = child;
                    depth += 1;
                }
            }
        }
        false
    }

    /// The first triangle that a ray meets with `t_min < t < t_max`, from either side.
    pub fn first_hit(&self, origin: Vec3, dir: Vec3, t_min: f32, t_max: f32) -> Option<Hit> {
        self.cast::<false>(origin, dir, t_min, t_max)
    }

    /// Whether anything lies on the ray with `t_min < t < t_max`.
    pub fn occluded(&self, origin: Vec3, dir: Vec3, t_min: f32, t_max: f32) -> bool {
        self.cast::<true>(origin, dir, t_min, t_max).is_some()
    }

    fn cast<const ANY: bool>(&self, origin: Vec3, dir: Vec3, t_min: f32, t_max: f32) -> Option<Hit> {
        let (o, inverse) = (Vec3A::from(origin), Vec3A::from(dir.recip()));
        let mut best: Option<Hit> = None;
        let mut t_best = t_max;
        let mut stack = [(0.0f32, 0u32); STACK];
        let missed = self.nodes.is_empty() || self.box_entry(0, o, inverse) >= t_max;
        let mut depth = usize::from(!missed);
        while depth > 0 {
            depth -= 1;
            let (entry, index) = stack[depth];
            if entry >= t_best {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for i in node.first as usize..(node.first + node.count) as usize {
                    if let Some((t, uv)) = intersect(origin, dir, &self.corners[i])
                        && t > t_min
                        && t < t_best
                    {
                        t_best = t;
                        best = Some(Hit { t, triangle: self.ids[i], uv });
                        if ANY {
                            return best;
                        }
                    }
                }
                continue;
            }
            let left = (self.box_entry(index + 1, o, inverse), index + 1);
            let right = (self.box_entry(node.first, o, inverse), node.first);
            let (near, far) = if left.0 <= right.0 { (left, right) } else { (right, left) };
            for child in [far, near] {
                if child.0 < t_best {
                    stack[depth] = child;
                    depth += 1;
                }
            }
        }
        best
    }

    #[inline(always)]
    fn box_distance(&self, index: u32, query: Vec3A) -> f32 {
        let node = &self.nodes[index as usize];
        let outside = (node.min - query).max(query - node.max).max(Vec3A::ZERO);
        outside.length_squared()
    }

    /// Ray parameter where the box is entered, infinite when it is missed.
    #[inline(always)]
    fn box_entry(&self, index: u32, origin: Vec3A, inverse: Vec3A) -> f32 {
        let node = &self.nodes[index as usize];
        let a = (node.min - origin) * inverse;
        let b = (node.max - origin) * inverse;
        // 0 * inf = NaN where the ray lies in a face; `min`/`max` then keep the other operand, which is
        // what we want.
        let entry = a.min(b).max_element().max(0.0);
        // 1 + 4 eps: rounding of the slab test must not lose a flat box (Ize, "Robust BVH ray traversal",
        // 2013).
        let exit = a.max(b).min_element() * (1.0 + 4.0 * f32::EPSILON);
        if entry <= exit { entry } else { f32::INFINITY }
    }
}

/// Nodes of the subtree over `items` in depth-first order; indices are relative to the subtree, triangles
/// to `base`.
fn build(items: &mut [Item], base: u32, depth: usize) -> Vec<Node> {
    let mut bounds = Bounds::EMPTY;
    for item in items.iter() {
        bounds.grow(item.min, item.max);
    }
    let mut node = Node { min: bounds.min, max: bounds.max, first: base, count: items.len() as u32 };
    if items.len() <= LEAF_SIZE {
        return vec![node];
    }
    let middle = split(items, depth);
    let parallel = items.len() >= PARALLEL_SIZE;
    let (a, b) = items.split_at_mut(middle);
    let mut build_left = || build(a, base, depth + 1);
    let mut build_right = || build(b, base + middle as u32, depth + 1);
    let (left, right) =
        if parallel { rayon::join(build_left, build_right) } else { (build_left(), build_right()) };
    let right_at = 1 + left.len() as u32;
    node.first = right_at;
    node.count = 0;
    let mut nodes = Vec::with_capacity(1 + left.len() + right.len());
    nodes.push(node);
    let shifted = |by: u32| {
        move |mut n: Node| {
            n.first += if n.count == 0 { by } else { 0 };
            n
        }
    };
    nodes.extend(left.into_iter().map(shifted(1)));
    nodes.extend(right.into_iter().map(shifted(right_at)));
    nodes
}

/// Partitions `items` in place and returns the size of the left part, which is neither empty nor
/// everything.
fn split(items: &mut [Item], depth: usize) -> usize {
    let mut centres = Bounds::EMPTY;
    for item in items.iter() {
        centres.grow(item.centre2(), item.centre2());
    }
    let extent = centres.max - centres.min;
    let axis = if extent.x >= extent.y && extent.x >= extent.z {
        0
    } else if extent.y >= extent.z {
        1
    } else {
        2
    };
    let half = items.len() / 2;
    if extent[axis] <= 0.0 {
        return half;
    }
    if depth >= SAH_DEPTH {
        items.select_nth_unstable_by(half, |a, b| a.centre2()[axis].total_cmp(&b.centre2()[axis]));
        return half;
    }
    let scale = BINS as f32 / extent[axis];
    let bin = |item: &Item| (((item.centre2()[axis] - centres.min[axis]) * scale) as usize).min(BINS - 1);
    let boundary = best_boundary(items, bin);
    let mut left = 0;
    for i in 0..items.len() {
        if bin(&items[i]) < boundary {
            items.swap(i, left);
            left += 1;
        }
    }
    // The first and the last bin each hold an extreme centre, so this can only happen through rounding.
    if left == 0 || left == items.len() { half } else { left }
}

/// The bin boundary (1..BINS) with the smallest surface-area cost.
fn best_boundary(items: &[Item], bin: impl Fn(&Item) -> usize) -> usize {
    let mut bins = [(Bounds::EMPTY, 0usize); BINS];
    for item in items {
        let (bounds, count) = &mut bins[bin(item)];
        bounds.grow(item.min, item.max);
        *count += 1;
    }
    let mut right_cost = [0.0f32; BINS];
    let (mut bounds, mut count) = (Bounds::EMPTY, 0);
    for i in (1..BINS).rev() {
        bounds.grow(bins[i].0.min, bins[i].0.max);
        count += bins[i].1;
        right_cost[i] = if count == 0 { 0.0 } else { bounds.half_area() * count as f32 };
    }
    (bounds, count) = (Bounds::EMPTY, 0);
    let mut best = (f32::INFINITY, BINS / 2);
    for i in 1..BINS {
        bounds.grow(bins[i - 1].0.min, bins[i - 1].0.max);
        count += bins[i - 1].1;
        let left_cost = if count == 0 { 0.0 } else { bounds.half_area() * count as f32 };
        if left_cost + right_cost[i] < best.0 {
            best = (left_cost + right_cost[i], i);
        }
    }
    best.1
}

/// A triangle is a sliver if the squared sine between two of its sides is smaller: a hundred times the rounding of f32.
const SLIVER: f32 = 1e-5;

/// Squared distance from `p` to a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
fn distance_squared(p: Vec3A, [a, b, c]: [Vec3A; 3]) -> f32 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return ap.length_squared();
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return bp.length_squared();
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return (ap - ab * (d1 / (d1 - d3))).length_squared();
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return cp.length_squared();
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return (ap - ac * (d2 / (d2 - d6))).length_squared();
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return (bp - (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))).length_squared();
    }
    let double_area2 = va + vb + vc;
    let inside = (ap - ab * (vb / double_area2) - ac * (vc / double_area2)).length_squared();
    if double_area2 > SLIVER * ab.length_squared() * ac.length_squared() {
        return inside;
    }
    // Of a sliver the weights may be nothing but rounding; a point of an edge can then be nearer.
    let edge = |s: Vec3A, e: Vec3A| {
        let (along, to) = (e - s, p - s);
        let length2 = along.length_squared();
        let t = if length2 > 0.0 { (to.dot(along) / length2).clamp(0.0, 1.0) } else { 0.0 };
        (to - along * t).length_squared()
    };
    // `min` passes over a NaN.
    inside.min(edge(a, b)).min(edge(b, c)).min(edge(c, a))
}

/// Ray parameter and barycentric weights (Möller & Trumbore 1997), both sides of the triangle.
#[inline(always)]
fn intersect(origin: Vec3, dir: Vec3, [a, b, c]: &[Vec3; 3]) -> Option<(f32, [f32; 2])> {
    // A hair beyond the edges, so that no ray slips between two triangles that share one.
    const SLACK: f32 = 1e-6;
    let (ab, ac) = (*b - *a, *c - *a);
    let p = dir.cross(ac);
    let det = ab.dot(p);
    if det == 0.0 {
        return None;
    }
    let inverse = 1.0 / det;
    let s = origin - *a;
    let u = s.dot(p) * inverse;
    if !(-SLACK..=1.0 + SLACK).contains(&u) {
        return None;
    }
    let q = s.cross(ab);
    let v = dir.dot(q) * inverse;
    if v < -SLACK || u + v > 1.0 + SLACK {
        return None;
    }
    let t = ac.dot(q) * inverse;
    t.is_finite().then_some((t, [u, v]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A fixed stream of numbers in [0, 1).
    fn unit(state: &mut u64) -> f32 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 40) as f32 / (1u64 << 24) as f32
    }

    fn soup(n: usize, size: f32) -> Vec<[Vec3; 3]> {
        let mut s = 7;
        let mut point = || Vec3::new(unit(&mut s), unit(&mut s), unit(&mut s));
        (0..n)
            .map(|_| {
                let p = point();
                [p, p + (point() - 0.5) * size, p + (point() - 0.5) * size]
            })
            .collect()
    }

    /// Distance by minimising over the triangle in f64: projection when inside, else the three edges.
    fn reference_distance(p: Vec3, t: &[Vec3; 3]) -> f64 {
        let p = p.as_dvec3();
        let [a, b, c] = t.map(|v| v.as_dvec3());
        let n = (b - a).cross(c - a);
        let inside = [(a, b), (b, c), (c, a)].iter().all(|(s, e)| (*e - *s).cross(p - *s).dot(n) >= 0.0);
        if inside && n.length() > 0.0 {
            return ((p - a).dot(n) / n.length()).abs();
        }
        let edge = |s: glam::DVec3, e: glam::DVec3| {
            let l2 = (e - s).length_squared();
            let k = if l2 > 0.0 { ((p - s).dot(e - s) / l2).clamp(0.0, 1.0) } else { 0.0 };
            (p - s - (e - s) * k).length()
        };
        edge(a, b).min(edge(b, c)).min(edge(c, a))
    }

    #[test]
    fn nearest_equals_brute_force() {
        for size in [0.0, 0.05, 1.0] {
            let triangles = soup(500, size);
            let bvh = TriangleBvh::new(triangles.len(), |i| triangles[i]);
            let mut s = 3;
            for _ in 0..300 {
                let q = Vec3::new(unit(&mut s), unit(&mut s), unit(&mut s)) * 2.0 - 0.5;
                let truth = triangles.iter().map(|t| reference_distance(q, t)).fold(f64::INFINITY, f64::min);
                let ours = bvh.nearest(q).unwrap();
                assert!((f64::from(ours.distance) - truth).abs() < 1e-5, "{q} {ours:?} {truth}");
                let named = reference_distance(q, &triangles[ours.triangle as usize]);
                assert!((named - truth).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn first_hit_equals_brute_force() {
        let triangles = soup(400, 0.3);
        let bvh = TriangleBvh::new(triangles.len(), |i| triangles[i]);
        let (mut s, mut hits) = (11, 0);
        for i in 0..1500 {
            let o = Vec3::new(unit(&mut s), unit(&mut s), unit(&mut s)) * 2.0 - 0.5;
            let mut d = (Vec3::new(unit(&mut s), unit(&mut s), unit(&mut s)) - 0.5).normalize();
            if i % 7 == 0 {
                d = Vec3::X; // axis-parallel rays divide by zero in the slab test
            }
            let all = triangles.iter().filter_map(|t| intersect(o, d, t)).map(|h| h.0);
            let truth = all.filter(|t| *t > 1e-4 && *t < 5.0).fold(f32::INFINITY, f32::min);
            let ours = bvh.first_hit(o, d, 1e-4, 5.0);
            assert_eq!(ours.map_or(f32::INFINITY, |h| h.t), truth);
            assert_eq!(bvh.occluded(o, d, 1e-4, 5.0), truth.is_finite());
            hits += usize::from(truth.is_finite());
        }
        assert!(hits > 100, "the test must see hits: {hits}");
    }

    #[test]
    fn equal_triangles_and_empty_input_are_fine() {
        let one = [Vec3::ZERO, Vec3::X, Vec3::Y];
        let bvh = TriangleBvh::new(1000, |_| one);
        assert_eq!(bvh.nearest(Vec3::Z).unwrap().distance, 1.0);
        let none = TriangleBvh::new(0, |_| one);
        assert!(none.nearest(Vec3::Z).is_none() && none.first_hit(Vec3::Z, Vec3::X, 0.0, 9.0).is_none());
    }
}
