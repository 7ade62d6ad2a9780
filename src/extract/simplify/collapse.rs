//! Vertices that are not needed are merged into neighbours (half-edge collapse), cheapest first (quadric error: Garland &
//! Heckbert, "Surface simplification using quadric error metrics", 1997), as long as everything of the original that lies
//! over the changed triangles stays close to them, and they to it (after Klein et al., "Mesh reduction with error
//! control", 1996).

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::Vec3A;

use super::cover::Cover;
use super::quadric::Quadric;
use super::scene::{Scene, foot};

/// Least cosine between the normal of a new triangle and the mean normal of those that it replaces.
const FACING: f32 = 0.2;
/// A triangle whose height is less than this share of its longest side is a sliver.
const SLIVER: f32 = 1e-4;
/// How much, in squares of the tolerance, it costs to move a vertex along a flat surface by its own distance: little, only
/// to prefer short edges.
const STRIDE: f64 = 1e-3;

/// A new edge of the border is looked at in steps of this share of the tolerance,
const BORDER_STEP: f32 = 0.25;
/// but not in more than this many.
const MOST_BORDER_STEPS: usize = 256;

struct Vertex {
    /// Number in the original.
    id: u32,
    place: Vec3A,
    faces: Vec<u32>,
    quadric: Quadric,
    /// Must stay: what is around it is not all known here.
    fixed: bool,
    /// Counts the changes around it.
    version: u32,
}

/// A triangle; without corners once it is gone.
struct Face {
    corners: [u32; 3],
    over: Vec<u32>,
    gone: bool,
}

/// What is around a vertex: `faces[i]` lies between it, `ring[i]` and `ring[i + 1]`.
struct Star {
    faces: Vec<u32>,
    ring: Vec<u32>,
    closed: bool,
}

impl Star {
    /// Vertices of the ring that are not beside the one at place `i`: merging into that one makes new edges to them.
    fn across(&self, i: usize) -> impl Iterator<Item = u32> {
        let n = self.ring.len();
        let beside = move |j: usize| j.abs_diff(i) <= 1 || self.closed && j.abs_diff(i) == n - 1;
        (0..n).filter(move |&j| !beside(j)).map(|j| self.ring[j])
    }
}

/// A collapse that may be done.
struct Plan {
    /// Triangles that go, and those that get the new corner, with all their corners then.
    removed: Vec<u32>,
    changed: Vec<(u32, [u32; 3])>,
    /// For each sample over the star, the triangle that it is over then.
    moves: Vec<(u32, u32)>,
}

/// Part of a cover, with numbers of its own.
pub(super) struct Collapser<'a, 's> {
    scene: &'s Scene<'a>,
    vertices: Vec<Vertex>,
    faces: Vec<Face>,
    /// Cost in bits (a number from 0), vertex and its version.
    queue: BinaryHeap<Reverse<(u64, u32, u32)>>,
}

/// Merges what can be merged of a part. `fixed` vertices stay; those that are not `due` are only tried where something
/// changed. Returns the part and the vertices that are left, apart from the fixed ones.
pub(super) fn collapse(
    scene: &Scene,
    part: Cover,
    fixed: impl Fn(u32, usize) -> bool,
    due: impl Fn(u32) -> bool,
) -> (Cover, Vec<u32>) {
    let mut collapser = Collapser::new(scene, part, fixed);
    for u in 0..collapser.vertices.len() as u32 {
        if due(collapser.vertices[u as usize].id) {
            collapser.enqueue(u);
        }
    }
    while let Some(Reverse((_, u, version))) = collapser.queue.pop() {
        if version == collapser.vertices[u as usize].version {
            collapser.merge(u);
        }
    }
    collapser.finish()
}

