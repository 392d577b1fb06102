//! Tracks in the store: after a restart, and between servers that share a database.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use uuid::Uuid;

use super::track::{ALONE, between, road, robot, view};
use super::{Fixture, image_id, settings};
use crate::{Principal, Tracks};
use jiff::Timestamp;
use whereabouts_api::TrackEstimate;
use whereabouts_core::{Descriptor, Map};
use whereabouts_store::embedded::EmbeddedStore;
use whereabouts_store::{StoreError, TrackHead, TrackKey, TrackRead, TrackState, TrackStore};

/// A store that several servers share, which yields before each call so that others get between.
struct Shared(Arc<EmbeddedStore>);

#[async_trait]
impl TrackStore for Shared {
    fn shares_tracks(&self) -> bool {
        true
    }

    async fn track(
        &self,
        key: &TrackKey,
        known: Option<u64>,
        idle: Duration,
    ) -> Result<TrackRead, StoreError> {
        tokio::task::yield_now().await;
        self.0.track(key, known, idle).await
    }

    async fn put_track(
        &self,
        key: &TrackKey,
        before: Option<u64>,
        next: TrackState,
        idle: Duration,
    ) -> Result<Option<u64>, StoreError> {
        tokio::task::yield_now().await;
        self.0.put_track(key, before, next, idle).await
    }

    async fn tracks(
        &self,
        map: Uuid,
        id: Option<&str>,
        limit: usize,
        idle: Duration,
    ) -> Result<Vec<TrackHead>, StoreError> {
        self.0.tracks(map, id, limit, idle).await
    }

    async fn prune_tracks(&self, idle: Duration, most: usize) -> Result<usize, StoreError> {
        self.0.prune_tracks(idle, most).await
    }
}

/// The tracks of a server, with the embedded store or one that is shared.
fn server(fixture: &Fixture, is_shared: bool) -> Arc<Tracks> {
    let store = Arc::clone(&fixture.store);
    let stored: Arc<dyn TrackStore> =
        if is_shared { Arc::new(Shared(Arc::clone(&store))) } else { store.clone() };
    Arc::new(Tracks::new(store, stored, 5.0, settings().track))
}

async fn follow(tracks: &Tracks, map: &Map, seconds: i64, view: &Descriptor) -> TrackEstimate {
    tracks.follow(map, robot(seconds), view, Some(ALONE)).await.unwrap().0
}

/// The views of a drive: what they show is not certain from one alone.
fn drive() -> Vec<(i64, Descriptor)> {
    (5..20).map(|place| (place as i64, between(place, (place * 7 + 11) % 40))).collect()
}

#[track_caller]
fn assert_same(found: &TrackEstimate, expected: &TrackEstimate) {
    assert_eq!((&found.image_id, found.frames), (&expected.image_id, expected.frames));
    let off = (found.probability - expected.probability).abs();
    assert!(off < 1e-3, "{found:?}, not {expected:?}");
    assert!((found.off_map - expected.off_map).abs() < 1e-3, "{found:?}, not {expected:?}");
}

/// The answers of one server that is never restarted.
async fn expected(fixture: &Fixture, map: &Map) -> Vec<TrackEstimate> {
    let alone = server(fixture, false);
    let mut answers = Vec::new();
    for (at, view) in drive() {
        answers.push(follow(&alone, map, at, &view).await);
    }
    answers
}

#[tokio::test]
async fn a_track_that_was_saved_goes_on_after_a_restart_as_if_nothing_had_happened() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let expected = expected(&fixture, &map).await;
    for (number, (at, view)) in drive().into_iter().enumerate() {
        let tracks = server(&fixture, false);
        assert_same(&follow(&tracks, &map, at, &view).await, &expected[number]);
        tracks.save().await;
        tracks.save().await;
    }
    let tracks = server(&fixture, false);
    assert_eq!(tracks.list(&map).await.unwrap().tracks[0].frames, 15);
    let way = tracks.way(&map, &Principal::Anonymous, "robot").await.unwrap();
    assert_eq!((way.frames, way.places.len()), (15, 15));
    let last = way.places.last().unwrap();
    assert_eq!(last.image_id, Some(image_id(19)));
    // A late frame is answered for its own time.
    let late = follow(&tracks, &map, 16, &view(16)).await;
    assert_eq!((late.is_late, late.image_id), (true, Some(image_id(16))));
}

#[tokio::test]
async fn servers_that_take_turns_answer_as_one_does() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let expected = expected(&fixture, &map).await;
    let servers = [server(&fixture, true), server(&fixture, true), server(&fixture, true)];
    for (number, (at, view)) in drive().into_iter().enumerate() {
        let answer = follow(&servers[number * 2 % 3], &map, at, &view).await;
        assert_same(&answer, &expected[number]);
    }
    for server in &servers {
        assert_eq!(server.list(&map).await.unwrap().tracks[0].frames, 15);
        let way = server.way(&map, &Principal::Anonymous, "robot").await.unwrap();
        assert_eq!(way.places.len(), 15);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_frames_at_two_servers_at_once_both_count() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let servers = [server(&fixture, true), server(&fixture, true)];
    for round in 0..20 {
        let mut answers = Vec::new();
        let frames = servers.iter().enumerate().map(|(number, server)| {
            let (server, map) = (Arc::clone(server), map.clone());
            let at = 2 * round + number as i64;
            tokio::spawn(async move { follow(&server, &map, at, &view(at as usize)).await })
        });
        for frame in frames.collect::<Vec<_>>() {
            answers.push(frame.await.unwrap().frames);
        }
        answers.sort_unstable();
        let before = 2 * round as u64;
        assert_eq!(answers, [before + 1, before + 2]);
    }
}

#[tokio::test]
async fn a_track_that_the_store_has_lost_goes_on_from_what_a_server_knows() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let servers = [server(&fixture, true), server(&fixture, true)];
    for place in 5..10 {
        follow(&servers[0], &map, place, &view(place as usize)).await;
    }
    assert_eq!(fixture.store.prune_tracks(Duration::ZERO, 0).await.unwrap(), 1);
    assert_eq!(follow(&servers[0], &map, 10, &view(10)).await.frames, 6);
    assert_eq!(follow(&servers[1], &map, 11, &view(11)).await.frames, 7);
}

#[tokio::test]
async fn a_state_that_cannot_be_read_starts_the_track_again() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let key = TrackKey { map: map.uid, owner: "-".into(), id: "robot".into() };
    for state in [&b""[..], b"no track", &[0xff; 64]] {
        let (frames, state) = (7, Bytes::copy_from_slice(state));
        let state = TrackState { frames, last_frame_at: Timestamp::now(), state };
        let idle = Duration::from_secs(60);
        assert!(fixture.store.put_track(&key, None, state, idle).await.unwrap().is_some());
        let answer = follow(&server(&fixture, true), &map, 5, &view(5)).await;
        assert_eq!((answer.frames, answer.image_id), (1, Some(image_id(5))));
        fixture.store.prune_tracks(Duration::ZERO, 0).await.unwrap();
    }
}
