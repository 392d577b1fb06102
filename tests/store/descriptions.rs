//! Cached descriptions, and the frames that they describe.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;
use whereabouts_core::{CachedDescription, DescribedFrame, DescriptionSubject};
use whereabouts_core::{Descriptor, Digest, Usage};
use whereabouts_store::{DescriptionBounds, DescriptionFilter, Store};

use crate::support::{Fixture, Random, Tuning, add, eventually, fill, map, next, odd_texts};

contract!(
    a_description_is_cached_verbatim,
    an_expired_description_is_not_used,
    the_oldest_descriptions_are_evicted,
    descriptions_are_listed_by_what_they_are_about_and_removed,
    a_purchase_is_begun_and_ended,
    earlier_frames_are_found_by_their_similarity,
    the_oldest_frames_are_evicted,
    frames_are_removed_with_their_map_and_with_its_descriptors,
);

fn description(text: &str) -> CachedDescription {
    let usage = Usage { calls: 1, prompt_tokens: 1 << 40, ..Usage::default() };
    CachedDescription { text: text.into(), usage, created_at: Timestamp::now(), about: None }
}

fn key(number: usize) -> Digest {
    Digest::of(&number.to_le_bytes())
}

/// The periodic sweep.
async fn tidy(store: &dyn Store) {
    store.collect_garbage().await.unwrap();
}

async fn a_description_is_cached_verbatim(fixture: &Fixture) {
    let store = fixture.open().await;
    assert_eq!(store.description(&key(0)).await.unwrap(), None);
    let texts: Vec<_> = odd_texts().iter().map(|text| description(text)).collect();
    for (number, text) in texts.iter().enumerate() {
        store.keep_description(key(number), text.clone()).await.unwrap();
    }
    store.keep_description(key(0), description("")).await.unwrap();
    store.keep_description(key(0), texts[0].clone()).await.unwrap();
    drop(store);
    let store = fixture.open().await;
    for (number, text) in texts.iter().enumerate() {
        assert_eq!(store.description(&key(number)).await.unwrap().as_ref(), Some(text));
    }
    tidy(&*store).await;
    assert_eq!(store.levels().entries, texts.len());
    let bytes: usize = texts.iter().map(|text| text.text.len()).sum();
    assert!(store.levels().bytes > bytes as u64);
}

async fn an_expired_description_is_not_used(fixture: &Fixture) {
    let max_age = Duration::from_millis(200);
    let descriptions = DescriptionBounds { max_bytes: 1 << 20, max_age };
    let store = fixture.open_with(Tuning { descriptions, ..Tuning::default() }).await;
    let made = Timestamp::now();
    store.keep_description(key(0), description("text")).await.unwrap();
    eventually(async || store.description(&key(0)).await.unwrap().is_none().then_some(())).await;
    assert!(Timestamp::now().duration_since(made) > SignedDuration::from_millis(200));
    tidy(&*store).await;
    // It may be computed again.
    store.keep_description(key(0), description("text")).await.unwrap();
}

async fn descriptions_are_listed_by_what_they_are_about_and_removed(fixture: &Fixture) {
    let store = fixture.open().await;
    let about = |map: &str, image: usize| DescriptionSubject {
        map: map.parse().unwrap(),
        image_id: format!("image-{image}").parse().unwrap(),
        query_id: Uuid::from_u128(7),
        server: "http://host/v1".into(),
        model: "m".into(),
    };
    for number in 0..6 {
        let map = if number < 4 { "a" } else { "b" };
        let about = Some(about(map, number)).filter(|_| number > 0);
        let text = format!("Text {number}");
        let description = CachedDescription { about, ..description(&text) };
        store.keep_description(key(number), description).await.unwrap();
    }
    let found = async |filter: &DescriptionFilter, after: Option<&Digest>, limit| {
        store.descriptions(filter, after, limit).await.unwrap()
    };
    let all = found(&DescriptionFilter::default(), None, 100).await;
    assert_eq!(all.len(), 6);
    assert!(all.is_sorted_by_key(|(key, _)| key.hex()));
    let page = found(&DescriptionFilter::default(), Some(&all[1].0), 2).await;
    assert_eq!(page, all[2..4]);
    // The first is from an earlier version, and is about nothing.
    let of_map =
        DescriptionFilter { map: Some("a".parse().unwrap()), ..DescriptionFilter::default() };
    assert_eq!(found(&of_map, None, 100).await.len(), 3);
    let image = Some("image-5".parse().unwrap());
    let of_image = DescriptionFilter { image, ..DescriptionFilter::default() };
    assert_eq!(found(&of_image, None, 100).await[0].0, key(5));
    let of_text = DescriptionFilter { text: Some("TEXT 0".into()), ..DescriptionFilter::default() };
    assert_eq!(found(&of_text, None, 100).await[0].0, key(0));
    let by_model = DescriptionFilter { model: Some("n".into()), ..DescriptionFilter::default() };
    assert_eq!(found(&by_model, None, 100).await, []);

    assert_eq!(store.remove_descriptions(&[key(0), key(5), key(9)]).await.unwrap(), 2);
    assert_eq!(store.description(&key(5)).await.unwrap(), None);
    assert_eq!(found(&DescriptionFilter::default(), None, 100).await.len(), 4);
    tidy(&*store).await;
    assert_eq!(store.levels().entries, 4);
}