impl<'a, 's> Collapser<'a, 's> {
    fn new(scene: &'s Scene<'a>, part: Cover, fixed: impl Fn(u32, usize) -> bool) -> Self {
        let mut ids: Vec<u32> = part.triangles.iter().flatten().copied().collect();
        ids.sort_unstable();
        ids.dedup();
        let origin = scene.position(ids[0]);
        let vertex = |&id: &u32| Vertex {
            id,
            place: scene.position(id) - origin,
            faces: Vec::new(),
            quadric: Quadric::default(),
            fixed: false,
            version: 0,
        };
        let mut vertices: Vec<Vertex> = ids.iter().map(vertex).collect();
        let number = |id: u32| ids.partition_point(|&i| i < id) as u32;
        let face = |(t, over): (&[u32; 3], Vec<u32>)| Face { corners: t.map(number), over, gone: false };
        let faces: Vec<Face> = part.triangles.iter().zip(part.over).map(face).collect();
        for (f, face) in faces.iter().enumerate() {
            let [a, b, c] = face.corners.map(|v| vertices[v as usize].place);
            let normal = (b - a).cross(c - a);
            let quadric = Quadric::of_plane(a, normal);
            for v in face.corners {
                let vertex = &mut vertices[v as usize];
                // Triangles without area stay as they are.
                vertex.fixed |= !(f32::MIN_POSITIVE..f32::INFINITY).contains(&normal.length_squared());
                if vertex.faces.last() != Some(&(f as u32)) {
                    vertex.faces.push(f as u32);
                }
                vertex.quadric += quadric;
            }
        }
        let mut collapser = Self { scene, vertices, faces, queue: BinaryHeap::new() };
        for u in 0..ids.len() {
            let vertex = &collapser.vertices[u];
            let star = collapser.star(u as u32);
            let whole = star.is_some() && !vertex.fixed && !fixed(vertex.id, vertex.faces.len());
            if let Some(star) = star.filter(|s| whole && !s.closed) {
                collapser.brace(u, &star);
            }
            collapser.vertices[u].fixed = !whole;
        }
        collapser
    }

    /// Makes it cost something to move a vertex of the border off it.
    fn brace(&mut self, u: usize, star: &Star) {
        let (Some(&first), Some(&last)) = (star.ring.first(), star.ring.last()) else { return };
        let normal = star.faces.iter().map(|&f| self.normal(self.faces[f as usize].corners)).sum::<Vec3A>();
        let place = self.vertices[u].place;
        for end in [first, last] {
            let along = self.vertices[end as usize].place - place;
            let across = along.cross(normal.normalize_or_zero());
            self.vertices[u].quadric += Quadric::of_plane(place, across * along.length());
        }
    }

    fn normal(&self, corners: [u32; 3]) -> Vec3A {
        let [a, b, c] = corners.map(|v| self.vertices[v as usize].place);
        (b - a).cross(c - a)
    }

    /// What is around a vertex, if that is one fan of triangles.
    fn star(&self, u: u32) -> Option<Star> {
        let mut left: Vec<(u32, u32, u32)> = Vec::with_capacity(8);
        for &f in &self.vertices[u as usize].faces {
            let t = self.faces[f as usize].corners;
            let k = (0..3).find(|&k| t[k] == u)?;
            left.push((t[(k + 1) % 3], t[(k + 2) % 3], f));
        }
        let start = left.iter().position(|l| left.iter().all(|m| m.1 != l.0));
        let mut star =
            Star { faces: Vec::with_capacity(8), ring: Vec::with_capacity(8), closed: start.is_none() };
        let mut at = left.get(start.unwrap_or(0))?.0;
        let first = at;
        while let Some(n) = left.iter().position(|l| l.0 == at) {
            let (_, next, f) = left.swap_remove(n);
            star.ring.push(at);
            star.faces.push(f);
            at = next;
            if at == first {
                break;
            }
        }
        if !star.closed {
            star.ring.push(at);
        }
        // Two triangles back to back are no fan.
        let whole = left.is_empty() && (at == first) == star.closed && (!star.closed || star.ring.len() > 2);
        let distinct = star.ring.iter().enumerate().all(|(i, v)| !star.ring[..i].contains(v));
        (whole && distinct).then_some(star)
    }

    fn enqueue(&mut self, u: u32) {
        if self.vertices[u as usize].fixed {
            return;
        }
        let Some(star) = self.star(u) else { return };
        let costs = self.targets(&star).map(|i| self.cost(u, star.ring[i]));
        if let Some(least) = costs.reduce(f64::min) {
            let version = self.vertices[u as usize].version;
            self.queue.push(Reverse((least.to_bits(), u, version)));
        }
    }

    /// Places along the ring that a vertex may be merged into: along the border it is on, if it is.
    fn targets(&self, star: &Star) -> impl Iterator<Item = usize> + use<> {
        let (last, closed) = (star.ring.len() - 1, star.closed);
        (0..=last).filter(move |&i| closed || i == 0 || i == last)
    }

