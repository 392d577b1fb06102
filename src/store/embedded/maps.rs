//! Maps and images. Every change goes through the writer thread; reads bypass it.

use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;

use super::super::changes::{changed_map, check_dim, check_frame, removed, same_bytes};
use super::super::{
    Added, BlobPin, BlobStore, HardNegatives, IndexState, LocatedImage, MapStore, StoreError,
};
use super::corrections::content;
use super::images::StoredImage;
use super::live_map::{LiveMap, folder_of};
use super::orphans::{remove_folder, sweep};
use super::trees::{BlobOwner, Trees, blob_ref_key, decode, failed, get, put};
use super::{EmbeddedStore, Inner, blocking};
use whereabouts_core::{
    Calibration, CalibrationSettings, Candidate, Descriptor, Digest, Image, ImageId, Map, MapName,
    Recording, dot,
};
use whereabouts_index::SearchMode;

impl Inner {
    /// Returns the loaded map, whatever its revision.
    pub(super) fn live(&self, map: &Map) -> Result<Arc<LiveMap>, StoreError> {
        let maps = self.maps.read();
        match maps.get(&map.name) {
            Some(live) if live.map().uid == map.uid => Ok(Arc::clone(live)),
            _ => Err(removed(map)),
        }
    }

    /// Returns the loaded map if it still has the revision that the caller knows.
    pub(super) fn live_revision(&self, map: &Map) -> Result<Arc<LiveMap>, StoreError> {
        let live = self.live(map)?;
        match live.map().revision == map.revision {
            true => Ok(live),
            false => Err(StoreError::Superseded(map.name.clone())),
        }
    }

    /// Removes an image from the map's index and that of its draft. Call it on the writer thread.
    fn withdraw(&self, map: &Map, slot: usize) {
        if let Ok(live) = self.live(map) {
            live.withdraw(slot);
            self.indexer.notify(&live);
        }
        let drafts = self.drafts.read();
        if let Some(draft) = drafts.get(&map.uid) {
            draft.withdraw(slot);
        }
    }

    /// Stores the map's record. Returns it, whether it is new, and the record before it. Call it on the writer thread.
    fn apply_put(
        &self,
        trees: &Trees,
        requested: Map,
    ) -> Result<(Map, bool, Option<Map>), StoreError> {
        let stored: Option<Map> = get(&trees.maps, requested.name.as_str().as_bytes())?;
        let before = stored.clone();
        let (map, new) = match stored {
            None => (requested, true),
            Some(stored) => {
                let uid = stored.uid;
                (changed_map(stored, requested, || content(trees, uid))?, false)
            }
        };
        put(&trees.maps, map.name.as_str().as_bytes(), &map)?;
        refer_to_vocabulary(trees, before.as_ref(), Some(&map))?;
        Ok((map, new, before))
    }

    /// Removes the vocabulary that a map had, unless something still refers to it. Call it on the writer thread.
    pub(super) fn forget_vocabulary(&self, before: Option<&Map>) {
        if let Some(own) = before.and_then(|map| map.vocabulary) {
            self.blobs.remove_unreferenced(&own.digest, &self.trees);
        }
    }

    fn publish_map(&self, map: &Map) {
        let mut maps = self.maps.write();
        match maps.get(&map.name) {
            Some(live) if live.map().uid == map.uid => live.set_map(map.clone()),
            _ => match LiveMap::load(map.clone(), &self.descriptors, self.index, &self.trees) {
                Ok(live) => {
                    maps.insert(map.name.clone(), Arc::new(live));
                }
                Err(error) => tracing::error!(map = %map.name, %error, "cannot open a new map"),
            },
        }
    }
}

#[async_trait]
impl MapStore for EmbeddedStore {
    async fn put_map(&self, map: Map) -> Result<(Map, bool), StoreError> {
        let (apply, publish) = (Arc::clone(&self.inner), Arc::clone(&self.inner));
        let (map, new, _) = self
            .inner
            .writer
            .commit(
                move |trees, _| apply.apply_put(trees, map),
                move |(map, _, before)| {
                    publish.publish_map(map);
                    publish.forget_vocabulary(before.as_ref());
                },
            )
            .await?;
        Ok((map, new))
    }

    async fn map(&self, name: &MapName) -> Result<Option<Map>, StoreError> {
        let maps = self.inner.maps.read();
        Ok(maps.get(name).map(|live| live.map()))
    }

    async fn maps(&self) -> Result<Vec<Map>, StoreError> {
        let maps = self.inner.maps.read();
        Ok(maps.values().map(|live| live.map()).collect())
    }

