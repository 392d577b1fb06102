//! Reads the text in the frame of a job.

use std::fmt;
use std::future::Future;
use std::sync::Arc;

use async_trait::async_trait;
use futures_util::FutureExt;
use futures_util::future::{BoxFuture, Shared};
use whereabouts_core::{Digest, MapName, TextLine};

/// Reads the text in the frames of jobs.
#[async_trait]
pub trait FrameReader: Send + Sync {
    /// Reads the text in a frame that is looked for in a map. Returns `None` if there is no reader, no text in the map to
    /// compare it with, or the frame cannot be read. A job does without.
    async fn read_frame(&self, map: &MapName, frame: &Digest) -> Option<Vec<TextLine>>;
}

/// Lines that are being read; `None` if they cannot be.
type Lines = Option<Arc<[TextLine]>>;

/// The text in a frame, which is read once, while its regions are compared.
#[derive(Clone, Default)]
pub struct FrameTexts(Option<Shared<BoxFuture<'static, Lines>>>);

impl FrameTexts {
    /// The text that a future will have read.
    pub fn of(read: impl Future<Output = Option<Vec<TextLine>>> + Send + 'static) -> Self {
        Self(Some(read.map(|lines| lines.map(Arc::from)).boxed().shared()))
    }

    /// Waits until the frame is read; `None` if it is not.
    pub async fn get(&self) -> Lines {
        self.0.clone()?.await
    }
}

impl fmt::Debug for FrameTexts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "FrameTexts(..)" } else { "FrameTexts(none)" })
    }
}
