//! The rows of the DIV-FF paper's two tables on one scene: each trains what it needs, all are measured alike.
//!
//! In the folder: `geometry/` (three streams, for all rows but one), `static/` (a run of one stream, with its features),
//! `patches/`, `masks/`, `masks+boxes/` (features alone). What is trained there is taken as it is.

use std::path::Path;

use super::evaluate::measurable;
use super::phrases::PhraseEvaluation;
use super::{Event, Observer, PipelineError, RunFolder, Stage, train, train_features};
use crate::config::Config;
use crate::eval::{self, Detections, NOTHING, PhraseTruth, ScoreSums, THRESHOLD, Task};
use crate::render::forward::Model;
use crate::render::image::render;
use crate::report::tables::{OrderCheck, OrderedRow, TableRow, Tables};
use crate::scene::features::Space;
use crate::scene::{Frame, Scene, Split};
use crate::semantics::TextSources;
use crate::semantics::targets::ImageMode;
use crate::train::{Session, StreamChoice, Trained};

/// A field of features that the paper compares; in its order from worst to best.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variant {
    /// LERF: one static stream, patches with their scale.
    Static,
    /// Three streams, and LERF's patches.
    Patches,
    /// Three streams, descriptors of masks.
    Masks,
    /// Three streams, descriptors of masks and their boxes: the full model.
    MasksAndBoxes,
}

impl Variant {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Static, Self::Patches, Self::Masks, Self::MasksAndBoxes];

    /// Short name, and that of its folder.
    pub fn name(self) -> &'static str {
        ["static", "patches", "masks", "masks+boxes"][self as usize]
    }

    /// The variant of a short name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|v| v.name() == name)
    }

    /// What the paper calls it when a space is asked.
    fn method(self, space: Space) -> &'static str {
        match (self, space) {
            (Self::Static, _) => "LERF (one static stream)",
            (Self::Patches, _) => "DIV-FF (CLIP in patches)",
            (Self::Masks, _) => "DIV-FF (CLIP in masks)",
            (Self::MasksAndBoxes, Space::Clip) => "DIV-FF (full model, image inference)",
            (Self::MasksAndBoxes, Space::Egovideo) => "DIV-FF (full model, video inference)",
        }
    }

    /// The rows of the paper that it gives.
    fn asked(self) -> &'static [(Task, Space)] {
        use {Space::*, Task::*};
        match self {
            Self::Masks => &[(Objects, Clip)],
            Self::Static | Self::Patches => &[(Objects, Clip), (Affordances, Clip)],
            Self::MasksAndBoxes => {
                &[(Objects, Egovideo), (Objects, Clip), (Affordances, Clip), (Affordances, Egovideo)]
            }
        }
    }

    /// `config` with what makes the difference.
    fn settings(self, config: &Config) -> Config {
        let mut config = config.clone();
        config.train.streams = match (self, config.train.streams) {
            (Self::Static, _) => StreamChoice::Static,
            (_, StreamChoice::Static) => StreamChoice::All,
            (_, asked) => asked,
        };
        // All rows of three streams are compared at the same geometry.
        config.semantics.joint_steps = 0;
        config.semantics.image.mode = match self {
            Self::Static | Self::Patches => ImageMode::ScaledPatches,
            Self::Masks => ImageMode::Masks,
            Self::MasksAndBoxes => ImageMode::MasksAndBoxes,
        };
        config
    }
}

/// A trained field and how its pictures are.
struct Geometry {
    trained: Trained,
    psnr: Option<f64>,
}

/// What is compared, on what.
#[derive(Clone, Copy)]
pub struct Comparison<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// Settings that all rows have in common.
    pub base: &'a Config,
    /// Where everything that is trained is kept.
    pub out: &'a Path,
    /// Fields to compare.
    pub variants: &'a [Variant],
    /// What detectors found; a row each.
    pub detections: &'a [Detections],
    /// Where embeddings of phrases come from.
    pub text: &'a TextSources,
    /// How often features are trained, each time from another seed; at least 1. Geometry is trained once.
    pub seeds: u32,
}

