//! The bytes of pictures: written, read, and removed by the sweep once nothing refers to them.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::join_all;
use jiff::Timestamp;
use whereabouts_core::{Digest, Job, JobState, Map, MapVocabulary, Scene};
use whereabouts_store::{Added, JobRetention, StoreError};

use crate::support::{
    Fixture, Tuning, add, claim, descriptor, fill, image, is_kept, map, next, submit,
};

contract!(
    bytes_are_returned_unchanged,
    bytes_are_removed_with_the_last_image_that_needs_them,
    bytes_of_a_frame_are_removed_with_its_job,
    bytes_of_a_vocabulary_are_removed_with_the_last_map_that_has_it,
    pinned_bytes_stay,
    bytes_put_during_their_removal_are_kept,
);
contract_over_s3!(
    bytes_are_returned_unchanged,
    bytes_are_removed_with_the_last_image_that_needs_them,
    bytes_of_a_frame_are_removed_with_its_job,
    bytes_of_a_vocabulary_are_removed_with_the_last_map_that_has_it,
    pinned_bytes_stay,
    bytes_put_during_their_removal_are_kept,
);

async fn bytes_are_returned_unchanged(fixture: &Fixture) {
    let store = fixture.open().await;
    let long: Vec<u8> = (0..3_000_000_u32).map(|number| (number % 251) as u8).collect();
    for bytes in [b"\0".to_vec(), b"text".to_vec(), long] {
        let (digest, bytes) = (Digest::of(&bytes), Bytes::from(bytes));
        assert_eq!(store.blob(&digest).await.unwrap(), None);
        let _pin = store.put_blob(digest, bytes.clone()).await.unwrap();
        assert_eq!(store.blob(&digest).await.unwrap().as_ref(), Some(&bytes));
        let _second = store.put_blob(digest, bytes.clone()).await.unwrap();
        assert_eq!(store.blob(&digest).await.unwrap(), Some(bytes));
    }
}

async fn bytes_are_removed_with_the_last_image_that_needs_them(fixture: &Fixture) {
    let store = fixture.open().await;
    let (one, _) = store.put_map(map("one", 3)).await.unwrap();
    let (two, _) = store.put_map(map("two", 3)).await.unwrap();
    let first = add(&*store, &one, "a", b"bytes").await;
    let second = add(&*store, &one, "b", b"bytes").await;
    let third = add(&*store, &two, "a", b"bytes").await;
    add(&*store, &two, "other", b"others").await;
    for (map, image, kept) in [(&one, first, true), (&two, third, true), (&one, second, false)] {
        assert!(store.delete_image(map, &image.id).await.unwrap());
        assert_eq!(is_kept(&*store, b"bytes").await, kept);
    }
    assert!(is_kept(&*store, b"others").await);
    // They may be stored again.
    add(&*store, &one, "a", b"bytes").await;
    assert!(is_kept(&*store, b"bytes").await);
}

async fn bytes_of_a_frame_are_removed_with_its_job(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    submit(&*store, "m", b"frame").await;
    submit(&*store, "m", b"image").await;
    let image = add(&*store, &map, "a", b"image").await;
    while let Some(record) = claim(&*store).await {
        let (state, finished_at) = (JobState::Failed, Some(Timestamp::now()));
        let job = Job { state, finished_at, ..record.job.clone() };
        store.finish(record.claim(), job).await.unwrap();
        assert!(is_kept(&*store, b"frame").await);
    }
    let none = JobRetention { since: None, most: Some(0), settled: Timestamp::now() };
    let removed = store.remove_ended(none, 64).await.unwrap();
    assert_eq!((removed.by_count, removed.bytes), (2, 5));
    assert!(!is_kept(&*store, b"frame").await && is_kept(&*store, b"image").await);
    assert!(store.delete_image(&map, &image.id).await.unwrap());
    assert!(!is_kept(&*store, b"image").await);
}

