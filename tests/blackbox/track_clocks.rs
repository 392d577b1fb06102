//! Tracks of robots whose clocks are wrong.

use serde_json::Value;
use whereabouts_town::{Town, TownSpec};

use super::support::{Server, jpeg, shared_server};
use super::track::metric_map;

/// Places in the town.
const PLACES: usize = 32;

/// When the drives begin, in seconds since 1970: long ago.
const START: f64 = 1_700_000_000.0;

/// Seconds from one place to the next.
const PAUSE: f64 = 2.0;

async fn town(server: &Server, map: &str) -> Town {
    let town = Town::new(TownSpec {
        seed: 11,
        places: PLACES,
        width: 320,
        height: 240,
        ..TownSpec::default()
    });
    metric_map(server, map, &town).await;
    town
}

/// The answers to a robot that drives past places, with the time that its clock shows at each.
async fn drive(
    map: &str,
    town: &Town,
    track: &str,
    frames: impl IntoIterator<Item = (usize, String)>,
) -> Vec<Value> {
    let (server, _) = shared_server();
    let mut answers = Vec::new();
    for (place, captured_at) in frames {
        let picture = jpeg(&town.query(place, 1).image);
        let path =
            format!("/localize?map={map}&refine=off&track={track}&captured_at={captured_at}");
        answers.push(server.post_jpeg(&path, picture).await.expect(200));
    }
    answers
}

/// A time as a number of seconds.
fn time(place: usize, off: f64) -> String {
    format!("{:.3}", START + PAUSE * place as f64 + off)
}

fn is_at(answer: &Value, place: usize) -> bool {
    answer["track"]["image_id"] == format!("place-{place}")
}

fn warnings(answer: &Value) -> String {
    answer["warnings"].to_string()
}

const MINUTE: f64 = 60.0;
const HOUR: f64 = 3600.0;
const YEAR: f64 = 86_400.0 * 365.0;

#[tokio::test]
async fn one_frame_with_a_time_in_the_future_does_not_stop_a_track() {
    let (server, map) = shared_server();
    let town = town(server, &map).await;
    for (name, off) in [("minute", MINUTE), ("hour", HOUR), ("year", YEAR), ("decade", 10.0 * YEAR)]
    {
        let off_at = |place| if place == 10 { off } else { 0.0 };
        let frames = (2..24).map(|place| (place, time(place, off_at(place))));
        let answers = drive(&map, &town, name, frames).await;
        assert!(warnings(&answers[8]).contains("captured_at"), "{}", answers[8]);
        for (number, answer) in answers.iter().enumerate().skip(9) {
            assert_eq!(answer["track"]["is_late"], false, "{name}, frame {number}");
        }
        let right = (12..24).filter(|place| is_at(&answers[place - 2], *place)).count();
        assert!(right >= 11, "{name}: {right}");
    }
}

#[tokio::test]
async fn a_clock_that_is_set_while_driving_costs_a_track_a_few_frames_and_is_reported() {
    let (server, map) = shared_server();
    let town = town(server, &map).await;
    for (name, off) in [
        ("minute-back", -MINUTE),
        ("hour-back", -HOUR),
        ("year-back", -YEAR),
        ("minute-ahead", MINUTE),
        ("hour-ahead", HOUR),
        ("year-ahead", YEAR),
        ("epoch", 5.0 - START),
    ] {
        let off_at = |place| if place >= 10 { off } else { 0.0 };
        let frames = (2..28).map(|place| (place, time(place, off_at(place))));
        let answers = drive(&map, &town, name, frames).await;
        let all: Vec<String> = answers[8..12].iter().map(warnings).collect();
        assert!(all.iter().any(|text| text.contains("NTP")), "{name}: {all:?}");
        assert!(answers[11..].iter().all(|answer| answer["track"]["is_late"] == false), "{name}");
        let right = (16..28).filter(|place| is_at(&answers[place - 2], *place)).count();
        assert!(right >= 11, "{name}: {right}");
        assert_eq!(answers[25]["track"]["known"], true, "{name}: {}", answers[25]["track"]);
    }
}

#[tokio::test]
async fn a_clock_that_is_set_from_1970_to_today_costs_a_track_a_few_frames() {
    let (server, map) = shared_server();
    let town = town(server, &map).await;
    let off_at = |place| if place >= 10 { 0.0 } else { -START };
    let frames = (2..28).map(|place| (place, time(place, off_at(place))));
    let answers = drive(&map, &town, "unset", frames).await;
    assert!(warnings(&answers[0]).contains("not set"), "{}", answers[0]);
    assert!(warnings(&answers[8]).contains("NTP"), "{}", answers[8]);
    let right = (14..28).filter(|place| is_at(&answers[place - 2], *place)).count();
    assert!(right >= 13, "{right}");
}

#[tokio::test]
async fn a_clock_that_is_wrong_all_the_time_is_followed_and_reported() {
    let (server, map) = shared_server();
    let town = town(server, &map).await;
    // Ahead of any clock that is right.
    let frames = (2..20).map(|place| (place, time(place, 30.0 * YEAR)));
    let answers = drive(&map, &town, "ahead", frames).await;
    assert!(answers.iter().all(|answer| warnings(answer).contains("ahead of this server's clock")));
    let right = (6..20).filter(|place| is_at(&answers[place - 2], *place)).count();
    assert!(right >= 13, "{right}");
}

#[tokio::test]
async fn times_in_milli_micro_and_nanoseconds_are_times() {
    let (server, map) = shared_server();
    let town = town(server, &map).await;
    for (name, digits) in [("seconds", 0), ("milli", 3), ("micro", 6), ("nano", 9)] {
        let seconds = |place: usize| START as u64 + 2 * place as u64;
        let frames =
            (2..20).map(|place| (place, format!("{}{}", seconds(place), "0".repeat(digits))));
        let answers = drive(&map, &town, name, frames).await;
        assert!(answers.iter().all(|answer| warnings(answer) == "[]"), "{name}: {}", answers[17]);
        let right = (6..20).filter(|place| is_at(&answers[place - 2], *place)).count();
        assert!(right >= 13, "{name}: {right}");
    }
}

#[tokio::test]
async fn robots_that_share_a_track_are_told_so_and_never_known_where_the_other_is() {
    let (server, map) = shared_server();
    let town = town(server, &map).await;
    // Both are slow: each place is seen four times.
    let frames = (0..16).flat_map(|number| {
        let at = |place: usize, off| (place, time(number, off));
        [at(1 + number / 4, 0.0), at(17 + number / 4, 0.7)]
    });
    let frames: Vec<(usize, String)> = frames.collect();
    let answers = drive(&map, &town, "shared", frames.clone()).await;
    let told = answers.iter().filter(|answer| warnings(answer).contains("of its own")).count();
    assert!(told >= 14, "{told} of {}", answers.len());
    let wrong = answers
        .iter()
        .zip(&frames)
        .filter(|(answer, (place, _))| answer["track"]["known"] == true && !is_at(answer, *place));
    assert!(wrong.count() <= 1);
}
