use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::{Fixture, candidates, image_id};
use crate::{Principal, TrackStep};
use whereabouts_api::{ErrorKind, TrackEstimate};
use whereabouts_core::{ApiKey, Calibration, KeyLimits, Map, Role};
use whereabouts_store::MapStore;

/// A step that is taken `seconds` after the epoch.
fn step(caller: &Principal, id: &str, seconds: i64) -> TrackStep {
    let at = Timestamp::UNIX_EPOCH + SignedDuration::from_secs(seconds);
    TrackStep::new(caller, id.into(), Some(at), None).unwrap()
}

async fn follow(
    fixture: &Fixture,
    map: &Map,
    step: TrackStep,
    similar: &[(usize, f32)],
) -> TrackEstimate {
    let tracks = &fixture.service.localizer.tracks;
    tracks.follow(map, step, &candidates(similar), &Calibration::default()).await.unwrap()
}

/// Images every ten metres along a road.
fn road(count: usize) -> Vec<Option<f64>> {
    (0..count).map(|number| Some(number as f64 * 10.0)).collect()
}

#[tokio::test]
async fn a_track_in_a_map_without_poses_is_unprocessable() {
    let fixture = Fixture::new().await;
    let map = fixture.map("yard", &[None, None]).await;
    let tracks = &fixture.service.localizer.tracks;
    let step = step(&Principal::Anonymous, "robot", 0);
    let found = candidates(&[(0, 0.9), (1, 0.8)]);
    let refused = tracks.follow(&map, step, &found, &Calibration::default()).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Unprocessable);
    assert!(refused.detail.contains("poses"), "{refused}");
}

#[tokio::test]
async fn the_second_frame_of_a_track_decides_between_places_that_look_alike() {
    let fixture = Fixture::new().await;
    let map = fixture.map("road", &road(40)).await;
    let robot = |seconds| step(&Principal::Anonymous, "robot", seconds);
    let first = follow(&fixture, &map, robot(0), &[(10, 0.9), (3, 0.5), (4, 0.5)]).await;
    assert_eq!((first.frames, first.image_id), (1, Some(image_id(10))));
    let alike = [(30, 0.91), (11, 0.9), (3, 0.5), (4, 0.5)];
    let second = follow(&fixture, &map, robot(1), &alike).await;
    assert_eq!((second.frames, second.image_id), (2, Some(image_id(11))));
    let alone = follow(&fixture, &map, step(&Principal::Anonymous, "new", 1), &alike).await;
    assert_eq!(alone.image_id, Some(image_id(30)));
}

#[tokio::test]
async fn tracks_of_two_api_keys_are_separate_even_if_their_ids_are_equal() {
    let fixture = Fixture::new().await;
    let map = fixture.map("road", &road(5)).await;
    let key = |id: &str| {
        Principal::ApiKey(
            ApiKey {
                id: id.into(),
                name: id.into(),
                role: Role::Robot,
                maps: vec![],
                limits: KeyLimits::default(),
                created_at: Timestamp::now(),
                expires_at: None,
                revoked_at: None,
            }
            .into(),
        )
    };
    let found = [(1, 0.9), (2, 0.5)];
    for (caller, frames) in [("one", 1), ("one", 2), ("two", 1), ("one", 3)] {
        let estimate = follow(&fixture, &map, step(&key(caller), "robot", 0), &found).await;
        assert_eq!(estimate.frames, frames, "{caller}");
    }
}

#[tokio::test]
async fn the_least_recently_used_track_is_evicted() {
    let fixture = Fixture::with(0, |settings| settings.track.max = 2).await;
    let map = fixture.map("road", &road(5)).await;
    for (id, frames) in [("a", 1), ("b", 1), ("a", 2), ("c", 1), ("a", 3), ("b", 1)] {
        let step = step(&Principal::Anonymous, id, 0);
        let estimate = follow(&fixture, &map, step, &[(1, 0.9), (2, 0.5)]).await;
        assert_eq!(estimate.frames, frames, "{id}");
    }
}

#[tokio::test(start_paused = true)]
async fn an_idle_track_starts_over() {
    let fixture = Fixture::with(0, |settings| settings.track.idle_s = 600).await;
    let map = fixture.map("road", &road(5)).await;
    for (idle_s, frames) in [(0, 1), (500, 2), (500, 3), (601, 1)] {
        tokio::time::advance(Duration::from_secs(idle_s)).await;
        let step = step(&Principal::Anonymous, "robot", 0);
        let estimate = follow(&fixture, &map, step, &[(1, 0.9), (2, 0.5)]).await;
        assert_eq!(estimate.frames, frames, "after {idle_s} s");
    }
}

#[tokio::test]
async fn a_deleted_image_is_never_the_estimate() {
    let fixture = Fixture::new().await;
    let map = fixture.map("road", &road(20)).await;
    let found = [(5, 0.9), (15, 0.8), (1, 0.3)];
    let robot = || step(&Principal::Anonymous, "robot", 0);
    let before = follow(&fixture, &map, robot(), &found).await;
    assert_eq!(before.image_id, Some(image_id(5)));
    fixture.store.delete_image(&map, &image_id(5)).await.unwrap();
    let after = follow(&fixture, &map, robot(), &found).await;
    assert!(after.image_id.is_some_and(|id| id != image_id(5)));
    assert!((0.0..=1.0).contains(&after.probability), "{}", after.probability);
}

#[test]
fn a_step_with_an_unusable_id_or_distance_is_unprocessable() {
    let new = |id: &str, moved_m| TrackStep::new(&Principal::Anonymous, id.into(), None, moved_m);
    assert!(new("robot-1_a.b:c", Some(0.0)).is_ok());
    let long = "x".repeat(65);
    for (id, moved_m) in [
        ("", None),
        ("a b", None),
        ("ö", None),
        (long.as_str(), None),
        ("robot", Some(-1.0)),
        ("robot", Some(f64::NAN)),
        ("robot", Some(1e7)),
    ] {
        let refused = new(id, moved_m).unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Unprocessable, "{id} {moved_m:?}");
    }
}
