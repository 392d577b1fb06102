use super::track::{follow, key, road, robot, step, view};
use super::{Fixture, image_id};
use whereabouts_api::ErrorKind;
use whereabouts_core::{Map, Role};

use crate::Principal;

async fn drive(fixture: &Fixture, map: &Map, caller: &Principal, id: &str) {
    for place in 5..15 {
        follow(fixture, map, step(caller, id, place as i64), &view(place)).await;
    }
}

#[tokio::test]
async fn the_way_of_a_robot_has_the_places_of_its_last_frames_in_order() {
    let fixture = Fixture::with(0, |settings| settings.track.history = 8).await;
    let map = road(&fixture, 40).await;
    drive(&fixture, &map, &Principal::Anonymous, "robot").await;
    // A late frame is none of the way.
    follow(&fixture, &map, robot(9), &view(9)).await;
    let tracks = &fixture.service.localizer.tracks;
    let way = tracks.way(&map, &Principal::Anonymous, "robot").await.unwrap();
    assert_eq!((way.frames, way.key, way.places.len()), (11, None, 8));
    for (place, number) in way.places.iter().zip(7..15) {
        assert_eq!(place.image_id, Some(image_id(number)));
        assert!(place.known && place.probability > 0.8 && place.off_map < 0.1, "{place:?}");
        assert_eq!(place.captured_at.unwrap().as_second(), number as i64);
    }
}

#[tokio::test]
async fn an_operator_sees_the_tracks_of_all_keys_and_a_robot_its_own() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 40).await;
    let (one, other) = (key("one", Role::Robot), key("other", Role::Robot));
    let operator = key("operator", Role::Operator);
    drive(&fixture, &map, &one, "a").await;
    drive(&fixture, &map, &other, "b").await;
    let tracks = &fixture.service.localizer.tracks;
    let list = tracks.list(&map).await.unwrap().tracks;
    let mut ids: Vec<_> = list.iter().map(|track| (track.id.as_str(), track.frames)).collect();
    ids.sort_unstable();
    assert_eq!(ids, [("a", 10), ("b", 10)]);
    for (caller, id, is_seen) in
        [(&one, "a", true), (&one, "b", false), (&operator, "a", true), (&operator, "c", false)]
    {
        match tracks.way(&map, caller, id).await {
            Ok(way) => assert!(is_seen && way.id == id && way.key.is_some()),
            Err(error) => assert!(!is_seen && error.kind == ErrorKind::NotFound, "{error}"),
        }
    }
}

#[tokio::test]
async fn a_track_in_another_map_is_not_found() {
    let fixture = Fixture::new().await;
    let map = road(&fixture, 10).await;
    let yard = fixture.map("yard", &[Some(0.0)]).await;
    drive(&fixture, &map, &Principal::Anonymous, "a").await;
    let tracks = &fixture.service.localizer.tracks;
    let refused = tracks.way(&yard, &Principal::Anonymous, "a").await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::NotFound);
    assert!(refused.detail.contains("track.idle_s"), "{refused}");
    assert!(tracks.list(&yard).await.unwrap().tracks.is_empty());
}

#[tokio::test]
async fn a_way_can_be_switched_off() {
    let fixture = Fixture::with(0, |settings| settings.track.history = 0).await;
    let map = road(&fixture, 40).await;
    drive(&fixture, &map, &Principal::Anonymous, "a").await;
    let tracks = &fixture.service.localizer.tracks;
    assert!(tracks.way(&map, &Principal::Anonymous, "a").await.unwrap().places.is_empty());
}
