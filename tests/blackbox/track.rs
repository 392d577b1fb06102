//! Tracks: a robot that drives through the town.

use image::{Rgb, RgbImage};
use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use whereabouts_town::{Town, TownSpec};

use super::support::{Answer, Server, frame, jpeg, shared_server};
use super::wait::{eventually, until};

const PLACES: usize = 96;
/// Speed of the robot in metres per second; the service knows only the default bound.
const SPEED: f64 = 8.0;

/// The id of the map image of a place.
fn id(place: usize) -> String {
    format!("place-{place}")
}

async fn metric_map(server: &Server, map: &str, town: &Town) {
    server
        .put(&format!("/maps/{map}"), json!({"scene": "outdoor", "frame": "metric"}))
        .await
        .expect(201);
    for place in 0..town.places() {
        let shot = town.reference(place);
        let path = format!("/maps/{map}/images?id={}&x={}&y={}", id(place), shot.x, shot.y);
        server.post_jpeg(&path, jpeg(&shot.image)).await.expect(201);
    }
    // The filter needs the calibration of the map.
    until(async || {
        server.get(&format!("/maps/{map}")).await.expect(200)["calibration"]["images"]
            == town.places()
    })
    .await;
}

/// The side of a van that fills nearly all of the picture.
fn occluded(mut picture: RgbImage, number: usize) -> RgbImage {
    let (width, height) = picture.dimensions();
    let paint = [40, 90, 140, 190, 220].map(|level| (level + 13 * number as u32 % 35) as u8);
    let body = Rgb([paint[number % 5], paint[number / 2 % 5], paint[number / 3 % 5]]);
    for (x, y, pixel) in picture.enumerate_pixels_mut() {
        let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
        let window = (0.2..0.45).contains(&v) && (u * 5.0).fract() > 0.2;
        if u > 0.05 && v > 0.08 {
            *pixel = if window { Rgb(body.0.map(|level| level / 3)) } else { body };
        }
    }
    picture
}

/// Three frames in ten, both isolated and in a row.
fn is_occluded(place: usize) -> bool {
    matches!(place % 20, 3 | 4 | 8 | 12 | 13 | 17)
}

#[tokio::test]
async fn a_track_is_located_better_than_its_frames() {
    let town = Town::new(TownSpec { seed: 11, places: PLACES, width: 320, height: 240 });
    let (server, map) = shared_server();
    metric_map(server, &map, &town).await;
    let (mut single, mut filtered, mut with_odometry) = (0, 0, 0);
    let mut at: Timestamp = "2026-03-01T12:00:00Z".parse().unwrap();
    let mut before: Option<[f64; 2]> = None;
    for place in 0..PLACES {
        let shot = town.query(place, (place / 8) as u32);
        let here = [shot.x, shot.y];
        let way = before.map_or(0.0, |[x, y]| (here[0] - x).hypot(here[1] - y));
        before = Some(here);
        at += SignedDuration::from_secs_f64(way / SPEED);
        let picture = if is_occluded(place) { occluded(shot.image, place) } else { shot.image };
        let bytes = jpeg(&picture);
        let path = format!("/localize?map={map}&refine=off&captured_at={at}&track=");
        let plain = server.post_jpeg(&format!("{path}a"), bytes.clone()).await.expect(200);
        // Odometry with an error of five metres.
        let moved = format!("{path}b&moved_m={}", way + 5.0);
        let moved = server.post_jpeg(&moved, bytes).await.expect(200);
        single += usize::from(plain["candidates"][0]["image_id"] == id(place));
        filtered += usize::from(plain["track"]["image_id"] == id(place));
        with_odometry += usize::from(moved["track"]["image_id"] == id(place));
        assert_eq!(plain["track"]["frames"], place + 1);
        let probability = plain["track"]["probability"].as_f64().unwrap();
        assert!((0.0..=1.0 + 1e-9).contains(&probability), "{probability}");
        assert_eq!(plain["track"]["known"], probability >= 0.5);
    }
    println!(
        "R@1 of {PLACES} frames, three in ten occluded: single {single}, track {filtered}, track with \
         odometry {with_odometry}"
    );
    assert!(filtered * 10 >= single * 10 + PLACES, "{filtered} of {PLACES}, {single} alone");
    assert!(with_odometry >= filtered, "{with_odometry}, {filtered} without odometry");
}

#[tokio::test]
async fn a_track_never_returns_a_deleted_image() {
    let (server, map) = shared_server();
    server.town(&map, 6).await;
    let localize = async || -> Value {
        let answer = server
            .post_jpeg(&format!("/localize?map={map}&refine=off&track=r1"), frame(2, 0))
            .await;
        answer.expect(200)["track"].clone()
    };
    for _ in 0..3 {
        localize().await;
    }
    assert_eq!(localize().await["image_id"], "place-2");
    server.delete(&format!("/maps/{map}/images/place-2")).await.expect(204);
    for frames in 5..8 {
        let track = localize().await;
        assert_eq!(track["frames"], frames);
        assert_ne!(track["image_id"], "place-2");
        assert!(track["image_id"].is_string(), "{track}");
    }
}

#[tokio::test]
async fn an_invalid_track_is_rejected_with_a_hint() {
    let (server, map) = shared_server();
    server.town(&map, 2).await;
    let ask = async |query: &str| -> Answer {
        server.post_jpeg(&format!("/localize?map={map}&refine=off{query}"), frame(0, 0)).await
    };
    for (query, named) in [
        ("&track=", "1 to 64"),
        ("&track=a%2Fb", "1 to 64"),
        ("&track=a&moved_m=-1", "moved_m"),
        ("&track=a&moved_m=NaN", "moved_m"),
        ("&moved_m=1", "track"),
        ("&captured_at=2026-01-01T00:00:00Z", "track"),
    ] {
        let problem = ask(query).await.problem(422);
        assert!(problem.contains(named), "{query}: {problem}");
    }
    ask("&track=a&captured_at=yesterday").await.problem(400);
    assert!(ask("").await.expect(200)["track"].is_null());

    server.put(&format!("/maps/{map}-bare"), json!({"scene": "indoor"})).await.expect(201);
    let path = &format!("/localize?map={map}-bare&refine=off&track=a");
    let empty = server.post_jpeg(path, frame(0, 0)).await.expect(200);
    assert!(empty["track"]["image_id"].is_null(), "{empty}");
    server.post_jpeg(&format!("/maps/{map}-bare/images?id=a"), frame(0, 0)).await.expect(201);
    // The poses of a map are read again after a while.
    let refused = eventually(async || {
        let answer = server.post_jpeg(path, frame(0, 0)).await;
        (answer.status != 200).then_some(answer)
    })
    .await;
    let problem = refused.problem(422);
    assert!(problem.contains("poses"), "{problem}");
}

#[tokio::test]
async fn the_least_recently_used_track_is_evicted() {
    let dir = tempfile::TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[("WHEREABOUTS_TRACK__MAX", "2")]);
    server.town("m", 2).await;
    let mut frames = Vec::new();
    for track in ["a", "b", "a", "c", "a", "b"] {
        let path = format!("/localize?map=m&refine=off&track={track}");
        let answer = server.post_jpeg(&path, frame(0, 0)).await.expect(200);
        frames.push(answer["track"]["frames"].as_u64().unwrap());
    }
    assert_eq!(frames, [1, 1, 2, 1, 3, 1]);
    assert!(server.log().contains("track.max"), "{}", server.log());
}
