//! Tracks: a robot that drives through the town.

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use whereabouts_town::{Town, TownSpec};

use super::deployment;
use super::drives::{self, behind_a_van, is_blocked};
use super::support::{Answer, Server, frame, jpeg, shared_server};
use super::wait::{eventually, until};

const PLACES: usize = 96;
/// Speed of the robot in metres per second; the service knows only the default bound.
const SPEED: f64 = 8.0;

/// The id of the map image of a place.
fn id(place: usize) -> String {
    format!("place-{place}")
}

pub(crate) async fn metric_map(server: &Server, map: &str, town: &Town) {
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

/// A place that a robot passes, with the number of its visit.
type Visit = (usize, u32);

/// The answers to the frames of a drive, one after another, with what the robot says of its way.
async fn drive(
    server: &Server,
    town: &Town,
    visits: &[Visit],
    query: impl Fn(&Step) -> String,
) -> Vec<Value> {
    let mut answers = Vec::new();
    let mut at: Timestamp = "2026-03-01T12:00:00Z".parse().unwrap();
    let mut before: Option<[f64; 2]> = None;
    for (place, visit) in visits {
        let shot = town.query(*place, *visit);
        let here = [shot.x, shot.y];
        let way = before.map_or(0.0, |[x, y]| (here[0] - x).hypot(here[1] - y));
        let pause = if way < 5.0 { 1.0 } else { 0.0 };
        at += SignedDuration::from_secs_f64(way / SPEED + pause);
        before = Some(here);
        let blocked = is_blocked(*place);
        let picture = if blocked { behind_a_van(shot.image, *place) } else { shot.image };
        let path = format!("/localize?refine=off&{}", query(&Step { at, way }));
        answers.push(server.post_jpeg(&path, jpeg(&picture)).await.expect(200));
    }
    answers
}

/// What a robot says of its way to a frame.
struct Step {
    at: Timestamp,
    /// Metres from the frame before.
    way: f64,
}

/// How many answers name the right image.
fn right(answers: impl IntoIterator<Item = String>, visits: &[Visit]) -> usize {
    answers.into_iter().zip(visits).filter(|(answer, (place, _))| *answer == id(*place)).count()
}

fn tracked(answers: &[Value]) -> Vec<String> {
    let image = |answer: &Value| {
        let image = answer["track"]["image_id"].as_str();
        image.unwrap_or_else(|| panic!("no place: {answer}")).to_owned()
    };
    answers.iter().map(image).collect()
}

fn names(places: Vec<usize>) -> Vec<String> {
    places.into_iter().map(id).collect()
}

#[tokio::test]
async fn a_track_is_located_better_than_its_frames_and_than_simple_filters() {
    let town = Town::new(TownSpec {
        seed: 11,
        places: PLACES,
        width: 320,
        height: 240,
        ..TownSpec::default()
    });
    let (server, map) = shared_server();
    metric_map(server, &map, &town).await;
    let visits: Vec<Visit> = (0..PLACES).map(|place| (place, (place / 8) as u32)).collect();
    let by_time = |step: &Step| format!("map={map}&k={PLACES}&track=a&captured_at={}", step.at);
    let plain = drive(server, &town, &visits, by_time).await;
    // Odometry with an error of five metres.
    let by_way = |step: &Step| {
        format!("map={map}&track=b&captured_at={}&moved_m={}", step.at, step.way + 5.0)
    };
    let moved = drive(server, &town, &visits, by_way).await;
    let similarities: Vec<Vec<f32>> = plain.iter().map(all_similarities).collect();
    let counted = |places: Vec<usize>| right(names(places), &visits);
    let alone = counted(drives::alone(&similarities));
    let a = counted(drives::with_odometry(&similarities));
    let b = counted(drives::without_odometry(&similarities));
    let line = counted(drives::best_line(&similarities));
    let filtered = right(tracked(&plain), &visits);
    let with_odometry = right(tracked(&moved), &visits);
    println!(
        "R@1 of {PLACES} frames, three in ten blocked: frame alone {alone}, track {filtered}, with odometry \
         {with_odometry}; A {a}, B {b}, SeqSLAM {line}"
    );
    // A frame behind a van says that it shows nothing, so the track goes by its motion there. B takes a hint from the
    // strip beside the van.
    assert!(
        filtered > alone && filtered >= a && filtered + 3 >= b,
        "{filtered} of {PLACES}, {alone} alone, A {a}, B {b}"
    );
    assert!(with_odometry > alone && with_odometry >= a, "{with_odometry}, {alone} alone, A {a}");
    let mut sure = [0; 2];
    for (answer, (place, _)) in plain.iter().chain(&moved).zip(visits.iter().chain(&visits)) {
        let probability = answer["track"]["probability"].as_f64().unwrap();
        assert!((0.0..=1.0 + 1e-9).contains(&probability), "{probability}");
        assert_eq!(answer["track"]["known"], probability >= 0.9);
        if probability >= 0.9 {
            sure[usize::from(answer["track"]["image_id"] == id(*place))] += 1;
        }
    }
    assert_eq!(plain[PLACES - 1]["track"]["frames"], PLACES);
    println!(
        "of answers with probability 0.9 or more, {} are right and {} wrong",
        sure[1], sure[0]
    );
    assert!(sure[1] >= 19 * sure[0], "{sure:?}");
}

/// The similarity of a frame to each image of the map, in order.
fn all_similarities(answer: &Value) -> Vec<f32> {
    let mut row = vec![0.0; PLACES];
    for candidate in answer["candidates"].as_array().unwrap() {
        let name = candidate["image_id"].as_str().unwrap();
        let place: usize = name.trim_start_matches("place-").parse().unwrap();
        row[place] = candidate["similarity"].as_f64().unwrap() as f32;
    }
    row
}

/// A town of six streets, and its map.
async fn small_town(server: &Server, map: &str) -> Town {
    let town = Town::new(TownSpec {
        seed: 11,
        places: 48,
        width: 320,
        height: 240,
        ..TownSpec::default()
    });
    metric_map(server, map, &town).await;
    town
}

#[tokio::test]
async fn a_robot_that_turns_round_is_followed_with_odometry_and_without() {
    let (server, map) = shared_server();
    let town = small_town(server, &map).await;
    let visits: Vec<Visit> = (8..24).chain((8..23).rev()).map(|place| (place, 1)).collect();
    let by_time = |step: &Step| format!("map={map}&track=a&captured_at={}", step.at);
    let turn = 16;
    let by_pose = |step: &Step| {
        let dyaw =
            if step.at == turn_time(&town, &visits, turn) { std::f64::consts::PI } else { 0.0 };
        let Step { at, way } = step;
        format!("map={map}&track=b&captured_at={at}&dx={way}&dy=0&dyaw={dyaw}&covariance=4,4,0.1")
    };
    let plain = drive(server, &town, &visits, by_time).await;
    let posed = drive(server, &town, &visits, by_pose).await;
    let back = &visits[turn..];
    let single = plain[turn..]
        .iter()
        .map(|answer| answer["candidates"][0]["image_id"].as_str().unwrap().to_owned());
    let single = right(single.collect::<Vec<_>>(), back);
    let [by_time, by_pose] = [&plain, &posed].map(|answers| right(tracked(&answers[turn..]), back));
    println!(
        "on the way back, of {}: frame alone {single}, track {by_time}, odometry {by_pose}",
        back.len()
    );
    assert!(by_time >= single, "{by_time}, {single} alone");
    assert!(by_pose * 10 >= back.len() * 8, "{by_pose} of {}", back.len());
}

/// When a drive is at its `number`th frame.
fn turn_time(town: &Town, visits: &[Visit], number: usize) -> Timestamp {
    let mut at: Timestamp = "2026-03-01T12:00:00Z".parse().unwrap();
    let mut before: Option<[f64; 2]> = None;
    for (place, visit) in &visits[..=number] {
        let shot = town.query(*place, *visit);
        let here = [shot.x, shot.y];
        let way = before.map_or(0.0, |[x, y]| (here[0] - x).hypot(here[1] - y));
        let pause = if way < 5.0 { 1.0 } else { 0.0 };
        at += SignedDuration::from_secs_f64(way / SPEED + pause);
        before = Some(here);
    }
    at
}

#[tokio::test]
async fn a_robot_that_stands_still_stays_where_it_is() {
    let (server, map) = shared_server();
    let town = small_town(server, &map).await;
    let standing = 15;
    let visits: Vec<Visit> = (8..standing).chain([standing; 12]).map(|place| (place, 1)).collect();
    let answers =
        drive(server, &town, &visits, |step| format!("map={map}&track=a&captured_at={}", step.at))
            .await;
    let there = tracked(&answers[visits.len() - 8..]);
    assert!(there.iter().all(|image| *image == id(standing)), "{there:?}");
}

#[tokio::test]
async fn a_kidnapped_robot_is_found_again() {
    let (server, map) = shared_server();
    let town = small_town(server, &map).await;
    let visits: Vec<Visit> = (0..16).chain(32..48).map(|place| (place, 1)).collect();
    // Neither the clock nor odometry sees that it was carried.
    let by_way = |step: &Step| {
        let way = step.way.min(17.0);
        format!("map={map}&track=a&moved_m={way}")
    };
    let answers = drive(server, &town, &visits, by_way).await;
    let end = visits.len() - 6;
    let found = right(tracked(&answers[end..]), &visits[end..]);
    assert!(found >= 5, "{:?}", tracked(&answers[16..]));
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
        ("&dx=1&dy=0&dyaw=0", "track"),
        ("&track=a&dx=1", "together"),
        ("&track=a&moved_m=1&dx=1&dy=0&dyaw=0", "alone"),
        ("&track=a&dx=1&dy=0&dyaw=NaN", "dyaw"),
        ("&track=a&dx=1&dy=0&dyaw=0&covariance=1,2", "9"),
        ("&track=a&dx=1&dy=0&dyaw=0&covariance=1,2,x", "number"),
        ("&track=a&dx=1&dy=0&dyaw=0&covariance=1,nan,0,nan,1,0,0,0,1", "symmetric"),
        ("&track=a&dx=1&dy=0&dyaw=0&covariance=1,0.5,0,0.1,1,0,0,0,1", "symmetric"),
        ("&track=a&dx=1&dy=0&dyaw=0&covariance=1,5,0,5,1,0,0,0,1", "variances"),
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
    assert_eq!(frames[..5], [1, 1, 2, 1, 3]);
    // The store may have it: with a database always, otherwise if it was written in the last seconds.
    assert!(frames[5] == 2 || !deployment::is_scale_out() && frames[5] == 1, "{frames:?}");
    assert!(server.log().contains("track.max"), "{}", server.log());
}
