//! The trained fields of features of a run, and their file: `checkpoint/features.safetensors`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use divff_exporters::atomic::write_bytes_atomically;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::compress::{Compressor, CompressorHeader};
use super::config::SemanticsConfig;
use super::error::SemanticsError;
use super::head::{HeadShape, Heads};
use super::relevancy::Queries;
use super::text_source::TextSources;
use crate::error::{BadFile, FileError};
use crate::field::Stream;
use crate::field::hashgrid::Row;
use crate::scene::features::Space;
use crate::train::Trained;

/// Version of the file's layout.
const FORMAT: u32 = 2;

/// The one key of the metadata.
const HEADER: &str = "divff";

/// Most rows of all tables of a file that is believed.
const MAX_ROWS: usize = 1 << 26;

/// The fields of one space.
#[derive(Clone, Debug)]
pub struct SpaceField {
    /// Which space.
    pub space: Space,
    /// The networks.
    pub heads: Heads,
    /// From descriptors to what the networks give, and back.
    pub compressor: Compressor,
    /// Model that made the descriptors, as the scene says.
    pub model: Option<String>,
}

/// The fields of features of a run.
#[derive(Clone, Debug)]
pub struct SemanticFields {
    /// Image-language and video-language; `None` where the scene has no features.
    pub spaces: [Option<SpaceField>; 2],
    /// What was left out, and why.
    pub skipped: Vec<(String, String)>,
    /// What was odd about the features but was worked with; not stored.
    pub warnings: Vec<String>,
    /// Settings that they were trained with.
    pub config: SemanticsConfig,
    /// Seconds that training took.
    pub seconds: f64,
    /// Number of the geometry that they were trained on.
    geometry: u64,
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: u32,
    geometry: u64,
    seconds: f64,
    skipped: Vec<(String, String)>,
    config: SemanticsConfig,
    spaces: Vec<SpaceHeader>,
}

#[derive(Serialize, Deserialize)]
struct SpaceHeader {
    space: Space,
    shape: HeadShape,
    compressor: CompressorHeader,
    model: Option<String>,
}

impl SpaceField {
    /// Phrases ready to be held against this space's features.
    ///
    /// # Errors
    /// [`crate::semantics::text::TextError::Phrase`] where no source knows a phrase, [`SemanticsError::Relevancy`] for embeddings that do
    /// not fit.
    pub fn queries(
        &self,
        text: &TextSources,
        phrases: &[String],
        temperature: f32,
    ) -> Result<Queries, SemanticsError> {
        text.queries(self.space, &self.compressor, phrases, temperature)
    }
}

impl SemanticFields {
    /// No fields yet, for the geometry of `trained`.
    pub fn empty(config: SemanticsConfig, trained: &Trained) -> Self {
        let geometry = geometry_id(trained);
        let (spaces, skipped, warnings) = ([None, None], Vec::new(), Vec::new());
        Self { spaces, skipped, warnings, config, seconds: 0.0, geometry }
    }

    /// Notes that the geometry of `trained` is the one that they were trained on.
    pub fn belongs_to(&mut self, trained: &Trained) {
        self.geometry = geometry_id(trained);
    }

    /// Notes that something was left out.
    pub fn skip(&mut self, what: &str, why: &str) {
        self.skipped.push((what.to_owned(), why.to_owned()));
    }

    /// Whether they were trained on this geometry, with these settings.
    pub fn fits(&self, trained: &Trained, config: &SemanticsConfig) -> bool {
        // τ and the sizes that are tried only matter to those who ask.
        let SemanticsConfig { temperature, query_scales, .. } = self.config;
        let asked = SemanticsConfig { temperature, query_scales, ..config.clone() };
        self.geometry == geometry_id(trained) && self.config == asked
    }

