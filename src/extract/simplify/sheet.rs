//! The plane of a patch, cut along its rim: constrained Delaunay triangulation.

use glam::DVec2;
use spade::handles::{FixedDirectedEdgeHandle, FixedFaceHandle, FixedVertexHandle, InnerTag};
use spade::{
    ConstrainedDelaunayTriangulation, Point2, PositionInTriangulation, Triangulation, mitigate_underflow,
};

use super::regions::Frame;
use super::scene::Scene;

/// A triangle of the triangulation.
pub(super) type Face = FixedFaceHandle<InnerTag>;

/// The triangulated plane.
pub(super) struct Sheet {
    pub(super) frame: Frame,
    pub(super) cdt: ConstrainedDelaunayTriangulation<Point2<f64>>,
    /// Vertex of the original and height, for each vertex of the triangulation.
    pub(super) ids: Vec<u32>,
    pub(super) heights: Vec<f64>,
    /// Whether a face (by its index) belongs to the patch.
    pub(super) inner: Vec<bool>,
}

pub(super) fn point(p: DVec2) -> Point2<f64> {
    mitigate_underflow(Point2::new(p.x, p.y))
}

impl Sheet {
    /// Cuts the plane along a rim, given by its sides, each with the patch on its left. `None` if the rim crosses or
    /// touches itself in the plane, or is turned inside out.
    pub(super) fn new(scene: &Scene, frame: Frame, rim: &[[u32; 2]]) -> Option<Self> {
        let mut ids: Vec<u32> = rim.iter().flatten().copied().collect();
        ids.sort_unstable();
        ids.dedup();
        let number = |v: u32| ids.partition_point(|&i| i < v);
        let edges: Vec<[usize; 2]> = rim.iter().map(|side| side.map(number)).collect();
        let places: Vec<(DVec2, f64)> = ids.iter().map(|&v| frame.project(scene.position(v))).collect();
        let points: Vec<Point2<f64>> = places.iter().map(|p| point(p.0)).collect();
        let mut conflicts = 0;
        let bulk =
            ConstrainedDelaunayTriangulation::try_bulk_load_cdt(points, edges.clone(), |_| conflicts += 1);
        let cdt = bulk.ok()?;
        if conflicts > 0 || cdt.num_vertices() != ids.len() || cdt.num_constraints() != edges.len() {
            return None;
        }
        let inner = vec![false; cdt.num_all_faces()];
        let heights = places.iter().map(|p| p.1).collect();
        let mut sheet = Self { frame, cdt, ids, heights, inner };
        sheet.flood(&edges)?;
        Some(sheet)
    }

    /// Marks the faces of the patch. Every side must have the patch on its left and nothing of it on its right.
    fn flood(&mut self, rim: &[[usize; 2]]) -> Option<()> {
        let directed = |ends: &[usize; 2]| {
            let [a, b] = ends.map(FixedVertexHandle::from_index);
            self.cdt.get_edge_from_neighbors(a, b)
        };
        let mut open = Vec::with_capacity(rim.len());
        for ends in rim {
            open.push(directed(ends)?.face().as_inner()?.fix());
        }
        while let Some(face) = open.pop() {
            if std::mem::replace(&mut self.inner[face.index()], true) {
                continue;
            }
            for edge in self.cdt.face(face).adjacent_edges() {
                if !edge.is_constraint_edge() {
                    open.push(edge.rev().face().as_inner()?.fix());
                }
            }
        }
        let free =
            |ends: &[usize; 2]| directed(ends).is_some_and(|e| !self.inner[e.rev().face().fix().index()]);
        rim.iter().all(free).then_some(())
    }

    /// The face of the patch that holds a point, or, if rounding put it across the rim, the one beside it there. The search
    /// starts at `hint`, which follows.
    pub(super) fn face_at(&self, p: Point2<f64>, hint: &mut FixedVertexHandle) -> Option<Face> {
        let inner = |f: Face| self.inner[f.index()];
        let faces = |edge: FixedDirectedEdgeHandle| {
            let edge = self.cdt.directed_edge(edge);
            [edge, edge.rev()].into_iter().filter_map(|e| Some(e.face().as_inner()?.fix()))
        };
        match self.cdt.locate_with_hint(p, *hint) {
            PositionInTriangulation::OnFace(face) => {
                let corners = self.cdt.face(face);
                *hint = corners.vertices()[0].fix();
                let mut near = std::iter::once(face)
                    .chain(corners.adjacent_edges().map(|e| e.fix()).into_iter().flat_map(faces));
                near.find(|&f| inner(f))
            }
            PositionInTriangulation::OnEdge(edge) => {
                *hint = self.cdt.directed_edge(edge).from().fix();
                // Of two the one with the lower index, whichever way the search came.
                faces(edge).filter(|&f| inner(f)).min_by_key(|f| f.index())
            }
            PositionInTriangulation::OnVertex(v) => {
                *hint = v;
                self.star(v).filter(|&f| inner(f)).min_by_key(|f| f.index())
            }
            PositionInTriangulation::OutsideOfConvexHull(edge) => faces(edge).find(|&f| inner(f)),
            PositionInTriangulation::NoTriangulation => None,
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

    fn places(&self, corners: [usize; 3]) -> [DVec2; 3] {
        corners.map(|corner| {
            let p = self.cdt.vertex(FixedVertexHandle::from_index(corner)).position();
            DVec2::new(p.x, p.y)
        })
    }

    /// Twice the areas of the triangles that a point makes with each side of a face, that of the first corner first: all from
    /// 0 if it is inside.
    pub(super) fn areas(&self, corners: [usize; 3], p: DVec2) -> [f64; 3] {
        let [a, b, c] = self.places(corners);
        [(b - p).perp_dot(c - p), (c - p).perp_dot(a - p), (a - p).perp_dot(b - p)]
    }

    /// Whether a face has a side on the rim that a point is on, or beyond.
    pub(super) fn is_at_rim(&self, face: Face, p: DVec2) -> bool {
        // The edges start at the corners in order, so the one opposite to corner k is the next.
        let areas = self.areas(self.corners(face), p);
        let edges = self.cdt.face(face).adjacent_edges();
        (0..3).any(|k| edges[(k + 1) % 3].is_constraint_edge() && (areas[k] <= 0.0 || areas[k].is_nan()))
    }
}
