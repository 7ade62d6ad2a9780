//! Patches: connected triangles that all face the same plane.
//!
//! A patch is a height field over its plane, so it may undulate; what it may not do is turn away from the plane. Grown
//! from the flattest places outwards (region growing, as in Cohen-Steiner et al., "Variational shape approximation",
//! 2004, without the iterations).

use std::collections::VecDeque;

use glam::{DVec2, DVec3, Vec3A};
use rayon::prelude::*;

use super::overlaps::{RimSide, crossings, inverted};
use super::topology::{Topology, side};
use crate::extract::TriMesh;
use crate::extract::clean::vertex_normals;

/// No patch.
const NONE: u32 = u32::MAX;
/// Not yet seen to belong to a part.
const WAITING: u32 = NONE - 1;
/// Smoothed normals of a patch are within this angle of its plane's: cos 50°.
const CONE: f32 = 0.64;
/// Cosine between a triangle's own normal and its plane's: with noise, beyond the cone, but never edge-on.
const FACING: f32 = 0.2;
/// Triangles from which a plane's normal is averaged.
const SEED_TRIANGLES: usize = 400;
/// A patch has no more triangles: patches are the unit of parallel work, and of what is kept where one fails.
const MOST_TRIANGLES: usize = 12_000;
/// Passes that take apart what lies over itself, one triangle's width each.
const PARTINGS: usize = 64;

/// Coordinates of a patch: in its plane, and height above it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame {
    origin: DVec3,
    u: DVec3,
    v: DVec3,
    pub(super) normal: Vec3A,
}

impl Frame {
    fn new(origin: DVec3, normal: Vec3A) -> Self {
        let n = normal.as_dvec3().normalize();
        let (u, v) = n.any_orthonormal_pair();
        // `any_orthonormal_pair` is right-handed, but counter-clockwise must stay counter-clockwise whatever it is.
        let v = if u.cross(v).dot(n) < 0.0 { -v } else { v };
        Self { origin, u, v, normal }
    }

    /// Place in the plane and height above it.
    pub(super) fn project(&self, p: Vec3A) -> (DVec2, f64) {
        let d = p.as_dvec3() - self.origin;
        (DVec2::new(d.dot(self.u), d.dot(self.v)), d.dot(self.u.cross(self.v)))
    }
}

/// The patches of a mesh.
pub(super) struct Regions {
    /// Triangles of each patch, in rising order.
    pub(super) members: Vec<Vec<u32>>,
    pub(super) frames: Vec<Frame>,
}

impl Regions {
    pub(super) fn grow(mesh: &TriMesh, topology: &Topology) -> Self {
        let mut grower = Grower::new(mesh, topology);
        let seeds = grower.seeds();
        grower.grow_all(&seeds);
        grower.part_overlaps();
        grower.finish()
    }
}

struct Grower<'a> {
    mesh: &'a TriMesh,
    topology: &'a Topology,
    /// Unit normal of each triangle.
    own: Vec<Vec3A>,
    /// The same, averaged with its surroundings.
    smooth: Vec<Vec3A>,
    of: Vec<u32>,
    normals: Vec<Vec3A>,
}

impl<'a> Grower<'a> {
    fn new(mesh: &'a TriMesh, topology: &'a Topology) -> Self {
        let corners = vertex_normals(mesh);
        let count = mesh.triangles.len();
        let own = |t: usize| mesh.area_normal(t).normalize_or_zero();
        let own: Vec<Vec3A> = (0..count).into_par_iter().map(own).collect();
        let smooth = |t: usize| {
            let sum: Vec3A = mesh.triangles[t].iter().map(|&v| Vec3A::from_array(corners[v as usize])).sum();
            sum.try_normalize().unwrap_or(own[t])
        };
        let smooth = (0..count).into_par_iter().map(smooth).collect();
        Self { mesh, topology, own, smooth, of: vec![NONE; count], normals: Vec::new() }
    }

