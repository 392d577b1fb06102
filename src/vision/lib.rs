//! The first half of coarse retrieval: from the bytes of a picture to its global descriptor and dense
//! features.
//!
//! An [`Extractor`] runs the stages `decode` → `preprocess` → `batcher` (inference) → `pooling`. Callers first
//! obtain a permit from [`Admission`], which bounds the pictures in progress. Searching and storing descriptors
//! is left to the index and the store.

mod admission;
mod batcher;
mod bench;
pub mod decode;
mod execution;
pub mod exif;
mod extraction;
mod extractor;
mod information;
mod input_sizes;
mod loaded;
pub mod manifest;
mod one_size;
mod pool;
pub mod pooling;
pub mod preprocess;
mod provider;
mod python;
mod raw_pixels;
mod runtime;
mod session;
mod settings;
mod sync;
mod trial;
mod verified;

pub use admission::{
    Admission, AdmissionLevels, AdmissionRequest, AdmissionSettings, Permit, RejectReason,
    Rejected, WorkClass,
};
pub use batcher::Layout;
pub use bench::{Bench, BenchFigures, BenchRow, BenchSettings};
pub use decode::{DecodeError, Foreign, ImageLimits, Needed, Picture};
pub use execution::{Execution, Provider, ProviderPreference};
pub use extraction::{Extraction, PendingExtraction, StageTimes};
pub use extractor::{ExtractError, Extractor, ExtractorSettings};
pub use information::{Dead, Information, Uninformative};
pub use input_sizes::InputSizes;
pub use loaded::{LoadedModels, LoadedSettings, ModelError};
pub use manifest::{DataFile, MANIFEST, Manifest, ManifestError, file_digest};
pub use one_size::OneSize;
pub use pool::{CpuPool, Overloaded, PoolError};
pub use pooling::{DescriptorSpec, FeatureSet, OwnVocabulary, Vocabulary};
pub use provider::{MIN_SIMILARITY, Measurement, Trial};
pub use raw_pixels::{PixelEncoding, RawPixels, RawPixelsError};
pub use runtime::{AUTO, Assets, BUILT_IN_MODEL, CHOSEN, PREFERRED_MODELS, RuntimeError, WhyModel};
pub use settings::{ImageSettings, auto, threads_or_cores};
pub use trial::{ModelFault, try_model};
