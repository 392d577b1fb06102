//! Tracks of robots.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::join_all;
use jiff::Timestamp;
use uuid::Uuid;
use whereabouts_store::{Store, StoredTrack, TrackKey, TrackRead, TrackState};

use crate::support::{Fixture, map};

contract!(
    a_track_is_read_as_it_was_written_last,
    a_reader_that_knows_the_version_reads_no_state,
    a_write_that_missed_another_changes_nothing,
    of_concurrent_writes_over_one_version_one_succeeds,
    a_track_that_expired_is_missing_and_starts_again,
    tracks_are_there_after_a_restart,
    tracks_are_listed_by_map_those_written_last_first,
    expired_tracks_and_the_oldest_of_too_many_are_removed,
    the_tracks_in_a_map_are_deleted_with_it,
);

const LONG: Duration = Duration::from_secs(600);

fn key(map: Uuid, owner: &str, id: &str) -> TrackKey {
    TrackKey { map, owner: owner.into(), id: id.into() }
}

async fn map_of(store: &dyn Store, name: &str) -> Uuid {
    store.put_map(map(name, 4)).await.unwrap().0.uid
}

/// Writes a state over a version, and returns the new version.
fn next(state: Bytes) -> TrackState {
    TrackState { frames: state.len() as u64, last_frame_at: Timestamp::now(), state }
}

async fn put(store: &dyn Store, key: &TrackKey, before: Option<u64>, state: &str) -> Option<u64> {
    let state = Bytes::copy_from_slice(state.as_bytes());
    store.put_track(key, before, next(state), LONG).await.unwrap()
}

async fn read(store: &dyn Store, key: &TrackKey) -> Option<StoredTrack> {
    match store.track(key, None, LONG).await.unwrap() {
        TrackRead::Found(found) => Some(found),
        TrackRead::Missing => None,
        TrackRead::Unchanged => panic!("no version was known"),
    }
}

async fn a_track_is_read_as_it_was_written_last(fixture: &Fixture) {
    let store = fixture.open().await;
    let map = map_of(&*store, "m").await;
    let of = |owner, id| key(map, owner, id);
    assert_eq!(read(&*store, &of("-", "a")).await, None);
    let keys = [of("-", "a"), of("-", "b"), of("key", "a"), of("- a", ""), of("-", "\u{1F916} :.")];
    for (number, key) in keys.iter().enumerate() {
        let first = put(&*store, key, None, &format!("first {number}")).await.unwrap();
        assert!(put(&*store, key, Some(first), &format!("{number}")).await.is_some());
    }
    for (number, key) in keys.iter().enumerate() {
        let found = read(&*store, key).await.unwrap();
        assert_eq!(found.state, format!("{number}").as_bytes());
        assert!(found.age < LONG);
    }
}

async fn a_reader_that_knows_the_version_reads_no_state(fixture: &Fixture) {
    let store = fixture.open().await;
    let key = key(map_of(&*store, "m").await, "-", "a");
    let first = put(&*store, &key, None, "one").await.unwrap();
    let read = async |known| store.track(&key, Some(known), LONG).await.unwrap();
    assert_eq!(read(first).await, TrackRead::Unchanged);
    let second = put(&*store, &key, Some(first), "two").await.unwrap();
    assert!(matches!(read(first).await, TrackRead::Found(found) if found.version == second));
    assert_eq!(read(second).await, TrackRead::Unchanged);
}

async fn a_write_that_missed_another_changes_nothing(fixture: &Fixture) {
    let store = fixture.open().await;
    let key = key(map_of(&*store, "m").await, "-", "a");
    assert_eq!(put(&*store, &key, Some(7), "of a track that is gone").await, None);
    let first = put(&*store, &key, None, "one").await.unwrap();
    let second = put(&*store, &key, Some(first), "two").await.unwrap();
    for before in [None, Some(first), Some(second + 1)] {
        assert_eq!(put(&*store, &key, before, "late").await, None, "{before:?}");
    }
    assert_eq!(read(&*store, &key).await.unwrap().state, "two");
}

