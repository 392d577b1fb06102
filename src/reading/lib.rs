//! Scene text: detects and recognises the lines of text in a picture.

use whereabouts_core::{Digest, TextLine};
use whereabouts_vision::Picture;

/// Reads the text in pictures. A call is CPU-bound.
pub trait Reader: Send + Sync + std::fmt::Debug {
    /// Identifies the models and everything else that a result depends on. Pictures are read again when
    /// it changes.
    fn digest(&self) -> Digest;

    /// The lines of text in a picture, from top to bottom.
    fn read(&self, picture: &Picture) -> Result<Vec<TextLine>, ReadError>;
}

/// Why a picture could not be read.
#[derive(Debug, thiserror::Error)]
#[error("cannot read the text of a picture: {0}")]
pub struct ReadError(pub String);