    /// Never below 0.
    fn cost(&self, u: u32, v: u32) -> f64 {
        let (from, to) = (&self.vertices[u as usize], &self.vertices[v as usize]);
        let stride =
            f64::from(from.place.distance_squared(to.place)) * f64::from(self.scene.tolerance).powi(2);
        (from.quadric + to.quadric).at(to.place).max(0.0) + STRIDE * stride
    }

    /// Merges a vertex into the cheapest neighbour that it may be merged into, if there is one.
    fn merge(&mut self, u: u32) {
        let Some(star) = self.star(u) else { return };
        let mut targets: Vec<(u64, usize)> =
            self.targets(&star).map(|i| (self.cost(u, star.ring[i]).to_bits(), i)).collect();
        targets.sort_unstable();
        for (_, i) in targets {
            if let Some(plan) = self.plan(u, &star, i) {
                self.carry_out(u, star.ring[i], plan);
                for w in star.ring {
                    self.vertices[w as usize].version += 1;
                    self.enqueue(w);
                }
                return;
            }
        }
    }

    /// What merging `u` into `ring[i]` would do, if it is allowed.
    fn plan(&mut self, u: u32, star: &Star, i: usize) -> Option<Plan> {
        let v = star.ring[i];
        let (mut removed, mut changed) = (Vec::new(), Vec::new());
        for (j, &f) in star.faces.iter().enumerate() {
            let (a, b) = (star.ring[j], star.ring[(j + 1) % star.ring.len()]);
            if a == v || b == v {
                removed.push(f);
            } else {
                changed.push((f, [v, a, b]));
            }
        }
        self.keeps_manifold(u, v, star, i, &changed)?;
        let normal = self.keeps_facing(star, &changed)?;
        let onto = if changed.is_empty() { vec![self.behind(u, star)?] } else { changed.clone() };
        let moves = self.moves(u, star, &onto)?;
        let near = self.crosses_near(star, i, &onto, normal)
            && self.keeps_border(star)
            && changed.iter().all(|(_, t)| self.is_near(*t));
        near.then_some(Plan { removed, changed, moves })
    }

    /// New edges must not be there already, here or in another part; nor new triangles.
    fn keeps_manifold(
        &self,
        u: u32,
        v: u32,
        star: &Star,
        i: usize,
        changed: &[(u32, [u32; 3])],
    ) -> Option<()> {
        let target = &self.vertices[v as usize];
        let around = || target.faces.iter().map(|&f| self.faces[f as usize].corners);
        for w in star.across(i) {
            let fixed = target.fixed && self.vertices[w as usize].fixed;
            if fixed || around().any(|t| t.contains(&w)) {
                return None;
            }
        }
        let double = |&(_, [_, a, b]): &(u32, [u32; 3])| {
            let fixed = [v, a, b].iter().all(|&w| self.vertices[w as usize].fixed);
            fixed || around().any(|t| !t.contains(&u) && t.contains(&a) && t.contains(&b))
        };
        (!changed.iter().any(double)).then_some(())
    }

    /// The mean normal of a star, if all triangles will face it.
    fn keeps_facing(&self, star: &Star, changed: &[(u32, [u32; 3])]) -> Option<Vec3A> {
        let before: Vec3A = star.faces.iter().map(|&f| self.normal(self.faces[f as usize].corners)).sum();
        let before = before.normalize_or_zero();
        let fine = |&(_, t): &(u32, [u32; 3])| {
            let [a, b, c] = t.map(|v| self.vertices[v as usize].place);
            let normal = (b - a).cross(c - a);
            let length = normal.length();
            let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
            length > SLIVER * longest && normal.dot(before) > FACING * length
        };
        changed.iter().all(fine).then_some(before)
    }

    /// The triangle behind the only one of a vertex.
    fn behind(&self, u: u32, star: &Star) -> Option<(u32, [u32; 3])> {
        let (&a, &b) = (star.ring.first()?, star.ring.last()?);
        let faces = self.vertices[a as usize].faces.iter();
        let mut behind = faces.map(|&f| (f, self.faces[f as usize].corners));
        behind.find(|(_, t)| t.contains(&b) && !t.contains(&u))
    }

