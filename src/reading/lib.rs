//! Scene text: detects and recognises the lines of text in a picture.
//!
//! An [`OnnxReader`] runs two models: `detector` finds the lines as quadrilaterals (DBNet, Liao et al., *Real-time Scene
//! Text Detection with Differentiable Binarization*, 2020), `crop` straightens each, and `recogniser` reads it (CTC,
//! Graves et al., 2006). What the models need is in a [`Manifest`].

mod crop;
mod detector;
mod geometry;
mod manifest;
mod model;
mod reader;
mod recogniser;
mod tensor;

use whereabouts_core::{Digest, TextLine};
use whereabouts_vision::Picture;

pub use self::manifest::Manifest;
pub use self::reader::{OnnxReader, ReaderSettings};

/// Reads the text in pictures. A call is CPU-bound.
pub trait Reader: Send + Sync + std::fmt::Debug {
    /// Identifies the models and everything else that a result depends on. Pictures are read again when
    /// it changes.
    fn digest(&self) -> Digest;

    /// The lines of text in a picture, from top to bottom.
    fn read(&self, picture: &Picture) -> Result<Vec<TextLine>, ReadError>;
}

/// Why a picture could not be read, or a reader not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The reader is not installed.
    #[error(
        "no reader of scene text called {name:?} is installed (searched {searched}); `make reader` installs \"ppocrv5\""
    )]
    NotInstalled {
        /// The reader.
        name: String,
        /// The folders that were searched.
        searched: String,
    },
    /// A file of the reader cannot be used.
    #[error("{0}; `make reader` installs the reader again")]
    File(String),
    /// ONNX Runtime is not available.
    #[error(transparent)]
    Runtime(#[from] whereabouts_vision::RuntimeError),
    /// A model failed.
    #[error("the text of a picture cannot be read: {0}")]
    Model(String),
}

impl From<ort::Error> for ReadError {
    fn from(error: ort::Error) -> Self {
        Self::Model(error.to_string())
    }
}
