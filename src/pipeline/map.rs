//! From a trained run to the files of its map.

use std::path::Path;
use std::time::Instant;

use divff_exporters::Manifest;

use super::folder::create_writable;
use super::{Cost, Event, Observer, PipelineError, Stage};
use crate::config::Config;
use crate::map::{self, Format};
use crate::scene::Scene;
use crate::semantics::SemanticFields;
use crate::semantics::bake::annotate;
use crate::train::Trained;
use crate::work::Work;

/// Builds the map of a trained field, with the features and scores of `fields`, simplifies it if asked to, and writes it to `out`, with the times
/// that it took into `cost`.
///
/// `None` if the observer said stop; the folder then holds no manifest, or an earlier map.
///
/// # Errors
/// The map cannot be built, or a file cannot be written.
#[allow(clippy::too_many_arguments)]
pub fn export_map(
    scene: &Scene,
    trained: &Trained,
    fields: Option<&SemanticFields>,
    config: &Config,
    out: &Path,
    formats: &[Format],
    cost: &mut Cost,
    observer: &mut dyn Observer,
) -> Result<Option<Manifest>, PipelineError> {
    create_writable(out)?;
    observer.event(&Event::Stage(Stage::Mapping));
    let start = Instant::now();
    let mut map = map::build(scene, trained, config, &mut |p| observer.event(&Event::Mapping(p)))?;
    if let Some(fields) = fields {
        annotate(&mut map, scene, trained, fields, &config.semantics)?;
    }
    map::simplify(&mut map, &config.map, &mut |p| observer.event(&Event::Mapping(p)))?;
    for (what, work) in &map.saved {
        cost.save(what, *work);
    }
    let unasked = Format::ALL.into_iter().filter(|f| !formats.contains(f));
    cost.save("formats", Work::bytes(unasked.map(|f| f.bytes(&map)).sum()));
    cost.extract_seconds = Some(start.elapsed().as_secs_f64());
    if observer.stop() {
        return Ok(None);
    }
    observer.event(&Event::Stage(Stage::Exporting));
    let start = Instant::now();
    let manifest = map::write(&map, out, formats)?;
    cost.export_seconds = Some(start.elapsed().as_secs_f64());
    Ok(Some(manifest))
}
