//! The files that drafts leave in the data folder. `tests/store/drafts.rs` tests their behaviour, for
//! every store.

use super::super::EmbeddedStore;
use super::super::test_records::{image, map, settings};
use crate::{Draft, DraftStore, MapStore};
use whereabouts_core::{Descriptor, Digest, Image, Map};

/// The same map reindexed with a model that gives five dimensions.
fn next(map: &Map) -> Map {
    Map {
        model: "new".into(),
        model_digest: Digest::of(b"new"),
        dim: 5,
        revision: map.revision + 1,
        ..map.clone()
    }
}

/// A descriptor that differs for each picture.
fn descriptor(image: &Image, dim: usize) -> Descriptor {
    let hex = image.digest.hex();
    let numbers = hex.bytes().take(dim).map(|byte| f32::from(byte) - 77.0);
    Descriptor::normalised(numbers.collect()).unwrap()
}

async fn add(store: &EmbeddedStore, map: &Map, id: &str, bytes: &[u8]) {
    let image = image(id, bytes);
    let descriptor = descriptor(&image, map.dim);
    store.add_image(map, image, descriptor).await.unwrap();
}

/// Writes the descriptors of all missing images.
async fn fill(draft: &mut dyn Draft) {
    for image in draft.missing(9).await.unwrap() {
        draft.write(&image, descriptor(&image, 5)).await.unwrap();
    }
    assert!(draft.missing(9).await.unwrap().is_empty());
}

#[tokio::test]
async fn discarded_and_finished_drafts_leave_one_descriptor_folder_per_map() {
    let dir = tempfile::tempdir().unwrap();
    let folders = || std::fs::read_dir(dir.path().join("descriptors")).unwrap().count();
    let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
    let (map, _) = store.put_map(map()).await.unwrap();
    add(&store, &map, "a", b"a").await;
    let mut draft = store.draft(next(&map)).await.unwrap();
    fill(draft.as_mut()).await;
    assert_eq!(folders(), 2);
    draft.discard().await;
    assert_eq!(folders(), 1);
    let mut draft = store.draft(next(&map)).await.unwrap();
    fill(draft.as_mut()).await;
    assert!(draft.replace().await.unwrap());
    assert_eq!(folders(), 1);
    let map = store.map(&map.name).await.unwrap().unwrap();
    let draft = store.draft(next(&map)).await.unwrap();
    assert!(store.delete_map(&map.name).await.unwrap());
    draft.discard().await;
    assert_eq!(folders(), 0);
}
