use super::*;
use proptest::prelude::*;
use whereabouts_core::{MetricPose, Pose};

/// Images every ten metres along a road.
fn road(count: usize) -> Places {
    let at = |x: f64| {
        Pose::Metric(MetricPose { x, y: 0.0, z: None, qx: None, qy: None, qz: None, qw: None })
    };
    let image = |i: usize| (format!("i{i}").parse().unwrap(), at(i as f64 * 10.0));
    Places::new((0..count).map(image).collect())
}

fn settings() -> TrackSettings {
    TrackSettings {
        outliers: 0.4,
        jump: 0.05,
        sharpness: 1.5,
        odometry_error: 0.1,
        states: 64,
        max: 1,
        idle_s: 1,
        max_speed_m_s: 1.0,
        candidates: 1,
        known_probability: 0.5,
    }
}

fn total(belief: &Belief) -> f64 {
    belief.elsewhere + belief.likely.iter().map(|(_, p)| p).sum::<f64>()
}

/// The formula of the module's documentation, over all images.
fn reference(
    before: &[f64],
    motion: Option<Motion>,
    similarities: &[f32],
    gap: f32,
    settings: &TrackSettings,
) -> Vec<f64> {
    let n = before.len();
    let mut moved = before.to_vec();
    if let Some(motion) = motion {
        moved = vec![settings.jump / n as f64; n];
        for (i, held) in before.iter().enumerate() {
            let weight = |j: usize| {
                let d = 10.0 * i.abs_diff(j) as f64;
                let off = match motion {
                    Motion::Within(reach) => (d - reach).max(0.0) / 5.0,
                    Motion::By(moved) => (d - moved) / (5.0 + settings.odometry_error * moved),
                };
                if off.abs() > TAIL { 0.0 } else { (-0.5 * off * off).exp() }
            };
            let sum: f64 = (0..n).map(weight).sum();
            for (j, part) in moved.iter_mut().enumerate() {
                *part += (1.0 - settings.jump) * held * weight(j) / sum;
            }
        }
    }
    let first = similarities.iter().copied().fold(f32::MIN, f32::max);
    let e: Vec<f64> = similarities
        .iter()
        .map(|s| f64::from(settings.sharpness as f32 * (s - first) / gap).exp())
        .collect();
    let mean = e.iter().sum::<f64>() / n as f64;
    let product: Vec<f64> = (0..n)
        .map(|j| moved[j] * (settings.outliers + (1.0 - settings.outliers) * e[j] / mean))
        .collect();
    let sum: f64 = product.iter().sum();
    product.iter().map(|p| p / sum).collect()
}

#[test]
fn the_filter_follows_its_formula() {
    let (places, settings) = (road(20), settings());
    let similarity = |seed: usize| -> Vec<f32> {
        (0..20).map(|i| 0.5 + ((i * 7 + seed * 3) % 11) as f32 / 40.0).collect()
    };
    let mut belief = Belief::uniform();
    let mut expected = vec![1.0 / 20.0; 20];
    for (seed, motion) in
        [None, Some(Motion::Within(12.0)), Some(Motion::By(20.0)), Some(Motion::Within(0.0))]
            .into_iter()
            .enumerate()
    {
        let similarities = similarity(seed);
        expected = reference(&expected, motion, &similarities, 0.05, &settings);
        if let Some(motion) = motion {
            belief = belief.predicted(motion, &places, &settings);
            assert!((total(&belief) - 1.0).abs() < 1e-9);
        }
        let numbered: Vec<(u32, f32)> = (0..).zip(similarities).collect();
        belief = belief.updated(&numbered, 0.05, &places, &settings);
        for (image, probability) in &belief.likely {
            let expected = expected[*image as usize];
            assert!(
                (probability - expected).abs() < 1e-6,
                "{seed} {image} {probability} {expected}"
            );
        }
    }
    assert!((total(&belief) - 1.0).abs() < 1e-9);
}