async fn bytes_of_a_vocabulary_are_removed_with_the_last_map_that_has_it(fixture: &Fixture) {
    let store = fixture.open().await;
    let own = |bytes: &[u8]| {
        let (digest, fitted_at) = (Digest::of(bytes), Timestamp::now());
        Some(MapVocabulary { digest, fitted_at, images: 2, of: 3, requested: false })
    };
    let put = async |bytes: &'static [u8]| {
        store.put_blob(Digest::of(bytes), Bytes::from_static(bytes)).await.unwrap()
    };
    let pin = put(b"words").await;
    let with_words = |name| Map { vocabulary: own(b"words"), ..map(name, 3) };
    let (one, _) = store.put_map(with_words("one")).await.unwrap();
    let (two, _) = store.put_map(with_words("two")).await.unwrap();
    drop(pin);
    assert_eq!(store.map(&one.name).await.unwrap().unwrap().vocabulary, one.vocabulary);
    // A change of the map leaves it.
    store.put_map(Map { scene: Scene::Indoor, ..one.clone() }).await.unwrap();
    assert!(is_kept(&*store, b"words").await);

    // A reindex replaces it, and another drops it.
    let _image = add(&*store, &one, "a", b"image").await;
    let pin = put(b"other words").await;
    let next_one = Map { vocabulary: own(b"other words"), ..next(&one, 3) };
    let mut draft = store.draft(next_one.clone()).await.unwrap();
    assert_eq!(fill(draft.as_mut(), 3).await, 1);
    assert!(draft.replace().await.unwrap());
    drop(pin);
    assert!(is_kept(&*store, b"words").await && is_kept(&*store, b"other words").await);
    let mut draft = store.draft(Map { vocabulary: None, ..next(&next_one, 3) }).await.unwrap();
    assert_eq!(fill(draft.as_mut(), 3).await, 1);
    assert!(draft.replace().await.unwrap());
    assert!(!is_kept(&*store, b"other words").await && is_kept(&*store, b"words").await);

    assert!(store.delete_map(&two.name).await.unwrap());
    assert!(!is_kept(&*store, b"words").await);
}

async fn pinned_bytes_stay(fixture: &Fixture) {
    let pin = Duration::from_secs(60);
    let store = fixture.open_with(Tuning { pin, ..Tuning::default() }).await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let pin = store.put_blob(Digest::of(b"bytes"), Bytes::from_static(b"bytes")).await.unwrap();
    assert!(is_kept(&*store, b"bytes").await);
    let image = add(&*store, &map, "a", b"bytes").await;
    assert!(store.delete_image(&map, &image.id).await.unwrap());
    assert!(is_kept(&*store, b"bytes").await);
    let descriptor = descriptor(&image, 3);
    store.add_image(&map, image, descriptor).await.unwrap();
    drop(pin);
    assert!(is_kept(&*store, b"bytes").await);
}

async fn bytes_put_during_their_removal_are_kept(fixture: &Fixture) {
    let pin = Duration::from_millis(30);
    let store = fixture.open_with(Tuning { pin, ..Tuning::default() }).await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let working = (0..3).map(|worker| {
        let (store, map) = (Arc::clone(&store), map.clone());
        tokio::spawn(async move {
            for round in 0..15 {
                let image = image(&format!("{worker}/{round}"), b"bytes");
                loop {
                    let bytes = Bytes::from_static(b"bytes");
                    let _pin = store.put_blob(image.digest, bytes).await.unwrap();
                    let descriptor = descriptor(&image, 3);
                    match store.add_image(&map, image.clone(), descriptor).await {
                        Ok(added) => break assert!(matches!(added, Added::Created(_))),
                        // So slow that the bytes were removed meanwhile, which is reported.
                        Err(StoreError::Failed(why)) => assert!(why.contains("send them again")),
                        Err(error) => panic!("{error}"),
                    }
                }
                assert!(is_kept(&*store, b"bytes").await);
                assert!(store.delete_image(&map, &image.id).await.unwrap());
            }
        })
    });
    join_all(working).await.into_iter().for_each(Result::unwrap);
}
