//! Maps, their images and the search in them.

use std::sync::Arc;

use async_trait::async_trait;
use futures_util::future::try_join_all;

use super::StoreError;
use whereabouts_core::{
    Calibration, CalibrationSettings, Candidate, Descriptor, ExportedImage, Image, ImageId, Map,
    MapName, Pose, Recording,
};
use whereabouts_index::SearchMode;

/// The result of adding an image.
#[derive(Debug, Clone, PartialEq)]
pub enum Added {
    /// The image is new.
    Created(Image),
    /// An image with this id and the same bytes was already stored; nothing changed.
    Present(Image),
}

/// The state of a map's index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IndexState {
    /// Images in the map.
    pub images: usize,
    /// Whether searches use a graph.
    pub graph: bool,
    /// Whether some images are not in the graph yet. Until they are, they are searched exactly.
    pub behind: bool,
    /// Number of additions, removals and changed poses since the store was opened.
    pub changes: u64,
    /// How often poses of images were changed since the map was created.
    pub moved: u64,
    /// The changes that concern images with a pose, counted like `changes`. A previous release that shares the database
    /// does not count them.
    pub located: u64,
}

/// The hard negatives of one image: images of other places that resemble it most.
#[derive(Debug, Clone, PartialEq)]
pub struct HardNegatives {
    /// The image that served as the query.
    pub image_id: ImageId,
    /// Images of other places, the most similar first.
    pub others: Vec<Candidate>,
}

/// An image that has a pose.
#[derive(Debug, Clone, PartialEq)]
pub struct LocatedImage {
    /// The position of its descriptor in the store, which stays the same as long as the image exists.
    pub slot: usize,
    /// Its id.
    pub id: ImageId,
    /// Where it was taken.
    pub pose: Pose,
}

/// Maps, their images and their descriptors.
#[async_trait]
pub trait MapStore: Send + Sync {
    /// Creates a map, or changes the map of the same name. Scene and description can always be
    /// changed; the coordinate frame while no image has a pose; model and descriptor only while the map
    /// has no images ([`StoreError::Conflict`] afterwards).
    ///
    /// Returns the map as stored, and whether it is new.
    async fn put_map(&self, map: Map) -> Result<(Map, bool), StoreError>;
    /// Returns the map of this name.
    async fn map(&self, name: &MapName) -> Result<Option<Map>, StoreError>;
    /// Returns all maps, sorted by name.
    async fn maps(&self) -> Result<Vec<Map>, StoreError>;
    /// Deletes a map with all its images. Returns `false` if there was no such map.
    async fn delete_map(&self, name: &MapName) -> Result<bool, StoreError>;
    /// Returns the state of a map's index.
    async fn index_state(&self, map: &Map) -> Result<IndexState, StoreError>;

    /// Adds an image, whose bytes must have been stored with [`BlobStore::put_blob`], with its place in a recording.
    ///
    /// # Errors
    /// [`StoreError::Conflict`] if an image with this id has other bytes;
    /// [`StoreError::Superseded`] if the descriptor belongs to another revision of the map, or the pose to
    /// another coordinate frame.
    ///
    /// [`BlobStore::put_blob`]: super::BlobStore::put_blob
    async fn add_recorded(
        &self,
        map: &Map,
        image: Image,
        descriptor: Descriptor,
        recording: Option<Recording>,
    ) -> Result<Added, StoreError>;
    /// Adds an image that belongs to no recording.
    async fn add_image(
        &self,
        map: &Map,
        image: Image,
        descriptor: Descriptor,
    ) -> Result<Added, StoreError> {
        self.add_recorded(map, image, descriptor, None).await
    }
    /// Replaces the record of an image, `current`, by `next`, which has the same id and bytes and another
    /// pose, time or tags. Returns `false`, and changes nothing, if `current` is not what is stored.
    ///
    /// # Errors
    /// [`StoreError::Superseded`] if the pose belongs to another coordinate frame than the map's.
    async fn replace_image(
        &self,
        map: &Map,
        current: &Image,
        next: Image,
    ) -> Result<bool, StoreError>;
    /// Returns one image.
    async fn image(&self, map: &Map, id: &ImageId) -> Result<Option<Image>, StoreError>;
    /// Returns the images with these ids: one entry for each id, in the order of `ids`, and `None` for an
    /// id that the map does not have.
    async fn images_by_id(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<Image>>, StoreError> {
        try_join_all(ids.iter().map(|id| self.image(map, id))).await
    }
    /// Returns the positions of images in the order of addition, with gaps where images were removed: one entry for each
    /// id, in the order of `ids`, and `None` for an id that the map does not have.
    async fn slots(&self, map: &Map, ids: &[ImageId]) -> Result<Vec<Option<usize>>, StoreError>;
    /// Returns up to `limit` images whose ids sort after `after`, in order of id.
    async fn images(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError>;
    /// Returns the images that have a pose, in the order of recording ([`Recording::sort`]).
    async fn positions(&self, map: &Map) -> Result<Vec<LocatedImage>, StoreError>;
    /// Deletes an image. Returns `false` if there was no such image.
    async fn delete_image(&self, map: &Map, id: &ImageId) -> Result<bool, StoreError>;

    /// Returns the `k` most similar images, best first.
    ///
    /// # Errors
    /// [`StoreError::Superseded`] if the query's descriptor belongs to another revision of the map.
    async fn search(
        &self,
        map: &Map,
        query: Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError>;

    /// Returns the descriptors in some slots: one entry for each, in the order of `slots`, and `None` for a slot whose
    /// image is gone.
    ///
    /// # Errors
    /// [`StoreError::Superseded`] if the map was reindexed after the caller read it.
    async fn descriptors(
        &self,
        map: &Map,
        slots: Vec<usize>,
    ) -> Result<Vec<Option<Descriptor>>, StoreError>;
    /// Returns the dot products of a vector of any length and the descriptors in some slots, as
    /// [`descriptors`](Self::descriptors) does.
    async fn similarities(
        &self,
        map: &Map,
        vector: Vec<f32>,
        slots: Vec<usize>,
    ) -> Result<Vec<Option<f32>>, StoreError>;

    /// Samples images evenly across the map and returns the `k` hardest negatives of each.
    /// [`CalibrationSettings`] sets the number of samples and what counts as another place.
    async fn hard_negatives(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError>;
    /// Returns the latest calibration of this revision of the map, if this revision is the current
    /// one. A calibration is derived data and may be lost.
    async fn calibration(&self, map: &Map) -> Result<Option<Arc<Calibration>>, StoreError>;
    /// Stores the calibration of this revision of the map.
    async fn put_calibration(&self, map: &Map, measured: Calibration) -> Result<(), StoreError>;
}

/// Images together with their descriptors, for a backup.
#[async_trait]
pub trait ExportStore: Send + Sync {
    /// Returns up to `limit` images whose ids sort after `after`, with their descriptors.
    ///
    /// # Errors
    /// [`StoreError::Superseded`] if the map was reindexed after the caller read it.
    async fn export(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<ExportedImage>, StoreError>;
}
