//! The contract between clients and the server as types: requests, responses, gRPC messages and the HTTP client.

mod batch;
#[cfg(feature = "client")]
mod client;
#[cfg(feature = "grpc")]
mod convert;
mod descriptions;
mod error;
mod images;
mod jobs;
mod keys;
mod localize;
mod maps;
mod texts;
#[cfg(feature = "grpc")]
mod texts_convert;
mod tracks;
mod usage;
mod webhooks;
mod words;

pub use self::batch::{BatchAnswer, BatchOutcome, BatchProblem, BatchResult};
#[cfg(feature = "client")]
pub use self::client::{Client, MAX_ATTEMPTS, MAX_PAUSE, explained, segment};
#[cfg(feature = "grpc")]
pub use self::convert::{job_state_to, moment_to};
pub use self::descriptions::{DescriptionPage, KeyedDescription, PurgedDescriptions};
pub use self::error::ErrorKind;
pub use self::images::{
    ExportPage, ImageAnswer, ImageMeta, ImagePage, ImagePatch, ImportedImage, ImportedMap,
    VocabularyData,
};
pub use self::jobs::{JobChange, JobPage, JobStatus, Missed, PairDescribed, PairRegions};
pub use self::keys::{MadeKey, NewKey};
pub use self::localize::{
    Answer, JobLink, NoJob, NoJobReason, RefineMode, TimingMs, TrackEstimate, TrackHypothesis,
};
pub use self::maps::{
    CalibrationState, IndexKind, MapChange, MapRefiner, MapState, Reindex, ReindexRequest,
    ReindexState, VocabularyChoice, VocabularyState,
};
pub use self::texts::{ImageMatch, ImageState, MapTexts};
pub use self::tracks::{TrackList, TrackPlace, TrackSummary, TrackWay};
pub use self::usage::{Today, Total, UsageReport};
pub use self::webhooks::{DeliveryPage, MadeWebhook, NewWebhook};
pub use self::words::{
    NamedSign, SeenSign, WordsAnswer, WordsCandidate, WordsEstimate, WordsRequest, WordsTimingMs,
};

/// The messages and services generated from `proto/`.
#[cfg(feature = "grpc")]
#[allow(missing_docs, clippy::all, clippy::pedantic)]
pub mod proto {
    tonic::include_proto!("whereabouts.v1");
}

/// The contract as an encoded `FileDescriptorSet`, for gRPC reflection.
#[cfg(feature = "grpc")]
pub const DESCRIPTOR_SET: &[u8] = tonic::include_file_descriptor_set!("whereabouts.v1");
