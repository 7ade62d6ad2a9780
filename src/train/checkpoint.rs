//! A trained field on disk: one safetensors file with the shape as JSON metadata, replaced atomically.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use divff_exporters::atomic::write_bytes_atomically;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::error::TrainError;
use super::step::Optimiser;
use crate::config::Config;
use crate::error::{BadFile, FileError};
use crate::field::hashgrid::Row;
use crate::field::{Field, FieldShape, Normalisation, Stream};
use crate::render::forward::Grids;

#[cfg(test)]
mod tests;

/// A field with the density grids that make it fast to evaluate: what training gives, and all that the later
/// stages need.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The field.
    pub field: Field,
    /// Where its densities are.
    pub grids: Grids,
    /// How far training has come.
    pub progress: TrainingState,
}

/// How far training has come.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingState {
    /// Steps taken.
    pub step: u64,
    /// Seconds spent in them.
    pub seconds: f64,
    /// Seconds of these that went by before the first step; a schedule by the clock begins after them.
    #[serde(default)]
    pub prepared: f64,
    /// Whether the schedule has come to its end.
    pub finished: bool,
    /// Field evaluations, one stream each.
    pub evaluations: u64,
    /// Of these, those of densities alone, because they gave too little light to be learned from.
    #[serde(default)]
    pub faint: u64,
    /// Evaluations there would have been at every placed sample for every stream.
    pub candidates: u64,
    /// Evaluations there would have been for the streams that the scene does not have.
    #[serde(default)]
    pub absent: u64,
    /// Steps through the density grids that rays were spared where nothing was left of their light.
    #[serde(default)]
    pub spared: u64,
    /// Rows of tables that steps left alone because no ray saw them.
    #[serde(default)]
    pub unseen: u64,
    /// Evaluations from which poses would have learned if they had not been exact.
    #[serde(default)]
    pub unrefined: u64,
    /// Rays traced.
    pub rays: u64,
    /// Whether the streams of the scene have been settled.
    pub streams_settled: bool,
    /// Share of image blocks that the persistent stream alone could not explain; `None` before it was measured.
    pub unexplained: Option<f64>,
    /// Whether the poses as they were given are as good as they can be, so that they are not refined.
    #[serde(default)]
    pub trusts_poses: bool,
    /// Share of pixels whose depth stereo found from the given poses, in a few frames; `None` before that was asked.
    #[serde(default)]
    pub given_coverage: Option<f64>,
    /// How many frames those were at most, where that is known.
    #[serde(default)]
    pub judged: Option<usize>,
    /// Pose refinement and rig from which depth was looked for by stereo; `None` before it was.
    pub stereo_from: Option<Vec<f32>>,
    /// Seconds that stereo would have taken, where that was too much of a time budget; `None` where it was not left out.
    #[serde(default)]
    pub stereo_left_out: Option<f64>,
    /// How many of the due alignments of the frames are done.
    pub aligned: usize,
    /// Steps after the end of the schedule, together with fields of features.
    #[serde(default)]
    pub joint: u64,
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: u32,
    shape: FieldShape,
    grid_cells: f32,
    threshold: [f32; 3],
    progress: TrainingState,
}

impl Header {
    /// Refuses a header that asks for a field which cannot be, or is larger than a file of `bytes`.
    ///
    /// # Errors
    /// [`TrainError::Checkpoint`].
    fn check(&self, path: &Path, bytes: usize) -> Result<(), TrainError> {
        let mut config = Config { field: self.shape.config.clone(), ..Config::default() };
        config.train.grid_cells = self.grid_cells;
        config.validate().map_err(|e| damaged(path, &e.to_string()))?;
        let shape = &self.shape;
        let Normalisation { origin, scale, extent } = shape.normalisation;
        let sound = extent.min_element() > 0.0
            && extent.max_element() <= 1.0
            && scale > 0.0
            && (origin.abs() + scale).is_finite()
            && !shape.times.is_empty()
            && shape.times.iter().chain(&shape.background).all(|t| t.is_finite());
        if !sound {
            return Err(damaged(path, "its box or its times are not those of a scene"));
        }
        let cells: usize = Grids::cells(extent, self.grid_cells).iter().sum();
        if cells.saturating_mul(size_of::<f32>()) > bytes {
            return Err(damaged(path, "it is shorter than the density grids of its header"));
        }
        let rows: usize = Stream::ALL
            .into_iter()
            .filter(|s| shape.streams[*s as usize])
            .flat_map(|s| shape.encoding(s).levels)
            .map(|level| level.rows())
            .sum();
        match rows.saturating_mul(size_of::<Row>()) <= bytes {
            true => Ok(()),
            false => Err(damaged(path, "it is shorter than the tables of its header")),
        }
    }
}

