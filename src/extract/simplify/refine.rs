//! Greedy insertion: the vertex with the largest error goes in, until none exceeds its tolerance (Garland & Heckbert,
//! "Fast polygonal approximation of terrains and height fields", 1995).

use std::collections::BinaryHeap;

use spade::Triangulation;
use spade::handles::FixedVertexHandle;

use super::cover::Cover;
use super::scene::Scene;
use super::sheet::{Face, Sheet, point};

/// The worst vertex over a face.
#[derive(Clone, Copy, PartialEq)]
struct Worst {
    error: f32,
    vertex: u32,
    face: Face,
    version: u32,
}

impl Eq for Worst {}

impl Ord for Worst {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        // Of equals the vertex with the lower number, so that the order of the faces does not matter.
        self.error.total_cmp(&other.error).then(other.vertex.cmp(&self.vertex))
    }
}

impl PartialOrd for Worst {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

struct Refiner<'a> {
    scene: &'a Scene<'a>,
    sheet: Sheet,
    /// Share of the tolerances that errors may reach.
    share: f32,
    /// Samples over each face.
    over: Vec<Vec<u32>>,
    /// Counts the changes of each face.
    versions: Vec<u32>,
    heap: BinaryHeap<Worst>,
}

/// Inserts vertices into `sheet` until all that are over it are within a share of the tolerances. `samples`: all that is
/// over it. `None` where the samples are no height field over the sheet.
pub(super) fn refine(scene: &Scene, sheet: Sheet, samples: &[u32], share: f32) -> Option<Cover> {
    let faces = sheet.inner.len();
    let (over, versions) = (vec![Vec::new(); faces], vec![0; faces]);
    let mut refiner = Refiner { scene, sheet, share, over, versions, heap: BinaryHeap::new() };
    let mut hint = FixedVertexHandle::from_index(0);
    for &sample in samples {
        let (p, _) = refiner.sheet.frame.project(scene.place(sample));
        let face = refiner.sheet.face_at(point(p), &mut hint)?;
        refiner.over[face.index()].push(sample);
    }
    let faces: Vec<Face> = refiner.sheet.cdt.inner_faces().map(|f| f.fix()).collect();
    faces.into_iter().for_each(|face| refiner.rank(face));
    while let Some(worst) = refiner.heap.pop() {
        if worst.version == refiner.versions[worst.face.index()] {
            refiner.insert(worst.vertex, worst.face)?;
        }
    }
    Some(refiner.cover())
}

impl Refiner<'_> {
    /// Puts the worst vertex over a face on the heap, if it is not within tolerance.
    fn rank(&mut self, face: Face) {
        let version = self.versions[face.index()];
        let vertices = self.over[face.index()].iter().filter_map(|&s| self.scene.vertex(s));
        let errors = vertices.map(|vertex| Worst { error: self.error(vertex, face), vertex, face, version });
        if let Some(worst) = errors.max()
            && worst.error > self.share
        {
            self.heap.push(worst);
        }
    }

    /// The error at a vertex over a face, of height and attributes, in tolerances.
    fn error(&self, v: u32, face: Face) -> f32 {
        let (p, height) = self.sheet.frame.project(self.scene.position(v));
        let corners = self.sheet.corners(face);
        let areas = self.sheet.areas(corners, p).map(|w| w.max(0.0));
        let sum: f64 = areas.iter().sum();
        let weights = if sum > 0.0 { areas.map(|w| w / sum) } else { [1.0 / 3.0; 3] };
        let surface: f64 = (0..3).map(|k| weights[k] * self.sheet.heights[corners[k]]).sum();
        let gap = ((height - surface).abs() / f64::from(self.scene.tolerance)) as f32;
        let ids = corners.map(|k| self.sheet.ids[k]);
        gap.max(self.scene.rows.deviation(v, ids, weights.map(|w| w as f32)))
    }

    fn insert(&mut self, v: u32, face: Face) -> Option<()> {
        let (p, height) = self.sheet.frame.project(self.scene.position(v));
        if self.sheet.is_at_rim(face, p) {
            return None;
        }
        let hint = FixedVertexHandle::from_index(self.sheet.corners(face)[0]);
        let new = self.sheet.cdt.insert_with_hint(point(p), hint).ok()?;
        // It fell onto another vertex.
        if new.index() != self.sheet.ids.len() {
            return None;
        }
        self.sheet.ids.push(v);
        self.sheet.heights.push(height);
        let count = self.sheet.cdt.num_all_faces();
        self.over.resize(count, Vec::new());
        self.versions.resize(count, 0);
        self.sheet.inner.resize(count, true);
        // Every face that changed touches the new vertex.
        let star: Vec<Face> = self.sheet.star(new).collect();
        self.share_out(v, &star);
        star.into_iter().for_each(|face| self.rank(face));
        Some(())
    }

    /// Gives the samples over some faces to those that they are over now.
    fn share_out(&mut self, inserted: u32, star: &[Face]) {
        let mut samples = Vec::new();
        for &face in star {
            samples.append(&mut self.over[face.index()]);
            self.versions[face.index()] += 1;
            self.sheet.inner[face.index()] = true;
        }
        let corners: Vec<[usize; 3]> = star.iter().map(|&face| self.sheet.corners(face)).collect();
        for sample in samples.into_iter().filter(|&s| s != inserted) {
            let (p, _) = self.sheet.frame.project(self.scene.place(sample));
            let inside = |c: &[usize; 3]| self.sheet.areas(*c, p).into_iter().fold(f64::INFINITY, f64::min);
            let margins = corners.iter().map(inside).enumerate();
            if let Some((n, _)) = margins.reduce(|a, b| if b.1 > a.1 { b } else { a }) {
                self.over[star[n].index()].push(sample);
            }
        }
    }

    fn cover(mut self) -> Cover {
        let mut cover = Cover::default();
        for face in self.sheet.cdt.inner_faces().map(|f| f.fix()) {
            if self.sheet.inner[face.index()] {
                cover.triangles.push(self.sheet.corners(face).map(|k| self.sheet.ids[k]));
                cover.over.push(std::mem::take(&mut self.over[face.index()]));
            }
        }
        cover
    }
}
