//! Which patch answers for a vertex that is not on a rim.
//!
//! Usually the patch that it was in. Where a rim was straightened, a strip beside it changed hands, and its vertices are
//! over the neighbour's surface.

use rayon::prelude::*;
use spade::handles::FixedVertexHandle;

use super::chains::Chains;
use super::regions::NONE;
use super::sheet::{Face, Failure, Scene, Sheet, point};

pub(super) struct Homes {
    /// Patch of each vertex; [`NONE`] if it has none yet or needs none.
    of: Vec<u32>,
    /// Whether a vertex is in the new mesh whatever else is.
    stays: Vec<bool>,
    /// The same, for good.
    locked: Vec<bool>,
    /// Largest deviations of the columns at vertices over nobody's surface, beside a rim.
    pub(super) deviations: Vec<f32>,
}

/// Vertices over the surface of each patch, with the faces that they are over.
type Points = Vec<Vec<(u32, Face)>>;

impl Homes {
    pub(super) fn new(vertices: usize, columns: usize) -> Self {
        Self {
            of: vec![NONE; vertices],
            stays: vec![false; vertices],
            locked: vec![false; vertices],
            deviations: vec![0.0; columns],
        }
    }

    /// Notes which vertices of a chain are in the mesh.
    pub(super) fn set_rim(&mut self, chain: &[u32], run: &[u32]) {
        for &v in &chain[1..chain.len() - 1] {
            self.stays[v as usize] = self.locked[v as usize];
        }
        for &i in run {
            self.stays[chain[i as usize] as usize] = true;
        }
    }

    /// Notes that a vertex stays for good.
    pub(super) fn lock(&mut self, v: u32) {
        self.locked[v as usize] = true;
        self.stays[v as usize] = true;
        self.of[v as usize] = NONE;
    }

    /// Finds homes among the sheets of this round for all vertices that have none or whose home is done again. Those that
    /// are over no surface must be close to the rim; else its owner fails.
    #[allow(clippy::too_many_arguments)]
    pub(super) fn settle(
        &mut self,
        scene: &Scene,
        chains: &Chains,
        beside: &[Vec<u32>],
        sheets: &[Option<Sheet>],
        redo: &[bool],
        failed: &[bool],
        near: f32,
        failures: &mut Vec<(u32, Failure)>,
    ) -> Points {
        let mut waiting = vec![Vec::new(); sheets.len()];
        for v in 0..self.of.len() {
            let (home, owner) = (self.of[v], chains.owners[v][0]);
            if self.stays[v] || owner == NONE || chains.ends[v] {
                self.of[v] = NONE;
            } else if home == NONE || redo[home as usize] {
                self.of[v] = NONE;
                waiting[owner as usize].push(v as u32);
            }
        }
        let settled: Vec<Settled> = waiting
            .par_iter()
            .enumerate()
            .map(|(p, vertices)| settle_patch(scene, chains, beside, sheets, failed, p, vertices, near))
            .collect();
        let mut points: Points = vec![Vec::new(); sheets.len()];
        for (p, settled) in settled.into_iter().enumerate() {
            for (v, patch, face) in settled.found {
                self.of[v as usize] = patch;
                points[patch as usize].push((v, face));
            }
            if let Some(failure) = settled.failure {
                failures.push((p as u32, failure));
            }
            self.deviations.iter_mut().zip(&settled.deviations).for_each(|(a, &b)| *a = a.max(b));
        }
        points
    }
}

/// What became of the vertices of one patch.
struct Settled {
    /// Vertex, patch and face.
    found: Vec<(u32, u32, Face)>,
    failure: Option<Failure>,
    deviations: Vec<f32>,
}

#[allow(clippy::too_many_arguments)]
fn settle_patch(
    scene: &Scene,
    chains: &Chains,
    beside: &[Vec<u32>],
    sheets: &[Option<Sheet>],
    failed: &[bool],
    patch: usize,
    vertices: &[u32],
    near: f32,
) -> Settled {
    let mut settled =
        Settled { found: Vec::new(), failure: None, deviations: vec![0.0; scene.rows.columns()] };
    let mut hint = FixedVertexHandle::from_index(0);
    for &v in vertices {
        if let Some(sheet) = &sheets[patch]
            && let Some(face) =
                sheet.face_at(point(sheet.frame.project(scene.mesh.positions[v as usize]).0), &mut hint)
        {
            settled.found.push((v, patch as u32, face));
            continue;
        }
        let other = chains.owners[v as usize][1];
        if let Some((at, face)) = adopt(scene, beside, sheets, patch, other, v, near) {
            settled.found.push((v, at, face));
            continue;
        }
        // Its home may be one that is done again because it failed; it will be asked then.
        let open = around(beside, patch, other).any(|q| failed[q as usize]);
        if let Some(sheet) = sheets[patch].as_ref().filter(|_| !open) {
            beside_rim(scene, sheet, v, &mut settled);
        }
    }
    settled
}

/// The patches beside either owner of a vertex.
fn around(beside: &[Vec<u32>], patch: usize, other: u32) -> impl Iterator<Item = u32> {
    beside[patch].iter().chain(beside.get(other as usize).into_iter().flatten()).copied()
}

/// The neighbour whose surface is nearest to a vertex, if it is near, and the face.
fn adopt(
    scene: &Scene,
    beside: &[Vec<u32>],
    sheets: &[Option<Sheet>],
    patch: usize,
    other: u32,
    v: u32,
    near: f32,
) -> Option<(u32, Face)> {
    let mut best: Option<(f64, u32, Face)> = None;
    for q in around(beside, patch, other).filter(|&q| q as usize != patch) {
        let Some(sheet) = &sheets[q as usize] else { continue };
        let p = point(sheet.frame.project(scene.mesh.positions[v as usize]).0);
        let Some(face) = sheet.face_at(p, &mut FixedVertexHandle::from_index(0)) else { continue };
        let gap = sheet.gap(scene, v, face);
        if gap <= f64::from(near) && best.is_none_or(|b| gap < b.0) {
            best = Some((gap, q, face));
        }
    }
    best.map(|(_, q, face)| (q, face))
}

/// Checks a vertex that is over no surface against the nearest segment of the rim.
fn beside_rim(scene: &Scene, sheet: &Sheet, v: u32, settled: &mut Settled) {
    let place = |v: u32| glam::Vec3A::from_array(scene.mesh.positions[v as usize]);
    let p = point(sheet.frame.project(scene.mesh.positions[v as usize]).0);
    let Some(segment) = sheet.nearest_segment(p) else { return };
    let [a, b] = segment.ends.map(place);
    let (along, to) = (b - a, place(v) - a);
    let t = (to.dot(along) / along.length_squared().max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
    let weights = [1.0 - t, t];
    let distance = (to - along * t).length() / scene.tolerance as f32;
    if distance.max(scene.rows.deviation(v, segment.ends, weights)) <= 1.0 {
        scene.rows.record(v, segment.ends, weights, &mut settled.deviations);
    } else {
        settled.failure.get_or_insert_default().spans.extend(segment.span);
    }
}