/// Trains what the rows need and measures them; rows come in the paper's order. `None` if the observer said stop: the same
/// call goes on from there.
///
/// A row whose phrases do not all have an embedding has no figure and says so: means over different phrases could not be
/// compared.
///
/// # Errors
/// [`PipelineError`]: the first thing that went wrong; what was finished before it stays.
pub fn paper_tables(
    asked: &Comparison,
    observer: &mut dyn Observer,
) -> Result<Option<Tables>, PipelineError> {
    let Comparison { scene, base, out, variants, detections, .. } = *asked;
    let truth = PhraseTruth::read(scene)?;
    let mut shared: Option<Geometry> = None;
    // Per task: variant (none for detections), space and row.
    let mut found: [Vec<(Option<Variant>, Space, TableRow)>; 2] = Default::default();
    for variant in Variant::ALL.into_iter().filter(|v| variants.contains(v)) {
        let config = variant.settings(base);
        let own;
        let geometry = if variant == Variant::Static {
            own = geometry(scene, &config, &RunFolder::new(out.join(variant.name())), observer)?;
            own.as_ref()
        } else {
            if shared.is_none() {
                // The same record whichever row comes first.
                let config = Variant::MasksAndBoxes.settings(base);
                shared = geometry(scene, &config, &RunFolder::new(out.join("geometry")), observer)?;
            }
            shared.as_ref()
        };
        let Some(geometry) = geometry else { return Ok(None) };
        let mut repeats = Vec::new();
        for repeat in 0..asked.seeds.max(1) {
            let Some(rows) = rows(asked, &truth, geometry, variant, repeat, observer)? else {
                return Ok(None);
            };
            repeats.push(rows);
        }
        for (n, (task, space)) in variant.asked().iter().enumerate() {
            let row = TableRow::mean(repeats.iter().map(|rows| rows[n].clone()));
            found[*task as usize].push((Some(variant), *space, row));
        }
    }
    for task in Task::ALL {
        // Detections stand after LERF among objects, and first among affordances.
        let first =
            |r: &(Option<Variant>, Space, TableRow)| task == Task::Objects && r.0 == Some(Variant::Static);
        let at = found[task as usize].iter().filter(|r| first(r)).count();
        for (n, of) in detections.iter().filter(|d| d.asks(task, &truth)).enumerate() {
            let sums = of.measure(scene, &truth, task)?;
            let row = row(of.method(), &sums, &truth.phrases(task), task);
            found[task as usize].insert(at + n, (None, Space::Clip, row));
        }
    }
    Ok(Some(tables(asked, found)))
}

/// Trains a geometry, or takes the one that is there, and measures its pictures.
fn geometry(
    scene: &Scene,
    config: &Config,
    run: &RunFolder,
    observer: &mut dyn Observer,
) -> Result<Option<Geometry>, PipelineError> {
    observer.event(&Event::Stage(Stage::Training));
    let trained = train(scene, config, run, false, observer)?.into_trained();
    if !trained.progress.finished {
        return Ok(None);
    }
    observer.event(&Event::Stage(Stage::Rendering));
    let model = Model::new(&trained.field, &trained.grids, [true; 3]);
    let sampling = config.train.render_sampling();
    let total = test_frames(scene).count();
    let mut done = 0;
    let quality = eval::evaluate_images(scene, |frame| {
        if observer.stop() {
            return Ok(None);
        }
        let image = render(&model, frame, &sampling, 1);
        done += 1;
        observer.event(&Event::Views { done, total });
        Ok(Some(measurable(image)))
    })?;
    let psnr = quality.psnr;
    Ok((!observer.stop()).then_some(Geometry { trained, psnr }))
}