    /// The field of a space.
    ///
    /// # Errors
    /// [`SemanticsError::NoFeatures`], with the reason.
    pub fn space(&self, space: Space) -> Result<&SpaceField, SemanticsError> {
        self.spaces[space as usize].as_ref().ok_or_else(|| {
            let why = self.skipped.iter().find(|s| s.0 == space.name());
            let why = why.map_or("there are none in this run", |s| &s.1).to_owned();
            SemanticsError::NoFeatures { space, why }
        })
    }

    /// Whether there is any field.
    pub fn is_empty(&self) -> bool {
        self.spaces.iter().all(Option::is_none)
    }

    /// The file of a run.
    pub fn path(run: &Path) -> PathBuf {
        run.join("checkpoint").join("features.safetensors")
    }

    /// Writes everything, at once or not at all.
    ///
    /// # Errors
    /// The file cannot be written; an older one is then untouched.
    pub fn save(&self, run: &Path) -> Result<(), SemanticsError> {
        let path = Self::path(run);
        let spaces: Vec<&SpaceField> = self.spaces.iter().flatten().collect();
        let header = Header {
            format: FORMAT,
            geometry: self.geometry,
            seconds: self.seconds,
            skipped: self.skipped.clone(),
            config: self.config.clone(),
            spaces: spaces.iter().map(|f| f.header()).collect(),
        };
        let bad = |e: &dyn std::fmt::Display| damaged(&path, &e.to_string());
        let json = serde_json::to_string(&header).map_err(|e| bad(&e))?;
        let mut arrays: Vec<(String, Vec<usize>, &[f32])> = Vec::new();
        for field in spaces {
            field.visit(&mut arrays);
        }
        let views = arrays
            .into_iter()
            .map(|(name, shape, data)| {
                let view = TensorView::new(Dtype::F32, shape, bytemuck::cast_slice(data));
                Ok((name, view.map_err(|e| bad(&e))?))
            })
            .collect::<Result<Vec<_>, SemanticsError>>()?;
        let metadata = HashMap::from([(HEADER.to_owned(), json)]);
        let bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| bad(&e))?;
        let folder = run.join("checkpoint");
        std::fs::create_dir_all(&folder).map_err(FileError::at(&folder))?;
        Ok(write_bytes_atomically(&path, &bytes)?)
    }

    /// Reads the fields of a run; `None` if it has no such file.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, or belongs to another version.
    pub fn load(run: &Path) -> Result<Option<Self>, SemanticsError> {
        let path = Self::path(run);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = std::fs::read(&path).map_err(FileError::at(&path))?;
        let bad = |e: &dyn std::fmt::Display| damaged(&path, &e.to_string());
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|e| bad(&e))?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| bad(&e))?;
        let json = metadata.metadata().as_ref().and_then(|m| m.get(HEADER));
        let json = json.ok_or_else(|| damaged(&path, "it has no header"))?;
        let header: Header = serde_json::from_str(json).map_err(|e| bad(&e))?;
        if header.format != FORMAT {
            return Err(damaged(&path, &format!("its format is {} and not {FORMAT}", header.format)));
        }
        let fetch = |name: &str, len: Option<usize>| -> Result<Vec<f32>, SemanticsError> {
            let tensor = tensors.tensor(name).map_err(|e| damaged(&path, &format!("{name}: {e}")))?;
            if tensor.dtype() != Dtype::F32 || len.is_some_and(|n| tensor.data().len() != n * 4) {
                return Err(damaged(&path, &format!("{name} has the wrong size")));
            }
            let values: Vec<f32> =
                tensor.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            match values.iter().position(|v| !v.is_finite()) {
                Some(n) => Err(damaged(&path, &format!("{name}[{n}] is not finite"))),
                None => Ok(values),
            }
        };
        if header.config.check().is_err() {
            return Err(damaged(&path, "its settings are out of range"));
        }
        let mut spaces = [None, None];
        for stored in header.spaces {
            let space = stored.space;
            if !stored.is_sound(bytes.len()) {
                return Err(damaged(&path, "its networks cannot be"));
            }
            let name = |part: &str| format!("{}.{part}", space.name());
            let compressor = Compressor::from_stored::<SemanticsError>(&stored.compressor, |part| {
                fetch(&name(part), None)
            })?;
            if compressor.dim() != stored.shape.dim {
                return Err(damaged(&path, "its networks do not fit its compression"));
            }
            let mut heads = Heads::zeros(stored.shape);
            for s in Stream::ALL {
                let weights = &mut heads.weights[s as usize];
                *weights = fetch(&name(&format!("weights.{}", s.name())), Some(weights.len()))?;
                for (n, table) in heads.tables[s as usize].iter_mut().enumerate() {
                    let values = fetch(&name(&format!("table.{}.{n}", s.name())), Some(4 * table.len()))?;
                    bytemuck::cast_slice_mut::<Row, f32>(table).copy_from_slice(&values);
                }
            }
            spaces[space as usize] = Some(SpaceField { space, heads, compressor, model: stored.model });
        }
        let Header { geometry, seconds, skipped, config, .. } = header;
        Ok(Some(Self { spaces, skipped, warnings: Vec::new(), config, seconds, geometry }))
    }
}

