use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use super::super::session::Frame;
use super::super::{Odometry, TrackStep};
use super::*;
use crate::Principal;
use whereabouts_core::{Descriptor, MetricPose, Pose, dot};
use whereabouts_store::LocatedImage;

/// Places along a road, the second half of which looks like the first.
const PLACES: u32 = 60;

fn settings() -> TrackSettings {
    TrackSettings { known_probability: 0.9, ..crate::tests::settings().track }
}

fn view(place: u32) -> Descriptor {
    let mut numbers = vec![0.1; PLACES as usize / 2];
    numbers[(place % (PLACES / 2)) as usize] += 1.0;
    Descriptor::normalised(numbers).unwrap()
}

fn road() -> Arc<Ground> {
    let image = |slot: u32| {
        let x = 10.0 * f64::from(slot);
        let pose = MetricPose { x, y: 0.0, z: None, qx: None, qy: None, qz: None, qw: None };
        let id = format!("image-{slot}").parse().unwrap();
        LocatedImage { slot: slot as usize, id, pose: Pose::Metric(pose) }
    };
    let mut ground = Ground::new((0..PLACES).map(image).collect());
    let known = (0..PLACES).map(|place| (place, view(place))).collect();
    ground.learn_common(&known);
    Arc::new(ground)
}

/// A robot on the road.
struct Robot {
    track: Track,
    ground: Arc<Ground>,
    frames: i64,
}

impl Robot {
    fn new() -> Self {
        Self { track: Track::new(), ground: road(), frames: 0 }
    }

    /// Sees a place, ten metres after the one before.
    fn see(&mut self, place: u32) {
        let at = Timestamp::UNIX_EPOCH + SignedDuration::from_secs(2 * self.frames);
        let moved = Odometry::distance(if self.frames == 0 { 0.0 } else { 10.0 }).unwrap();
        let step =
            TrackStep::new(&Principal::Anonymous, "r".into(), Some(at), Some(moved)).unwrap();
        let (frame, settings) = (view(place), settings());
        self.track.enter(&self.ground, 0);
        let frame = Frame { descriptor: frame.as_slice(), is_informative: true };
        let prediction = self.track.predict(&step, frame, &self.ground, &settings);
        let images: Vec<u32> = (0..PLACES).collect();
        let similar = |image: &u32| Some(dot(&prediction.frame, view(*image).as_slice()));
        let similarities: Vec<_> = images.iter().map(similar).collect();
        let weights = prediction.weights((&images, &similarities), None, &self.ground, &settings);
        self.track.update(prediction, weights.as_ref(), &self.ground, &settings);
        self.frames += 1;
    }

    /// Hears that the frame of a number showed a place.
    fn hears(&mut self, frame: u64, place: u32, confidence: f64) -> bool {
        let image = self.ground.number(&format!("image-{place}").parse().unwrap()).unwrap();
        self.track.learn(Verdict { frame, image, confidence }, &self.ground, &settings())
    }

    /// The probability that it is at a place or one next to it.
    fn at(&self, place: u32) -> f64 {
        let masses = self.track.posterior.belief.masses();
        let near = masses.iter().filter(|(image, _)| image.abs_diff(place) <= 1);
        near.map(|(_, mass)| mass).sum()
    }
}

#[test]
fn a_verdict_counts_where_the_robot_has_come_to_since() {
    let mut robot = Robot::new();
    (5..15).for_each(|place| robot.see(place));
    let odds = |probability: f64| probability / (1.0 - probability);
    let before = [odds(robot.at(14)), odds(robot.at(44))];
    let mut other = Robot { track: robot.track.clone(), ground: robot.ground.clone(), ..robot };
    // The fourth frame was at the place 8, or at 38.
    let mut robot = Robot { track: other.track.clone(), ground: other.ground.clone(), ..other };
    assert!(robot.hears(4, 8, 0.95));
    assert!(odds(robot.at(14)) > 5.0 * before[0], "{before:?} {}", robot.at(14));
    assert!(other.hears(4, 38, 0.95));
    assert!(odds(other.at(44)) > 5.0 * before[1], "{before:?} {}", other.at(44));
    // And it is a robot like any other.
    (15..18).for_each(|place| robot.see(place));
    assert!(robot.at(17) > 0.8, "{}", robot.at(17));
}

#[test]
fn a_verdict_that_says_nothing_or_comes_too_late_changes_nothing() {
    let mut robot = Robot::new();
    for number in 0..=VERDICT_STEPS as u32 {
        robot.see(number % PLACES);
    }
    let before = Arc::clone(&robot.track.posterior);
    let last = robot.track.frames;
    assert!(!robot.hears(1, 0, 0.99));
    assert!(!robot.hears(last + 1, 0, 0.99));
    assert!(!robot.hears(last, 5, 0.0));
    assert_eq!(robot.track.posterior, before);
    assert!(robot.hears(last, 5, 0.5));
    assert_ne!(robot.track.posterior, before);
}

#[test]
fn a_wrong_verdict_alone_does_not_move_a_robot_that_is_sure() {
    let mut robot = Robot::new();
    (5..15).for_each(|place| robot.see(place));
    robot.hears(10, 14, 0.99);
    (15..22).for_each(|place| robot.see(place));
    let before = robot.at(21);
    assert!(before > 0.9);
    robot.hears(robot.track.frames, 40, 0.99);
    assert!(robot.at(21) > 0.5, "{}", robot.at(21));
}

#[test]
fn confidences_off_the_map_are_evidence_against_being_on_it_on_average() {
    let off_map = (0..1000).map(|number| (f64::from(number) + 0.5) / 1000.0);
    let ratios: Vec<f64> = off_map.map(presence_ratio).collect();
    let mean = ratios.iter().sum::<f64>() / 1000.0;
    assert!((0.95..=1.0).contains(&mean), "{mean}");
    assert!(ratios.iter().map(|ratio| ratio.ln()).sum::<f64>() < 0.0);
    assert!(presence_ratio(0.95) > 1.5 && presence_ratio(1.0) < 4.0);
}

#[test]
fn jobs_that_are_waited_for_are_bounded() {
    let waiting = Waiting::new(1);
    let subject = || {
        let track = TrackKey { map: Uuid::nil(), owner: "-".into(), id: "r".into() };
        Subject { track, frame: 1, since: Instant::now() }
    };
    for _ in 0..3 * JOBS_EACH {
        waiting.add(Uuid::now_v7(), subject(), Duration::from_secs(60));
    }
    assert_eq!(waiting.all().len(), JOBS_EACH);
    waiting.add(Uuid::now_v7(), subject(), Duration::ZERO);
    assert_eq!(waiting.all().len(), 1);
}