/// Version of the layout of checkpoint files.
const FORMAT: u32 = 1;

/// The one key of the metadata: a map of several would be written in random order.
const HEADER: &str = "divff";

impl Trained {
    /// The checkpoint file of a run.
    pub fn path(run: &Path) -> PathBuf {
        run.join("checkpoint").join("field.safetensors")
    }

    /// Drops the streams that the scene does not need, and everything that was learned for them.
    pub fn keep_streams(&mut self, streams: [bool; 3]) {
        let old = &self.field;
        let mut field = Field::zeros(FieldShape { streams, ..old.shape.clone() });
        let mut copy = |to: std::ops::Range<usize>, from: std::ops::Range<usize>| {
            if !to.is_empty() {
                field.weights[to].copy_from_slice(&old.weights[from]);
            }
        };
        for (to, from) in field.layout.streams.iter().zip(&old.layout.streams) {
            copy(to.trunk.clone(), from.trunk.clone());
            copy(to.head.clone(), from.head.clone());
            copy(to.code.clone(), from.code.clone());
        }
        let (to, from) = (&field.layout, &old.layout);
        copy(to.exposure.clone(), from.exposure.clone());
        copy(to.pose.clone(), from.pose.clone());
        copy(to.rig.clone(), from.rig.clone());
        for s in Stream::ALL.into_iter().filter(|s| streams[*s as usize]) {
            field.tables[s as usize].clone_from(&old.tables[s as usize]);
        }
        self.field = field;
    }

    /// Writes the field and, where given, what is needed to resume its training.
    ///
    /// # Errors
    /// The file cannot be written; an older one is then untouched.
    pub fn save(&self, run: &Path, grid_cells: f32, optimiser: Option<&Optimiser>) -> Result<(), TrainError> {
        let path = Self::path(run);
        let folder = run.join("checkpoint");
        std::fs::create_dir_all(&folder).map_err(FileError::at(&folder))?;
        let header = Header {
            format: FORMAT,
            shape: self.field.shape.clone(),
            grid_cells,
            threshold: self.grids.threshold,
            progress: self.progress.clone(),
        };
        let json = serde_json::to_string(&header).map_err(|e| damaged(&path, &e.to_string()))?;
        let mut arrays: Vec<(String, &[f32])> = Vec::new();
        self.visit(|name, data| arrays.push((name, data)));
        if let Some(o) = optimiser {
            o.visit(|name, data| arrays.push((name, data)));
        }
        let views = arrays
            .into_iter()
            .map(|(name, data)| {
                let view = TensorView::new(Dtype::F32, vec![data.len()], bytemuck::cast_slice(data));
                Ok((name, view.map_err(|e| damaged(&path, &e.to_string()))?))
            })
            .collect::<Result<Vec<_>, TrainError>>()?;
        let bytes = safetensors::serialize(views, Some(HashMap::from([(HEADER.to_owned(), json)])))
            .map_err(|e| damaged(&path, &e.to_string()))?;
        Ok(write_bytes_atomically(&path, &bytes)?)
    }

    /// Reads the field of a run.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, or belongs to another version.
    pub fn load(run: &Path) -> Result<Self, TrainError> {
        Ok(Self::load_with(run, false)?.0)
    }

