//! Triangulates all patches, checks the whole, and does those again that failed, with less simplified rims; what keeps
//! failing stays as it was.

use rayon::prelude::*;

use super::chains::{Chain, Chains, Limits, simplify_chains};
use super::columns::Rows;
use super::homes::Homes;
use super::measure::{Surface, new_to_old, old_to_new};
use super::refine::{Outcome, refine};
use super::regions::{NONE, Regions};
use super::sheet::{Face, Failure, Scene, Segment, Sheet, Span};
use super::topology::{Topology, sorted_sides};
use super::{Simplified, SimplifyReport};
use crate::extract::TriMesh;

/// A patch that fails more often is not tried again.
const PATIENT: u32 = 10;
/// As often a rim to blame gets three more vertices; afterwards it gets all of them.
const GENTLE: u32 = 3;
/// A patch with more triangles is divided before it is kept.
const SMALL: usize = 32;
/// A rim may leave the surface by this share of the tolerance.
const RIM_SHARE: f32 = 0.5;
/// A rim may run beside its old course by this many mean edges: marched rims zigzag by one.
const RIM_EDGES: f32 = 2.0;

/// The state of the work.
pub(super) struct Rounds<'a> {
    scene: Scene<'a>,
    tolerance: f32,
    mean_edge: f32,
    topology: Topology,
    regions: Regions,
    chains: Chains,
    /// Patches that have a chain in common with each patch.
    beside: Vec<Vec<u32>>,
    /// Vertices of chains that must stay.
    required: Vec<bool>,
    /// Triangles of each patch that must stay, and since which round.
    locked: Vec<Vec<(u32, usize)>>,
    /// How often each patch failed.
    tries: Vec<u32>,
    /// Patches that stay as they are.
    kept: Vec<bool>,
    /// Places along each chain of the vertices that stay.
    runs: Vec<Vec<u32>>,
    /// Patches to divide before the next round.
    to_split: Vec<u32>,
    homes: Homes,
    outcomes: Vec<Outcome>,
    distances: Vec<f32>,
    round: usize,
}

impl<'a> Rounds<'a> {
    pub(super) fn new(mesh: &'a TriMesh, rows: &'a Rows, tolerance: f32) -> Self {
        let topology = Topology::new(mesh);
        let regions = Regions::grow(mesh, &topology);
        let chains = Chains::trace(mesh, &topology, &regions);
        let patches = regions.members.len();
        let sides = mesh.triangles.len() as f64 * 3.0;
        let lengths = (0..mesh.triangles.len()).map(|t| {
            let [a, b, c] = mesh.corners(t);
            f64::from(a.distance(b) + b.distance(c) + c.distance(a))
        });
        Self {
            scene: Scene { mesh, rows, tolerance: f64::from(tolerance) },
            tolerance,
            mean_edge: (lengths.sum::<f64>() / sides) as f32,
            required: chains.ends.clone(),
            runs: vec![Vec::new(); chains.all.len()],
            homes: Homes::new(mesh.positions.len(), rows.columns()),
            outcomes: vec![Outcome::default(); patches],
            distances: vec![0.0; patches],
            locked: vec![Vec::new(); patches],
            tries: vec![0; patches],
            kept: vec![false; patches],
            beside: chains.beside(),
            to_split: Vec::new(),
            round: 0,
            topology,
            regions,
            chains,
        }
    }

    pub(super) fn run(mut self) -> Simplified {
        let mut dirty = vec![true; self.kept.len()];
        let mut unmeasured = vec![false; self.kept.len()];
        let original = Surface::new(&self.scene.mesh.positions, &self.scene.mesh.triangles);
        loop {
            let redo = self.widened(&dirty);
            let mut failures = self.triangulate(&dirty, &redo);
            unmeasured.iter_mut().zip(&redo).for_each(|(u, &r)| *u |= r);
            if failures.is_empty() {
                failures = self.tangled();
            }
            if failures.is_empty() {
                failures = self.measure(&original, &unmeasured);
                unmeasured.fill(false);
            }
            if failures.is_empty() {
                return self.finish();
            }
            dirty.fill(false);
            for (patch, failure) in failures {
                dirty[patch as usize] = true;
                self.relent(patch, &failure, &mut dirty);
            }
            self.split(&mut dirty, &mut unmeasured);
            self.round += 1;
        }
    }

    /// The patches and those beside them.
    fn widened(&self, dirty: &[bool]) -> Vec<bool> {
        let near = |p: usize| dirty[p] || self.beside[p].iter().any(|&q| dirty[q as usize]);
        (0..dirty.len()).map(near).collect()
    }

