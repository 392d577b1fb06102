//! Tracks of robots that leave the map, or were never on it.

use image::{Rgb, RgbImage};
use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use whereabouts_town::{Town, TownSpec};

use super::drives::{behind_a_van, is_blocked};
use super::support::{Server, jpeg, shared_server};
use super::wait::until;

/// Speed of the robot in metres per second.
const SPEED: f64 = 8.0;

/// Places in the town.
const PLACES: usize = 48;

/// Places in each of its streets.
const STREET: usize = 8;

fn town(seed: u64) -> Town {
    Town::new(TownSpec { seed, places: PLACES, width: 320, height: 240, ..TownSpec::default() })
}

fn id(place: usize) -> String {
    format!("place-{place}")
}

/// A map of some places of a town.
async fn map_of(server: &Server, map: &str, town: &Town, places: &[usize]) {
    let change = json!({"scene": "outdoor", "frame": "metric"});
    server.put(&format!("/maps/{map}"), change).await.expect(201);
    for place in places {
        let shot = town.reference(*place);
        let path = format!("/maps/{map}/images?id={}&x={}&y={}", id(*place), shot.x, shot.y);
        server.post_jpeg(&path, jpeg(&shot.image)).await.expect(201);
    }
    until(async || {
        server.get(&format!("/maps/{map}")).await.expect(200)["calibration"]["images"]
            == places.len()
    })
    .await;
}

/// A frame of a drive.
struct Frame {
    picture: RgbImage,
    /// Metres from the frame before.
    way: f64,
    /// The image of its place, if it is in the map.
    truth: Option<String>,
}

/// What a robot sees that drives past some places of a town; a van blocks three frames in ten.
fn past(town: &Town, places: impl IntoIterator<Item = usize>, mapped: &[usize]) -> Vec<Frame> {
    let mut before: Option<[f64; 2]> = None;
    let frame = |place: usize| {
        let shot = town.query(place, 1);
        let way = before.map_or(16.0, |[x, y]| (shot.x - x).hypot(shot.y - y));
        before = Some([shot.x, shot.y]);
        let blocked = is_blocked(place);
        let picture = if blocked { behind_a_van(shot.image, place) } else { shot.image };
        Frame { picture, way, truth: mapped.contains(&place).then(|| id(place)) }
    };
    places.into_iter().map(frame).collect()
}

/// Frames off the map.
fn away(frames: Vec<Frame>) -> Vec<Frame> {
    frames.into_iter().map(|frame| Frame { truth: None, ..frame }).collect()
}

/// What a robot with a cap on its lens sees.
fn blank(count: usize) -> Vec<Frame> {
    let picture = RgbImage::from_pixel(320, 240, Rgb([3, 3, 3]));
    (0..count).map(|_| Frame { picture: picture.clone(), way: 16.0, truth: None }).collect()
}

/// What is counted over several drives.
#[derive(Debug, Default)]
struct Counts {
    /// Answers with a probability of at least 0.9, and those of them that are right.
    sure: [usize; 2],
    /// Answers off the map, and those of them that are known.
    off_map: [usize; 2],
    /// Answers on the map, and those of them that are known and right.
    on_map: [usize; 2],
}

impl Counts {
    fn add(&mut self, frames: &[Frame], answers: &[Value]) {
        for (frame, answer) in frames.iter().zip(answers) {
            let track = &answer["track"];
            let number = |name: &str| track[name].as_f64().unwrap();
            let (probability, off_map) = (number("probability"), number("off_map"));
            assert!((0.0..=1.0).contains(&probability) && (0.0..=1.0).contains(&off_map));
            assert!(probability + off_map <= 1.0 + 1e-9, "{track}");
            assert_eq!(track["known"], probability >= 0.9);
            let right =
                frame.truth.is_some() && track["image_id"].as_str() == frame.truth.as_deref();
            let known = track["known"] == true;
            let counted = match frame.truth {
                Some(_) => (&mut self.on_map, known && right),
                None => (&mut self.off_map, known),
            };
            counted.0[0] += 1;
            counted.0[1] += usize::from(counted.1);
            if probability >= 0.9 {
                self.sure[0] += 1;
                self.sure[1] += usize::from(right);
            }
        }
    }

    /// The targets: of sure answers 95 % are right, and off the map at most 5 % are known.
    fn check(&self, name: &str) {
        println!("{name}: {self:?}");
        assert!(self.sure[1] * 100 >= self.sure[0] * 95, "{name}: {self:?}");
        assert!(self.off_map[1] * 20 <= self.off_map[0], "{name}: {self:?}");
    }
}