    async fn delete_map(&self, name: &MapName) -> Result<bool, StoreError> {
        let (name, inner) = (name.clone(), Arc::clone(&self.inner));
        let removed: Option<Map> = self
            .inner
            .writer
            .commit(
                move |trees, _| {
                    let record = trees.maps.remove(name.as_str()).map_err(failed)?;
                    let map = record.map(|record| decode(&record)).transpose()?;
                    refer_to_vocabulary(trees, map.as_ref(), None)?;
                    Ok(map)
                },
                move |removed: &Option<Map>| {
                    if let Some(map) = removed {
                        let mut maps = inner.maps.write();
                        maps.remove(&map.name);
                        drop(maps);
                        inner.forget_vocabulary(removed.as_ref());
                    }
                },
            )
            .await?;
        let Some(map) = removed else { return Ok(false) };
        // Callers no longer see the map; its images are now removed in small batches. If this process
        // ends before that is done, the next start finishes it.
        let inner = Arc::clone(&self.inner);
        blocking(move || {
            sweep(map.uid, &inner.trees, &inner.blobs)?;
            remove_folder(&folder_of(&map, &inner.descriptors));
            inner.tracks.forget(map.uid);
            Ok(true)
        })
        .await
    }

    async fn index_state(&self, map: &Map) -> Result<IndexState, StoreError> {
        let live = self.inner.live(map)?;
        Ok(IndexState {
            images: live.index.len(),
            graph: live.index.graphed() > 0,
            behind: live.index.is_behind(),
            changes: live.changes(),
            moved: live.moved(),
            located: live.located(),
        })
    }

    async fn add_recorded(
        &self,
        map: &Map,
        image: Image,
        descriptor: Descriptor,
        recording: Option<Recording>,
    ) -> Result<Added, StoreError> {
        let live = self.inner.live_revision(map)?;
        let (map, writing, publishing) = (map.clone(), Arc::clone(&live), Arc::clone(&live));
        let (uid, inner) = (map.uid, Arc::clone(&self.inner));
        let (stored, new) = self
            .inner
            .writer
            .commit(
                move |trees, touched| {
                    if let Some(present) = trees.image(uid, &image.id)? {
                        let image = same_bytes(present.image, &image)?;
                        return Ok((StoredImage { image, ..present }, false));
                    }
                    check_frame(&check_revision(trees, &map)?, &image)?;
                    let slot = writing.allocate_slot();
                    writing.vectors.write(slot, descriptor.as_slice())?;
                    touched.vectors.push(Arc::clone(&writing.vectors));
                    let stored = StoredImage { image, slot, recording };
                    trees.insert_image(uid, &stored)?;
                    Ok((stored, true))
                },
                move |(stored, new)| {
                    if *new {
                        publishing.publish(stored);
                        inner.indexer.notify(&publishing);
                    }
                },
            )
            .await?;
        Ok(if new { Added::Created(stored.image) } else { Added::Present(stored.image) })
    }

    async fn replace_image(
        &self,
        map: &Map,
        current: &Image,
        next: Image,
    ) -> Result<bool, StoreError> {
        self.inner.replace_image(map, current, next).await
    }

    async fn image(&self, map: &Map, id: &ImageId) -> Result<Option<Image>, StoreError> {
        let (inner, uid, id) = (Arc::clone(&self.inner), map.uid, id.clone());
        blocking(move || Ok(inner.trees.image(uid, &id)?.map(|stored| stored.image))).await
    }

