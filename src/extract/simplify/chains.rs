//! The lines along which patches meet, each simplified once for both sides (Douglas & Peucker, 1973).

use glam::Vec3A;
use rayon::prelude::*;

use super::columns::Rows;
use super::regions::{NONE, Regions};
use super::topology::{BORDER, SINGULAR, Topology, side};
use crate::extract::TriMesh;

/// Sides before and after over which a chain's normals are averaged: the normal of one marched triangle is noise.
const WINDOW: usize = 2;

/// A line of edges with the same patches on either side.
pub(super) struct Chain {
    /// In the direction in which the left patch runs through them; the first is also the last of a closed chain.
    pub(super) vertices: Vec<u32>,
    pub(super) left: u32,
    /// [`NONE`] at the mesh's border.
    pub(super) right: u32,
    /// Of each edge: the normals of the surface on the left and on the right.
    normals: Vec<[Vec3A; 2]>,
}

/// All chains of a mesh.
pub(super) struct Chains {
    pub(super) all: Vec<Chain>,
    /// Chains of each patch.
    pub(super) of_patch: Vec<Vec<u32>>,
    /// Sides of each patch that must stay as they are, in the patch's direction.
    pub(super) fixed: Vec<Vec<[u32; 2]>>,
    /// Patches that a vertex is inside of or on the rim of (two of them at most), or [`NONE`].
    pub(super) owners: Vec<[u32; 2]>,
    /// Vertices that must stay: ends of chains and of fixed sides.
    pub(super) ends: Vec<bool>,
}

/// One edge between two patches.
struct Link {
    from: u32,
    to: u32,
    left: u32,
    right: u32,
    normals: [Vec3A; 2],
}

/// How far a simplified chain may go.
#[derive(Clone, Copy)]
pub(super) struct Limits {
    /// From the mesh's border, world units.
    pub(super) border: f32,
    /// Off the surface, world units.
    pub(super) off: f32,
    /// Along the surface, world units: the surface stays, only the patches' share of it changes.
    pub(super) along: f32,
}

