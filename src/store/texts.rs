//! What was read in images.

use std::collections::BTreeSet;

use async_trait::async_trait;

use super::StoreError;
use whereabouts_core::{Digest, Image, ImageId, ImageTexts, Map};

/// How much of a map was read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TextCounts {
    /// Images that were read.
    pub read: usize,
    /// Images that could not be read.
    pub failed: usize,
    /// Lines in the images that were read.
    pub lines: usize,
}

/// An image whose texts may match.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TextCandidate {
    /// The image.
    pub image: ImageId,
    /// How many of the grams occur in its texts.
    pub shared: usize,
}

/// The texts of images. They do not depend on descriptors, so a reindex keeps them; they are removed with their image or
/// their map.
#[async_trait]
pub trait TextStore: Send + Sync {
    /// Stores what was read in an image, in place of what was read before. Returns `false`, and stores nothing, if the
    /// map no longer has the image with these bytes.
    async fn put_texts(
        &self,
        map: &Map,
        image: &Image,
        texts: ImageTexts,
    ) -> Result<bool, StoreError>;
    /// Returns the texts of the images with these ids, in the order of `ids`; `None` for one that was not read.
    async fn texts(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<ImageTexts>>, StoreError>;
    /// Returns at most `limit` images whose ids sort after `after` and that this reader has not tried to read, by id.
    async fn unread(
        &self,
        map: &Map,
        reader: &Digest,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError>;
    /// Returns how much of the map was read by this reader; with `None`, by any.
    async fn text_counts(
        &self,
        map: &Map,
        reader: Option<&Digest>,
    ) -> Result<TextCounts, StoreError>;
    /// Returns at most `limit` images in whose texts most of these grams occur, and at least one
    /// ([`grams`](whereabouts_core::text_search::grams)); those with as many, by id.
    async fn text_candidates(
        &self,
        map: &Map,
        grams: &BTreeSet<u32>,
        limit: usize,
    ) -> Result<Vec<TextCandidate>, StoreError>;
}