/// Drives with odometry and without. Returns the answers of both.
async fn drive(server: &Server, map: &str, frames: &[Frame]) -> [Vec<Value>; 2] {
    let mut all = [Vec::new(), Vec::new()];
    for (with_odometry, answers) in [false, true].into_iter().zip(&mut all) {
        let mut at: Timestamp = "2026-03-01T12:00:00Z".parse().unwrap();
        for Frame { picture, way, .. } in frames {
            at += SignedDuration::from_secs_f64(way / SPEED);
            let moved =
                if with_odometry { format!("&moved_m={}", way + 1.0) } else { String::new() };
            let path = format!(
                "/localize?map={map}&refine=off&track=r-{with_odometry}&captured_at={at}{moved}"
            );
            answers.push(server.post_jpeg(&path, jpeg(picture)).await.expect(200));
        }
    }
    all
}

/// Runs a drive both ways, and counts.
async fn counted(map: &str, frames: &[Frame]) -> (Counts, [Vec<Value>; 2]) {
    let (server, _) = shared_server();
    let answers = drive(server, map, frames).await;
    let mut counts = Counts::default();
    answers.iter().for_each(|answers| counts.add(frames, answers));
    (counts, answers)
}

fn off_map(answer: &Value) -> f64 {
    answer["track"]["off_map"].as_f64().unwrap()
}

#[tokio::test]
async fn a_robot_that_drives_past_the_end_of_the_map_is_off_it() {
    let (server, map) = shared_server();
    let town = town(11);
    let mapped: Vec<usize> = (0..32).collect();
    map_of(server, &map, &town, &mapped).await;
    let frames = past(&town, 12..PLACES, &mapped);
    let (counts, answers) = counted(&map, &frames).await;
    counts.check("past the end");
    assert!(counts.on_map[1] * 2 > counts.on_map[0], "{counts:?}");
    assert!(answers.iter().all(|answers| off_map(answers.last().unwrap()) > 0.8));
}

#[tokio::test]
async fn a_robot_in_a_street_that_is_not_in_the_map_is_off_it_until_it_comes_back() {
    let (server, map) = shared_server();
    let town = town(11);
    let mapped: Vec<usize> = (0..PLACES).filter(|place| place / STREET != 2).collect();
    map_of(server, &map, &town, &mapped).await;
    let frames = past(&town, 4..PLACES, &mapped);
    let (counts, answers) = counted(&map, &frames).await;
    counts.check("a street that is not in the map");
    assert!(answers.iter().all(|answers| off_map(answers.last().unwrap()) < 0.2));
}

#[tokio::test]
async fn a_robot_that_is_carried_to_another_town_and_back_is_off_the_map_meanwhile() {
    let (server, map) = shared_server();
    let (town, other) = (town(11), town(12));
    let mapped: Vec<usize> = (0..PLACES).collect();
    map_of(server, &map, &town, &mapped).await;
    let mut frames = past(&town, 0..16, &mapped);
    frames.extend(away(past(&other, 0..24, &mapped)));
    frames.extend(past(&town, 24..PLACES, &mapped));
    let (counts, answers) = counted(&map, &frames).await;
    counts.check("carried to another town");
    assert!(answers.iter().all(|answers| off_map(&answers[39]) > 0.8));
    assert!(answers.iter().all(|answers| off_map(answers.last().unwrap()) < 0.2));
}

#[tokio::test]
async fn a_robot_that_was_never_on_the_map_is_not_known() {
    let (server, map) = shared_server();
    let mapped: Vec<usize> = (0..PLACES).collect();
    map_of(server, &map, &town(11), &mapped).await;
    let frames = away(past(&town(12), 0..PLACES, &mapped));
    let (counts, _) = counted(&map, &frames).await;
    counts.check("never on the map");
}

#[tokio::test]
async fn a_robot_that_drives_on_past_the_end_without_seeing_anything_is_not_known() {
    let (server, map) = shared_server();
    let town = town(11);
    let mapped: Vec<usize> = (0..32).collect();
    map_of(server, &map, &town, &mapped).await;
    let mut frames = past(&town, 12..32, &mapped);
    frames.extend(blank(24));
    let (counts, answers) = counted(&map, &frames).await;
    counts.check("blind past the end");
    for answers in answers {
        // Without seeing anything, it may also have come back.
        let off: Vec<f64> = answers[20..].iter().map(off_map).collect();
        assert!(off[2..8].iter().all(|off| *off > 0.7) && off[23] > 0.5, "{off:?}");
    }
}

#[tokio::test]
async fn half_of_a_map_is_a_map_of_half_the_places() {
    let (server, map) = shared_server();
    let town = town(11);
    let mapped: Vec<usize> =
        (0..PLACES).filter(|place| (place / STREET).is_multiple_of(2)).collect();
    map_of(server, &map, &town, &mapped).await;
    let frames = past(&town, 0..PLACES, &mapped);
    let (counts, _) = counted(&map, &frames).await;
    counts.check("half of the map");
}