/// The rows that one variant gives, in the order of [`Variant::asked`]; `repeat` counts the trainings of its features.
fn rows(
    asked: &Comparison,
    truth: &PhraseTruth,
    geometry: &Geometry,
    variant: Variant,
    repeat: u32,
    observer: &mut dyn Observer,
) -> Result<Option<Vec<TableRow>>, PipelineError> {
    let Comparison { scene, base, out, text, .. } = *asked;
    let mut config = variant.settings(base);
    config.seed = config.seed.wrapping_add(repeat.into());
    let run = RunFolder::new(out.join(match repeat {
        0 => variant.name().to_owned(),
        _ => format!("{}-{}", variant.name(), repeat + 1),
    }));
    let trained = &geometry.trained;
    let session = Session::Over(Box::new(trained.clone()));
    let Some((fields, _)) = train_features(scene, session, &config, &run, observer)? else { return Ok(None) };
    let without = |asked: &(Task, Space)| unknown(text, &truth.phrases(asked.0), asked.1);
    let asked: Vec<(Task, Space)> =
        variant.asked().iter().filter(|a| without(a).is_none()).copied().collect();
    let mut phrases = PhraseEvaluation::new(truth.clone(), Some(&fields), &config, &asked, text)?;
    observer.event(&Event::Stage(Stage::Evaluating));
    let model = Model::new(&trained.field, &trained.grids, [true; 3]);
    let sampling = config.train.render_sampling();
    let total = test_frames(scene).count();
    for (done, frame) in test_frames(scene).enumerate() {
        if observer.stop() {
            return Ok(None);
        }
        phrases.add(&model, frame, &sampling)?;
        observer.event(&Event::Views { done: done + 1, total });
    }
    let found = phrases.finish();
    let one = |asked: &(Task, Space)| {
        let (task, space) = *asked;
        let measured = found.iter().find(|f| f.task == task && f.space == space);
        let method = variant.method(space).to_owned();
        let mut row = match measured {
            Some(measured) => row(method, &measured.sums, &truth.phrases(task), task),
            None => TableRow { method, ..TableRow::default() },
        };
        if let Some(why) = measured.map_or_else(|| without(asked), |m| m.why.clone()) {
            row.absent = Some(why);
        }
        row.psnr = geometry.psnr;
        row.geometry_seconds = Some(trained.progress.seconds);
        row.feature_seconds = Some(fields.seconds);
        row
    };
    Ok(Some(variant.asked().iter().map(one).collect()))
}

fn test_frames(scene: &Scene) -> impl Iterator<Item = &Frame> {
    scene.frames.iter().filter(|f| f.split == Split::Test)
}

/// Which phrases have no embedding in a space, as a reason; `None` if all have one.
fn unknown(text: &TextSources, phrases: &[String], space: Space) -> Option<String> {
    let missing: Vec<String> =
        phrases.iter().filter(|p| text.embedding(space, p).is_err()).map(|p| format!("\"{p}\"")).collect();
    let name = space.name();
    (!missing.is_empty()).then(|| {
        format!(
            "there is no {name} embedding of {}: add them to the scene's text/{name}.npy and .txt, or give a text encoder",
            missing.join(", ")
        )
    })
}

/// What was measured.
fn row(method: String, sums: &ScoreSums, phrases: &[String], task: Task) -> TableRow {
    let miou = sums.mean();
    let none = || match phrases.is_empty() {
        true => format!("the scene has no truth for {}", task.measure()),
        false => NOTHING.to_owned(),
    };
    TableRow {
        method,
        miou,
        phrases: phrases.iter().filter_map(|p| Some((p.clone(), sums.mean_of(p)?))).collect(),
        absent: miou.is_none().then(none),
        ..TableRow::default()
    }
}

fn tables(asked: &Comparison, found: [Vec<(Option<Variant>, Space, TableRow)>; 2]) -> Tables {
    let scene = asked.scene;
    let row = |task: Task, variant: Variant, space: Space| {
        let row = found[task as usize].iter().find(|r| r.0 == Some(variant) && r.1 == space);
        row.map(|r| &r.2)
    };
    let order = Variant::ALL.map(|v| OrderedRow::new(v.name(), row(Task::Objects, v, Space::Clip)));
    let full = |space| row(Task::Affordances, Variant::MasksAndBoxes, space)?.miou;
    let video_over_image = match (full(Space::Egovideo), full(Space::Clip)) {
        (Some(video), Some(image)) if image > 0.0 => Some(video / image),
        _ => None,
    };
    let name = scene.root.file_name().map(|n| n.to_string_lossy().into_owned());
    let [objects, affordances] = found.map(|rows| rows.into_iter().map(|r| r.2).collect());
    Tables {
        scene: name.unwrap_or_else(|| scene.root.display().to_string()),
        test_frames: test_frames(scene).count(),
        threshold: THRESHOLD,
        seeds: asked.seeds.max(1),
        objects,
        affordances,
        order: OrderCheck::new(order.to_vec()),
        video_over_image,
    }
}
