//! Whatever happens while a draft is made, in a store of descriptors that point in a few directions.

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;
use uuid::Uuid;

use super::super::{DescriptionBounds, EmbeddedSettings, EmbeddedStore};
use crate::domain::{
    Descriptor, DescriptorKind, Digest, Frame, Image, Map, MediaType, Precision, Scene,
};
use crate::retrieve::index::{IndexSettings, SearchMode};
use crate::store::{Draft, DraftStore, MapStore, StoreError};

pub fn settings(dir: &Path) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            exact_up_to: 4,
            m: 8,
            ef_construction: 50,
            ef_search: 50,
            max_dead_share: 0.5,
        },
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 1 << 20,
        commit_batch: 8,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(60) },
    }
}

/// Opens the store, if need be as soon as the threads of an earlier one have ended.
fn open(dir: &Path) -> EmbeddedStore {
    let mut tries = (0..1000).filter_map(|_| {
        std::thread::sleep(Duration::from_millis(5));
        EmbeddedStore::open(&settings(dir)).ok()
    });
    tries.next().unwrap()
}

/// The old model gives three numbers, the new one five.
fn map() -> Map {
    Map {
        uid: Uuid::now_v7(),
        name: "m".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::Gem,
        frame: Frame::Wgs84,
        model: "old".into(),
        model_digest: Digest::of(b"old"),
        precision: Precision::Full,
        dim: 3,
        revision: 0,
        description: None,
        created_at: Timestamp::now(),
    }
}

fn next(map: &Map) -> Map {
    Map {
        model: "new".into(),
        model_digest: Digest::of(b"new"),
        dim: 5,
        revision: map.revision + 1,
        ..map.clone()
    }
}

fn image(id: &str, bytes: &[u8]) -> Image {
    Image {
        id: id.parse().unwrap(),
        digest: Digest::of(bytes),
        pose: None,
        captured_at: None,
        tags: Vec::new(),
        media_type: MediaType::Jpeg,
        width: 1,
        height: 1,
        created_at: Timestamp::now(),
    }
}

/// Another direction for each picture.
fn descriptor(image: &Image, dim: usize) -> Descriptor {
    let hex = image.digest.hex();
    let numbers = hex.bytes().take(dim).map(|byte| f32::from(byte) - 77.0);
    Descriptor::normalised(numbers.collect()).unwrap()
}

async fn add(store: &EmbeddedStore, map: &Map, id: &str, bytes: &[u8]) -> Image {
    let image = image(id, bytes);
    store.add_image(map, image.clone(), descriptor(&image, map.dim)).await.unwrap();
    image
}

/// Gives all that is missing its descriptor.
async fn fill(draft: &mut dyn Draft) -> usize {
    let mut written = 0;
    loop {
        let missing = draft.missing(3).await.unwrap();
        if missing.is_empty() {
            return written;
        }
        for image in missing {
            draft.write(&image, descriptor(&image, 5)).await.unwrap();
            written += 1;
        }
    }
}

/// Every image is found by its own descriptor, and nothing else is.
async fn finds(store: &EmbeddedStore, images: &[&Image]) {
    let map = store.map(&"m".parse().unwrap()).await.unwrap().unwrap();
    assert_eq!(store.index_state(&map).await.unwrap().images, images.len());
    for mode in [SearchMode::Fast, SearchMode::Exact] {
        for image in images {
            let query = descriptor(image, map.dim);
            let found = store.search(&map, query, 20, mode).await.unwrap();
            assert_eq!(found.len(), images.len());
            assert_eq!((&found[0].image_id, found[0].similarity > 0.999), (&image.id, true));
        }
    }
}

#[tokio::test]
async fn what_is_added_and_removed_meanwhile_is_carried_over_and_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path());
    let (map, _) = store.put_map(map()).await.unwrap();
    let mut images = Vec::new();
    for name in ["a", "b", "c", "d", "e", "f", "g"] {
        images.push(add(&store, &map, name, name.as_bytes()).await);
    }
    let mut draft = store.draft(next(&map)).await.unwrap();
    let page = draft.missing(2).await.unwrap();
    assert_eq!(page, images[..2]);
    draft.write(&page[0], descriptor(&page[0], 5)).await.unwrap();
    // One that has its new descriptor; one that is about to get it, and whose id goes to another.
    for gone in ["a", "b", "f"] {
        assert!(store.delete_image(&map, &gone.parse().unwrap()).await.unwrap());
    }
    let other = add(&store, &map, "b", b"other").await;
    draft.write(&page[1], descriptor(&page[1], 5)).await.unwrap();
    let again = add(&store, &map, "a", b"a").await;
    assert_eq!(fill(draft.as_mut()).await, 4 + 2);
    // Between the last look and the step.
    let late = add(&store, &map, "late", b"late").await;
    let all = [&again, &other, &images[2], &images[3], &images[4], &images[6], &late];
    assert!(!draft.replace().await.unwrap());
    finds(&store, &all).await;
    assert_eq!(fill(draft.as_mut()).await, 1);
    assert!(store.delete_image(&map, &"g".parse().unwrap()).await.unwrap());
    let all = [&again, &other, &images[2], &images[3], &images[4], &late];
    finds(&store, &all).await;
    assert!(draft.replace().await.unwrap());
    finds(&store, &all).await;
    drop(draft);

    // Who looked at the map before is told so.
    let superseded = |error| assert!(matches!(error, StoreError::Superseded(_)), "{error}");
    let query = descriptor(&late, 3);
    superseded(store.search(&map, query.clone(), 1, SearchMode::Fast).await.unwrap_err());
    superseded(store.add_image(&map, image("x", b"x"), query).await.unwrap_err());
    superseded(store.put_map(map.clone()).await.unwrap_err());
    superseded(store.draft(next(&map)).await.err().unwrap());
    // A removal means the same in either.
    assert!(store.delete_image(&map, &late.id).await.unwrap());
    finds(&store, &all[..5]).await;
    drop(store);
    finds(&open(dir.path()), &all[..5]).await;
    assert_eq!(std::fs::read_dir(dir.path().join("descriptors")).unwrap().count(), 1);
}

#[tokio::test]
async fn a_draft_that_is_given_up_leaves_nothing_and_another_may_begin() {
    let dir = tempfile::tempdir().unwrap();
    let folders = || std::fs::read_dir(dir.path().join("descriptors")).unwrap().count();
    let store = open(dir.path());
    let (map, _) = store.put_map(map()).await.unwrap();
    let image = add(&store, &map, "a", b"a").await;
    let mut draft = store.draft(next(&map)).await.unwrap();
    assert!(matches!(store.draft(next(&map)).await.err(), Some(StoreError::Conflict(_))));
    fill(draft.as_mut()).await;
    draft.discard().await;
    assert_eq!(folders(), 1);
    finds(&store, &[&image]).await;

    let mut draft = store.draft(next(&map)).await.unwrap();
    assert!(store.delete_map(&map.name).await.unwrap());
    assert!(matches!(draft.missing(3).await, Err(StoreError::NotFound(_))));
    assert!(matches!(draft.replace().await, Err(StoreError::NotFound(_))));
    draft.discard().await;
    assert_eq!(folders(), 0);
}
