//! A procedural egocentric kitchen with ground truth: [`generate`] writes a whole scene folder, without any
//! assets.
//!
//! A head walks between work places and looks around; a hand picks up mugs and pans and puts them down
//! elsewhere. Poses, depth, instances, streams and meshes are exact: the meshes are what the images show.
//!
//! `room`, `furniture` and `props` say what there is, `story` what happens, `render` what is seen of it, `features` what
//! models might say about it, `write` stores it.

mod arms;
mod features;
mod furniture;
mod material;
mod mesh;
mod noise;
mod props;
mod render;
mod room;
mod story;
mod write;

use std::path::{Path, PathBuf};

use features::Models;
use glam::Affine3A;
use mesh::Mesh;
use props::Prop;
use rayon::prelude::*;
use render::{Body, Lens, Picture, Stage};
use room::{Room, Thing};
use story::Story;

use crate::error::FileError;

/// Horizontal field of view, degrees: a head-mounted camera's.
const FIELD_OF_VIEW_DEG: f64 = 87.0;
/// Frames with index 4 modulo 8 are the test split, as where a scene names none.
const TEST_PERIOD: u32 = 8;
const TEST_PHASE: u32 = 4;
/// Times at which dynamic and actor meshes are written, at most.
const MESH_TIMES: usize = 8;

/// What to generate.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthOptions {
    /// Number of frames, at least 8.
    pub frames: u32,
    /// Image width, px.
    pub width: u32,
    /// Image height, px.
    pub height: u32,
    /// Layout, colours, objects' places and what happens all follow from it.
    pub seed: u64,
}

impl Default for SynthOptions {
    fn default() -> Self {
        Self { frames: 60, width: 160, height: 90, seed: 0 }
    }
}

impl SynthOptions {
    fn validate(&self) -> Result<(), SynthError> {
        let check = |name, value, low, high| {
            if (low..=high).contains(&value) {
                Ok(())
            } else {
                Err(SynthError::Option { name, value, low, high })
            }
        };
        check("frames", self.frames, 8, 100_000)?;
        check("width", self.width, 16, 4096)?;
        check("height", self.height, 16, 4096)
    }

    /// More frames leave time for more moves.
    fn moves(&self) -> usize {
        (self.frames as usize / 15).clamp(3, 6)
    }

    fn time(&self, frame: u32) -> f64 {
        f64::from(frame) / f64::from(self.frames - 1)
    }

    fn lens(&self) -> Lens {
        let half = (FIELD_OF_VIEW_DEG / 2.0).to_radians();
        Lens { width: self.width, height: self.height, focal: f64::from(self.width) / 2.0 / half.tan() }
    }

    fn is_test(&self, frame: u32) -> bool {
        frame % TEST_PERIOD == TEST_PHASE
    }

    fn test_frames(&self) -> Vec<u32> {
        (0..self.frames).filter(|f| self.is_test(*f)).collect()
    }

    /// Test frames, evenly spread, that get a mesh of what moves.
    fn mesh_frames(&self) -> Vec<u32> {
        let test = self.test_frames();
        let count = test.len().min(MESH_TIMES);
        (0..count).map(|i| test[i * test.len() / count]).collect()
    }
}

/// What was written.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthSummary {
    /// Frames, of which every eighth is held out.
    pub frames: u32,
    /// Instances in `gt/objects.json`.
    pub instances: usize,
    /// Times at which an object changes its place.
    pub moves: usize,
    /// Triangles of `gt/mesh/persistent.ply`.
    pub persistent_triangles: usize,
    /// Frames with a mesh of the dynamic objects and of the actor.
    pub mesh_frames: Vec<u32>,
}

/// Why no scene was made.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// An option is out of range.
    #[error("{name} is {value}; choose a number from {low} to {high}")]
    Option {
        /// Field of [`SynthOptions`].
        name: &'static str,
        /// What was asked for.
        value: u32,
        /// Smallest allowed value.
        low: u32,
        /// Largest allowed value.
        high: u32,
    },
    /// The folder holds something already.
    #[error("{path} is not empty; choose another folder, or delete it", path = path.display())]
    NotEmpty {
        /// The folder.
        path: PathBuf,
    },
    /// A folder cannot be made or read.
    #[error(transparent)]
    Io(#[from] FileError),
    /// An image cannot be encoded.
    #[error("{path}: {source}", path = path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// The encoder's complaint.
        source: image::ImageError,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] divff_exporters::Error),
}

