//! Drafts: new descriptors in a folder next to the current ones, and their atomic replacement.
//!
//! An image has the same slot in both, so the replacement changes a single record: the map's, which
//! names the revision. All slots below `done` have a descriptor in the draft. The replacement runs on
//! the writer thread, and only if no image has a slot at or above `done`.

#[cfg(test)]
mod tests;

use std::fs::File;
use std::path::PathBuf;
use std::sync::Arc;

use async_trait::async_trait;

use super::super::changes::being_reindexed;
use super::super::{Draft, DraftStore, StoreError};
use super::images::StoredImage;
use super::live_map::{LiveMap, folder_of};
use super::maps::{check_revision, refer_to_vocabulary};
use super::orphans::remove_folder;
use super::trees::put;
use super::{EmbeddedStore, Inner, blocking};
use whereabouts_core::{Descriptor, Image, ImageId, Map};

struct EmbeddedDraft {
    inner: Arc<Inner>,
    /// The map as it is, with the record of the next.
    old: Map,
    /// The map as it is.
    stored: Map,
    current: Arc<LiveMap>,
    /// The map as it will be.
    next: Arc<LiveMap>,
    /// Images with slots below this one have a descriptor in the draft.
    done: usize,
    /// Images with slots below this one will have one after the current pass over the images.
    end: usize,
    /// The last image of the current pass that was returned.
    cursor: Option<ImageId>,
}

#[async_trait]
impl DraftStore for EmbeddedStore {
    async fn draft(&self, next: Map) -> Result<Box<dyn Draft>, StoreError> {
        let old = Map { revision: next.revision.saturating_sub(1), ..next.clone() };
        let inner = Arc::clone(&self.inner);
        let draft = blocking(move || {
            let current = inner.live_revision(&old)?;
            let mut drafts = inner.drafts.write();
            if drafts.contains_key(&next.uid) {
                return Err(being_reindexed(&next));
            }
            // A failed draft may have left its folder.
            remove_folder(&folder_of(&next, &inner.descriptors));
            let next = Arc::new(LiveMap::open(next, &inner.descriptors, inner.index)?);
            drafts.insert(old.uid, Arc::clone(&next));
            drop(drafts);
            let stored = current.map();
            Ok(EmbeddedDraft { inner, old, stored, current, next, done: 0, end: 0, cursor: None })
        });
        Ok(Box::new(draft.await?))
    }
}

#[async_trait]
impl Draft for EmbeddedDraft {
    async fn missing(&mut self, limit: usize) -> Result<Vec<Image>, StoreError> {
        loop {
            self.inner.live_revision(&self.old)?;
            let page = self.page(limit).await?;
            if let Some(last) = page.last() {
                self.cursor = Some(last.id.clone());
                return Ok(page);
            }
            (self.done, self.cursor) = (self.end, None);
            let current = Arc::clone(&self.current);
            self.end =
                self.inner.writer.commit(move |_, _| Ok(current.next_slot()), |_| {}).await?;
            if self.end == self.done {
                return Ok(Vec::new());
            }
        }
    }

    async fn write(&mut self, image: &Image, descriptor: Descriptor) -> Result<(), StoreError> {
        let (uid, end, image) = (self.old.uid, self.end, image.clone());
        let (writing, publishing) = (Arc::clone(&self.next), Arc::clone(&self.next));
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    // If the id now belongs to another image, a later pass finds that one.
                    let same = |stored: &StoredImage| {
                        stored.image.digest == image.digest && stored.slot < end
                    };
                    let stored = trees.image(uid, &image.id)?.filter(same);
                    if let Some(stored) = &stored {
                        // Synced together with all others, before the replacement.
                        writing.vectors.write(stored.slot, descriptor.as_slice())?;
                    }
                    Ok(stored)
                },
                move |stored| {
                    if let Some(stored) = stored {
                        publishing.publish(stored);
                    }
                },
            )
            .await?;
        Ok(())
    }

    async fn replace(&mut self) -> Result<bool, StoreError> {
        let (inner, next) = (Arc::clone(&self.inner), Arc::clone(&self.next));
        blocking(move || {
            // Build the graph first, so that a large map is never searched exactly.
            inner.indexer.finish(&next);
            next.vectors.sync()?;
            sync_folder(&inner)
        })
        .await?;
        let (old, before, done) = (self.stored.clone(), self.stored.clone(), self.done);
        let (reading, current) = (Arc::clone(&self.current), Arc::clone(&self.current));
        let (inner, next, new_map) =
            (Arc::clone(&self.inner), Arc::clone(&self.next), self.next.map());
        let replaced = self
            .inner
            .writer
            .commit(
                move |trees, _| {
                    let stored = check_revision(trees, &old)?;
                    if reading.next_slot() != done {
                        return Ok(None);
                    }
                    // Scene, coordinate frame and description may have changed meanwhile.
                    let Map { scene, frame, refiner, description, .. } = stored;
                    let map = Map { scene, frame, refiner, description, ..new_map };
                    put(&trees.maps, map.name.as_str().as_bytes(), &map)?;
                    refer_to_vocabulary(trees, Some(&old), Some(&map))?;
                    // The descriptors of described frames belong to the old revision.
                    trees.forget_frames(map.uid)?;
                    Ok(Some(map))
                },
                move |map| {
                    let Some(map) = map else { return };
                    next.set_map(map.clone());
                    next.continue_from(&current);
                    inner.indexer.notify(&next);
                    let mut maps = inner.maps.write();
                    maps.insert(map.name.clone(), next);
                    drop(maps);
                    inner.forget_draft(map);
                    inner.forget_vocabulary(Some(&before));
                },
            )
            .await?
            .is_some();
        if replaced {
            let folder = folder_of(&self.old, &self.inner.descriptors);
            remove(folder).await?;
        }
        Ok(replaced)
    }

    async fn discard(self: Box<Self>) {
        let folder = folder_of(&self.next.map(), &self.inner.descriptors);
        if let Err(error) = remove(folder).await {
            tracing::warn!(%error, "cannot delete a draft; the next start does");
        }
        self.inner.forget_draft(&self.old);
    }
}

impl EmbeddedDraft {
    /// Returns the next images of the current pass.
    async fn page(&self, limit: usize) -> Result<Vec<Image>, StoreError> {
        let (slots, after) = (self.done..self.end, self.cursor.clone());
        if slots.is_empty() {
            return Ok(Vec::new());
        }
        let (trees, uid) = (self.inner.trees.clone(), self.old.uid);
        blocking(move || {
            let in_pass = |stored: &Result<StoredImage, _>| {
                stored.as_ref().map_or(true, |stored| slots.contains(&stored.slot))
            };
            let images = trees.images_after(uid, after.as_ref()).filter(in_pass).take(limit);
            images.map(|stored| Ok(stored?.image)).collect()
        })
        .await
    }
}

impl Inner {
    fn forget_draft(&self, map: &Map) {
        self.drafts.write().remove(&map.uid);
    }
}

async fn remove(folder: PathBuf) -> Result<(), StoreError> {
    blocking(move || {
        remove_folder(&folder);
        Ok(())
    })
    .await
}

/// Syncs the parent of the draft's folder, so that the folder survives a power cut.
fn sync_folder(inner: &Inner) -> Result<(), StoreError> {
    let folder = &inner.descriptors;
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(|error| StoreError::Failed(format!("cannot sync {}: {error}", folder.display())))
}
