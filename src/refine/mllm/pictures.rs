//! Prepares pictures for the model: scaled down, as JPEG, in a data URL.

use std::sync::Arc;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use image::RgbImage;
use tokio::sync::Semaphore;

use super::kept::KeptPictures;
use super::side_by_side::side_by_side;
use super::single_flight::SingleFlight;
use whereabouts_core::Digest;
use whereabouts_store::{BlobStore, StoreError};
use whereabouts_vision::decode::{Needed, decode, encode_jpeg};
use whereabouts_vision::preprocess::shrink_to;
use whereabouts_vision::{CpuPool, ImageLimits};

/// Threads that decode, scale and encode. Two are enough, because a picture takes milliseconds and a call
/// seconds.
const THREADS: usize = 2;

/// A prepared picture.
#[derive(Debug, Clone)]
pub struct SentPicture {
    /// The data URL.
    pub url: Arc<str>,
    /// Its estimated cost in tokens.
    pub tokens: u64,
}

/// Why a picture could not be prepared.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The store has no such picture.
    #[error("the bytes of the picture are missing from the store")]
    Missing,
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// It cannot be decoded, scaled or encoded.
    #[error("the picture cannot be prepared: {0}")]
    Unfit(String),
    /// The threads did not do the work.
    #[error("the picture was not prepared: {0}")]
    Undone(String),
}

/// Fetches and prepares pictures.
pub struct Pictures {
    blobs: Arc<dyn BlobStore>,
    limits: ImageLimits,
    max_edge: u32,
    pool: CpuPool,
    /// One permit for each place in the pool's queue, so that the queue never overflows.
    permits: Arc<Semaphore>,
    kept: KeptPictures,
    in_preparation: SingleFlight<SentPicture>,
}

impl Pictures {
    /// Starts the threads.
    pub fn new(
        blobs: Arc<dyn BlobStore>,
        limits: ImageLimits,
        max_edge: u32,
        kept_bytes: usize,
    ) -> std::io::Result<Self> {
        let pool = CpuPool::new("mllm-pictures", THREADS, THREADS)?;
        let (permits, kept) = (Arc::new(Semaphore::new(THREADS)), KeptPictures::new(kept_bytes));
        Ok(Self {
            blobs,
            limits,
            max_edge,
            pool,
            permits,
            kept,
            in_preparation: SingleFlight::default(),
        })
    }

    /// Prepares the picture of an image in a map, or returns the one that was prepared for another pair.
    pub async fn of_image(&self, digest: &Digest) -> Result<SentPicture, PictureError> {
        let prepare = || async {
            if let Some(kept) = self.kept.get(digest) {
                return Ok(kept);
            }
            let picture = self.picture(digest).await?;
            self.kept.keep(*digest, picture.clone());
            Ok(picture)
        };
        self.in_preparation.join(*digest, prepare).await
    }

    /// Fetches and prepares the picture with that digest.
    pub async fn picture(&self, digest: &Digest) -> Result<SentPicture, PictureError> {
        let undone = |error: &dyn std::error::Error| PictureError::Undone(error.to_string());
        let bytes = self.blobs.blob(digest).await?.ok_or(PictureError::Missing)?;
        let permit =
            Arc::clone(&self.permits).acquire_owned().await.map_err(|error| undone(&error))?;
        let (limits, max_edge) = (self.limits, self.max_edge);
        let work = move || {
            // Held until the work is done, even if the caller is cancelled before.
            let _permit = permit;
            prepare(&bytes, limits, max_edge)
        };
        self.pool.run(work).await.map_err(|error| undone(&error))?
    }

    /// Fetches the pictures with these digests and prepares one of both, each as large as it would be sent alone.
    pub async fn both(
        &self,
        frame: &Digest,
        candidate: &Digest,
    ) -> Result<SentPicture, PictureError> {
        let undone = |error: &dyn std::error::Error| PictureError::Undone(error.to_string());
        let frame = self.blobs.blob(frame).await?.ok_or(PictureError::Missing)?;
        let candidate = self.blobs.blob(candidate).await?.ok_or(PictureError::Missing)?;
        let permit =
            Arc::clone(&self.permits).acquire_owned().await.map_err(|error| undone(&error))?;
        let (limits, max_edge) = (self.limits, self.max_edge);
        let work = move || {
            let _permit = permit;
            let [frame, candidate] =
                [frame, candidate].map(|bytes| scaled(&bytes, limits, max_edge));
            encoded(&side_by_side(&frame?, &candidate?))
        };
        self.pool.run(work).await.map_err(|error| undone(&error))?
    }
}

/// Decodes, scales and encodes; blocks. Even a JPEG that is small enough is encoded again, because its EXIF
/// data may contain the position, which must not leave the service.
fn prepare(bytes: &Bytes, limits: ImageLimits, max_edge: u32) -> Result<SentPicture, PictureError> {
    encoded(&scaled(bytes, limits, max_edge)?)
}

fn scaled(bytes: &Bytes, limits: ImageLimits, max_edge: u32) -> Result<RgbImage, PictureError> {
    let unfit = |error: &dyn std::error::Error| PictureError::Unfit(error.to_string());
    let needed = Needed::LongestEdge(max_edge);
    let picture = decode(bytes, limits, needed).map_err(|error| unfit(&error))?;
    let pixels = shrink_to(&picture.pixels, max_edge).map_err(|error| unfit(&error))?;
    Ok(pixels)
}

fn encoded(pixels: &RgbImage) -> Result<SentPicture, PictureError> {
    let jpeg = encode_jpeg(pixels).map_err(|error| PictureError::Unfit(error.to_string()))?;
    Ok(SentPicture { url: data_url(&jpeg), tokens: estimate_tokens(pixels) })
}

/// Returns the data URL of a JPEG.
pub(super) fn data_url(jpeg: &[u8]) -> Arc<str> {
    format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)).into()
}

/// Estimates by the rule of OpenAI's vision models: 85 tokens, plus 170 for each tile of 512 pixels. Other
/// models count differently; reservations use the estimate, and bills use the server's count.
fn estimate_tokens(pixels: &RgbImage) -> u64 {
    let tiles = u64::from(pixels.width().div_ceil(512)) * u64::from(pixels.height().div_ceil(512));
    85 + 170 * tiles
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: ImageLimits = ImageLimits { max_pixels: 1_000_000 };

    #[test]
    fn a_picture_is_sent_as_a_scaled_down_jpeg() {
        let bytes = encode_jpeg(&RgbImage::new(800, 600)).unwrap();
        let sent = prepare(&bytes.into(), LIMITS, 400).unwrap();
        let data = sent.url.strip_prefix("data:image/jpeg;base64,").unwrap();
        let pixels = decode(&STANDARD.decode(data).unwrap(), LIMITS, Needed::All).unwrap().pixels;
        assert_eq!(pixels.dimensions(), (400, 300));
        assert_eq!(sent.tokens, 85 + 170);
    }

    #[test]
    fn bytes_that_are_no_picture_are_not_sent() {
        let error = prepare(&Bytes::from_static(b"hello"), LIMITS, 400).unwrap_err();
        assert!(matches!(error, PictureError::Unfit(_)));
    }
}
