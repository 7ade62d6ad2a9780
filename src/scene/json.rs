//! JSON with errors that name the file, the frame and the key.

use std::path::Path;

use glam::DMat4;
use serde_json::{Map, Value};

use super::error::{Place, SceneError};

/// Reads a JSON file whose top level is an object.
///
/// Python writes NaN and infinities as bare words, which JSON does not know; they are read as `null`, so that
/// the error can name the frame and the key that hold them and not only a column.
pub(crate) fn read_object(path: &Path) -> Result<Map<String, Value>, SceneError> {
    let mut text = std::fs::read(path).map_err(|e| SceneError::io(path, e))?;
    blank_non_finite_words(&mut text);
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&text);
    let value: Value = serde_json::from_slice(text).map_err(|e| {
        SceneError::invalid(
            path,
            Place::Line(e.line()),
            format!("not valid JSON: {e}"),
            "the file may be cut short or edited by hand; write it again",
        )
    })?;
    match value {
        Value::Object(map) => Ok(map),
        other => Err(SceneError::invalid(
            path,
            Place::File,
            format!("the top level is {}, not an object", kind(&other)),
            "check that this is the scene's own file",
        )),
    }
}

/// Replaces `NaN`, `Infinity` and `-Infinity` outside strings by `null` and blanks: lines keep their numbers.
fn blank_non_finite_words(text: &mut [u8]) {
    let (mut i, mut in_string) = (0, false);
    while i < text.len() {
        match text[i] {
            b'\\' if in_string => i += 1,
            b'"' => in_string = !in_string,
            b'-' | b'N' | b'I' if !in_string => {
                for word in [&b"-Infinity"[..], b"Infinity", b"NaN"] {
                    if text[i..].starts_with(word) {
                        // Three letters do not hold `null`; "" is as little a number.
                        let blank: &[u8] = if word.len() < 4 { b"\"\" " } else { b"null     " };
                        text[i..i + word.len()].copy_from_slice(&blank[..word.len()]);
                        i += word.len() - 1;
                        break;
                    }
                }
            }
            _ => {}
        }
        i += 1;
    }
}

/// A JSON object together with where it is, for error messages.
#[derive(Clone, Copy)]
pub(crate) struct Fields<'a> {
    pub path: &'a Path,
    /// Name of the frame that the object describes; `None` at the top level.
    pub frame: Option<&'a str>,
    pub map: &'a Map<String, Value>,
}

impl<'a> Fields<'a> {
    /// Where `key` of this object is.
    pub fn place(&self, key: &str) -> Place {
        match self.frame {
            Some(frame) => Place::FrameKey { frame: frame.to_owned(), key: key.to_owned() },
            None => Place::Key(key.to_owned()),
        }
    }

    pub fn invalid(&self, key: &str, what: impl Into<String>, remedy: impl Into<String>) -> SceneError {
        SceneError::invalid(self.path, self.place(key), what, remedy)
    }

    fn wrong_type(&self, key: &str, wanted: &str, found: &Value) -> SceneError {
        self.invalid(key, format!("expected {wanted}, found {}", kind(found)), "correct the value")
    }

    /// The value of a key that must be there.
    pub fn required(&self, key: &str) -> Result<&'a Value, SceneError> {
        self.map.get(key).ok_or_else(|| self.invalid(key, "the key is missing", "add it"))
    }

    /// A finite number, if the key is there.
    pub fn number(&self, key: &str) -> Result<Option<f64>, SceneError> {
        self.map
            .get(key)
            .map(|v| finite(v).ok_or_else(|| self.wrong_type(key, "a finite number", v)))
            .transpose()
    }

    /// A text, if the key is there and not null.
    pub fn text(&self, key: &str) -> Result<Option<&'a str>, SceneError> {
        match self.map.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(Value::String(s)) => Ok(Some(s)),
            Some(other) => Err(self.wrong_type(key, "a text", other)),
        }
    }

    /// True or false, if the key is there.
    pub fn flag(&self, key: &str) -> Result<Option<bool>, SceneError> {
        self.map
            .get(key)
            .map(|v| v.as_bool().ok_or_else(|| self.wrong_type(key, "true or false", v)))
            .transpose()
    }

    /// A whole number from 0 to 2³²−1, if the key is there (3 and 3.0 alike).
    pub fn whole(&self, key: &str) -> Result<Option<u32>, SceneError> {
        let Some(x) = self.number(key)? else { return Ok(None) };
        if x.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&x) {
            return Ok(Some(x as u32));
        }
        Err(self.invalid(key, format!("{x} is not a whole number from 0 to {}", u32::MAX), "correct it"))
    }

    /// A list, if the key is there and not null.
    pub fn list(&self, key: &str) -> Result<Option<&'a [Value]>, SceneError> {
        match self.map.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(Value::Array(items)) => Ok(Some(items)),
            Some(other) => Err(self.wrong_type(key, "a list", other)),
        }
    }

    /// An object that must be there.
    pub fn object(&self, key: &str) -> Result<&'a Map<String, Value>, SceneError> {
        let value = self.required(key)?;
        value.as_object().ok_or_else(|| self.wrong_type(key, "an object", value))
    }

    /// A 3×4 or 4×4 row-major matrix, if the key is there. Numbers may be NaN: the pose check names them.
    pub fn matrix(&self, key: &str) -> Result<Option<DMat4>, SceneError> {
        self.map.get(key).map(|v| self.matrix_of(key, v)).transpose()
    }

    /// [`Fields::matrix`] of a value already in hand.
    pub fn matrix_of(&self, key: &str, value: &Value) -> Result<DMat4, SceneError> {
        let shape = || {
            self.invalid(
                key,
                "expected a matrix of 3 or 4 rows of 4 numbers",
                "write the camera-to-world matrix row by row",
            )
        };
        let rows = value.as_array().filter(|r| r.len() == 3 || r.len() == 4).ok_or_else(shape)?;
        let mut m = [0.0, 0.0, 0.0, 1.0].map(|w| [0.0, 0.0, 0.0, w]);
        for (i, row) in rows.iter().enumerate() {
            let row = row.as_array().filter(|r| r.len() == 4).ok_or_else(shape)?;
            for (j, x) in row.iter().enumerate() {
                m[i][j] = match x {
                    Value::Number(_) => x.as_f64().unwrap_or(f64::NAN),
                    // What `read_object` makes of NaN and infinities.
                    Value::Null => f64::NAN,
                    Value::String(s) if s.is_empty() => f64::NAN,
                    _ => return Err(shape()),
                };
            }
        }
        Ok(DMat4::from_cols_array_2d(&m).transpose())
    }
}

/// The finite number that a value holds.
pub(crate) fn finite(value: &Value) -> Option<f64> {
    value.as_f64().filter(|x| x.is_finite())
}

/// `N` finite numbers; `None` if the value is anything else.
pub(crate) fn finite_array<const N: usize>(value: &Value) -> Option<[f64; N]> {
    let items = value.as_array().filter(|items| items.len() == N)?;
    let mut out = [0.0; N];
    for (slot, item) in out.iter_mut().zip(items) {
        *slot = finite(item)?;
    }
    Some(out)
}

/// What a value is, for people.
fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null or an infinite number",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "a number",
        Value::String(s) if s.is_empty() => "an empty text or NaN",
        Value::String(_) => "a text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}
