//! The coarse retriever: from the bytes of a picture to its global descriptor, and from a
//! descriptor to the most similar ones.
//!
//! `decode` → `preprocess` → `batcher` (inference) → `pooling` → `index`, in this order; the
//! [`Extractor`] strings the first four together. Where descriptors and records are kept is the
//! business of [`crate::store`].

pub mod decode;
mod batcher;
mod extractor;
pub mod index;
mod jpeg;
pub mod manifest;
pub mod pooling;
mod pool;
pub mod preprocess;
mod runtime;

pub use decode::{DecodeError, ImageLimits, Picture};
pub use extractor::{Extraction, ExtractError, Extractor, ExtractorSettings, StageTimes};
pub use manifest::{Manifest, ManifestError};
pub use pool::{CpuPool, Overloaded, PoolError};
pub use runtime::{Assets, RuntimeError};