    /// All triangles that have an area, those in flat surroundings first.
    fn seeds(&self) -> Vec<u32> {
        let bend = |t: u32| {
            let here = self.smooth[t as usize];
            let flattest = self.topology.neighbours(t).map(|n| here.dot(self.smooth[n as usize]));
            // In 1/64 steps, so that noise does not scatter the seeds.
            (64.0 * (1.0 - flattest.fold(here.dot(self.own[t as usize]), f32::min))) as u32
        };
        let all = 0..self.mesh.triangles.len() as u32;
        let mut seeds: Vec<(u32, u32)> =
            all.filter(|&t| !self.topology.frozen[t as usize]).map(|t| (bend(t), t)).collect();
        seeds.par_sort_unstable();
        seeds.into_iter().map(|(_, t)| t).collect()
    }

    /// Grows patches from all of these triangles that are free.
    fn grow_all(&mut self, seeds: &[u32]) {
        for &seed in seeds {
            if self.of[seed as usize] == NONE {
                self.grow_from(seed);
            }
        }
    }

    fn grow_from(&mut self, seed: u32) {
        let start = self.smooth[seed as usize];
        let start =
            if start.dot(self.own[seed as usize]) >= FACING { start } else { self.own[seed as usize] };
        let around = self.reach(seed, start, CONE.sqrt(), SEED_TRIANGLES);
        let mean: Vec3A = around.iter().map(|&t| self.mesh.area_normal(t as usize)).sum();
        let mean = mean.try_normalize().unwrap_or(start);
        let normal = if mean.dot(self.own[seed as usize]) >= FACING { mean } else { start };
        let patch = self.normals.len() as u32;
        self.normals.push(normal);
        for t in self.reach(seed, normal, CONE, MOST_TRIANGLES) {
            self.of[t as usize] = patch;
        }
    }

    /// The free triangles that are connected to `seed` and face `normal`, nearest first.
    fn reach(&mut self, seed: u32, normal: Vec3A, cone: f32, most: usize) -> Vec<u32> {
        // Marks what is on its way, and is taken back before returning.
        const SEEN: u32 = NONE - 1;
        let (mut found, mut queue) = (Vec::new(), VecDeque::from([seed]));
        self.of[seed as usize] = SEEN;
        while let Some(t) = queue.pop_front() {
            found.push(t);
            if found.len() == most {
                break;
            }
            for n in self.topology.neighbours(t) {
                let i = n as usize;
                let faces = self.own[i].dot(normal) >= FACING && self.smooth[i].dot(normal) >= cone;
                if self.of[i] == NONE && faces {
                    self.of[i] = SEEN;
                    queue.push_back(n);
                }
            }
        }
        for &t in found.iter().chain(&queue) {
            self.of[t as usize] = NONE;
        }
        found
    }

    /// Takes triangles out of patches that lie over themselves, from the rim inwards, until none does.
    fn part_overlaps(&mut self) {
        let mut changed: Vec<u32> = (0..self.normals.len() as u32).collect();
        for _ in 0..PARTINGS {
            let parts = self.connect(&changed);
            let out: Vec<u32> = parts.par_iter().flat_map_iter(|part| self.over_itself(part)).collect();
            if out.is_empty() {
                return;
            }
            changed = out.iter().map(|&t| self.of[t as usize]).collect();
            out.iter().for_each(|&t| self.of[t as usize] = NONE);
            changed.sort_unstable();
            changed.dedup();
        }
    }

    /// Makes a patch of each connected part of some patches; returns the triangles of all these.
    fn connect(&mut self, patches: &[u32]) -> Vec<Vec<u32>> {
        let mut members = self.members();
        let mut parts = Vec::new();
        for &patch in patches {
            let whole = std::mem::take(&mut members[patch as usize]);
            let mut label = patch;
            whole.iter().for_each(|&t| self.of[t as usize] = WAITING);
            for &seed in &whole {
                if self.of[seed as usize] != WAITING {
                    continue;
                }
                let of = &mut self.of;
                parts.push(connected(self.topology, seed, |t| {
                    let waiting = of[t as usize] == WAITING;
                    if waiting {
                        of[t as usize] = label;
                    }
                    waiting
                }));
                // For the next part; without one it stays empty.
                label = self.normals.len() as u32;
                self.normals.push(self.normals[patch as usize]);
            }
        }
        parts.iter_mut().for_each(|part| part.sort_unstable());
        parts
    }