    /// For each sample over the star the nearest of the triangles `onto`; `None` if one is too far from all of them.
    fn moves(&mut self, u: u32, star: &Star, onto: &[(u32, [u32; 3])]) -> Option<Vec<(u32, u32)>> {
        let scene = self.scene;
        let ids: Vec<[u32; 3]> = onto.iter().map(|(_, t)| t.map(|v| self.vertices[v as usize].id)).collect();
        let places: Vec<[Vec3A; 3]> = ids.iter().map(|t| t.map(|v| scene.position(v))).collect();
        let limit = scene.tolerance * scene.tolerance;
        let find = |sample: u32| -> Option<u32> {
            let p = scene.place(sample);
            let mut best = ([0.0; 3], f32::INFINITY, 0);
            for (n, corners) in places.iter().enumerate() {
                let (weights, distance) = foot(p, *corners);
                if distance < best.1 {
                    best = (weights, distance, n);
                }
            }
            let (weights, distance, n) = best;
            let near = distance <= limit && scene.fits_attributes(sample, ids[n], weights);
            near.then(|| onto[n].0)
        };
        let mut moves = vec![(self.vertices[u as usize].id, find(self.vertices[u as usize].id)?)];
        for &f in &star.faces {
            let over = &mut self.faces[f as usize].over;
            for n in 0..over.len() {
                let Some(face) = find(over[n]) else {
                    // What failed now fails again, most likely: next time it comes first.
                    over.swap(0, n);
                    return None;
                };
                moves.push((over[n], face));
            }
        }
        Some(moves)
    }

    /// Whether the new edges are close to the original's sides where they cross.
    fn crosses_near(&self, star: &Star, i: usize, onto: &[(u32, [u32; 3])], normal: Vec3A) -> bool {
        let place = |v: u32| self.scene.position(self.vertices[v as usize].id);
        let old = self.scene.triangles(star.faces.iter().flat_map(|&f| &self.faces[f as usize].over));
        let faces: Vec<[Vec3A; 3]> = onto.iter().map(|(_, t)| t.map(place)).collect();
        let edges = star.across(i).map(|w| [place(star.ring[i]), place(w)]);
        self.scene.far_crossing(edges, &old, normal, &faces).is_none()
    }

    /// Whether a new edge of the border, if there is one, is close to the original: a notch is narrower than the raster.
    fn keeps_border(&self, star: &Star) -> bool {
        if star.closed {
            return true;
        }
        let ends = [star.ring[0], star.ring[star.ring.len() - 1]];
        let [a, b] = ends.map(|v| self.scene.position(self.vertices[v as usize].id));
        let step = BORDER_STEP * self.scene.tolerance;
        let steps = ((a.distance(b) / step).ceil() as usize).clamp(1, MOST_BORDER_STEPS);
        let mut places = (1..steps).map(|n| a + (b - a) * (n as f32 / steps as f32));
        places.all(|p| self.scene.surface.is_within(p, self.scene.tolerance))
    }

    /// Whether the places of a triangle are close to the original.
    fn is_near(&self, corners: [u32; 3]) -> bool {
        let corners = corners.map(|v| self.scene.position(self.vertices[v as usize].id));
        self.scene.surface.holds(corners, self.scene.spacing, self.scene.tolerance)
    }

    fn carry_out(&mut self, u: u32, v: u32, plan: Plan) {
        for &f in plan.removed.iter().chain(plan.changed.iter().map(|(f, _)| f)) {
            self.faces[f as usize].over.clear();
        }
        for &f in &plan.removed {
            self.faces[f as usize].gone = true;
            for w in self.faces[f as usize].corners {
                self.vertices[w as usize].faces.retain(|&g| g != f);
            }
        }
        for (f, corners) in plan.changed {
            self.faces[f as usize].corners = corners;
            self.vertices[v as usize].faces.push(f);
        }
        for (sample, f) in plan.moves {
            self.faces[f as usize].over.push(sample);
        }
        let quadric = self.vertices[u as usize].quadric;
        self.vertices[v as usize].quadric += quadric;
        let merged = &mut self.vertices[u as usize];
        merged.faces = Vec::new();
        merged.version += 1;
    }

    fn finish(self) -> (Cover, Vec<u32>) {
        let settled =
            self.vertices.iter().filter(|v| !v.fixed && !v.faces.is_empty()).map(|v| v.id).collect();
        let mut cover = Cover::default();
        for face in self.faces.into_iter().filter(|f| !f.gone) {
            cover.triangles.push(face.corners.map(|v| self.vertices[v as usize].id));
            cover.over.push(face.over);
        }
        (cover, settled)
    }
}