    /// Reads the field and the state of its optimiser, to go on training.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn resume(run: &Path) -> Result<(Self, Optimiser), TrainError> {
        let (trained, optimiser) = Self::load_with(run, true)?;
        let path = Self::path(run);
        Ok((trained, optimiser.ok_or_else(|| damaged(&path, "it holds no optimiser state"))?))
    }

    fn load_with(run: &Path, optimiser: bool) -> Result<(Self, Option<Optimiser>), TrainError> {
        let path = Self::path(run);
        let bytes = std::fs::read(&path).map_err(FileError::at(&path))?;
        let bad = |e: safetensors::SafeTensorError| damaged(&path, &e.to_string());
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(bad)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(bad)?;
        let json = metadata.metadata().as_ref().and_then(|m| m.get(HEADER));
        let json = json.ok_or_else(|| damaged(&path, "it has no header"))?;
        let header: Header = serde_json::from_str(json).map_err(|e| damaged(&path, &e.to_string()))?;
        if header.format != FORMAT {
            return Err(damaged(&path, &format!("its format is {} and not {FORMAT}", header.format)));
        }
        header.check(&path, bytes.len())?;
        let field = Field::zeros(header.shape);
        let refinement = field.layout.refinement().len();
        if header.progress.stereo_from.as_ref().is_some_and(|from| from.len() != refinement) {
            return Err(damaged(&path, "the poses of its stereo are not those of its frames"));
        }
        let mut grids = Grids::new(&field, header.grid_cells);
        grids.threshold = header.threshold;
        let mut trained = Self { field, grids, progress: header.progress };
        let mut fill = |name: String, into: &mut [f32]| {
            let tensor = tensors.tensor(&name).map_err(|e| damaged(&path, &format!("{name}: {e}")))?;
            if tensor.dtype() != Dtype::F32 || tensor.data().len() != into.len() * 4 {
                return Err(damaged(&path, &format!("{name} has the wrong size")));
            }
            for (o, b) in into.iter_mut().zip(tensor.data().chunks_exact(4)) {
                *o = f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
            }
            match into.iter().position(|v| !v.is_finite()) {
                Some(n) => Err(damaged(&path, &format!("{name}[{n}] is not finite"))),
                None => Ok(()),
            }
        };
        trained.visit_mut(&mut fill)?;
        let optimiser = match optimiser && tensors.names().iter().any(|n| n.starts_with("optimiser.")) {
            true => {
                let mut o = Optimiser::new(&trained.field);
                o.visit_mut(&mut fill)?;
                Some(o)
            }
            false => None,
        };
        Ok((trained, optimiser))
    }

    fn visit<'a>(&'a self, mut f: impl FnMut(String, &'a [f32])) {
        f("weights".to_owned(), &self.field.weights);
        for s in Stream::ALL {
            for (n, t) in self.field.tables[s as usize].iter().enumerate() {
                f(format!("table.{}.{n}", s.name()), bytemuck::cast_slice(t));
            }
            f(format!("grid.{}", s.name()), &self.grids.streams[s as usize].sigma);
        }
    }

    fn visit_mut(
        &mut self,
        f: &mut impl FnMut(String, &mut [f32]) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        f("weights".to_owned(), &mut self.field.weights)?;
        for s in Stream::ALL {
            for (n, t) in self.field.tables[s as usize].iter_mut().enumerate() {
                f(format!("table.{}.{n}", s.name()), bytemuck::cast_slice_mut::<Row, f32>(t))?;
            }
            f(format!("grid.{}", s.name()), &mut self.grids.streams[s as usize].sigma)?;
        }
        Ok(())
    }
}

impl Optimiser {
    fn visit<'a>(&'a self, mut f: impl FnMut(String, &'a [f32])) {
        f("optimiser.first".to_owned(), &self.dense.first);
        f("optimiser.second".to_owned(), &self.dense.second);
        for s in Stream::ALL {
            for (n, t) in self.tables[s as usize].iter().enumerate() {
                f(format!("optimiser.{}.{n}.first", s.name()), bytemuck::cast_slice(&t.first));
                f(format!("optimiser.{}.{n}.second", s.name()), bytemuck::cast_slice(&t.second));
            }
        }
    }

    fn visit_mut(
        &mut self,
        f: &mut impl FnMut(String, &mut [f32]) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        f("optimiser.first".to_owned(), &mut self.dense.first)?;
        f("optimiser.second".to_owned(), &mut self.dense.second)?;
        for s in Stream::ALL {
            for (n, t) in self.tables[s as usize].iter_mut().enumerate() {
                let first = bytemuck::cast_slice_mut::<Row, f32>(&mut t.first);
                f(format!("optimiser.{}.{n}.first", s.name()), first)?;
                let second = bytemuck::cast_slice_mut::<Row, f32>(&mut t.second);
                f(format!("optimiser.{}.{n}.second", s.name()), second)?;
            }
        }
        Ok(())
    }
}

fn damaged(path: &Path, what: &str) -> TrainError {
    let remedy = "train again with another --out, or delete the checkpoint";
    TrainError::Checkpoint(BadFile { path: path.to_owned(), what: what.to_owned(), remedy })
}
