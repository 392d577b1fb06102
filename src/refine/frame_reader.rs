//! Reads the text in the frame of a job.

use async_trait::async_trait;
use whereabouts_core::{Digest, TextLine};

/// Reads the text in the frames of jobs.
#[async_trait]
pub trait FrameReader: Send + Sync {
    /// Reads the text in a frame; `None` if there is no reader, or the frame cannot be read. A job does without.
    async fn read_frame(&self, frame: &Digest) -> Option<Vec<TextLine>>;
}
