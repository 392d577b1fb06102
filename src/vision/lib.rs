//! The coarse retriever: from the bytes of a picture to its global descriptor, and from a
//! descriptor to the most similar ones.
//!
//! `decode` → `preprocess` → `batcher` (inference) → `pooling` → `index`, in this order; the
//! [`Extractor`] strings the first four together, for whoever has a permit of the
//! [`Admission`]. Where descriptors and records are kept is the
//! business of the store.

mod admission;
mod batcher;
mod bench;
pub mod decode;
mod extractor;
mod jpeg;
mod loaded;
pub mod manifest;
mod pool;
pub mod pooling;
pub mod preprocess;
mod provider;
mod runtime;
mod session;

pub use admission::{
    Admission, AdmissionLevels, AdmissionRequest, AdmissionSettings, Permit, RejectReason,
    Rejected, WorkClass,
};
pub use batcher::Layout;
pub use bench::{Bench, BenchFigures, BenchRow, BenchSettings};
pub use decode::{DecodeError, ImageLimits, Needed, Picture};
pub use extractor::{
    ExtractError, Extraction, Extractor, ExtractorSettings, Inference, PendingExtraction,
    StageTimes,
};
pub use loaded::{LoadedModels, LoadedSettings, ModelError};
pub use manifest::{MANIFEST, Manifest, ManifestError, file_digest};
pub use pool::{CpuPool, Overloaded, PoolError};
pub use provider::{Execution, MIN_SIMILARITY, Measurement, Provider, ProviderPreference, Trial};
pub use runtime::{AUTO, Assets, BUILT_IN_MODEL, CHOSEN, PREFERRED_MODELS, RuntimeError, WhyModel};