impl SpaceHeader {
    /// Whether the networks can be built and fit into a file of `bytes`.
    fn is_sound(&self, bytes: usize) -> bool {
        let shape = &self.shape;
        let sound = (1..=4096).contains(&shape.dim)
            && shape.parts <= 4096
            && (1..=8).contains(&shape.layers)
            && (1..=512).contains(&shape.hidden)
            && shape.frames < 1 << 24
            && shape.extent.min_element() > 0.0
            && shape.extent.max_element() <= 1.0
            && shape.scales.is_none_or(|[low, high]| low > 0.0 && high > low && high.is_finite());
        // Encodings are those of settings that have been checked already.
        let as_config = SemanticsConfig {
            persistent: shape.encodings[0].clone(),
            dynamic: shape.encodings[1].clone(),
            actor: shape.encodings[2].clone(),
            ..SemanticsConfig::default()
        };
        if !sound || as_config.check().is_err() {
            return false;
        }
        let present = Stream::ALL.into_iter().filter(|s| shape.streams[*s as usize]);
        let rows: usize = present.flat_map(|s| shape.grid(s).levels).map(|level| level.rows()).sum();
        rows <= MAX_ROWS && rows * size_of::<Row>() <= bytes
    }
}

impl SpaceField {
    fn header(&self) -> SpaceHeader {
        SpaceHeader {
            space: self.space,
            shape: self.heads.shape.clone(),
            compressor: self.compressor.header(),
            model: self.model.clone(),
        }
    }

    fn visit<'a>(&'a self, arrays: &mut Vec<(String, Vec<usize>, &'a [f32])>) {
        let name = |part: &str| format!("{}.{part}", self.space.name());
        self.compressor.visit(|part, shape, data| arrays.push((name(part), shape, data)));
        for s in Stream::ALL {
            let weights = &self.heads.weights[s as usize];
            arrays.push((name(&format!("weights.{}", s.name())), vec![weights.len()], weights));
            for (n, table) in self.heads.tables[s as usize].iter().enumerate() {
                let data: &[f32] = bytemuck::cast_slice(table);
                arrays.push((name(&format!("table.{}.{n}", s.name())), vec![table.len(), 4], data));
            }
        }
    }
}

/// A number that changes whenever the geometry does (FNV-1a of its weights and finest tables).
fn geometry_id(trained: &Trained) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut add = |v: &f32| hash = (hash ^ u64::from(v.to_bits())).wrapping_mul(0x0100_0000_01b3);
    trained.field.weights.iter().for_each(&mut add);
    for tables in &trained.field.tables {
        for table in tables.iter().take(1) {
            bytemuck::cast_slice::<Row, f32>(table).iter().for_each(&mut add);
        }
    }
    hash
}

fn damaged(path: &Path, what: &str) -> SemanticsError {
    let remedy = "delete it and train again: the geometry is kept";
    SemanticsError::Stored(BadFile { path: path.to_owned(), what: what.to_owned(), remedy })
}
