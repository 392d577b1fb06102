//! What deleted maps leave behind: images, bytes and folders of descriptors.

use std::path::Path;

use uuid::Uuid;

use super::super::StoreError;
use super::blobs::Blobs;
use super::images::StoredImage;
use super::live_map::folder_of;
use super::trees::{Trees, failed};

/// Images removed in one transaction when a map is deleted.
const SWEEP_BATCH: usize = 256;

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
pub(super) fn sweep(uid: Uuid, trees: &Trees, blobs: &Blobs) -> Result<(), StoreError> {
    trees.forget_frames(uid)?;
    trees.moves.remove(uid.as_bytes()).map_err(failed)?;
    loop {
        let batch: Vec<StoredImage> =
            trees.images_of(uid).take(SWEEP_BATCH).collect::<Result<_, _>>()?;
        if batch.is_empty() {
            break;
        }
        trees.remove_images(uid, &batch)?;
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
