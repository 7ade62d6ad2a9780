//! The plane of a patch, cut along its outline: a constrained Delaunay triangulation of the patch's rim.

use std::collections::HashMap;

use glam::DVec2;
use spade::handles::{FixedDirectedEdgeHandle, FixedFaceHandle, FixedVertexHandle, InnerTag};
use spade::{
    ConstrainedDelaunayTriangulation, Point2, PositionInTriangulation, Triangulation, mitigate_underflow,
};

use super::columns::Rows;
use super::regions::Frame;
use super::topology::side;
use crate::extract::TriMesh;

/// A triangle of the triangulation.
pub(super) type Face = FixedFaceHandle<InnerTag>;

/// Part of a chain: its number and the places where the part begins and ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Span {
    pub(super) chain: u32,
    pub(super) from: u32,
    pub(super) to: u32,
}

/// One straight piece of a patch's rim, with the patch on its left.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segment {
    pub(super) ends: [u32; 2],
    /// What it stands for; `None` for a side that cannot be simplified.
    pub(super) span: Option<Span>,
}

/// A patch that could not be triangulated or is too far away, and what is to blame. Nothing: the patch itself is.
#[derive(Clone, Debug, Default)]
pub(super) struct Failure {
    /// Parts of its rim, which must not be straightened so much.
    pub(super) spans: Vec<Span>,
    /// Triangles of the original, which must stay.
    pub(super) triangles: Vec<u32>,
}

impl Failure {
    pub(super) fn of_rim(spans: Vec<Span>) -> Self {
        Self { spans, triangles: Vec::new() }
    }
}

/// What every step of the work on a patch looks at.
#[derive(Clone, Copy)]
pub(super) struct Scene<'a> {
    pub(super) mesh: &'a TriMesh,
    pub(super) rows: &'a Rows,
    /// Largest height difference, world units.
    pub(super) tolerance: f64,
}

/// The triangulated plane.
pub(super) struct Sheet {
    pub(super) frame: Frame,
    pub(super) cdt: ConstrainedDelaunayTriangulation<Point2<f64>>,
    /// Vertex of the mesh and height, for each vertex of the triangulation.
    pub(super) ids: Vec<u32>,
    pub(super) heights: Vec<f64>,
    /// Whether a face (by its index) belongs to the patch.
    pub(super) inner: Vec<bool>,
    pub(super) segments: Vec<Segment>,
    /// From both ends (numbers in the triangulation, in the patch's direction) to the segment.
    rim: HashMap<[usize; 2], u32>,
}

pub(super) fn point(p: DVec2) -> Point2<f64> {
    mitigate_underflow(Point2::new(p.x, p.y))
}

impl Sheet {
    /// Cuts the plane along `segments`; `locked` triangles of the mesh are put in as they are.
    pub(super) fn new(
        scene: &Scene,
        frame: Frame,
        segments: Vec<Segment>,
        locked: &[u32],
    ) -> Result<Self, Failure> {
        let triangles = || locked.iter().map(|&t| &scene.mesh.triangles[t as usize]);
        let mut ids: Vec<u32> = segments.iter().flat_map(|s| s.ends).collect();
        ids.extend(triangles().flatten());
        ids.sort_unstable();
        ids.dedup();
        let number = |v: u32| ids.partition_point(|&i| i < v);
        let ends = |s: &Segment| s.ends.map(number);
        let mut edges: Vec<[usize; 2]> = segments.iter().map(ends).collect();
        let rim: HashMap<[usize; 2], u32> = edges.iter().copied().zip(0..).collect();
        for t in triangles() {
            let inner = (0..3).map(|k| side(t, k).map(number));
            // A side that is part of the rim is there already.
            edges.extend(inner.filter(|[a, b]| !rim.contains_key(&[*a, *b]) && !rim.contains_key(&[*b, *a])));
        }
        let places: Vec<(DVec2, f64)> =
            ids.iter().map(|&v| frame.project(scene.mesh.positions[v as usize])).collect();
        let points: Vec<Point2<f64>> = places.iter().map(|p| point(p.0)).collect();
        let mut conflicts = Vec::new();
        let cdt =
            ConstrainedDelaunayTriangulation::try_bulk_load_cdt(points, edges, |edge| conflicts.push(edge))
                .map_err(|_| Failure::default())?;
        // Two vertices above each other: the patch is no height field.
        if cdt.num_vertices() != ids.len() {
            return Err(Failure::default());
        }
        let inner = vec![false; cdt.num_all_faces()];
        let heights = places.iter().map(|p| p.1).collect();
        let mut sheet = Self { frame, cdt, ids, heights, inner, segments, rim };
        sheet.blame(&conflicts)?;
        sheet.flood()?;
        sheet.holds_all()?;
        Ok(sheet)
    }