#[test]
fn one_outlier_does_not_outvote_the_track_but_three_relocate_it() {
    let (places, settings) = (road(100), settings());
    let mut belief = Belief::uniform();
    for at in 10..16 {
        belief = belief.predicted(Motion::Within(15.0), &places, &settings);
        belief = belief.updated(&[(at, 0.9), (50, 0.8), (70, 0.79)], 0.05, &places, &settings);
    }
    assert_eq!(belief.best(&places, 15.0).unwrap().0, 15);
    belief = belief.predicted(Motion::Within(15.0), &places, &settings);
    let misled = belief.updated(&[(80, 0.95), (50, 0.8), (70, 0.79)], 0.05, &places, &settings);
    let (best, probability) = misled.best(&places, 15.0).unwrap();
    assert!((14..=17).contains(&best), "{best} {probability}");
    // Three in a row mean that the robot was carried away.
    let mut carried = misled;
    for _ in 0..3 {
        carried = carried.predicted(Motion::Within(15.0), &places, &settings);
        carried = carried.updated(&[(80, 0.95), (50, 0.8), (70, 0.79)], 0.05, &places, &settings);
    }
    let (best, probability) = carried.best(&places, 15.0).unwrap();
    assert_eq!(best, 80);
    assert!(probability > 0.5, "{probability}");
}

#[test]
fn odometry_tells_apart_two_places_that_look_alike() {
    let (places, settings) = (road(60), settings());
    let alike = [(20, 0.9), (40, 0.9), (3, 0.7)];
    let start = Belief::uniform().updated(&[(10, 0.9), (3, 0.7)], 0.05, &places, &settings);
    let moved = start.predicted(Motion::By(300.0), &places, &settings);
    let moved = moved.updated(&alike, 0.05, &places, &settings);
    assert_eq!(moved.best(&places, 5.0).unwrap().0, 40);
}

#[test]
fn odometry_out_of_the_map_resets_the_belief() {
    let (places, settings) = (road(20), settings());
    let start = Belief::uniform().updated(&[(0, 0.9), (10, 0.7)], 0.05, &places, &settings);
    let lost = start.predicted(Motion::By(900.0), &places, &settings);
    assert_eq!(lost.likely, []);
    assert!((lost.elsewhere - 1.0).abs() < 1e-9);
}

#[test]
fn the_number_of_states_is_bounded_and_the_sum_stays_one() {
    let (places, settings) = (road(500), TrackSettings { states: 10, ..settings() });
    let similarities: Vec<(u32, f32)> =
        (0..200).map(|image| (image, 0.5 + image as f32 / 1000.0)).collect();
    let belief = Belief::uniform().updated(&similarities, 0.05, &places, &settings);
    assert_eq!(belief.likely.len(), 10);
    assert!((total(&belief) - 1.0).abs() < 1e-9);
    assert_eq!(belief.best(&places, 1.0).unwrap().0, 199);
    let far = belief.predicted(Motion::Within(1e7), &places, &settings);
    assert!((total(&far) - 1.0).abs() < 1e-9);
}

#[test]
fn a_belief_survives_a_change_of_the_map_without_the_deleted_images() {
    let (places, settings) = (road(20), settings());
    let belief = Belief::uniform().updated(&[(5, 0.9), (6, 0.85)], 0.05, &places, &settings);
    let (by_id, larger) = (belief.by_id(&places), road(30));
    assert_eq!(Belief::from_ids(&by_id, &larger).best(&larger, 1.0).unwrap().0, 5);
    let smaller = Belief::from_ids(&by_id, &road(6)).without(5);
    assert_eq!(smaller.best(&places, 1.0), None);
    assert!((total(&smaller) - 1.0).abs() < 1e-9);
    assert_eq!(belief.without(5).best(&places, 1.0).unwrap().0, 6);
}

