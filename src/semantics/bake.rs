//! Features and scores at the vertices and points of a map.

use divff_exporters::{Attribute, AttributeValues, Features, Geometry};
use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;

use super::compress::Map;
use super::config::SemanticsConfig;
use super::error::SemanticsError;
use super::fields::{SemanticFields, SpaceField};
use super::head::HeadModel;
use super::relevancy::Queries;
use super::text_source::{TextSources, slug};
use crate::field::Stream;
use crate::field::mlp::Precision;
use crate::map::{MapFeatures, SemanticMap, Skipped};
use crate::render::forward::Model;
use crate::render::refined::refined_camera;
use crate::scene::features::Space;
use crate::scene::{Frame, Scene};
use crate::train::Trained;
use crate::work::Work;

/// Phrases of a space that get a column each; a long list of embeddings is there to be asked, not to be stored.
const MOST_PHRASES: usize = 24;

/// Some of the points of a geometry: their stream, time and numbers.
type Part = (Stream, f32, std::ops::Range<usize>);

/// What is written at every vertex for one space.
struct Columns<'a> {
    field: &'a SpaceField,
    heads: HeadModel<'a>,
    queries: Option<Queries>,
    /// Names of the columns, in the order of the queries.
    names: Vec<String>,
    /// Sizes at which scores are tried beside that of the features.
    others: Vec<f32>,
}

/// Adds the features of all spaces, and the scores of the phrases that come with the scene, to every geometry of the
/// map and to its points: `<space>_pca`, `relevancy_<slug>` (image-language) and `affordance_<slug>` (video-language).
///
/// Where features depend on a size, those of the middle size are written, and the scores of the best one for each
/// phrase and geometry.
///
/// # Errors
/// Embeddings that cannot be used, or features that are not finite.
pub fn annotate(
    map: &mut SemanticMap,
    scene: &Scene,
    trained: &Trained,
    fields: &SemanticFields,
    config: &SemanticsConfig,
) -> Result<(), SemanticsError> {
    let text = TextSources::of_scene(scene)?;
    let place = Place { trained, model: Model::new(&trained.field, &trained.grids, [true; 3]) };
    for space in Space::ALL {
        let Some(field) = &fields.spaces[space as usize] else {
            let why = fields.skipped.iter().find(|s| s.0 == space.name());
            let why = why.map_or("it was not trained", |s| &s.1).to_owned();
            map.skipped.push(Skipped { what: format!("{} features", space.name()), why });
            let vertices = map.geometries.iter().chain([&map.points]).map(|g| g.positions.len());
            let samples = vertices.sum::<usize>() as u64;
            *map.saved.entry("feature_spaces").or_default() += Work::samples(samples);
            continue;
        };
        let columns = Columns::new(map, field, &text, config)?;
        for n in 0..map.geometries.len() {
            let Some(object) = map.objects.iter().find(|o| o.geometry == n) else { continue };
            let frame = object.frame_index.and_then(|i| scene.frames.iter().find(|f| f.frame_index == i));
            let stream = object.stream;
            let points = place.points(&map.geometries[n], stream, frame);
            let time = frame.map_or(0.0, |f| f.time as f32);
            columns.add(&mut map.geometries[n], &[(stream, time, 0..points.len())], &points)?;
        }
        // The cloud holds what stays, and then what is moved at its first time.
        let first = map.objects.iter().find(|o| o.stream == Stream::Dynamic).and_then(|o| o.frame_index);
        let frame = first.and_then(|i| scene.frames.iter().find(|f| f.frame_index == i));
        let streams = map.points.attributes.iter().find_map(|a| match &a.values {
            AttributeValues::U8(v) if a.name == "stream" => Some(v.clone()),
            _ => None,
        });
        let Some(streams) = streams else { continue };
        let moving = streams.partition_point(|s| *s == Stream::Persistent as u8);
        let points = place.points(&map.points, Stream::Persistent, None);
        let time = frame.map_or(0.0, |f| f.time as f32);
        let parts = [(Stream::Persistent, 0.0, 0..moving), (Stream::Dynamic, time, moving..points.len())];
        columns.add(&mut map.points, &parts, &points)?;
    }
    Ok(())
}