    /// The segments that could not be put in, and those that are in their way. Sides of locked triangles may be left out.
    fn blame(&self, conflicts: &[[usize; 2]]) -> Result<(), Failure> {
        let segment = |a: usize, b: usize| self.rim.get(&[a, b]).or_else(|| self.rim.get(&[b, a]));
        let mut failure = Failure::default();
        let mut failed = false;
        for &[a, b] in conflicts {
            let Some(&s) = segment(a, b) else { continue };
            failed = true;
            failure.spans.extend(self.segments[s as usize].span);
            let [from, to] = [a, b].map(FixedVertexHandle::from_index);
            for edge in self.cdt.get_conflicting_edges_between_vertices(from, to) {
                let [c, d] = edge.vertices().map(|v| v.fix().index());
                if let Some(&s) = segment(c, d) {
                    failure.spans.extend(self.segments[s as usize].span);
                }
            }
        }
        if failed { Err(failure) } else { Ok(()) }
    }

    /// Marks the faces of the patch. Every segment must have the patch on its left and nothing of it on its right.
    fn flood(&mut self) -> Result<(), Failure> {
        let mut failure = Failure::default();
        let mut failed = false;
        let mut open = Vec::new();
        let directed = |ends: &[usize; 2]| {
            let [a, b] = ends.map(FixedVertexHandle::from_index);
            self.cdt.get_edge_from_neighbors(a, b)
        };
        let mut rim: Vec<(&[usize; 2], &u32)> = self.rim.iter().collect();
        rim.sort_unstable();
        for &(ends, &s) in &rim {
            match directed(ends).filter(|e| e.is_constraint_edge() && !e.face().is_outer()) {
                Some(edge) => open.push(edge.face().fix()),
                None => {
                    failed = true;
                    failure.spans.extend(self.segments[s as usize].span);
                }
            }
        }
        while let Some(face) = open.pop() {
            if std::mem::replace(&mut self.inner[face.index()], true) {
                continue;
            }
            let Some(face) = self.cdt.face(face).as_inner() else { continue };
            for edge in face.adjacent_edges() {
                if self.segment_of(edge.fix()).is_none() {
                    open.push(edge.rev().face().fix());
                }
            }
        }
        for &(ends, &s) in &rim {
            if directed(ends).is_some_and(|e| self.inner[e.rev().face().fix().index()]) {
                failed = true;
                failure.spans.extend(self.segments[s as usize].span);
            }
        }
        // Sides that are used twice do not bound anything.
        failed |= self.rim.len() != self.segments.len() || self.inner[self.cdt.outer_face().fix().index()];
        if failed { Err(failure) } else { Ok(()) }
    }

    /// Locked vertices must lie inside.
    fn holds_all(&self) -> Result<(), Failure> {
        let mut spans = Vec::new();
        let mut failed = false;
        for v in self.cdt.vertices() {
            if !v.out_edges().any(|e| self.inner[e.face().fix().index()]) {
                failed = true;
                spans.extend(self.nearest_segment(v.position()).and_then(|s| s.span));
            }
        }
        if failed { Err(Failure::of_rim(spans)) } else { Ok(()) }
    }

    /// The segment that an edge is part of, whichever its direction.
    pub(super) fn segment_of(&self, edge: FixedDirectedEdgeHandle) -> Option<&Segment> {
        let edge = self.cdt.directed_edge(edge);
        if !edge.is_constraint_edge() {
            return None;
        }
        let [a, b] = edge.vertices().map(|v| v.fix().index());
        let number = self.rim.get(&[a, b]).or_else(|| self.rim.get(&[b, a]))?;
        Some(&self.segments[*number as usize])
    }

