//! Export of images with their descriptors, for a backup.

use std::sync::Arc;

use async_trait::async_trait;

use super::super::{ExportStore, StoreError};
use super::images::StoredImage;
use super::{EmbeddedStore, blocking};
use whereabouts_core::ExportedImage;
use whereabouts_core::{ImageId, Map};

#[async_trait]
impl ExportStore for EmbeddedStore {
    async fn export(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<ExportedImage>, StoreError> {
        let live = self.inner.live_revision(map)?;
        let (inner, uid, after) = (Arc::clone(&self.inner), map.uid, after.cloned());
        blocking(move || {
            let images = inner.trees.images_after(uid, after.as_ref()).take(limit);
            images
                .map(|stored| {
                    let StoredImage { image, slot, recording } = stored?;
                    let (descriptor, position) = (live.vectors.read(slot), Some(slot as u64));
                    let texts = inner.trees.read_texts(uid, &image.id)?;
                    Ok(ExportedImage { image, descriptor, position, recording, texts })
                })
                .collect()
        })
        .await
    }
}