impl Chains {
    pub(super) fn trace(mesh: &TriMesh, topology: &Topology, regions: &Regions) -> Self {
        let mut chains = Self {
            all: Vec::new(),
            of_patch: vec![Vec::new(); regions.members.len()],
            fixed: vec![Vec::new(); regions.members.len()],
            owners: vec![[NONE; 2]; mesh.positions.len()],
            ends: vec![false; mesh.positions.len()],
        };
        let links = chains.links(mesh, topology, regions);
        chains.join(mesh, links);
        for (n, chain) in chains.all.iter().enumerate() {
            chains.of_patch[chain.left as usize].push(n as u32);
            if chain.right != NONE {
                chains.of_patch[chain.right as usize].push(n as u32);
            }
        }
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            let patch = regions.of[t];
            for &v in triangle.iter().filter(|_| patch != NONE) {
                let owners = &mut chains.owners[v as usize];
                if !owners.contains(&patch) {
                    match owners.iter().position(|&o| o == NONE) {
                        Some(free) => owners[free] = patch,
                        None => chains.ends[v as usize] = true,
                    }
                }
            }
        }
        chains
    }

    /// Patches that have a chain in common with each patch.
    pub(super) fn beside(&self) -> Vec<Vec<u32>> {
        let mut beside = vec![Vec::new(); self.of_patch.len()];
        for chain in self.all.iter().filter(|c| c.right != NONE) {
            beside[chain.left as usize].push(chain.right);
            beside[chain.right as usize].push(chain.left);
        }
        for list in &mut beside {
            list.sort_unstable();
            list.dedup();
        }
        beside
    }

    /// All edges between patches; those that cannot be simplified go to `fixed`.
    fn links(&mut self, mesh: &TriMesh, topology: &Topology, regions: &Regions) -> Vec<Link> {
        let mut links = Vec::new();
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            let left = regions.of[t];
            for k in 0..3 {
                let [from, to] = side(triangle, k);
                let beyond = topology.across[t][k];
                if beyond == SINGULAR {
                    self.ends[from as usize] = true;
                    self.ends[to as usize] = true;
                    if left != NONE {
                        self.fixed[left as usize].push([from, to]);
                    }
                    continue;
                }
                let normal = mesh.area_normal(t);
                if beyond == BORDER {
                    links.push(Link { from, to, left, right: NONE, normals: [normal; 2] });
                    continue;
                }
                let right = regions.of[beyond as usize];
                if left < right {
                    let normals = [normal, mesh.area_normal(beyond as usize)];
                    links.push(Link { from, to, left, right, normals });
                }
            }
        }
        links
    }

    /// Joins links to chains, from end to end, then those that have none.
    fn join(&mut self, mesh: &TriMesh, links: Vec<Link>) {
        let vertices = mesh.positions.len();
        // At each vertex the links that touch it: more or fewer than two make it an end.
        let mut touching = vec![[NONE; 2]; vertices];
        for (n, link) in links.iter().enumerate() {
            for v in [link.from, link.to] {
                match touching[v as usize].iter().position(|&l| l == NONE) {
                    Some(free) => touching[v as usize][free] = n as u32,
                    None => self.ends[v as usize] = true,
                }
            }
        }
        let next = |n: u32| {
            let v = links[n as usize].to as usize;
            let other = touching[v].into_iter().find(|&l| l != n).filter(|&l| l != NONE)?;
            let (a, b) = (&links[n as usize], &links[other as usize]);
            (b.from == a.to && (a.left, a.right) == (b.left, b.right)).then_some(other)
        };
        for v in 0..vertices {
            if let [a, b] = touching[v]
                && a != NONE
                && (b == NONE || next(a) != Some(b) && next(b) != Some(a))
            {
                self.ends[v] = true;
            }
        }
        let mut done = vec![false; links.len()];
        for closed in [false, true] {
            for first in 0..links.len() as u32 {
                let starts = closed || self.ends[links[first as usize].from as usize];
                if done[first as usize] || !starts {
                    continue;
                }
                let mut numbers = vec![first];
                done[first as usize] = true;
                let mut last = first;
                while !self.ends[links[last as usize].to as usize]
                    && let Some(n) = next(last)
                    && !done[n as usize]
                {
                    done[n as usize] = true;
                    numbers.push(n);
                    last = n;
                }
                if closed {
                    start_at_corner(mesh, &links, &mut numbers);
                }
                self.all.push(Chain::new(&links, &numbers));
            }
        }
    }
}

/// Turns a closed chain so that it begins at the vertex farthest from its middle: there a vertex is needed anyway.
fn start_at_corner(mesh: &TriMesh, links: &[Link], numbers: &mut [u32]) {
    let place = |n: &u32| Vec3A::from_array(mesh.positions[links[*n as usize].from as usize]);
    let middle = numbers.iter().map(place).sum::<Vec3A>() / numbers.len() as f32;
    let distances = numbers.iter().map(|n| place(n).distance_squared(middle)).enumerate();
    if let Some((first, _)) = distances.reduce(|a, b| if b.1 > a.1 { b } else { a }) {
        numbers.rotate_left(first);
    }
}

impl Chain {
    fn new(links: &[Link], numbers: &[u32]) -> Self {
        let link = |n: &u32| &links[*n as usize];
        let first = &links[numbers[0] as usize];
        let mut vertices = vec![first.from];
        vertices.extend(numbers.iter().map(|n| link(n).to));
        let around = |i: usize| {
            let window = &numbers[i.saturating_sub(WINDOW)..(i + WINDOW + 1).min(numbers.len())];
            [0, 1].map(|s| window.iter().map(|n| link(n).normals[s]).sum::<Vec3A>().normalize_or_zero())
        };
        let normals = (0..numbers.len()).map(around).collect();
        Self { vertices, left: first.left, right: first.right, normals }
    }

