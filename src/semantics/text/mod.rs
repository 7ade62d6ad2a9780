//! Phrases to embeddings: from a file given by the user, from the scene's own `text/<space>.npy`, or from an encoder
//! that runs inside the tool.
//!
//! [`TextSource`] asks them in this order. [`TextEncoder`] is the last of them, ONNX and a tokenizer in a folder.

#[cfg(not(feature = "text"))]
mod absent;
#[cfg(feature = "text")]
mod encoder;
mod error;
mod folder;
mod source;
mod spelling;
#[cfg(test)]
mod tests;

#[cfg(not(feature = "text"))]
pub use absent::TextEncoder;
#[cfg(feature = "text")]
pub use encoder::TextEncoder;
pub use error::TextError;
pub use source::TextSource;