/// The kitchen and its story, ready to be photographed.
struct Kitchen {
    room: Room,
    still: Body,
    props: Vec<Prop>,
    story: Story,
}

impl Kitchen {
    fn new(options: &SynthOptions) -> Self {
        let mut room = room::build(options.seed);
        let props = props::build(room.things.len() as u16 + 1, options.seed);
        let story = Story::new(&room, &props, options.moves(), options.seed);
        let still = Body::new(std::mem::take(&mut room.mesh));
        Self { room, still, props, story }
    }

    /// Everything with an instance number, which is its place in the list plus one.
    fn things(&self) -> Vec<Thing> {
        let props = self.props.iter().map(|p| p.thing.clone());
        self.room.things.iter().cloned().chain(props).chain(arms::things()).collect()
    }

    /// Instance number of a prop.
    fn prop_instance(&self, prop: usize) -> u16 {
        (self.room.things.len() + prop + 1) as u16
    }

    fn camera(&self, time: f64) -> Affine3A {
        self.story.head(time as f32).camera_to_world()
    }

    fn prop_pose(&self, prop: usize, time: f64) -> Affine3A {
        self.story.prop_pose(&self.room, &self.props, prop, time as f32)
    }

    /// All movable objects at a time, world coordinates.
    fn dynamic(&self, time: f64) -> Mesh {
        let mut mesh = Mesh::default();
        for (i, prop) in self.props.iter().enumerate() {
            mesh.append(&prop.mesh, &self.prop_pose(i, time));
        }
        mesh
    }

    /// Both arms at a time, world coordinates.
    fn actor(&self, time: f64) -> Mesh {
        let [left, right] = self.story.hands(&self.room, &self.props, time as f32);
        let arms = arms::build(self.prop_instance(self.props.len()), left, right);
        let mut mesh = Mesh::default();
        mesh.append(&arms, &self.camera(time));
        mesh
    }

    fn picture(&self, lens: &Lens, time: f64) -> Picture {
        let mut moving = self.dynamic(time);
        moving.append(&self.actor(time), &Affine3A::IDENTITY);
        let moving = Body::new(moving);
        Stage { room: &self.room, bodies: [&self.still, &moving] }.picture(lens, &self.camera(time))
    }

    /// Stream (0 persistent, 1 dynamic, 2 actor) of an instance; 0 also where nothing was hit.
    fn stream(&self, instance: u16) -> u8 {
        let (first_prop, first_arm) = (self.prop_instance(0), self.prop_instance(self.props.len()));
        u8::from(instance >= first_prop) + u8::from(instance >= first_arm)
    }
}

/// A frame of the scene that is being made, and what is seen in it.
struct Shot<'a> {
    /// Folder of the scene.
    out: &'a Path,
    options: &'a SynthOptions,
    frame: u32,
    picture: Picture,
}

/// Generates a scene folder at `out`, which must not exist or be empty.
///
/// `transforms.json` is written last and at once: a folder without it is not a scene, so an interrupted
/// call leaves nothing that could be mistaken for one. The same options give the same bytes on any number
/// of threads.
///
/// # Errors
/// [`SynthError`]: options out of range, a folder that is in use, files that cannot be written.
pub fn generate(options: &SynthOptions, out: &Path) -> Result<SynthSummary, SynthError> {
    options.validate()?;
    write::prepare(out)?;
    let kitchen = Kitchen::new(options);
    let lens = options.lens();
    let (models, things) = (Models::new(&kitchen, options.seed), kitchen.things());
    (0..options.frames).into_par_iter().try_for_each(|frame| {
        let shot = Shot { out, options, frame, picture: kitchen.picture(&lens, options.time(frame)) };
        write::frame(&shot, &kitchen)?;
        if options.is_test(frame) {
            features::affordance_masks(&shot, &things)?;
        }
        models.frame(&shot, &kitchen)
    })?;
    models.descriptions(out, options)?;
    write::meshes(out, &kitchen, options)?;
    write::descriptions(out, &kitchen, options)?;
    write::transforms(out, &kitchen, options)?;
    Ok(SynthSummary {
        frames: options.frames,
        instances: things.len(),
        moves: kitchen.story.moves.len(),
        persistent_triangles: kitchen.still.mesh.triangles.len(),
        mesh_frames: options.mesh_frames(),
    })
}

#[cfg(test)]
mod tests;
