use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::{DIM, Fixture, candidates, image, image_id, map};
use crate::{FrameEvidence, Odometry, Principal, TrackStep};
use whereabouts_api::{ErrorKind, TrackEstimate};
use whereabouts_core::{ApiKey, Descriptor, KeyLimits, Map, Role};
use whereabouts_store::{BlobStore, MapStore};

/// Places with views that differ from each other.
const VIEWS: usize = 64;

/// A frame about which the search says nothing: in these small maps, all images are compared.
pub(super) const ALONE: FrameEvidence<'static> =
    FrameEvidence { candidates: &[], confidence: None };

/// A step that is taken `seconds` after the epoch.
pub(super) fn step(caller: &Principal, id: &str, seconds: i64) -> TrackStep {
    let at = Timestamp::UNIX_EPOCH + SignedDuration::from_secs(seconds);
    TrackStep::new(caller, id.into(), Some(at), None).unwrap()
}

pub(super) fn robot(seconds: i64) -> TrackStep {
    step(&Principal::Anonymous, "robot", seconds)
}

/// What a camera sees at a place: all views have something in common, and neighbours a little more.
pub(super) fn view(place: usize) -> Descriptor {
    let mut numbers = vec![0.1; VIEWS];
    numbers[place % VIEWS] += 1.0;
    numbers[(place + 1) % VIEWS] += 0.3;
    Descriptor::normalised(numbers).unwrap()
}

/// What a camera sees that is halfway between two places in looks.
pub(super) fn between(one: usize, other: usize) -> Descriptor {
    let sum = view(one).as_slice().iter().zip(view(other).as_slice()).map(|(a, b)| a + b).collect();
    Descriptor::normalised(sum).unwrap()
}

/// A map of views every ten metres along a road.
pub(super) async fn road(fixture: &Fixture, places: usize) -> Map {
    let map = Map { dim: VIEWS, ..map("road") };
    let (map, _) = fixture.store.put_map(map).await.unwrap();
    for place in 0..places {
        let (bytes, image) = image(place, Some(place as f64 * 10.0));
        let _pin = fixture.store.put_blob(image.digest, bytes.into()).await.unwrap();
        fixture.store.add_image(&map, image, view(place)).await.unwrap();
    }
    map
}

pub(super) async fn follow(
    fixture: &Fixture,
    map: &Map,
    step: TrackStep,
    view: &Descriptor,
) -> TrackEstimate {
    follow_with_warning(fixture, map, step, view).await.0
}

async fn follow_with_warning(
    fixture: &Fixture,
    map: &Map,
    step: TrackStep,
    view: &Descriptor,
) -> (TrackEstimate, Option<String>) {
    let tracks = &fixture.service.localizer.tracks;
    tracks.follow(map, step, view, Some(ALONE)).await.unwrap()
}

/// A caller with an API key.
pub(super) fn key(id: &str, role: Role) -> Principal {
    Principal::ApiKey(
        ApiKey {
            id: id.into(),
            name: id.into(),
            role,
            maps: vec![],
            limits: KeyLimits::default(),
            created_at: Timestamp::now(),
            expires_at: None,
            revoked_at: None,
        }
        .into(),
    )
}

#[tokio::test]
async fn a_track_in_a_map_without_poses_is_unprocessable() {
    let fixture = Fixture::new().await;
    let map = fixture.map("yard", &[None, None]).await;
    let tracks = &fixture.service.localizer.tracks;
    let found = candidates(&[(0, 0.9), (1, 0.8)]);
    let found = FrameEvidence { candidates: &found, confidence: None };
    let frame = Descriptor::normalised(vec![1.0; DIM]).unwrap();
    let refused = tracks.follow(&map, robot(0), &frame, Some(found)).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Unprocessable);
    assert!(refused.detail.contains("poses"), "{refused}");
}

#[tokio::test]
async fn the_frames_before_decide_between_places_that_look_alike() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    for place in 7..=10 {
        follow(&fixture, &map, robot(place as i64), &view(place)).await;
    }
    let alike = between(11, 30);
    let estimate = follow(&fixture, &map, robot(11), &alike).await;
    assert_eq!((estimate.frames, estimate.image_id), (5, Some(image_id(11))));
}

#[tokio::test]
async fn a_robot_that_may_be_at_either_of_two_places_is_told_both() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let estimate = follow(&fixture, &map, robot(0), &between(11, 30)).await;
    let other = &estimate.others[0];
    let mut places = [estimate.image_id.unwrap(), other.image_id.clone()];
    places.sort();
    assert_eq!(places, [image_id(11), image_id(30)]);
    assert!((0.1..0.5).contains(&other.probability), "{}", other.probability);
}

#[tokio::test]
async fn a_late_frame_answers_for_its_own_time_and_does_not_move_the_track_back() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    for place in 5..15 {
        follow(&fixture, &map, robot(place as i64), &view(place)).await;
    }
    let late = follow(&fixture, &map, robot(9), &view(9)).await;
    assert_eq!((late.is_late, late.image_id), (true, Some(image_id(9))));
    let (very_late, warning) = follow_with_warning(&fixture, &map, robot(-900), &view(3)).await;
    assert!(warning.is_some_and(|text| text.contains("new track id")));
    assert_eq!((very_late.is_late, very_late.image_id), (true, Some(image_id(3))));
    let next = follow(&fixture, &map, robot(15), &between(15, 9)).await;
    assert_eq!((next.is_late, next.image_id), (false, Some(image_id(15))));
    assert!(next.probability > 0.8, "{}", next.probability);
}

