use super::super::moves::fit;
use super::*;
use proptest::prelude::*;

const HABITS: Habits =
    Habits { max_speed: 10.0, turn: 0.005, jump: 0.01, leave: 0.005, enter: 0.02 };

/// A map with an image every ten metres along a road.
#[derive(Debug)]
struct Road {
    grid: Grid,
    paths: Paths,
}

impl Road {
    fn new(count: usize) -> Self {
        Self::at((0..count).map(|number| [10.0 * number as f64, 0.0]).collect())
    }

    fn at(positions: Vec<[f64; 2]>) -> Self {
        let grid = Grid::new(positions);
        let paths = Paths::new(&grid, 0.1);
        Self { grid, paths }
    }

    fn roads(&self) -> Roads<'_> {
        Roads { grid: &self.grid, paths: &self.paths, changes: &[] }
    }

    /// The weights of a frame that looks like these images, and like no other.
    fn looks_like(&self, images: &[u32]) -> Weights {
        let count = self.grid.len() as u32;
        let similar = |image: u32| if images.contains(&image) { 0.9 } else { 0.5 };
        let all: Vec<(u32, f32)> = (0..count).map(|image| (image, similar(image))).collect();
        let sample: Vec<f32> = all.iter().map(|(_, s)| *s).collect();
        Weights::new(&all, &sample, all.len(), (1.0, 0.1))
    }

    fn updated(&self, belief: &Belief, images: &[u32]) -> Belief {
        belief.updated(&self.looks_like(images), self.grid.len(), 512)
    }

    /// The belief after frames that look like these images, one a second.
    fn driven(&self, images: impl IntoIterator<Item = u32>) -> Belief {
        let mut belief = Belief::uniform();
        for (number, image) in images.into_iter().enumerate() {
            if number > 0 {
                belief = belief.predicted(second(), HABITS, self.roads()).0;
            }
            belief = self.updated(&belief, &[image]);
        }
        belief
    }
}

fn second() -> Motion {
    Motion::Elapsed { time: 1.0, novelty: None }
}

fn measured(metres: f64) -> Motion {
    Motion::Measured { metres, error: 0.1 * metres, speed: metres }
}

fn best(belief: &Belief) -> u32 {
    belief.masses().into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap().0
}

fn mass(belief: &Belief, image: u32) -> f64 {
    belief.masses().into_iter().filter(|(other, _)| *other == image).map(|(_, mass)| mass).sum()
}

fn total(belief: &Belief) -> f64 {
    belief.elsewhere + belief.masses().iter().map(|(_, mass)| mass).sum::<f64>()
}

#[test]
fn a_robot_is_expected_ahead_of_where_it_drove_and_not_behind() {
    let road = Road::new(60);
    for (way, next, behind) in
        [((10..20).collect::<Vec<_>>(), 20, 18), ((10..20).rev().collect(), 9, 11)]
    {
        let belief = road.driven(way).predicted(second(), HABITS, road.roads()).0;
        assert_eq!(best(&belief), next);
        assert!(mass(&belief, next) > 10.0 * mass(&belief, behind), "{behind}");
    }
}

#[test]
fn the_direction_decides_between_places_that_look_alike() {
    let road = Road::new(60);
    let belief = road.driven(10..20).predicted(second(), HABITS, road.roads()).0;
    assert_eq!(best(&road.updated(&belief, &[18, 20, 50])), 20);
}

#[test]
fn odometry_decides_between_places_that_look_alike() {
    let road = Road::new(60);
    let start = road.updated(&Belief::uniform(), &[10]);
    let moved =
        road.updated(&start.predicted(measured(200.0), HABITS, road.roads()).0, &[18, 30, 42]);
    assert_eq!(best(&moved), 30);
}

#[test]
fn a_turn_is_expected_when_odometry_has_seen_one() {
    let road = Road::new(60);
    let habits = Habits { turn: 0.8, ..HABITS };
    let mut belief = road.driven(10..20);
    belief = belief.predicted(measured(0.0), habits, road.roads()).0;
    belief = belief.predicted(measured(10.0), HABITS, road.roads()).0;
    assert_eq!(best(&belief), 18);
}

#[test]
fn one_misleading_frame_does_not_outvote_the_track_but_a_few_relocate_it() {
    let road = Road::new(100);
    let mut belief = road.driven(10..20).predicted(second(), HABITS, road.roads()).0;
    belief = road.updated(&belief, &[80]);
    assert_eq!(best(&belief), 20);
    for image in 81..86 {
        belief = road.updated(&belief.predicted(second(), HABITS, road.roads()).0, &[image]);
    }
    assert_eq!(best(&belief), 85);
}

#[test]
fn a_pause_in_which_the_robot_may_have_passed_the_whole_map_spreads_the_belief() {
    let road = Road::new(400);
    let driven = road.driven(10..20);
    let paused = Motion::Elapsed { time: 7200.0, novelty: None };
    let later = driven.predicted(paused, HABITS, road.roads()).0;
    assert!(later.elsewhere > 0.5, "{}", later.elsewhere);
    assert!((total(&later) - 1.0).abs() < 1e-5);
}