    /// Simplifies the rims of `dirty` patches and triangulates those of `redo`.
    fn triangulate(&mut self, dirty: &[bool], redo: &[bool]) -> Vec<(u32, Failure)> {
        let touched = |c: &Chain| dirty[c.left as usize] || c.right != NONE && dirty[c.right as usize];
        let due = |n: &u32| self.runs[*n as usize].is_empty() || touched(&self.chains.all[*n as usize]);
        let which: Vec<u32> = (0..self.chains.all.len() as u32).filter(due).collect();
        let Scene { mesh, rows, .. } = self.scene;
        let limits = Limits {
            border: self.tolerance,
            off: RIM_SHARE * self.tolerance,
            along: RIM_EDGES * self.mean_edge,
        };
        let runs = simplify_chains(&self.chains.all, &which, mesh, rows, &self.required, limits);
        for (&c, run) in which.iter().zip(runs) {
            self.homes.set_rim(&self.chains.all[c as usize].vertices, &run);
            self.runs[c as usize] = run;
        }
        let sheets: Vec<Option<Result<Sheet, Failure>>> = (0..redo.len())
            .into_par_iter()
            .map(|p| (redo[p] && !self.kept[p]).then(|| self.sheet(p)))
            .collect();
        let mut failures = Vec::new();
        let mut ready = Vec::with_capacity(sheets.len());
        for (p, sheet) in sheets.into_iter().enumerate() {
            ready.push(match sheet {
                None => None,
                Some(Ok(sheet)) => Some(sheet),
                Some(Err(failure)) => {
                    failures.push((p as u32, failure));
                    None
                }
            });
        }
        let near = self.mean_edge * RIM_EDGES;
        let mut failed = vec![false; redo.len()];
        failures.iter().for_each(|f| failed[f.0 as usize] = true);
        let points = self.homes.settle(
            &self.scene,
            &self.chains,
            &self.beside,
            &ready,
            redo,
            &failed,
            near,
            &mut failures,
        );
        let outcomes: Vec<Option<Result<Outcome, Failure>>> = ready
            .into_par_iter()
            .zip(points)
            .enumerate()
            .map(|(p, (sheet, points))| sheet.map(|sheet| self.outcome(p, sheet, &points)))
            .collect();
        for (p, outcome) in outcomes.into_iter().enumerate() {
            match outcome {
                None => {}
                Some(Ok(outcome)) => self.outcomes[p] = outcome,
                Some(Err(failure)) => failures.push((p as u32, failure)),
            }
        }
        for p in (0..redo.len()).filter(|&p| redo[p] && self.kept[p]) {
            let triangles = self.regions.members[p].iter().map(|&t| mesh.triangles[t as usize]).collect();
            self.outcomes[p] = Outcome { triangles, deviations: vec![0.0; rows.columns()] };
        }
        failures
    }

    /// The plane of a patch, cut along its rim as it is now.
    fn sheet(&self, p: usize) -> Result<Sheet, Failure> {
        let mut segments: Vec<Segment> =
            self.chains.fixed[p].iter().map(|&ends| Segment { ends, span: None }).collect();
        for &number in &self.chains.of_patch[p] {
            let chain = &self.chains.all[number as usize];
            for piece in self.runs[number as usize].windows(2) {
                let [from, to] = [piece[0], piece[1]];
                let mut ends = [from, to].map(|i| chain.vertices[i as usize]);
                if chain.left as usize != p {
                    ends.reverse();
                }
                segments.push(Segment { ends, span: Some(Span { chain: number, from, to }) });
            }
        }
        let locked: Vec<u32> = self.locked[p].iter().map(|l| l.0).collect();
        Sheet::new(&self.scene, self.regions.frames[p], segments, &locked)
    }

    fn outcome(&self, p: usize, sheet: Sheet, points: &[(u32, Face)]) -> Result<Outcome, Failure> {
        let removed: usize =
            sheet.segments.iter().filter_map(|s| s.span).map(|s| (s.to - s.from - 1) as usize).sum();
        let outcome = refine(&self.scene, sheet, points)?;
        let before = self.regions.members[p].iter().map(|&t| self.scene.mesh.triangles[t as usize]);
        // Each vertex that the rim lost took an edge with it.
        let same = characteristic(before, 0) == characteristic(outcome.triangles.iter().copied(), removed);
        if same { Ok(outcome) } else { Err(Failure::default()) }
    }

