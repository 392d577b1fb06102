use super::*;

fn paths(positions: Vec<[f64; 2]>) -> (Grid, Paths) {
    let grid = Grid::new(positions);
    let paths = Paths::new(&grid, 0.1);
    (grid, paths)
}

/// The images that a robot passes within some metres, in order, and where it may leave the path.
fn passed(paths: &(Grid, Paths), image: u32, ahead: bool, reach: f64) -> (Vec<u32>, Vec<u32>) {
    let (mut way, mut branches) = (Vec::new(), Vec::new());
    let start = Stop { image, ahead, metres: 0.0 };
    paths.1.walk(&paths.0, start, reach, (&mut way, &mut branches));
    let ends = branches.iter().map(|branch: &Vec<Stop>| branch.last().unwrap().image);
    (way.iter().map(|stop| stop.image).collect(), ends.collect())
}

#[test]
fn a_road_leads_to_the_next_image_in_either_direction() {
    let road = paths((0..30).map(|n| [2.0 * f64::from(n), 0.0]).collect());
    assert_eq!(road.1.spacing(), 2.0);
    assert_eq!(passed(&road, 5, true, 3.0), (vec![5, 6, 7], vec![]));
    assert_eq!(passed(&road, 5, false, 3.0), (vec![5, 4, 3], vec![]));
    assert_eq!(passed(&road, 28, true, 100.0), (vec![28, 29], vec![]));
}

#[test]
fn a_second_drive_through_a_street_is_linked_with_the_first() {
    let there = (0..30).map(|n| [2.0 * f64::from(n), 0.0]);
    let again = (0..30).map(|n| [2.0 * f64::from(n) + 0.3, 1.0]);
    let street = paths(there.chain(again).collect());
    let (way, ends) = passed(&street, 5, true, 3.0);
    assert_eq!(way, [5, 6, 7]);
    assert!(ends.contains(&36), "{ends:?}");
}

#[test]
fn a_drive_the_other_way_is_linked_with_its_direction_reversed() {
    let there = (0..30).map(|n| [2.0 * f64::from(n), 0.0]);
    let back = (0..30).rev().map(|n| [2.0 * f64::from(n), 1.0]);
    let street = paths(there.chain(back).collect());
    // Image 59 − n is next to image n.
    let (_, ends) = passed(&street, 5, true, 1.0);
    assert!(ends.contains(&53) && !ends.contains(&55), "{ends:?}");
}

#[test]
fn several_views_of_each_spot_are_one_place_on_the_way() {
    let street = paths((0..120).map(|n| [10.0 * f64::from(n / 6), 0.0]).collect());
    assert_eq!(street.1.spacing(), 10.0);
    let (mut way, _) = passed(&street, 14, true, 5.0);
    assert_eq!(way.len(), 7, "{way:?}");
    way.sort_unstable();
    assert_eq!(way, (12..19).collect::<Vec<_>>());
}

#[test]
fn images_in_no_order_become_a_path_of_neighbours() {
    let place = |n: u32| n * 17 % 40;
    let road = paths((0..40).map(|n| [3.0 * f64::from(place(n)), 0.0]).collect());
    let (way, _) = passed(&road, 0, true, 1000.0);
    let (back, _) = passed(&road, 0, false, 1000.0);
    let places: Vec<u32> = way.into_iter().chain(back).map(place).collect();
    assert_eq!(places.iter().max(), Some(&39));
    assert_eq!(road.1.spacing(), 3.0);
}

#[test]
fn maps_without_a_way_have_no_neighbours_and_do_not_fail() {
    for positions in [vec![], vec![[0.0, 0.0]], vec![[1.0, 1.0]; 50]] {
        let count = positions.len() as u32;
        let spot = paths(positions);
        assert!(spot.1.spacing() > 0.0);
        for image in 0..count {
            passed(&spot, image, true, 10.0);
        }
    }
}