    /// Places along the chain of the vertices that stay, the first and the last among them.
    pub(super) fn simplified(
        &self,
        mesh: &TriMesh,
        rows: &Rows,
        required: &[bool],
        limits: Limits,
    ) -> Vec<u32> {
        let last = self.vertices.len() - 1;
        let mut keep: Vec<bool> = self.vertices.iter().map(|&v| required[v as usize]).collect();
        keep[0] = true;
        keep[last] = true;
        if self.vertices[0] == self.vertices[last] {
            self.span_loop(mesh, &mut keep);
        }
        let pins: Vec<usize> = (0..=last).filter(|&i| keep[i]).collect();
        let mut spans: Vec<[usize; 2]> = pins.windows(2).map(|w| [w[0], w[1]]).collect();
        while let Some([from, to]) = spans.pop() {
            let scores = (from + 1..to).map(|i| (self.score(mesh, rows, [from, to], i, limits), i));
            // Of equals the first: the order of the search must not matter.
            let worst = scores.reduce(|a, b| if b.0 > a.0 { b } else { a });
            if let Some((score, i)) = worst
                && score > 1.0
            {
                keep[i] = true;
                spans.extend([[from, i], [i, to]]);
            }
        }
        (0..=last as u32).filter(|&i| keep[i as usize]).collect()
    }

    /// A loop needs three corners: its start, the farthest from it, and the farthest from the line between these.
    fn span_loop(&self, mesh: &TriMesh, keep: &mut [bool]) {
        let inner = 1..self.vertices.len() - 1;
        let start = self.place(mesh, 0);
        let farthest = |distance: &dyn Fn(Vec3A) -> f32| {
            let distances = inner.clone().map(|i| (distance(self.place(mesh, i)), i));
            distances.reduce(|a, b| if b.0 > a.0 { b } else { a }).map(|(_, i)| i)
        };
        let Some(second) = farthest(&|p| p.distance_squared(start)) else { return };
        let axis = (self.place(mesh, second) - start).normalize_or_zero();
        let third = farthest(&|p| (p - start).reject_from_normalized(axis).length_squared());
        keep[second] = true;
        if let Some(third) = third.filter(|&third| third != second) {
            keep[third] = true;
        } else {
            keep.fill(true);
        }
    }

    fn place(&self, mesh: &TriMesh, i: usize) -> Vec3A {
        Vec3A::from_array(mesh.positions[self.vertices[i] as usize])
    }

    /// How far vertex `i` is from the straight line between two others, in what is allowed.
    fn score(&self, mesh: &TriMesh, rows: &Rows, [from, to]: [usize; 2], i: usize, limits: Limits) -> f32 {
        let (a, b, p) = (self.place(mesh, from), self.place(mesh, to), self.place(mesh, i));
        let along = b - a;
        let length2 = along.length_squared();
        let t = if length2 > 0.0 { ((p - a).dot(along) / length2).clamp(0.0, 1.0) } else { 0.0 };
        let off = p - (a + along * t);
        let distance = match self.right {
            NONE => off.length() / limits.border,
            _ => {
                let normals = self.normals[i - 1].iter().chain(&self.normals[i]);
                let away = normals.map(|n| off.dot(*n).abs()).fold(0.0, f32::max);
                (away / limits.off).max(off.length() / limits.along)
            }
        };
        let (v, ends) = (self.vertices[i], [self.vertices[from], self.vertices[to]]);
        distance.max(rows.deviation(v, ends, [1.0 - t, t]))
    }
}

/// Simplifies some chains, each on its own.
pub(super) fn simplify_chains(
    chains: &[Chain],
    which: &[u32],
    mesh: &TriMesh,
    rows: &Rows,
    required: &[bool],
    limits: Limits,
) -> Vec<Vec<u32>> {
    let one = |n: &u32| chains[*n as usize].simplified(mesh, rows, required, limits);
    which.par_iter().map(one).collect()
}