    pub(super) fn nearest_segment(&self, p: Point2<f64>) -> Option<&Segment> {
        let p = DVec2::new(p.x, p.y);
        let place = |v: u32| {
            let at = self.ids.partition_point(|&i| i < v);
            let p = self.cdt.vertex(FixedVertexHandle::from_index(at)).position();
            DVec2::new(p.x, p.y)
        };
        let distance = |s: &Segment| {
            let [a, b] = s.ends.map(place);
            let along = b - a;
            let t = ((p - a).dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            (p - a - along * t).length_squared()
        };
        self.segments.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }

    /// The face of the patch that holds a point, or that it lies on the rim of. The search starts at `hint`, which
    /// follows.
    pub(super) fn face_at(&self, p: Point2<f64>, hint: &mut FixedVertexHandle) -> Option<Face> {
        let inner = |f: Face| Some(f).filter(|f| self.inner[f.index()]);
        // Of several the one with the lowest index, whichever way the search came.
        let first = |faces: &mut dyn Iterator<Item = Face>| faces.filter_map(inner).min_by_key(|f| f.index());
        match self.cdt.locate_with_hint(p, *hint) {
            PositionInTriangulation::OnFace(face) => {
                *hint = self.cdt.face(face).vertices()[0].fix();
                inner(face)
            }
            PositionInTriangulation::OnEdge(edge) => {
                let edge = self.cdt.directed_edge(edge);
                *hint = edge.from().fix();
                first(&mut [edge, edge.rev()].into_iter().filter_map(|e| Some(e.face().as_inner()?.fix())))
            }
            PositionInTriangulation::OnVertex(v) => {
                *hint = v;
                first(&mut self.star(v))
            }
            PositionInTriangulation::OutsideOfConvexHull(_) | PositionInTriangulation::NoTriangulation => {
                None
            }
        }
    }

    /// The faces round a vertex of the triangulation.
    pub(super) fn star(&self, v: FixedVertexHandle) -> impl Iterator<Item = Face> {
        self.cdt.vertex(v).out_edges().filter_map(|e| Some(e.face().as_inner()?.fix()))
    }

    /// Corners of a face (numbers in the triangulation, counter-clockwise).
    pub(super) fn corners(&self, face: Face) -> [usize; 3] {
        self.cdt.face(face).vertices().map(|v| v.fix().index())
    }

    fn place(&self, corner: usize) -> DVec2 {
        let p = self.cdt.vertex(FixedVertexHandle::from_index(corner)).position();
        DVec2::new(p.x, p.y)
    }

    /// Weights of a face's corners at a point of the plane: each at least 0, together 1.
    pub(super) fn weights(&self, corners: [usize; 3], p: DVec2) -> [f64; 3] {
        let [a, b, c] = corners.map(|k| self.place(k));
        let raw =
            [(b - p).perp_dot(c - p), (c - p).perp_dot(a - p), (a - p).perp_dot(b - p)].map(|w| w.max(0.0));
        let sum: f64 = raw.iter().sum();
        if sum > 0.0 { raw.map(|w| w / sum) } else { [1.0 / 3.0; 3] }
    }

    /// How much of the corners' least weight is missing for `p` to be inside: 0 or more if it is, in areas.
    pub(super) fn margin(&self, corners: [usize; 3], p: DVec2) -> f64 {
        let [a, b, c] = corners.map(|k| self.place(k));
        (b - p).perp_dot(c - p).min((c - p).perp_dot(a - p)).min((a - p).perp_dot(b - p))
    }

    /// Height of a vertex of the mesh above a face, world units.
    pub(super) fn gap(&self, scene: &Scene, v: u32, face: Face) -> f64 {
        let (p, height) = self.frame.project(scene.mesh.positions[v as usize]);
        let corners = self.corners(face);
        let weights = self.weights(corners, p);
        let surface: f64 = (0..3).map(|k| weights[k] * self.heights[corners[k]]).sum();
        (height - surface).abs()
    }

    /// The error at a vertex of the mesh over a face, of height and attributes, in tolerances.
    pub(super) fn error(&self, scene: &Scene, v: u32, face: Face) -> f32 {
        let (p, _) = self.frame.project(scene.mesh.positions[v as usize]);
        let corners = self.corners(face);
        let weights = self.weights(corners, p).map(|w| w as f32);
        let height = (self.gap(scene, v, face) / scene.tolerance) as f32;
        height.max(scene.rows.deviation(v, corners.map(|k| self.ids[k]), weights))
    }
}