#[tokio::test(start_paused = true)]
async fn frames_without_times_that_arrive_too_fast_are_followed_and_the_answer_says_what_to_send() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let mut warnings = 0;
    for place in 3..30 {
        tokio::time::advance(Duration::from_millis(50)).await;
        let step = TrackStep::new(&Principal::Anonymous, "replay".into(), None, None).unwrap();
        let (estimate, warning) = follow_with_warning(&fixture, &map, step, &view(place)).await;
        assert_eq!(estimate.image_id, Some(image_id(place)));
        assert!(warning.as_ref().is_none_or(|text| text.contains("captured_at")), "{warning:?}");
        warnings += usize::from(warning.is_some());
    }
    assert!(warnings > 15, "{warnings}");
}

#[tokio::test(start_paused = true)]
async fn a_robot_in_real_time_is_not_warned() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    for place in 3..30 {
        tokio::time::advance(Duration::from_secs(5)).await;
        let step = TrackStep::new(&Principal::Anonymous, "live".into(), None, None).unwrap();
        let (_, warning) = follow_with_warning(&fixture, &map, step, &view(place)).await;
        assert_eq!(warning, None);
    }
}

#[tokio::test]
async fn a_frame_that_shows_nothing_moves_the_track_on() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let moved = |place: i64| {
        let odometry = Some(Odometry::distance(10.0).unwrap());
        let at = Some(Timestamp::UNIX_EPOCH + SignedDuration::from_secs(place));
        TrackStep::new(&Principal::Anonymous, "robot".into(), at, odometry).unwrap()
    };
    for place in 5..10 {
        follow(&fixture, &map, moved(place as i64), &view(place)).await;
    }
    let tracks = &fixture.service.localizer.tracks;
    let (blind, _) = tracks.follow(&map, moved(10), &view(30), None).await.unwrap();
    assert_eq!(blind.image_id, Some(image_id(10)));
}

#[tokio::test]
async fn tracks_of_two_api_keys_are_separate_even_if_their_ids_are_equal() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 5).await;
    for (caller, frames) in [("one", 1), ("one", 2), ("two", 1), ("one", 3)] {
        let estimate =
            follow(&fixture, &map, step(&key(caller, Role::Robot), "robot", 0), &view(1)).await;
        assert_eq!(estimate.frames, frames, "{caller}");
    }
}

#[tokio::test]
async fn the_least_recently_used_track_is_evicted() {
    let fixture = Fixture::with(0, |settings| settings.track.max = 2).await;
    let map = road(&fixture, 5).await;
    for (id, frames) in [("a", 1), ("b", 1), ("a", 2), ("c", 1), ("a", 3), ("b", 1)] {
        let step = step(&Principal::Anonymous, id, 0);
        let estimate = follow(&fixture, &map, step, &view(1)).await;
        assert_eq!(estimate.frames, frames, "{id}");
    }
}

#[tokio::test(start_paused = true)]
async fn an_idle_track_starts_over() {
    let fixture = Fixture::with(0, |settings| settings.track.idle_s = 600).await;
    let map = road(&fixture, 5).await;
    for (idle_s, frames) in [(0, 1), (500, 2), (500, 3), (601, 1)] {
        tokio::time::advance(Duration::from_secs(idle_s)).await;
        let estimate = follow(&fixture, &map, robot(0), &view(1)).await;
        assert_eq!(estimate.frames, frames, "after {idle_s} s");
    }
}

#[tokio::test]
async fn a_deleted_image_is_never_the_estimate() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 20).await;
    let before = follow(&fixture, &map, robot(0), &view(5)).await;
    assert_eq!(before.image_id, Some(image_id(5)));
    fixture.store.delete_image(&map, &image_id(5)).await.unwrap();
    let after = follow(&fixture, &map, robot(1), &view(5)).await;
    assert!(after.image_id.is_some_and(|id| id != image_id(5)));
    assert!((0.0..=1.0).contains(&after.probability), "{}", after.probability);
}

#[test]
fn a_step_with_an_unusable_id_is_unprocessable() {
    let new = |id: &str| TrackStep::new(&Principal::Anonymous, id.into(), None, None);
    assert!(new("robot-1_a.b:c").is_ok());
    let long = "x".repeat(65);
    for id in ["", "a b", "ö", long.as_str()] {
        assert_eq!(new(id).unwrap_err().kind, ErrorKind::Unprocessable, "{id}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_stands_still_for_long_neither_leaves_the_map_nor_comes_back() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    for place in 5..15 {
        follow(&fixture, &map, robot(place as i64), &view(place)).await;
    }
    let mut last = None;
    for second in 15..315 {
        last = Some(follow(&fixture, &map, robot(second), &view(14)).await);
    }
    let last = last.unwrap();
    assert_eq!(last.image_id, Some(image_id(14)));
    assert!(last.off_map < 0.05 && last.known, "{last:?}");
}

#[tokio::test]
async fn a_robot_that_sees_what_no_image_shows_is_off_the_map() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    for place in 5..15 {
        follow(&fixture, &map, robot(place as i64), &view(place)).await;
    }
    let mut answers = Vec::new();
    for second in 15..35_i64 {
        // Views that no place of the map has.
        let view = view(41 + second as usize % 20);
        answers.push(follow(&fixture, &map, robot(second), &view).await);
    }
    let last = answers.last().unwrap();
    assert!(last.off_map > 0.8 && !last.known, "{last:?}");
    assert!(answers[6..].iter().all(|answer| answer.probability < 0.5), "{answers:?}");
    assert!((last.probability + last.off_map) <= 1.0 + 1e-9);
}

#[tokio::test]
async fn in_a_map_of_a_few_images_nothing_says_that_a_robot_is_off_it() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 4).await;
    for second in 0..10 {
        let answer = follow(&fixture, &map, robot(second), &view(20)).await;
        assert!(!answer.known && answer.off_map < 0.5, "{answer:?}");
    }
}
