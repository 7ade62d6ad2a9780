//! Width and storage of compressed features: what they lose, and what a phrase costs.

use std::path::Path;
use std::time::Instant;

use half::f16;

use super::runs::{base, folder, measure};
use super::{Bench, Better, Cell, Kind, Plot, Row, Sweep};
use crate::error::FileError;
use crate::pipeline::PipelineError;
use crate::scene::features::{FeatureStore, Space};
use crate::scene::{Frame, Scene, Split};
use crate::semantics::agreement::{cosine, mean_answers_iou};
use crate::semantics::relevancy::Points;
use crate::semantics::targets::ImageTargets;
use crate::semantics::{SemanticsConfig, SemanticsError, SpaceField, TextSources};
use crate::train::Trained;

/// Points that a phrase is held against; their number decides nothing but how well time can be told.
const POINTS: usize = 200_000;

/// Phrases that are asked.
const PHRASES: usize = 16;

/// Error over bytes and seconds, for each number of dimensions, stored as f32 and f16.
pub(super) fn features(bench: &mut Bench) -> Result<Option<Sweep>, PipelineError> {
    let Some(run) = base(bench)? else { return Ok(None) };
    let plots = vec![
        Plot { cost: "mb_per_million", quality: "cosine_error", better: Better::Lower },
        Plot { cost: "mb_per_million", quality: "object_miou", better: Better::Higher },
        Plot { cost: "query_ms_per_million", quality: "answers_iou", better: Better::Higher },
    ];
    let (name, title) = (Kind::Features.name(), "Features: what they lose over what they take");
    let mut sweep = Sweep { name, title, rows: Vec::new(), plots, notes: Vec::new() };
    if let Err(error) = run.fields.space(Space::Clip) {
        sweep.notes.push(error.to_string());
        return Ok(Some(sweep));
    }
    let dims: &[usize] = bench.choose(&[8, 32], &[4, 8, 16, 32, 64]);
    for &dim in dims {
        bench.announce(Kind::Features, &format!("{dim} numbers"));
        let setting = format!("semantics.compress.dim={dim}");
        let mut config = bench.with(std::slice::from_ref(&setting))?;
        // The geometry is shared.
        config.semantics.joint_steps = 0;
        let name = format!("features_{dim}");
        share(run.run.root(), &folder(bench, &name))?;
        let Some(measured) = measure(bench, &name, &config)? else { return Ok(None) };
        let field = match measured.fields.space(Space::Clip) {
            Ok(field) => field,
            Err(error) => {
                sweep.notes.push(format!("{setting}: {error}"));
                continue;
            }
        };
        let miou = measured.metrics.quality.object_miou;
        for half in [false, true] {
            let stored = Stored::new(bench.scene, field, &config.semantics, half)?;
            let storage = if half { "f16" } else { "f32" };
            let row = Row::new(format!("{dim} × {storage}"), vec![setting.clone()])
                .with("mb_per_million", (field.compressor.dim() * if half { 2 } else { 4 }) as f64)
                .with("cosine_error", stored.cosine_error)
                .with("answers_iou", stored.answers_iou)
                .with("query_ms_per_million", stored.query_ms_per_million)
                .with("object_miou", if half { Cell::Missing("as f32".to_owned()) } else { miou.into() });
            sweep.rows.push(row);
        }
    }
    sweep.notes.push(
        "answers_iou: IoU of the descriptors that answer a phrase as they are stored with those that do uncompressed; \
         object_miou: of held-out frames, whose features are rendered as f32"
            .to_owned(),
    );
    Ok(Some(sweep))
}

/// Gives a run the trained field of another one, unless it has one.
fn share(from: &Path, to: &Path) -> Result<(), PipelineError> {
    for name in ["run.json", "config.toml"].map(Path::new).into_iter().chain([Path::new(CHECKPOINT)]) {
        let target = to.join(name);
        if target.exists() {
            continue;
        }
        let parent = target.parent().unwrap_or(to);
        std::fs::create_dir_all(parent).map_err(FileError::at(parent))?;
        std::fs::copy(from.join(name), &target).map_err(FileError::at(&target))?;
    }
    debug_assert_eq!(Trained::path(to), to.join(CHECKPOINT));
    Ok(())
}

/// The trained field within a run.
const CHECKPOINT: &str = "checkpoint/field.safetensors";

/// What storing descriptors in a certain way loses and costs.
struct Stored {
    cosine_error: f64,
    answers_iou: Option<f64>,
    query_ms_per_million: Option<f64>,
}

impl Stored {
    fn new(
        scene: &Scene,
        field: &SpaceField,
        config: &SemanticsConfig,
        half: bool,
    ) -> Result<Self, SemanticsError> {
        let frames: Vec<Frame> = scene.frames.iter().filter(|f| f.split == Split::Train).cloned().collect();
        let rows = match ImageTargets::load(&FeatureStore::open(scene)?, &frames, config.image)? {
            Some(targets) => targets.table.sample(POINTS),
            None => Vec::new(),
        };
        let compressor = &field.compressor;
        let count = rows.len() / compressor.full();
        let mut codes = vec![0.0; count * compressor.dim()];
        compressor.encode(&rows, &mut codes);
        let halves: Vec<f16> = codes.iter().map(|v| f16::from_f32(*v)).collect();
        if half {
            codes = halves.iter().map(|v| v.to_f32()).collect();
        }
        let mut back = vec![0.0; rows.len()];
        compressor.decode(&codes, &mut back);
        let text = TextSources::of_scene(scene)?;
        let phrases = text.phrases(field.space, PHRASES);
        let cosine_error = cosine_error(&rows, &back, compressor.full());
        if phrases.is_empty() || text.canonical(field.space).is_empty() || count == 0 {
            return Ok(Self { cosine_error, answers_iou: None, query_ms_per_million: None });
        }
        let tau = config.temperature;
        let whole = text.plain_queries(field.space, &phrases, tau)?.score(Points::F32(&rows))?.scores;
        let short = field.queries(&text, &phrases, tau)?.score(Points::F32(&codes))?.scores;
        let answers_iou = mean_answers_iou(&whole, &short);

        // One phrase, as somebody asks; points repeat, since only their number matters.
        let query = field.queries(&text, &phrases[..1], tau)?;
        let many: Vec<f32> = codes.iter().copied().cycle().take(POINTS * compressor.dim()).collect();
        let many_halves: Vec<f16> = halves.iter().copied().cycle().take(POINTS * compressor.dim()).collect();
        let points = if half { Points::F16(&many_halves) } else { Points::F32(&many) };
        let mut least = f64::INFINITY;
        for _ in 0..5 {
            let start = Instant::now();
            query.score(points)?;
            least = least.min(start.elapsed().as_secs_f64());
        }
        let query_ms_per_million = Some(1e3 * least * 1e6 / POINTS as f64);
        Ok(Self { cosine_error, answers_iou, query_ms_per_million })
    }
}

/// 1 − mean cosine between rows of `width`.
fn cosine_error(a: &[f32], b: &[f32], width: usize) -> f64 {
    let pairs = a.chunks_exact(width).zip(b.chunks_exact(width));
    let (count, sum) = pairs.fold((0usize, 0.0), |(n, sum), (a, b)| (n + 1, sum + cosine(a, b)));
    if count == 0 { 0.0 } else { 1.0 - sum / count as f64 }
}
