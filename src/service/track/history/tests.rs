use super::super::presence::Presence;
use super::super::{belief::Belief, evidence::Weights};
use super::*;
use whereabouts_core::{MetricPose, Pose};
use whereabouts_store::LocatedImage;

const HABITS: Habits =
    Habits { max_speed: 10.0, turn: 0.005, jump: 0.005, leave: 0.005, enter: 0.02 };

/// A map with an image every ten metres along a road.
fn road(count: usize) -> Ground {
    let located = |slot: usize| {
        let pose = MetricPose {
            x: 10.0 * slot as f64,
            y: 0.0,
            z: None,
            qx: None,
            qy: None,
            qz: None,
            qw: None,
        };
        LocatedImage { slot, id: slot.to_string().parse().unwrap(), pose: Pose::Metric(pose) }
    };
    Ground::new((0..count).map(located).collect())
}

/// What the filter said after a frame that looks like some images, with probabilities in the given order.
fn passed(images: &[(u32, f32)], off_map: f64, moved: f64) -> Passed {
    let on_map = 1.0 - off_map;
    let known: f32 = images.iter().map(|(_, mass)| mass).sum();
    Passed {
        captured_at: None,
        received_at: Timestamp::UNIX_EPOCH,
        images: images.iter().map(|(image, mass)| (*image, mass * on_map as f32)).collect(),
        elsewhere: on_map * f64::from(1.0 - known),
        off_map,
        moved: Some(Move { metres: moved, error: 1.0 }),
    }
}

fn way(frames: Vec<Passed>) -> Vec<Smoothed> {
    smoothed(&frames.into(), &road(60), 25.0, HABITS)
}

#[test]
fn later_frames_decide_where_a_robot_was_at_first() {
    // At first it may be at either of two places; later it is at one of them.
    let places = way(vec![
        passed(&[(40, 0.6), (10, 0.4)], 0.0, 0.0),
        passed(&[(41, 0.5), (11, 0.5)], 0.0, 10.0),
        passed(&[(12, 0.95), (42, 0.05)], 0.0, 10.0),
    ]);
    let images: Vec<u32> = places.iter().map(|place| place.image.unwrap()).collect();
    assert_eq!(images, [10, 11, 12]);
    assert!(places.iter().all(|place| place.probability > 0.8), "{places:?}");
}

#[test]
fn the_last_place_is_what_the_filter_said() {
    let places = way(vec![passed(&[(1, 0.9)], 0.0, 0.0), passed(&[(2, 0.7)], 0.2, 10.0)]);
    assert_eq!(places[1].image, Some(2));
    assert!((places[1].probability - 0.56).abs() < 1e-3, "{places:?}");
    assert!((places[1].off_map - 0.2).abs() < 1e-9);
}

#[test]
fn a_robot_that_turns_out_to_have_left_the_map_had_left_it_before_the_filter_was_sure() {
    let places = way(vec![
        passed(&[(5, 0.9)], 0.01, 0.0),
        passed(&[(6, 0.9)], 0.6, 10.0),
        passed(&[(7, 0.9)], 0.99, 10.0),
    ]);
    assert!(places[1].off_map > 0.6 && places[0].off_map > 0.01, "{places:?}");
}

#[test]
fn probabilities_are_probabilities_whatever_the_filter_said() {
    let nothing = Passed {
        captured_at: None,
        received_at: Timestamp::UNIX_EPOCH,
        images: Vec::new(),
        elsewhere: 0.0,
        off_map: 0.0,
        moved: None,
    };
    for frames in [
        vec![],
        vec![nothing.clone()],
        vec![passed(&[(1, 1.0)], 0.0, 0.0), nothing.clone(), passed(&[(50, 1.0)], 0.0, 1e9)],
        vec![passed(&[(1, 1.0)], 1.0, 0.0), passed(&[(50, 1.0)], 0.0, 0.0)],
    ] {
        let count = frames.len();
        let places = way(frames);
        assert_eq!(places.len(), count);
        for place in places {
            let numbers = [place.probability, place.off_map];
            assert!(numbers.iter().all(|number| (0.0..=1.0).contains(number)), "{place:?}");
        }
    }
}

#[test]
fn only_the_likeliest_images_of_a_frame_are_kept() {
    let ground = road(60);
    let similar: Vec<(u32, f32)> = (0..60).map(|image| (image, image as f32 / 60.0)).collect();
    let sample: Vec<f32> = similar.iter().map(|(_, similarity)| *similarity).collect();
    let weights = Weights::new(&similar, &sample, ground.len(), (1.0, 0.2));
    let belief = Belief::uniform().updated(&weights, 60, 512);
    let posterior = Posterior { belief, presence: Presence::new() };
    let mut passed = Passed::new((None, Timestamp::UNIX_EPOCH), &posterior, None);
    assert_eq!(passed.images.len(), KEPT);
    assert_eq!(passed.images[0].0, 59);
    let total = |passed: &Passed| {
        let images: f64 = passed.images.iter().map(|(_, mass)| f64::from(*mass)).sum();
        images + passed.elsewhere + passed.off_map
    };
    assert!((total(&passed) - 1.0).abs() < 1e-5);
    passed.renumber(&|image| image.checked_sub(50));
    assert_eq!(passed.images.len(), 10);
    assert!((total(&passed) - 1.0).abs() < 1e-5);
}

#[test]
fn what_was_known_stays_and_nothing_is_known_where_later_frames_contradict() {
    // The believed speed contradicts a gap in the map that the robot has crossed.
    let frames = vec![
        passed(&[(10, 0.97), (30, 0.03)], 0.0, 0.0),
        passed(&[(11, 0.6), (31, 0.4)], 0.0, 10.0),
        passed(&[(32, 0.97)], 0.0, 10.0),
    ];
    let (ground, settled_from) = (road(60), 0.9);
    let all = way(frames.clone());
    let settled = |at: usize| settled(&frames[at], all[at], (&ground, 25.0), settled_from);
    assert_eq!(all[0].image, Some(30), "smoothed");
    assert_eq!((settled(0).0.image, settled(0).1), (Some(10), true));
    assert_eq!((settled(1).0.image, settled(1).1), (Some(31), false));
    assert_eq!((settled(2).0.image, settled(2).1), (Some(32), true));
}
