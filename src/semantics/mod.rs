//! What things are and what can be done with them: targets that fields are trained on, compression of their
//! descriptors, and how well a point answers a phrase.
//!
//! `targets` turns the features of a scene's frames into one table per space and tells which rows a pixel is to look
//! like; `compress` makes the rows short; `head` learns and renders them for every stream; `fields` is what a run keeps
//! of that; `text` embeds phrases; `relevancy` holds points against them without making them long again.

pub mod agreement;
pub mod bake;
pub mod compress;
pub mod config;
pub mod error;
pub mod fields;
pub mod head;
pub mod layers;
pub mod overlay;
pub mod relevancy;
pub mod targets;
pub mod text;
pub mod text_source;

pub use self::config::SemanticsConfig;
pub use self::error::SemanticsError;
pub use self::fields::{SemanticFields, SpaceField};
pub use self::text_source::{TextSources, slug};
