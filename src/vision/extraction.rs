//! One picture on its way through a model: decoded and waiting for inference, and what comes of it.

use std::time::{Duration, Instant};

use super::batcher::{PendingInference, Pooled};
use super::extractor::ExtractError;
use super::information::Information;
use whereabouts_core::{DenseFeatures, Descriptor, Digest, MediaType};

/// A decoded picture whose inference is in progress. Dropping it cancels the inference if it has not started.
#[derive(Debug)]
pub struct PendingExtraction {
    pub(super) inference: PendingInference,
    pub(super) picture: SubmittedPicture,
}

/// What is known of a picture whose inference is in progress.
#[derive(Debug)]
pub(super) struct SubmittedPicture {
    pub digest: Digest,
    pub media_type: MediaType,
    pub width: u32,
    pub height: u32,
    pub warnings: Vec<String>,
    pub information: Information,
    /// Duration of decoding and resizing.
    pub decode: Duration,
    pub submitted: Instant,
}

impl PendingExtraction {
    /// Waits for inference.
    pub async fn result(self) -> Result<Extraction, ExtractError> {
        let Self { inference, picture } = self;
        Ok(picture.with(inference.result().await?))
    }

    /// Blocks until inference is done.
    pub(super) fn wait(self) -> Result<Extraction, ExtractError> {
        let Self { inference, picture } = self;
        Ok(picture.with(inference.wait()?))
    }
}

impl SubmittedPicture {
    fn with(self, Pooled { descriptor, dense, batch }: Pooled) -> Extraction {
        let Self { digest, media_type, width, height, warnings, information, decode, submitted } =
            self;
        let times = StageTimes { decode, extract: submitted.elapsed() };
        Extraction {
            descriptor,
            dense,
            digest,
            media_type,
            width,
            height,
            warnings,
            information,
            times,
            batch,
        }
    }
}

/// The result of extracting one picture.
#[derive(Debug)]
pub struct Extraction {
    /// Global descriptor.
    pub descriptor: Descriptor,
    /// Dense features, if they were requested.
    pub dense: Option<DenseFeatures>,
    /// SHA-256 of the picture's bytes.
    pub digest: Digest,
    /// Format of the picture.
    pub media_type: MediaType,
    /// Width in pixels, after applying the EXIF orientation.
    pub width: u32,
    /// Height in pixels, after applying the EXIF orientation.
    pub height: u32,
    /// What the sender should know about the picture, such as damage.
    pub warnings: Vec<String>,
    /// How much structure the picture has.
    pub information: Information,
    /// Durations of the stages.
    pub times: StageTimes,
    /// Size of the batch that the picture was part of.
    pub batch: usize,
}

/// Durations of the stages of one extraction.
#[derive(Debug, Clone, Copy, Default)]
pub struct StageTimes {
    /// Decoding and resizing.
    pub decode: Duration,
    /// Queueing for a session, inference and pooling.
    pub extract: Duration,
}
