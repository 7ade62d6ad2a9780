//! Greedy insertion: the vertex with the largest error goes in, until none exceeds its tolerance (Garland & Heckbert,
//! "Fast polygonal approximation of terrains and height fields", 1995).

use std::collections::BinaryHeap;

use glam::DVec2;
use spade::Triangulation;
use spade::handles::{FixedDirectedEdgeHandle, FixedVertexHandle};

use super::sheet::{Face, Failure, Scene, Sheet, point};

/// A vertex closer to the rim than this share of the tolerance would leave a sliver; the rim has to bend instead.
const SLIVER: f64 = 0.05;

/// A patch that was triangulated anew.
#[derive(Clone, Debug, Default)]
pub(super) struct Outcome {
    /// Vertices of the mesh.
    pub(super) triangles: Vec<[u32; 3]>,
    /// Largest deviation of each column, in its own units.
    pub(super) deviations: Vec<f32>,
}

/// The worst vertex of a face.
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
    /// Vertices over each face.
    over: Vec<Vec<u32>>,
    /// Counts the changes of each face.
    versions: Vec<u32>,
    heap: BinaryHeap<Worst>,
}

/// Inserts vertices into `sheet` until everything over it is within tolerance. `points`: vertices and their faces.
pub(super) fn refine(scene: &Scene, sheet: Sheet, points: &[(u32, Face)]) -> Result<Outcome, Failure> {
    let faces = sheet.inner.len();
    let mut refiner = Refiner {
        scene,
        sheet,
        over: vec![Vec::new(); faces],
        versions: vec![0; faces],
        heap: BinaryHeap::new(),
    };
    for &(v, face) in points {
        refiner.over[face.index()].push(v);
    }
    let faces: Vec<Face> = refiner.sheet.cdt.inner_faces().map(|f| f.fix()).collect();
    faces.into_iter().for_each(|face| refiner.rank(face));
    while let Some(worst) = refiner.heap.pop() {
        if worst.version != refiner.versions[worst.face.index()] {
            continue;
        }
        if worst.error <= 1.0 {
            break;
        }
        refiner.insert(worst.vertex, worst.face)?;
    }
    Ok(refiner.outcome())
}

impl Refiner<'_> {
    /// Puts the worst vertex of a face on the heap.
    fn rank(&mut self, face: Face) {
        let version = self.versions[face.index()];
        let errors = self.over[face.index()].iter().map(|&vertex| {
            let error = self.sheet.error(self.scene, vertex, face);
            Worst { error, vertex, face, version }
        });
        if let Some(worst) = errors.max() {
            self.heap.push(worst);
        }
    }

    fn insert(&mut self, v: u32, face: Face) -> Result<(), Failure> {
        let (p, height) = self.sheet.frame.project(self.scene.mesh.positions[v as usize]);
        self.clear_of_rim(p, face)?;
        let hint = FixedVertexHandle::from_index(self.sheet.corners(face)[0]);
        let before = self.sheet.ids.len();
        let new = self.sheet.cdt.insert_with_hint(point(p), hint).map_err(|_| Failure::default())?;
        // It fell onto a vertex, which cannot be: that would have been an error of 0 or a failure before.
        if new.index() != before {
            return Err(Failure::default());
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
        Ok(())
    }

    /// Gives the vertices over some faces to those that they are over now.
    fn share_out(&mut self, inserted: u32, star: &[Face]) {
        let mut points = Vec::new();
        for &face in star {
            points.append(&mut self.over[face.index()]);
            self.versions[face.index()] += 1;
            self.sheet.inner[face.index()] = true;
        }
        let corners: Vec<[usize; 3]> = star.iter().map(|&face| self.sheet.corners(face)).collect();
        for v in points.into_iter().filter(|&v| v != inserted) {
            let (p, _) = self.sheet.frame.project(self.scene.mesh.positions[v as usize]);
            let margins = corners.iter().map(|&c| self.sheet.margin(c, p));
            let best = margins.enumerate().reduce(|a, b| if b.1 > a.1 { b } else { a });
            if let Some((n, _)) = best {
                self.over[star[n].index()].push(v);
            }
        }
    }

    /// Whether a point may be inserted into a face: not onto the rim, nor so close to a simplified part of it that a
    /// sliver would be left.
    fn clear_of_rim(&self, p: DVec2, face: Face) -> Result<(), Failure> {
        let corners = self.sheet.corners(face);
        for k in 0..3 {
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            let Some(segment) = self.edge(a, b).and_then(|e| self.sheet.segment_of(e)) else { continue };
            let [pa, pb] = [a, b].map(|c| self.sheet.cdt.vertex(FixedVertexHandle::from_index(c)).position());
            let (pa, pb) = (DVec2::new(pa.x, pa.y), DVec2::new(pb.x, pb.y));
            let distance = (pb - pa).perp_dot(p - pa) / (pb - pa).length().max(f64::MIN_POSITIVE);
            let bends = segment.span.filter(|s| s.to - s.from > 1);
            let least = if bends.is_some() { SLIVER * self.scene.tolerance } else { 0.0 };
            if distance.is_nan() || distance <= least {
                return Err(Failure::of_rim(bends.into_iter().collect()));
            }
        }
        Ok(())
    }

    fn edge(&self, a: usize, b: usize) -> Option<FixedDirectedEdgeHandle> {
        let [a, b] = [a, b].map(FixedVertexHandle::from_index);
        self.sheet.cdt.get_edge_from_neighbors(a, b).map(|e| e.fix())
    }

    fn outcome(self) -> Outcome {
        let mut outcome = Outcome { triangles: Vec::new(), deviations: vec![0.0; self.scene.rows.columns()] };
        for face in self.sheet.cdt.inner_faces().map(|f| f.fix()) {
            if !self.sheet.inner[face.index()] {
                continue;
            }
            let corners = self.sheet.corners(face);
            let ids = corners.map(|k| self.sheet.ids[k]);
            outcome.triangles.push(ids);
            for &v in &self.over[face.index()] {
                let (p, _) = self.sheet.frame.project(self.scene.mesh.positions[v as usize]);
                let weights = self.sheet.weights(corners, p).map(|w| w as f32);
                self.scene.rows.record(v, ids, weights, &mut outcome.deviations);
            }
        }
        outcome
    }
}
