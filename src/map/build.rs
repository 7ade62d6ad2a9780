//! From a trained field to its map, stage by stage.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use divff_exporters::Geometry;
use glam::{Vec3, Vec3A};

use super::config::MapConfig;
use super::error::MapError;
use super::{MapObject, SemanticMap, Skipped, moving, persistent, place, points, times, views};
use crate::config::Config;
use crate::extract::{GridReport, GridSpec};
use crate::field::Stream;
use crate::render::forward::Model;
use crate::render::sampler::Sampling;
use crate::scene::Scene;
use crate::train::Trained;
use crate::work::Work;

/// The stages of [`build`] in order, and the one after it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Depth of every training frame.
    Depth,
    /// The persistent surface.
    Persistent,
    /// The dynamic surface at each time.
    Dynamic,
    /// The actor's surface at each time.
    Actor,
    /// The point cloud.
    Points,
    /// Fewer triangles, after all attributes are there: [`super::simplify`].
    Simplify,
}

/// How far [`build`] has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Current stage.
    pub stage: Stage,
    /// Items of the stage that are done.
    pub done: usize,
    /// Items of the stage.
    pub total: usize,
}

/// What all stages look at.
pub(super) struct Context<'a> {
    pub(super) scene: &'a Scene,
    pub(super) config: &'a MapConfig,
    pub(super) model: Model<'a>,
    pub(super) sampling: Sampling,
    /// World units.
    pub(super) voxel: f64,
    pub(super) spec: GridSpec,
    pub(super) offset: [f64; 3],
    /// Blocks of all grids in which there was nothing to look at. A count: in which order it grows does not matter.
    skipped_blocks: AtomicUsize,
}

/// The map as far as it is built.
pub(super) struct Builder<'a> {
    pub(super) cx: Context<'a>,
    pub(super) map: SemanticMap,
    progress: &'a mut dyn FnMut(Progress),
}

/// Extracts the map of a trained field.
///
/// The result depends on its arguments alone, whatever the number of threads.
///
/// # Errors
/// A setting out of range, a time that no frame has, a training image that cannot be read, a grid that does not fit
/// into memory, or a field with numbers that are not finite.
pub fn build(
    scene: &Scene,
    trained: &Trained,
    config: &Config,
    progress: &mut dyn FnMut(Progress),
) -> Result<SemanticMap, MapError> {
    config.map.validate()?;
    let mut b = Builder::new(scene, trained, config, progress);
    let moments = times::resolve(scene, &config.map.times)?;
    let seen = views::look_from_all(&mut b)?;
    persistent::extract(&mut b, &seen)?;
    moving::extract_dynamic(&mut b, &seen, &moments)?;
    moving::extract_actor(&mut b, &moments)?;
    points::sample(&mut b)?;
    let blocks = b.cx.skipped_blocks.load(Ordering::Relaxed);
    b.save("empty_blocks", GridReport::work(blocks));
    Ok(b.map)
}

impl<'a> Builder<'a> {
    pub(super) fn new(
        scene: &'a Scene,
        trained: &'a Trained,
        config: &'a Config,
        progress: &'a mut dyn FnMut(Progress),
    ) -> Self {
        let n = trained.field.normalisation;
        let voxel = config.map.voxel_size.unwrap_or_else(|| place::default_voxel(&n));
        let (up_axis, up_is_known) = place::up_axis(scene);
        let name = scene.root.file_name().map(|n| n.to_string_lossy().into_owned());
        let map = SemanticMap {
            geometries: Vec::new(),
            objects: Vec::new(),
            points: Geometry { name: "points".into(), ..Geometry::default() },
            features: Vec::new(),
            affordances: Vec::new(),
            skipped: Vec::new(),
            saved: BTreeMap::new(),
            simplified: Vec::new(),
            up_axis,
            up_is_known,
            normalisation: n,
            voxel_size: voxel,
            source_id: name.unwrap_or_else(|| scene.root.display().to_string()),
            seed: config.seed,
            animation_seconds: config.map.animation_seconds,
        };
        let cx = Context {
            scene,
            config: &config.map,
            model: Model::new(&trained.field, &trained.grids, [true; 3]),
            sampling: Sampling { count: config.map.depth_samples, ..config.train.render_sampling() },
            voxel,
            spec: place::grid(&n, voxel),
            offset: place::offset(&n, voxel),
            skipped_blocks: AtomicUsize::new(0),
        };
        Self { cx, map, progress }
    }

    pub(super) fn report(&mut self, stage: Stage, done: usize, total: usize) {
        (self.progress)(Progress { stage, done, total });
    }

    pub(super) fn skip(&mut self, what: impl Into<String>, why: impl Into<String>) {
        self.map.skipped.push(Skipped { what: what.into(), why: why.into() });
    }

    /// Notes work that was saved.
    pub(super) fn save(&mut self, what: &'static str, work: Work) {
        *self.map.saved.entry(what).or_default() += work;
    }

    /// Adds an object with a geometry of its own; one without triangles is skipped. Whether it was added.
    pub(super) fn add(&mut self, mut object: MapObject, geometry: Geometry) -> bool {
        if geometry.triangles.is_empty() {
            self.skip(object.name(), "no surface was found that a camera saw");
            return false;
        }
        object.geometry = self.map.geometries.len();
        self.map.geometries.push(geometry);
        self.map.objects.push(object);
        true
    }

    /// Whether a stream is asked for and the field has it; says why not.
    pub(super) fn has(&mut self, stream: Stream) -> bool {
        let why = if !self.cx.config.wants(stream) {
            "it was not asked for"
        } else if self.cx.model.field.net(stream).is_none() {
            "the scene was trained without it"
        } else {
            return true;
        };
        self.skip(stream.name(), why);
        false
    }
}

impl Context<'_> {
    /// Units of a position relative to the grid's origin, kept inside the box (the grid sticks out by part of a voxel).
    pub(super) fn to_unit(&self, p: Vec3A) -> Vec3 {
        let n = &self.model.field.normalisation;
        (Vec3::from(p) / n.scale as f32).clamp(Vec3::ZERO, n.extent)
    }

    /// Notes what a grid left out.
    pub(super) fn count(&self, report: GridReport) {
        self.skipped_blocks.fetch_add(report.skipped_blocks, Ordering::Relaxed);
    }

    /// Length in units over which a density is turned into the opacity that is marched at one half.
    pub(super) fn opaque_length(&self) -> f32 {
        self.config.opaque_voxels * (self.voxel / self.model.field.normalisation.scale) as f32
    }
}
