//! Maps and images. Every change goes through the writer thread; reads bypass it.

use std::path::Path;
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use sled::Transactional;
use uuid::Uuid;

use super::super::changes::{MapContent, changed_map, check_dim, check_frame, removed, same_bytes};
use super::super::{Added, BlobPin, BlobStore, HardNegatives, IndexState, MapStore, StoreError};
use super::blobs::Blobs;
use super::live_map::{LiveMap, folder_of};
use super::trees::{
    BlobOwner, StoredImage, Trees, blob_ref_key, decode, encode, failed, get, image_key, put,
    transaction_failed,
};
use super::{EmbeddedStore, Inner, blocking};
use whereabouts_core::{
    Calibration, CalibrationSettings, Candidate, Descriptor, Digest, Image, ImageId, Map, MapName,
    Pose,
};
use whereabouts_index::SearchMode;

/// Images removed in one transaction when a map is deleted.
const SWEEP_BATCH: usize = 256;

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

    /// Makes the changed pose of an image visible, also in the map's draft. Call it on the writer thread.
    fn publish_pose(&self, map_uid: Uuid, stored: &StoredImage) {
        let maps = self.maps.read();
        if let Some(live) = maps.values().find(|live| live.map().uid == map_uid) {
            live.move_image(stored);
        }
        drop(maps);
        let drafts = self.drafts.read();
        if let Some(draft) = drafts.get(&map_uid) {
            draft.move_image(stored);
        }
    }

    /// Stores the map's record. Call it on the writer thread.
    fn apply_put(&self, trees: &Trees, requested: Map) -> Result<(Map, bool), StoreError> {
        let stored: Option<Map> = get(&trees.maps, requested.name.as_str().as_bytes())?;
        let (map, new) = match stored {
            None => (requested, true),
            Some(stored) => {
                let uid = stored.uid;
                (changed_map(stored, requested, || content(trees, uid))?, false)
            }
        };
        put(&trees.maps, map.name.as_str().as_bytes(), &map)?;
        Ok((map, new))
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
        self.inner
            .writer
            .commit(
                move |trees, _| apply.apply_put(trees, map),
                move |(map, _)| publish.publish_map(map),
            )
            .await
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
                    record.map(|record| decode(&record)).transpose()
                },
                move |removed: &Option<Map>| {
                    if let Some(map) = removed {
                        let mut maps = inner.maps.write();
                        maps.remove(&map.name);
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
        })
    }

    async fn add_image(
        &self,
        map: &Map,
        image: Image,
        descriptor: Descriptor,
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
                        let slot = present.slot;
                        let image = same_bytes(present.image, &image)?;
                        return Ok((StoredImage { image, slot }, false));
                    }
                    check_frame(&check_revision(trees, &map)?, &image)?;
                    let slot = writing.allocate_slot();
                    writing.vectors.write(slot, descriptor.as_slice())?;
                    touched.vectors.push(Arc::clone(&writing.vectors));
                    let stored = StoredImage { image, slot };
                    insert_image(trees, uid, &stored)?;
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
        self.inner.live(map)?;
        let (map, uid, current) = (map.clone(), map.uid, current.clone());
        let inner = Arc::clone(&self.inner);
        let replaced = self
            .inner
            .writer
            .commit(
                move |trees, _| {
                    check_frame(&stored_map(trees, &map)?, &next)?;
                    let Some(stored) = trees.image(uid, &current.id)? else { return Ok(None) };
                    if stored.image != current {
                        return Ok(None);
                    }
                    let moved = current.pose != next.pose;
                    let stored = StoredImage { image: next, slot: stored.slot };
                    replace_record(trees, uid, &stored, moved)?;
                    Ok(Some((stored, moved)))
                },
                move |replaced| {
                    if let Some((stored, true)) = replaced {
                        inner.publish_pose(uid, stored);
                    }
                },
            )
            .await?;
        Ok(replaced.is_some())
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

    async fn positions(&self, map: &Map) -> Result<Vec<(ImageId, Pose)>, StoreError> {
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
                        remove_images(trees, uid, std::slice::from_ref(stored))?;
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

/// Returns what a map contains.
fn content(trees: &Trees, uid: Uuid) -> Result<MapContent, StoreError> {
    let mut content = MapContent::Empty;
    for stored in trees.images_of(uid) {
        if stored?.image.pose.is_some() {
            return Ok(MapContent::WithPoses);
        }
        content = MapContent::WithoutPoses;
    }
    Ok(content)
}

/// Returns the stored map, whatever its revision.
fn stored_map(trees: &Trees, map: &Map) -> Result<Map, StoreError> {
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

/// Replaces the record of an image, whose bytes stay the same, and counts a changed pose.
fn replace_record(
    trees: &Trees,
    uid: Uuid,
    stored: &StoredImage,
    moved: bool,
) -> Result<(), StoreError> {
    let key = image_key(uid, &stored.image.id);
    let value = encode(stored)?;
    let count = encode(&(trees.moved(uid)? + u64::from(moved)))?;
    (&trees.images, &trees.moves)
        .transaction(|(images, moves)| {
            images.insert(key.as_slice(), value.as_slice())?;
            if moved {
                moves.insert(uid.as_bytes().as_slice(), count.as_slice())?;
            }
            Ok(())
        })
        .map_err(transaction_failed)
}

fn insert_image(trees: &Trees, uid: Uuid, stored: &StoredImage) -> Result<(), StoreError> {
    let key = image_key(uid, &stored.image.id);
    let owner = BlobOwner::Image { map_uid: uid, id: &stored.image.id };
    let reference = blob_ref_key(&stored.image.digest, &owner);
    let value = encode(stored)?;
    (&trees.images, &trees.blob_refs)
        .transaction(|(images, refs)| {
            images.insert(key.as_slice(), value.as_slice())?;
            refs.insert(reference.as_slice(), &[] as &[u8])?;
            Ok(())
        })
        .map_err(transaction_failed)
}

fn remove_images(trees: &Trees, uid: Uuid, stored: &[StoredImage]) -> Result<(), StoreError> {
    (&trees.images, &trees.blob_refs)
        .transaction(|(images, refs)| {
            for StoredImage { image, .. } in stored {
                images.remove(image_key(uid, &image.id))?;
                let owner = BlobOwner::Image { map_uid: uid, id: &image.id };
                refs.remove(blob_ref_key(&image.digest, &owner))?;
            }
            Ok(())
        })
        .map_err(transaction_failed)
}

/// Removes orphans: images and descriptor folders of deleted maps, left by a process that ended before
/// it had removed them.
pub(super) fn collect_orphans(
    trees: &Trees,
    blobs: &Blobs,
    descriptors: &Path,
) -> Result<(), StoreError> {
    let maps = trees.maps()?;
    let known: Vec<Uuid> = maps.iter().map(|map| map.uid).collect();
    let mut at = Uuid::nil();
    while let Some(entry) = trees.images.range(at.as_bytes().to_vec()..).next() {
        let (key, _) = entry.map_err(failed)?;
        let Some(uid) = key.get(..16).and_then(|uid| Uuid::from_slice(uid).ok()) else { break };
        if !known.contains(&uid) {
            sweep(uid, trees, blobs)?;
        }
        match uid.as_u128().checked_add(1) {
            Some(next) => at = Uuid::from_u128(next),
            None => break,
        }
    }
    // Folders are left by deleted maps, by a map whose model changed while it was empty, and by a
    // reindex that did not finish.
    let in_use: Vec<_> = maps.iter().map(|map| folder_of(map, descriptors)).collect();
    for folder in std::fs::read_dir(descriptors).into_iter().flatten().flatten() {
        if !in_use.contains(&folder.path()) {
            remove_folder(&folder.path());
        }
    }
    trees.flush()
}

/// Removes the frames, images, references and bytes of a deleted map.
fn sweep(uid: Uuid, trees: &Trees, blobs: &Blobs) -> Result<(), StoreError> {
    trees.forget_frames(uid)?;
    trees.moves.remove(uid.as_bytes()).map_err(failed)?;
    loop {
        let batch: Vec<StoredImage> =
            trees.images_of(uid).take(SWEEP_BATCH).collect::<Result<_, _>>()?;
        if batch.is_empty() {
            break;
        }
        remove_images(trees, uid, &batch)?;
        trees.flush()?;
        for stored in &batch {
            blobs.remove_unreferenced(&stored.image.digest, trees);
        }
    }
    Ok(())
}

/// Removes a folder of descriptors. One that cannot be removed is harmless and only takes up space.
pub(super) fn remove_folder(folder: &Path) {
    if let Err(error) = std::fs::remove_dir_all(folder)
        && error.kind() != std::io::ErrorKind::NotFound
    {
        tracing::warn!(folder = %folder.display(), %error, "cannot remove old descriptors");
    }
}
