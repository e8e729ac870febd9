//! What can go wrong while a map is read or a method is built. Evaluation never fails.
//!
//! The variants are classes a caller acts on: a file that cannot be read, a file whose content is unusable,
//! a parameter out of its domain. Every message names the file or the parameter and says what to do.

use std::path::PathBuf;

/// Result of reading a map or building a method.
pub type Result<T> = std::result::Result<T, Error>;

#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file is missing, unreadable, or not an image that the library decodes.
    #[error("filename \"{}\": {reason}", path.display())]
    File { path: PathBuf, reason: String },

    /// The image was decoded, but its texels are not a normal map.
    #[error("filename \"{map}\": {reason}")]
    Map { map: String, reason: String },

    /// A parameter outside its domain.
    #[error("parameter \"{name}\" = {value}: {reason}")]
    Parameter {
        name: &'static str,
        value: String,
        reason: String,
    },
}

impl Error {
    pub(crate) fn parameter(name: &'static str, value: impl ToString, reason: impl Into<String>) -> Self {
        Self::Parameter {
            name,
            value: value.to_string(),
            reason: reason.into(),
        }
    }
}