    /// Makes room for a patch that failed: more vertices on the rims to blame, or else it stays as it was.
    fn relent(&mut self, patch: u32, failure: &Failure, dirty: &mut [bool]) {
        let (mut more, tries) = (false, self.tries[patch as usize]);
        self.tries[patch as usize] += 1;
        let patient = tries < PATIENT;
        for span in failure.spans.iter().filter(|_| patient) {
            let chain = &self.chains.all[span.chain as usize];
            let inside = span.from + 1..span.to;
            let length = span.to - span.from;
            let gentle = tries < GENTLE;
            for i in inside.filter(|i| !gentle || (1..4).any(|q| span.from + (q * length).div_ceil(4) == *i))
            {
                self.required[chain.vertices[i as usize] as usize] = true;
            }
            // Also if the patch on the other side asked for the same in this round.
            more |= length > 1;
            for side in [chain.left, chain.right].into_iter().filter(|&s| s != NONE) {
                dirty[side as usize] = true;
            }
        }
        if patient {
            failure.triangles.iter().for_each(|&t| more |= self.lock(t, dirty));
        }
        if !more && !self.kept[patch as usize] {
            if self.regions.members[patch as usize].len() > SMALL {
                self.to_split.push(patch);
            } else {
                self.keep(patch, dirty);
            }
        }
    }

    /// Divides the patches that failed for good, so that as little as possible of them must stay as it was.
    fn split(&mut self, dirty: &mut Vec<bool>, unmeasured: &mut Vec<bool>) {
        if self.to_split.is_empty() {
            return;
        }
        for patch in std::mem::take(&mut self.to_split) {
            self.regions.split(&self.topology, patch);
            self.tries[patch as usize] = 0;
            dirty.resize(self.regions.members.len(), true);
        }
        let patches = self.regions.members.len();
        unmeasured.resize(patches, true);
        self.outcomes.resize(patches, Outcome::default());
        self.distances.resize(patches, 0.0);
        self.tries.resize(patches, 0);
        self.kept.resize(patches, false);
        let locked: Vec<(u32, usize)> = self.locked.concat();
        self.locked = vec![Vec::new(); patches];
        for lock in locked {
            self.locked[self.regions.of[lock.0 as usize] as usize].push(lock);
        }
        self.chains = Chains::trace(self.scene.mesh, &self.topology, &self.regions);
        self.beside = self.chains.beside();
        for (v, end) in self.chains.ends.iter().enumerate().filter(|(_, end)| **end) {
            self.required[v] = *end;
        }
        // All chains are new, though most of them run as before.
        self.runs = vec![Vec::new(); self.chains.all.len()];
    }

    /// Keeps a triangle. Whether it was not kept before this round.
    fn lock(&mut self, t: u32, dirty: &mut [bool]) -> bool {
        let patch = self.regions.of[t as usize];
        if patch == NONE || self.kept[patch as usize] {
            return false;
        }
        if let Some((_, round)) = self.locked[patch as usize].iter().find(|l| l.0 == t) {
            return *round == self.round;
        }
        self.locked[patch as usize].push((t, self.round));
        dirty[patch as usize] = true;
        for &v in &self.scene.mesh.triangles[t as usize] {
            self.homes.lock(v);
            self.required[v as usize] = true;
            // Its chains belong to all its owners.
            for owner in self.chains.owners[v as usize].into_iter().filter(|&o| o != NONE) {
                dirty[owner as usize] = true;
            }
        }
        true
    }

    /// Keeps all triangles of a patch, and so its whole rim.
    fn keep(&mut self, patch: u32, dirty: &mut [bool]) {
        self.kept[patch as usize] = true;
        dirty[patch as usize] = true;
        for &t in &self.regions.members[patch as usize] {
            for &v in &self.scene.mesh.triangles[t as usize] {
                self.homes.lock(v);
                self.required[v as usize] = true;
            }
        }
        for &q in &self.beside[patch as usize] {
            dirty[q as usize] = true;
        }
    }

    /// All triangles with their patches: those without area first, which belong to none.
    fn triangles(&self) -> (Vec<[u32; 3]>, Vec<u32>) {
        let all = self.scene.mesh.triangles.iter().zip(&self.topology.frozen);
        let mut triangles: Vec<[u32; 3]> = all.filter(|(_, frozen)| **frozen).map(|(t, _)| *t).collect();
        let mut patches = vec![NONE; triangles.len()];
        for (p, outcome) in self.outcomes.iter().enumerate() {
            triangles.extend(&outcome.triangles);
            patches.resize(triangles.len(), p as u32);
        }
        (triangles, patches)
    }

