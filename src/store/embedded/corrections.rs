//! Corrections: the record of an image changes, its bytes, slot and descriptor stay.

use std::sync::Arc;

use sled::Transactional;
use uuid::Uuid;

use super::super::StoreError;
use super::super::changes::{MapContent, check_frame};
use super::Inner;
use super::maps::stored_map;
use super::trees::{StoredImage, Trees, encode, image_key, transaction_failed};
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