    /// Triangles of each patch.
    fn members(&self) -> Vec<Vec<u32>> {
        let mut members = vec![Vec::new(); self.normals.len()];
        for (t, &p) in self.of.iter().enumerate().filter(|(_, p)| **p != NONE) {
            members[p as usize].push(t as u32);
        }
        members
    }

    /// Triangles of a patch that lie over others: of each two sides of its rim that cross, the one that faces the plane
    /// less; and those round a hole that is turned inside out, for what was there was folded.
    fn over_itself(&self, members: &[u32]) -> Vec<u32> {
        let Some(&first) = members.first() else { return Vec::new() };
        let patch = self.of[first as usize];
        let frame = Frame::new(self.mesh.corners(first as usize)[0].as_dvec3(), self.normals[patch as usize]);
        let inside = |t: u32, k: usize| {
            let beyond = self.topology.across[t as usize][k];
            (self.of.get(beyond as usize) == Some(&patch)).then_some(beyond)
        };
        let rim: Vec<(u32, usize)> = members
            .iter()
            .flat_map(|&t| (0..3).map(move |k| (t, k)))
            .filter(|&(t, k)| inside(t, k).is_none())
            .collect();
        let to_plane = |&(t, k): &(u32, usize)| {
            let vertices = side(&self.mesh.triangles[t as usize], k);
            RimSide {
                vertices,
                ends: vertices.map(|v| frame.project(Vec3A::from_array(self.mesh.positions[v as usize])).0),
            }
        };
        let sides: Vec<RimSide> = rim.iter().map(to_plane).collect();
        // Round the end of a side, through the patch, to the side where the rim goes on.
        let next = |&(mut t, mut k): &(u32, usize)| {
            let pivot = side(&self.mesh.triangles[t as usize], k)[1];
            loop {
                k = (k + 1) % 3;
                let Some(beyond) = inside(t, k) else { return rim.binary_search(&(t, k)).unwrap_or(0) };
                t = beyond;
                let ends_here = |k: &usize| side(&self.mesh.triangles[t as usize], *k)[1] == pivot;
                k = (0..3).find(ends_here).unwrap_or(0);
            }
        };
        let next: Vec<usize> = rim.iter().map(next).collect();
        let facing = |t: u32| self.own[t as usize].dot(frame.normal);
        let mut out: Vec<u32> = crossings(&sides)
            .into_iter()
            .map(|pair| pair.map(|i| rim[i].0))
            .map(|[a, b]| if facing(a) < facing(b) || facing(a) == facing(b) && a < b { a } else { b })
            .collect();
        out.extend(inverted(&sides, &next).into_iter().map(|i| rim[i].0));
        out.sort_unstable();
        out.dedup();
        // One triangle does not lie over itself.
        if out.len() < members.len() { out } else { Vec::new() }
    }

    /// The patches as they are, without empty ones.
    fn finish(self) -> Regions {
        let mut regions = Regions { members: Vec::new(), frames: Vec::new() };
        for (label, part) in self.members().into_iter().enumerate().filter(|(_, part)| !part.is_empty()) {
            let origin = self.mesh.corners(part[0] as usize)[0].as_dvec3();
            regions.frames.push(Frame::new(origin, self.normals[label]));
            regions.members.push(part);
        }
        regions
    }
}

/// The triangles that are connected to `seed` through those that `take` takes, nearest first. `take` is asked at most
/// three times about each.
fn connected(topology: &Topology, seed: u32, mut take: impl FnMut(u32) -> bool) -> Vec<u32> {
    let mut part = Vec::from_iter(take(seed).then_some(seed));
    let mut next = 0;
    while next < part.len() {
        let beside = topology.neighbours(part[next]);
        part.extend(beside.filter(|&n| take(n)));
        next += 1;
    }
    part
}
