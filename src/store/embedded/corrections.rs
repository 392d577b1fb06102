//! Corrections: the record of an image changes, its bytes, slot and descriptor stay.

use std::sync::Arc;

use uuid::Uuid;

use super::super::StoreError;
use super::super::changes::{MapContent, check_frame};
use super::Inner;
use super::images::StoredImage;
use super::maps::stored_map;
use super::trees::Trees;
use whereabouts_core::{Image, Map};

impl Inner {
    /// Replaces the record of an image, if it is still `current`.
    pub(super) async fn replace_image(
        self: &Arc<Self>,
        map: &Map,
        current: &Image,
        next: Image,
    ) -> Result<bool, StoreError> {
        self.live(map)?;
        let (map, uid, current) = (map.clone(), map.uid, current.clone());
        let inner = Arc::clone(self);
        let replaced = self
            .writer
            .commit(
                move |trees, _| {
                    check_frame(&stored_map(trees, &map)?, &next)?;
                    let Some(stored) = trees.image(uid, &current.id)? else { return Ok(None) };
                    if stored.image != current {
                        return Ok(None);
                    }
                    let moved = current.pose != next.pose;
                    let stored = StoredImage { image: next, ..stored };
                    trees.replace_image(uid, &stored, moved)?;
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
}

/// Returns what a map contains.
pub(super) fn content(trees: &Trees, uid: Uuid) -> Result<MapContent, StoreError> {
    let mut content = MapContent::Empty;
    for stored in trees.images_of(uid) {
        if stored?.image.pose.is_some() {
            return Ok(MapContent::WithPoses);
        }
        content = MapContent::WithoutPoses;
    }
    Ok(content)
}
