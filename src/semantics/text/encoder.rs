//! Text towers that run inside the tool: ONNX by `rten`, tokens by `tokenizers`, both Rust and without network.
//!
//! A folder as `scripts/export_text_encoders.py` writes it: `model.onnx` (tokens, and for BERT their mask, to one
//! embedding), `tokenizer.json`, and `encoder.json` with what the two do not say.

use std::path::{Path, PathBuf};

use rten::{Dimension, Model, NodeId, Value};
use tokenizers::Tokenizer;

use super::TextError;
use super::folder::{EXPORT_AGAIN, EncoderFile};
use crate::scene::features::{Space, normalise};

/// A text tower and its tokenizer.
pub struct TextEncoder {
    folder: PathBuf,
    about: EncoderFile,
    tokenizer: Tokenizer,
    model: Model,
    ids: NodeId,
    mask: Option<NodeId>,
    output: NodeId,
    /// The model takes any number of tokens up to its context: padding, which changes nothing, is left away.
    any_length: bool,
}

impl TextEncoder {
    /// Loads the encoder in a folder.
    ///
    /// # Errors
    /// [`TextError::Encoder`]: a file is missing or damaged, or the model is not such a text tower.
    pub fn open(folder: &Path) -> Result<Self, TextError> {
        let bad = |name: &str, what: String| TextError::Encoder {
            path: folder.join(name),
            what,
            remedy: EXPORT_AGAIN,
        };
        let about = EncoderFile::read(folder)?;
        let tokenizer = Tokenizer::from_file(folder.join("tokenizer.json"))
            .map_err(|e| bad("tokenizer.json", e.to_string()))?;
        let model =
            Model::load_file(folder.join("model.onnx")).map_err(|e| bad("model.onnx", e.to_string()))?;
        let node = |name: &str| model.find_node(name);
        let ids = node("input_ids").ok_or_else(|| bad("model.onnx", "it has no input `input_ids`".into()))?;
        let mask = node("attention_mask");
        let output = node("text_embedding")
            .ok_or_else(|| bad("model.onnx", "it has no output `text_embedding`".into()))?;
        let shape = model.node_info(ids).and_then(|info| info.shape()).unwrap_or_default();
        let any_length = matches!(shape[..], [_, Dimension::Symbolic(_)]);
        Ok(Self { folder: folder.to_owned(), about, tokenizer, model, ids, mask, output, any_length })
    }

    /// The space of its embeddings.
    pub fn space(&self) -> Space {
        self.about.space
    }

    /// Numbers per embedding.
    pub fn dim(&self) -> usize {
        self.about.dim
    }

    /// Tokens of a text, padded or cut to the model's context, and how many of them are the text's.
    ///
    /// A text that is too long loses what is behind, but keeps its last token, which marks the end.
    ///
    /// # Errors
    /// [`TextError::Encoder`] if the tokenizer fails.
    pub fn tokens(&self, text: &str) -> Result<(Vec<u32>, usize), TextError> {
        let encoding = self.tokenizer.encode(text, true).map_err(|e| self.failed(e.to_string()))?;
        let mut ids = encoding.get_ids().to_vec();
        let context = self.about.context;
        if ids.len() > context {
            let end = ids[ids.len() - 1];
            ids.truncate(context);
            ids[context - 1] = end;
        }
        let count = ids.len();
        ids.resize(context, self.about.pad);
        Ok((ids, count))
    }

    /// The embedding of a text, of unit length.
    ///
    /// # Errors
    /// [`TextError::Encoder`] if the model fails or its answer is not a finite embedding.
    pub fn embed(&self, text: &str) -> Result<Vec<f32>, TextError> {
        let (mut ids, count) = self.tokens(text)?;
        if self.any_length {
            ids.truncate(count);
        }
        let length = ids.len();
        // ONNX's 64-bit integers are 32-bit ones in rten.
        let tensor = |values: Vec<i32>| {
            Value::from_shape([1, length].as_slice(), values).map_err(|e| self.failed(e.to_string()))
        };
        let mask: Vec<i32> = (0..length).map(|n| i32::from(n < count)).collect();
        let ids = tensor(ids.into_iter().map(|id| id as i32).collect())?;
        let mut inputs = vec![(self.ids, ids.into())];
        if let Some(node) = self.mask {
            inputs.push((node, tensor(mask)?.into()));
        }
        let [output] =
            self.model.run_n(inputs, [self.output], None).map_err(|e| self.failed(e.to_string()))?;
        let (_, mut embedding) = output.into_shape_vec::<f32, 2>().map_err(|e| self.failed(e.to_string()))?;
        if embedding.len() != self.about.dim || embedding.iter().any(|v| !v.is_finite()) {
            let what =
                format!("it gave {} numbers for one text, or some that are not finite", embedding.len());
            return Err(self.failed(what));
        }
        normalise(&mut embedding);
        Ok(embedding)
    }

    fn failed(&self, what: String) -> TextError {
        TextError::Encoder { path: self.folder.clone(), what, remedy: EXPORT_AGAIN }
    }
}

impl std::fmt::Debug for TextEncoder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TextEncoder").field("folder", &self.folder).field("about", &self.about).finish()
    }
}
