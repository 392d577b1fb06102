//! Reads the text in the frame of a job.

use async_trait::async_trait;
use whereabouts_core::{Digest, MapName, TextLine};

/// Reads the text in the frames of jobs.
#[async_trait]
pub trait FrameReader: Send + Sync {
    /// Reads the text in a frame that is looked for in a map. Returns `None` if there is no reader, no text in the map to
    /// compare it with, or the frame cannot be read. A job does without.
    async fn read_frame(&self, map: &MapName, frame: &Digest) -> Option<Vec<TextLine>>;
}
