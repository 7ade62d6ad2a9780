//! What things are and what can be done with them: targets that fields are trained on, compression of their
//! descriptors, and how well a point answers a phrase.
//!
//! `targets` turns the features of a scene's frames into one table per space and tells which rows a pixel is to look
//! like; `compress` makes the rows short; `relevancy` holds points against a phrase without making them long again;
//! `text` embeds phrases.

pub mod compress;
pub mod relevancy;
pub mod targets;
pub mod text;