/// A robot's frame: how it has moved since the one before, and which images it looks like.
#[derive(Debug, Clone)]
struct RandomFrame {
    motion: Option<Motion>,
    similarities: Vec<(u32, f32)>,
}

/// A map of up to 60 images within a kilometre.
fn random_places() -> impl Strategy<Value = Places> {
    let position = (-500.0..500.0_f64, -500.0..500.0_f64);
    proptest::collection::vec(position, 1..60).prop_map(|positions| {
        let image = |(number, (x, y)): (usize, (f64, f64))| {
            let pose = MetricPose { x, y, z: None, qx: None, qy: None, qz: None, qw: None };
            (format!("i{number}").parse().unwrap(), Pose::Metric(pose))
        };
        Places::new(positions.into_iter().enumerate().map(image).collect())
    })
}

fn random_settings() -> impl Strategy<Value = TrackSettings> {
    let share = || 0.001..0.999_f64;
    (share(), share(), 0.01..1000.0_f64, 0.001..10.0_f64, 1..40_usize).prop_map(
        |(outliers, jump, sharpness, odometry_error, states)| TrackSettings {
            outliers,
            jump,
            sharpness,
            odometry_error,
            states,
            ..settings()
        },
    )
}

fn random_frame() -> impl Strategy<Value = RandomFrame> {
    let motion = prop_oneof![
        Just(None),
        (0.0..1e8_f64).prop_map(|metres| Some(Motion::Within(metres))),
        (0.0..2000.0_f64).prop_map(|metres| Some(Motion::Within(metres))),
        (0.0..2000.0_f64).prop_map(|metres| Some(Motion::By(metres))),
        (0.0..1e6_f64).prop_map(|metres| Some(Motion::By(metres))),
    ];
    let similarities = proptest::collection::btree_map(0..60_u32, -1.0..1.0_f32, 0..20);
    (motion, similarities).prop_map(|(motion, similarities)| RandomFrame {
        motion,
        similarities: similarities.into_iter().collect(),
    })
}

/// Whether these are probabilities of each image once, and of the rest of the map.
fn check(belief: &Belief) -> Result<(), TestCaseError> {
    let sum = total(belief);
    prop_assert!((sum - 1.0).abs() < 1e-9, "the sum is {}", sum);
    let valid = 0.0..=1.0 + 1e-9;
    prop_assert!(valid.contains(&belief.elsewhere), "{} elsewhere", belief.elsewhere);
    for (image, probability) in &belief.likely {
        prop_assert!(valid.contains(probability), "{} at {}", probability, image);
    }
    prop_assert!(belief.likely.is_sorted_by(|one, next| one.0 < next.0));
    Ok(())
}

proptest! {
    #[test]
    fn a_belief_is_a_bounded_probability_distribution_after_any_frames(
        places in random_places(),
        settings in random_settings(),
        gap in 1e-4..1.0_f32,
        frames in proptest::collection::vec(random_frame(), 1..12),
    ) {
        let mut belief = Belief::uniform();
        for RandomFrame { motion, mut similarities } in frames {
            similarities.retain(|(image, _)| (*image as usize) < places.len());
            if let Some(motion) = motion {
                belief = belief.predicted(motion, &places, &settings);
                check(&belief)?;
                prop_assert!(belief.likely.len() <= places.len());
            }
            let before = belief.clone();
            belief = belief.updated(&similarities, gap, &places, &settings);
            check(&belief)?;
            match similarities.is_empty() {
                true => prop_assert_eq!(&belief, &before),
                false => prop_assert!(belief.likely.len() <= settings.states),
            }
            if let Some((best, probability)) = belief.best(&places, 25.0) {
                prop_assert!((0.0..=1.0 + 1e-9).contains(&probability), "{}", probability);
                check(&belief.clone().without(best))?;
            }
            let restored = Belief::from_ids(&belief.by_id(&places), &places);
            check(&restored)?;
            prop_assert_eq!(&restored.likely, &belief.likely);
        }
    }
}
