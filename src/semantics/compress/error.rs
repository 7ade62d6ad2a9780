//! What can go wrong with compression.

/// Why descriptors cannot be compressed, or a stored compressor not be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CompressError {
    /// There is nothing to learn from.
    #[error("all descriptors are missing or zero; extract the features again")]
    NoDescriptors,
    /// A descriptor is not finite.
    #[error("descriptor {row} holds a NaN or an infinity; extract the features again")]
    NonFinite {
        /// Number of the row.
        row: usize,
    },
    /// A setting is out of range.
    #[error("{name} is {value}; {remedy}")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Its value.
        value: String,
        /// What to choose.
        remedy: &'static str,
    },
    /// A stored compressor lacks an array, or one has the wrong length.
    #[error("the stored compressor's array `{name}` {what}; compress again")]
    Stored {
        /// Name of the array.
        name: String,
        /// What is wrong.
        what: String,
    },
}