#[test]
fn who_sees_something_else_has_moved_and_who_sees_the_same_has_not() {
    assert!(fit(0.0, 1.0, 1.0) < fit(1.0, 1.0, 1.0));
    assert!(fit(1.0, 0.01, 1.0) < fit(0.0, 0.01, 1.0));
    // In a tunnel neighbours look the same.
    assert_eq!(fit(1.0, 0.01, 0.0), fit(0.0, 0.01, 0.0));
}

#[test]
fn a_robot_may_take_either_way_where_a_road_branches() {
    // From (0, 0) to (200, 0), and from there north and south.
    let mut positions: Vec<[f64; 2]> = (0..=20).map(|n| [10.0 * f64::from(n), 0.0]).collect();
    positions.extend((1..=10).map(|n| [200.0, 10.0 * f64::from(n)]));
    positions.extend((1..=10).map(|n| [200.0, -10.0 * f64::from(n)]));
    let road = Road::at(positions);
    for (look, name) in [(25, "north"), (35, "south")] {
        let belief = road.driven(10..=20).predicted(measured(50.0), HABITS, road.roads()).0;
        let belief = road.updated(&belief, &[look]);
        assert_eq!(best(&belief), look, "{name}");
        assert!(mass(&belief, look) > 0.5, "{name}: {}", mass(&belief, look));
    }
}

#[test]
fn a_loop_is_driven_round_and_round() {
    let count = 36;
    let angle = |n: usize| n as f64 / count as f64 * std::f64::consts::TAU;
    let road =
        Road::at((0..count).map(|n| [57.3 * angle(n).cos(), 57.3 * angle(n).sin()]).collect());
    let belief = road.driven((20..60).map(|n| n % count as u32));
    let belief = belief.predicted(second(), HABITS, road.roads()).0;
    assert_eq!(best(&belief), 60 % count as u32);
}

#[test]
fn images_in_no_order_are_driven_past_by_their_positions() {
    let count = 60;
    let place = |n: u32| n * 23 % count;
    let number = |wanted: u32| (0..count).find(|n| place(*n) == wanted).unwrap();
    let road = Road::at((0..count).map(|n| [10.0 * f64::from(place(n)), 0.0]).collect());
    let belief = road.driven((10..20).map(number)).predicted(second(), HABITS, road.roads()).0;
    assert_eq!(best(&belief), number(20));
}

#[test]
fn the_number_of_images_is_bounded_and_the_sum_stays_one() {
    let road = Road::new(500);
    let all: Vec<u32> = (0..500).step_by(3).collect();
    let belief = Belief::uniform().updated(&road.looks_like(&all), 500, 10);
    assert_eq!(belief.images.len(), 10);
    assert!((total(&belief) - 1.0).abs() < 1e-5);
}

#[test]
fn a_belief_survives_a_change_of_the_map_without_the_deleted_images() {
    let road = Road::new(40);
    let belief = road.driven(5..10);
    let shifted = belief.renumbered(&|image| image.checked_sub(3));
    assert_eq!(best(&shifted), 6);
    assert!((total(&shifted) - 1.0).abs() < 1e-5);
    let without = belief.renumbered(&|image| (image != 9).then_some(image));
    assert_ne!(best(&without), 9);
    assert!((total(&without) - 1.0).abs() < 1e-5);
}

/// A map of up to 60 images within a kilometre.
fn random_road() -> impl Strategy<Value = Road> {
    let position = (-500.0..500.0_f64, -500.0..500.0_f64);
    proptest::collection::vec(position, 1..60)
        .prop_map(|positions| Road::at(positions.into_iter().map(|(x, y)| [x, y]).collect()))
}

fn random_motion() -> impl Strategy<Value = Motion> {
    prop_oneof![
        (0.0..1e6_f64, 0.0..1e3_f64).prop_map(|(metres, error)| Motion::Measured {
            metres,
            error,
            speed: metres
        }),
        (0.0..100.0_f64).prop_map(measured),
        (0.0..1e5_f64).prop_map(|time| Motion::Elapsed { time, novelty: None }),
        (0.0..20.0_f64, 0.0..3.0_f64)
            .prop_map(|(time, seen)| Motion::Elapsed { time, novelty: Some(seen) }),
    ]
}

proptest! {
    #[test]
    fn a_belief_is_a_bounded_probability_distribution_after_any_frames(
        road in random_road(),
        shares in (0.001..0.999_f64, 0.001..0.999_f64),
        most in 1..40_usize,
        frames in proptest::collection::vec(
            (random_motion(), proptest::collection::btree_set(0..60_u32, 0..20)),
            1..12,
        ),
    ) {
        let habits = Habits { turn: shares.0, jump: shares.1, ..HABITS };
        let count = road.grid.len();
        let mut belief = Belief::uniform();
        for (motion, images) in frames {
            belief = belief.predicted(motion, habits, road.roads()).0;
            prop_assert!((total(&belief) - 1.0).abs() < 1e-4, "{}", total(&belief));
            let images: Vec<u32> = images.into_iter().filter(|i| (*i as usize) < count).collect();
            belief = belief.updated(&road.looks_like(&images), count, most);
            prop_assert!((total(&belief) - 1.0).abs() < 1e-4, "{}", total(&belief));
            prop_assert!(belief.images.len() <= most);
            for (_, mass) in belief.masses() {
                prop_assert!((0.0..=1.0 + 1e-4).contains(&mass), "{}", mass);
            }
        }
    }
}