    async fn images_by_id(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<Image>>, StoreError> {
        let (inner, uid, ids) = (Arc::clone(&self.inner), map.uid, ids.to_vec());
        blocking(move || {
            let image = |id| Ok(inner.trees.image(uid, id)?.map(|stored| stored.image));
            ids.iter().map(image).collect()
        })
        .await
    }

    async fn slots(&self, map: &Map, ids: &[ImageId]) -> Result<Vec<Option<usize>>, StoreError> {
        let (inner, uid, ids) = (Arc::clone(&self.inner), map.uid, ids.to_vec());
        blocking(move || {
            let slot = |id| Ok(inner.trees.image(uid, id)?.map(|stored| stored.slot));
            ids.iter().map(slot).collect()
        })
        .await
    }

    async fn images(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError> {
        let (inner, uid, after) = (Arc::clone(&self.inner), map.uid, after.cloned());
        blocking(move || {
            let images = inner.trees.images_after(uid, after.as_ref()).take(limit);
            images.map(|stored| Ok(stored?.image)).collect()
        })
        .await
    }

    async fn positions(&self, map: &Map) -> Result<Vec<LocatedImage>, StoreError> {
        Ok(self.inner.live(map)?.positions())
    }

    async fn delete_image(&self, map: &Map, id: &ImageId) -> Result<bool, StoreError> {
        self.inner.live(map)?;
        let (map, uid, id) = (map.clone(), map.uid, id.clone());
        let inner = Arc::clone(&self.inner);
        let removed = self
            .inner
            .writer
            .commit(
                move |trees, _| {
                    let stored = trees.image(uid, &id)?;
                    if let Some(stored) = &stored {
                        trees.remove_images(uid, std::slice::from_ref(stored))?;
                    }
                    Ok(stored)
                },
                move |stored: &Option<StoredImage>| {
                    if let Some(stored) = stored {
                        inner.withdraw(&map, stored.slot);
                        inner.blobs.remove_unreferenced(&stored.image.digest, &inner.trees);
                    }
                },
            )
            .await?;
        Ok(removed.is_some())
    }

    async fn search(
        &self,
        map: &Map,
        query: Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError> {
        let live = self.inner.live_revision(map)?;
        check_dim(map, &query)?;
        blocking(move || Ok(live.search(query.as_slice(), k, mode))).await
    }

    async fn descriptors(
        &self,
        map: &Map,
        slots: Vec<usize>,
    ) -> Result<Vec<Option<Descriptor>>, StoreError> {
        let live = self.inner.live_revision(map)?;
        blocking(move || {
            let read = live.read_slots(&slots, |numbers| Descriptor::stored(numbers.to_vec()).ok());
            Ok(read.into_iter().map(Option::flatten).collect())
        })
        .await
    }

    async fn similarities(
        &self,
        map: &Map,
        vector: Vec<f32>,
        slots: Vec<usize>,
    ) -> Result<Vec<Option<f32>>, StoreError> {
        let live = self.inner.live_revision(map)?;
        blocking(move || Ok(live.read_slots(&slots, |numbers| dot(&vector, numbers)))).await
    }

    async fn hard_negatives(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError> {
        let live = self.inner.live_revision(map)?;
        blocking(move || Ok(live.hard_negatives(settings, k))).await
    }

    async fn calibration(&self, map: &Map) -> Result<Option<Arc<Calibration>>, StoreError> {
        // A calibration is gone with its map or its revision.
        Ok(self.inner.live_revision(map).ok().and_then(|live| live.calibration.get()))
    }

    async fn put_calibration(&self, map: &Map, measured: Calibration) -> Result<(), StoreError> {
        let live = self.inner.live_revision(map)?;
        blocking(move || {
            live.calibration.put(measured);
            Ok(())
        })
        .await
    }
}

#[async_trait]
impl BlobStore for EmbeddedStore {
    async fn put_blob(&self, digest: Digest, bytes: Bytes) -> Result<BlobPin, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || Ok(Box::new(inner.blobs.put(digest, &bytes)?) as BlobPin)).await
    }

    async fn blob(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        let (inner, digest) = (Arc::clone(&self.inner), *digest);
        blocking(move || inner.blobs.get(&digest)).await
    }
}

/// Replaces the reference of a map to its vocabulary.
pub(super) fn refer_to_vocabulary(
    trees: &Trees,
    before: Option<&Map>,
    after: Option<&Map>,
) -> Result<(), StoreError> {
    let reference = |map: &Map| {
        let owner = BlobOwner::Vocabulary(map.uid);
        map.vocabulary.map(|own| blob_ref_key(&own.digest, &owner))
    };
    let (before, after) = (before.and_then(reference), after.and_then(reference));
    if before != after {
        if let Some(key) = after {
            trees.blob_refs.insert(key, &[]).map_err(failed)?;
        }
        if let Some(key) = before {
            trees.blob_refs.remove(key).map_err(failed)?;
        }
    }
    Ok(())
}

/// Returns the stored map, whatever its revision.
pub(super) fn stored_map(trees: &Trees, map: &Map) -> Result<Map, StoreError> {
    let stored: Option<Map> = get(&trees.maps, map.name.as_str().as_bytes())?;
    stored.filter(|stored| stored.uid == map.uid).ok_or_else(|| removed(map))
}

/// Returns the stored map, if it still has the revision that the caller knows.
pub(super) fn check_revision(trees: &Trees, map: &Map) -> Result<Map, StoreError> {
    let stored = stored_map(trees, map)?;
    match stored.revision == map.revision {
        true => Ok(stored),
        false => Err(StoreError::Superseded(stored.name)),
    }
}