async fn the_oldest_descriptions_are_evicted(fixture: &Fixture) {
    let descriptions = DescriptionBounds { max_bytes: 20_000, max_age: Duration::from_secs(3600) };
    let store = fixture.open_with(Tuning { descriptions, ..Tuning::default() }).await;
    let text = "x".repeat(3000);
    for number in 0..10 {
        store.keep_description(key(number), description(&text)).await.unwrap();
    }
    tidy(&*store).await;
    let mut kept = Vec::new();
    for number in 0..10 {
        if store.description(&key(number)).await.unwrap().is_some() {
            kept.push(number);
        }
    }
    assert_eq!(kept, [4, 5, 6, 7, 8, 9]);
    let levels = store.levels();
    assert_eq!(levels.entries, 6);
    assert!((18_000..=20_000).contains(&levels.bytes), "{levels:?}");
}

async fn a_purchase_is_begun_and_ended(fixture: &Fixture) {
    let store = fixture.open().await;
    let until = Timestamp::now() + SignedDuration::from_secs(60);
    // A process does not block itself.
    for _ in 0..2 {
        assert!(store.acquire_lease(&key(0), until).await.unwrap());
    }
    store.release_lease(&key(0)).await.unwrap();
    store.release_lease(&key(1)).await.unwrap();
    assert!(store.acquire_lease(&key(0), until).await.unwrap());
    store.keep_description(key(0), description("text")).await.unwrap();
    assert!(store.acquire_lease(&key(0), until).await.unwrap());
}

fn frame(number: u8, descriptor: &Descriptor) -> DescribedFrame {
    let (query_id, descriptor) = (Uuid::now_v7(), descriptor.clone());
    DescribedFrame { query_id, digest: Digest::of(&[number]), descriptor }
}

/// The numbers of the frames that are at least this similar.
async fn similar(store: &dyn Store, map: Uuid, to: &Descriptor, at_least: f32) -> Vec<u8> {
    let found = store.similar_frames(map, to, at_least).await.unwrap();
    let number = |digest| (0..100).find(|number| Digest::of(&[*number]) == digest).unwrap();
    found.iter().map(|found| number(found.digest)).collect()
}

/// A direction at this angle to the first axis, in degrees.
fn at(degrees: f32) -> Descriptor {
    let (sin, cos) = degrees.to_radians().sin_cos();
    Descriptor::normalised(vec![cos, sin, 0.0]).unwrap()
}

async fn earlier_frames_are_found_by_their_similarity(fixture: &Fixture) {
    let store = fixture.open().await;
    let (one, other) = (Uuid::now_v7(), Uuid::now_v7());
    assert!(similar(&*store, one, &at(0.0), -1.0).await.is_empty());
    let frames: Vec<_> = [40.0, 10.0, 90.0, 20.0, 30.0, 170.0]
        .iter()
        .zip(0..)
        .map(|(degrees, number)| frame(number, &at(*degrees)))
        .collect();
    for frame in &frames {
        store.keep_frame(one, frame.clone(), 100).await.unwrap();
    }
    store.keep_frame(other, frame(50, &at(0.0)), 100).await.unwrap();
    // A map that was empty may have had another model.
    let long = Random(1).descriptor(5);
    store.keep_frame(one, frame(60, &long), 100).await.unwrap();
    assert_eq!(similar(&*store, one, &at(0.0), 0.9).await, [1, 3]);
    // The number of results is bounded.
    assert_eq!(similar(&*store, one, &at(0.0), -1.0).await, [1, 3, 4, 0]);
    assert_eq!(similar(&*store, one, &long, 0.9).await, [60]);
    assert_eq!(similar(&*store, other, &at(0.0), 0.9).await, [50]);
    let found = store.similar_frames(one, &at(0.0), 0.9).await.unwrap();
    assert_eq!(found[0].stand_in.query_id, frames[1].query_id);
    assert!((found[0].stand_in.similarity - 10_f32.to_radians().cos()).abs() < 1e-6);
    // Storing a frame again does not duplicate it.
    store.keep_frame(one, frames[1].clone(), 100).await.unwrap();
    assert_eq!(similar(&*store, one, &at(0.0), 0.9).await, [1, 3]);
}

async fn the_oldest_frames_are_evicted(fixture: &Fixture) {
    let store = fixture.open().await;
    let (one, other) = (Uuid::now_v7(), Uuid::now_v7());
    store.keep_frame(other, frame(9, &at(0.0)), 3).await.unwrap();
    for number in 0..6 {
        store.keep_frame(one, frame(number, &at(f32::from(number))), 3).await.unwrap();
    }
    assert_eq!(similar(&*store, one, &at(0.0), 0.9).await, [3, 4, 5]);
    assert_eq!(similar(&*store, other, &at(0.0), 0.9).await, [9]);
}

async fn frames_are_removed_with_their_map_and_with_its_descriptors(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    add(&*store, &map, "a", b"a").await;
    store.keep_frame(map.uid, frame(1, &at(0.0)), 9).await.unwrap();
    let mut draft = store.draft(next(&map, 3)).await.unwrap();
    fill(draft.as_mut(), 3).await;
    assert_eq!(similar(&*store, map.uid, &at(0.0), 0.9).await, [1]);
    assert!(draft.replace().await.unwrap());
    assert!(similar(&*store, map.uid, &at(0.0), 0.9).await.is_empty());
    store.keep_frame(map.uid, frame(2, &at(0.0)), 9).await.unwrap();
    assert!(store.delete_map(&map.name).await.unwrap());
    assert!(similar(&*store, map.uid, &at(0.0), 0.9).await.is_empty());
}
