//! The files that drafts leave in the data folder. `tests/store/drafts.rs` tests their behaviour, for
//! every store.

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;
use uuid::Uuid;

use super::super::{DescriptionBounds, EmbeddedSettings, EmbeddedStore};
use crate::{Draft, DraftStore, MapStore};
use whereabouts_core::{
    CoordinateFrame, Descriptor, DescriptorKind, Digest, Image, Map, MediaType, Precision, Scene,
};
use whereabouts_index::IndexSettings;

pub fn settings(dir: &Path) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            exact_up_to: 4,
            m: 8,
            ef_construction: 50,
            ef_search: 50,
            threads: 0,
            max_dead_share: 0.5,
            check_s: 0,
        },
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 1 << 20,
        commit_batch: 8,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(60) },
    }
}

/// A map whose model gives three dimensions.
fn map() -> Map {
    Map {
        uid: Uuid::now_v7(),
        name: "m".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "old".into(),
        model_digest: Digest::of(b"old"),
        precision: Precision::Full,
        dim: 3,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    }
}

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
