//! What can go wrong between a field and its surface.

/// Errors of this area, by cause.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
pub enum ExtractError {
    /// A value that must be finite is not. Never replaced by zero.
    #[error("{stage}: value {index} is not finite; the input of this stage has diverged or is damaged")]
    NonFinite {
        /// Which stage saw it.
        stage: &'static str,
        /// Index of the value in that stage's own order (said in the stage's documentation).
        index: usize,
    },
    /// An option or a grid that makes no sense.
    #[error("{name} is {value}; it must be {expected}")]
    Invalid {
        /// Name of the option.
        name: &'static str,
        /// What was given.
        value: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// Two inputs that must be as long as each other are not.
    #[error("{what} holds {found} values where {expected} are needed")]
    Length {
        /// The input, with its frame or column where there are several.
        what: String,
        /// Values needed.
        expected: usize,
        /// Values given.
        found: usize,
    },
    /// The grid would not fit the memory that it may use.
    #[error("{what} needs {needed_mb} MB but may use {limit_mb} MB; use a larger voxel or a smaller box")]
    TooLarge {
        /// What would have been allocated.
        what: &'static str,
        /// Memory needed, MB (10^6 bytes).
        needed_mb: u64,
        /// Memory allowed, MB.
        limit_mb: u64,
    },
}

impl ExtractError {
    /// `Ok` where `ok` holds, else an [`ExtractError::Invalid`] with the value as it was given.
    pub(crate) fn require(
        ok: bool,
        name: &'static str,
        value: impl std::fmt::Debug,
        expected: &'static str,
    ) -> Result<(), Self> {
        if ok { Ok(()) } else { Err(Self::Invalid { name, value: format!("{value:?}"), expected }) }
    }

    /// `Ok` where both lengths agree.
    pub(crate) fn same_length(
        what: impl FnOnce() -> String,
        expected: usize,
        found: usize,
    ) -> Result<(), Self> {
        if expected == found { Ok(()) } else { Err(Self::Length { what: what(), expected, found }) }
    }
}