    /// Patches that use an edge, or all corners of a triangle, that others use as well: on both sides of something thin.
    fn tangled(&self) -> Vec<(u32, Failure)> {
        let (triangles, patches) = self.triangles();
        let mut tangled = Vec::new();
        let patch = |side: &(u32, u32, u32)| patches[side.2 as usize / 3];
        let free = |p: &u32| *p != NONE && !self.kept[*p as usize];
        for edge in sorted_sides(&triangles).chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
            let start = |s: &(u32, u32, u32)| triangles[s.2 as usize / 3][s.2 as usize % 3];
            let far = |s: &(u32, u32, u32)| {
                triangles[s.2 as usize / 3][(s.2 as usize + 2 - s.2 as usize / 3 * 3) % 3]
            };
            let sound = match edge {
                [_] => true,
                [x, y] => start(x) != start(y) && far(x) != far(y),
                _ => false,
            };
            if !sound && !self.was_singular(edge[0].0, edge[0].1) {
                tangled.extend(edge.iter().map(patch).filter(free).max());
            }
        }
        tangled.sort_unstable();
        tangled.dedup();
        let failure = |p: u32| {
            let sides = self.chains.of_patch[p as usize].iter();
            let spans = sides.flat_map(|&c| {
                let pieces = self.runs[c as usize].windows(2);
                pieces.map(move |w| Span { chain: c, from: w[0], to: w[1] })
            });
            (p, Failure { spans: spans.filter(|s| s.to - s.from > 1).collect(), triangles: Vec::new() })
        };
        tangled.into_iter().map(failure).collect()
    }

    /// Whether an edge was not between two triangles in the original.
    fn was_singular(&self, a: u32, b: u32) -> bool {
        let singular = |v: u32| self.chains.ends[v as usize];
        let same = |e: &[u32; 2]| *e == [a, b] || *e == [b, a];
        singular(a) && singular(b) && self.chains.fixed.iter().flatten().any(same)
    }

    /// Measures the distances of some patches and the original; fails those that are too far away.
    fn measure(&mut self, original: &Surface, which: &[bool]) -> Vec<(u32, Failure)> {
        let mesh = self.scene.mesh;
        let (triangles, _) = self.triangles();
        let now = Surface::new(&mesh.positions, &triangles);
        let mut failures = Vec::new();
        for p in (0..which.len()).filter(|&p| which[p] && !self.kept[p]) {
            let members = &self.regions.members[p];
            let old = old_to_new(mesh, members, &now);
            let mut bad: Vec<u32> =
                members.iter().zip(&old).filter(|(_, d)| **d > self.tolerance).map(|(t, _)| *t).collect();
            let new = &self.outcomes[p].triangles;
            let new = new_to_old(&mesh.positions, new, original, self.mean_edge, self.tolerance);
            bad.extend(new.iter().flat_map(|(_, beyond)| beyond));
            self.distances[p] = old.iter().chain(new.iter().map(|(d, _)| d)).copied().fold(0.0, f32::max);
            if !bad.is_empty() {
                bad.sort_unstable();
                bad.dedup();
                failures.push((p as u32, Failure { spans: Vec::new(), triangles: bad }));
            }
        }
        failures
    }

    fn finish(self) -> Simplified {
        let (triangles, _) = self.triangles();
        let mut mesh = TriMesh { positions: self.scene.mesh.positions.clone(), triangles };
        let kept_vertices = mesh.drop_unused_vertices();
        let mut deviations = self.homes.deviations;
        for outcome in &self.outcomes {
            deviations.iter_mut().zip(&outcome.deviations).for_each(|(d, &o)| *d = d.max(o));
        }
        let distances = self.distances.iter().zip(&self.kept).filter(|(_, kept)| !**kept).map(|(d, _)| *d);
        let report = SimplifyReport {
            triangles_before: self.scene.mesh.triangles.len(),
            triangles_after: mesh.triangles.len(),
            patches: self.kept.len(),
            kept_patches: self.kept.iter().filter(|&&k| k).count(),
            max_distance: distances.fold(0.0, f32::max),
            deviations,
        };
        Simplified { mesh, kept_vertices, report }
    }
}

/// Twice (vertices − edges + faces) of a part of a mesh, plus twice a correction, less the rim's edges, which are the
/// same before and after but for that correction.
fn characteristic(triangles: impl Iterator<Item = [u32; 3]>, removed: usize) -> i64 {
    let (mut corners, mut faces): (Vec<u32>, i64) = (Vec::new(), 0);
    for t in triangles {
        corners.extend(t);
        faces += 1;
    }
    corners.sort_unstable();
    corners.dedup();
    // E = (3F + B) / 2, so 2(V − E + F) = 2V − F − B; V and B both lose what the rim lost.
    2 * corners.len() as i64 - faces + removed as i64
}