async fn of_concurrent_writes_over_one_version_one_succeeds(fixture: &Fixture) {
    let store = fixture.open().await;
    let key = key(map_of(&*store, "m").await, "-", "a");
    let mut before = None;
    for round in 0..4 {
        let writing = (0..8).map(|writer| {
            let (store, key) = (Arc::clone(&store), key.clone());
            tokio::spawn(async move {
                let state = format!("{round} {writer}");
                Some((put(&*store, &key, before, &state).await?, state))
            })
        });
        let written = join_all(writing).await.into_iter().filter_map(Result::unwrap);
        let written: Vec<(u64, String)> = written.collect();
        assert_eq!(written.len(), 1, "{written:?}");
        let found = read(&*store, &key).await.unwrap();
        assert_eq!((found.version, &*found.state), (written[0].0, written[0].1.as_bytes()));
        before = Some(found.version);
    }
}

async fn a_track_that_expired_is_missing_and_starts_again(fixture: &Fixture) {
    let store = fixture.open().await;
    let key = key(map_of(&*store, "m").await, "-", "a");
    let first = put(&*store, &key, None, "one").await.unwrap();
    let gone = store.track(&key, Some(first + 1), Duration::ZERO).await.unwrap();
    assert_eq!(gone, TrackRead::Missing);
    let state = || next(Bytes::from_static(b"two"));
    let next = store.put_track(&key, None, state(), Duration::ZERO).await.unwrap().unwrap();
    // A process that knew the first is not led to believe that it still does.
    assert_ne!(next, first);
    assert_eq!(read(&*store, &key).await.unwrap().state, "two");
}

async fn tracks_are_there_after_a_restart(fixture: &Fixture) {
    let store = fixture.open().await;
    let key = key(map_of(&*store, "m").await, "-", "a");
    let version = put(&*store, &key, None, "one").await.unwrap();
    drop(store);
    let store = fixture.open().await;
    let found = read(&*store, &key).await.unwrap();
    assert_eq!((found.version, &*found.state), (version, b"one".as_slice()));
}

async fn tracks_are_listed_by_map_those_written_last_first(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, other) = (map_of(&*store, "m").await, map_of(&*store, "other").await);
    let mut versions = Vec::new();
    for (owner, id) in [("-", "a"), ("key", "a"), ("-", "b")] {
        versions.push(put(&*store, &key(map, owner, id), None, "12345").await);
    }
    put(&*store, &key(other, "-", "c"), None, "1").await;
    put(&*store, &key(map, "-", "a"), versions[0], "123456").await;
    let list = async |id, limit, idle| -> Vec<(String, String, u64)> {
        let heads = store.tracks(map, id, limit, idle).await.unwrap();
        heads.into_iter().map(|head| (head.owner, head.id, head.frames)).collect()
    };
    let entry = |owner: &str, id: &str, frames| (owner.to_owned(), id.to_owned(), frames);
    let all = [entry("-", "a", 6), entry("-", "b", 5), entry("key", "a", 5)];
    assert_eq!(list(None, 9, LONG).await, all);
    assert_eq!(list(None, 2, LONG).await, all[..2]);
    assert_eq!(list(Some("a"), 9, LONG).await, [all[0].clone(), all[2].clone()]);
    assert!(list(None, 9, Duration::ZERO).await.is_empty());
}

async fn expired_tracks_and_the_oldest_of_too_many_are_removed(fixture: &Fixture) {
    let store = fixture.open().await;
    let map = map_of(&*store, "m").await;
    for id in ["a", "b", "c", "d"] {
        put(&*store, &key(map, "-", id), None, "state").await;
    }
    assert_eq!(store.prune_tracks(LONG, 4).await.unwrap(), 0);
    assert_eq!(store.prune_tracks(LONG, 2).await.unwrap(), 2);
    let left = store.tracks(map, None, 9, LONG).await.unwrap();
    assert_eq!(left.iter().map(|head| head.id.as_str()).collect::<Vec<_>>(), ["d", "c"]);
    assert_eq!(store.prune_tracks(Duration::ZERO, 9).await.unwrap(), 2);
    assert_eq!(read(&*store, &key(map, "-", "d")).await, None);
}

async fn the_tracks_in_a_map_are_deleted_with_it(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, other) = (map_of(&*store, "m").await, map_of(&*store, "other").await);
    for map in [map, other] {
        put(&*store, &key(map, "-", "a"), None, "state").await.unwrap();
    }
    assert!(store.delete_map(&"m".parse().unwrap()).await.unwrap());
    assert_eq!(read(&*store, &key(map, "-", "a")).await, None);
    assert!(read(&*store, &key(other, "-", "a")).await.is_some());
}