impl<'a> Columns<'a> {
    fn new(
        map: &mut SemanticMap,
        field: &'a SpaceField,
        text: &TextSources,
        config: &SemanticsConfig,
    ) -> Result<Self, SemanticsError> {
        let space = field.space;
        let mut phrases = text.phrases(space, MOST_PHRASES);
        phrases.retain(|p| !slug(p).is_empty());
        let kind = if space == Space::Clip { "relevancy" } else { "affordance" };
        let names: Vec<String> = phrases.iter().map(|p| format!("{kind}_{}", slug(p))).collect();
        let mut skip = |why: &str| {
            map.skipped
                .push(Skipped { what: format!("scores of {} phrases", space.name()), why: why.into() });
        };
        let queries = if phrases.is_empty() {
            skip("no embeddings come with the scene");
            None
        } else if text.canonical(space).is_empty() {
            skip("no canonical phrase comes with the scene's embeddings");
            None
        } else {
            Some(field.queries(text, &phrases, config.temperature)?)
        };
        if queries.is_some() && space == Space::Egovideo {
            map.affordances.extend(phrases.iter().map(|p| (slug(p), p.clone())));
        }
        map.features.push(MapFeatures {
            name: format!("{}_pca", space.name()),
            dim: field.compressor.dim(),
            model: field.model.clone().unwrap_or_else(|| "unknown".into()),
            map: match &field.compressor.map {
                Map::Linear(map) => Some((map.mean().to_vec(), map.basis().to_vec())),
                Map::Autoencoder(_) => None,
            },
        });
        let others = field.heads.shape.other_sizes(config.query_scales);
        Ok(Self { field, heads: HeadModel::new(&field.heads, Precision::F32), queries, names, others })
    }

    /// Features of `points` at `size`.
    fn features(&self, parts: &[Part], points: &[Vec3], size: f32) -> Vec<f32> {
        let dim = self.field.heads.shape.dim;
        let mut values = vec![0.0; points.len() * dim];
        for (stream, time, range) in parts {
            let out = &mut values[range.start * dim..range.end * dim];
            self.heads.features(*stream, &points[range.clone()], *time, size, out);
        }
        values
    }

    fn add(&self, geometry: &mut Geometry, parts: &[Part], points: &[Vec3]) -> Result<(), SemanticsError> {
        let at = |size: f32| self.features(parts, points, size);
        let values = at(self.field.heads.shape.middle_size());
        if let Some(queries) = &self.queries {
            let found = queries.best_scores(&values, &self.others, at)?;
            for (name, scores) in self.names.iter().zip(found) {
                if geometry.attributes.iter().all(|a| a.name != *name) {
                    let values = AttributeValues::F32(scores);
                    geometry.attributes.push(Attribute { name: name.clone(), values });
                }
            }
        }
        let name = format!("{}_pca", self.field.space.name());
        geometry.features.push(Features { name, dim: self.field.heads.shape.dim, values });
        Ok(())
    }
}

/// From the map's coordinates to those of a stream.
struct Place<'a> {
    trained: &'a Trained,
    model: Model<'a>,
}

impl Place<'_> {
    fn points(&self, geometry: &Geometry, stream: Stream, frame: Option<&Frame>) -> Vec<Vec3> {
        let offset = DVec3::from_array(geometry.offset);
        let world = |p: &[f32; 3]| Vec3::from_array(*p).as_dvec3() + offset;
        let n = self.trained.field.normalisation;
        let (true, Some(frame)) = (stream == Stream::Actor, frame) else {
            let unit = |p| n.to_unit(world(p)).clamp(Vec3::ZERO, n.extent);
            return geometry.positions.par_iter().map(unit).collect();
        };
        let (camera, c2w) = refined_camera(&self.trained.field, frame);
        let to_camera = c2w.inverse();
        let size = DVec2::new(f64::from(camera.width), f64::from(camera.height));
        let actor = |p: &[f32; 3]| {
            let at = to_camera.transform_point3(world(p));
            let uv = camera.project(at).map_or(Vec2::splat(0.5), |uv| (uv / size).as_vec2());
            self.model.actor_point(uv.clamp(Vec2::ZERO, Vec2::ONE), (at.z / n.scale) as f32)
        };
        geometry.positions.par_iter().map(actor).collect()
    }
}
