use super::*;
use whereabouts_core::{GeographicPose, MetricPose};

fn metric(x: f64) -> Pose {
    Pose::Metric(MetricPose { x, y: 0.0, z: None, qx: None, qy: None, qz: None, qw: None })
}

fn located(slot: usize, id: &str, pose: Pose) -> LocatedImage {
    LocatedImage { slot, id: id.parse().unwrap(), pose }
}

#[test]
fn images_that_were_added_in_no_order_are_numbered_by_their_ids_if_these_are_in_order() {
    // Added by several senders: 7, 0, 5, …
    let images = (0..12).map(|slot| slot * 7 % 12).enumerate();
    let images =
        images.map(|(slot, place)| located(slot, &format!("frame-{place}"), metric(place as f64)));
    let ground = Ground::new(images.collect());
    let ids: Vec<&str> = (0..12).map(|number| ground.id(number).as_str()).collect();
    assert_eq!(ids[..3], ["frame-0", "frame-1", "frame-2"]);
    assert_eq!(ids[9..], ["frame-9", "frame-10", "frame-11"]);
    assert_eq!(ground.slots(&[7]), [1]);
    assert_eq!(ground.number(&"frame-7".parse().unwrap()), Some(7));
}

#[test]
fn images_whose_ids_say_nothing_are_numbered_in_the_order_of_addition() {
    let ids = ["z", "b", "m", "a", "q"];
    let images = ids.iter().enumerate().map(|(slot, id)| located(slot, id, metric(slot as f64)));
    let ground = Ground::new(images.collect());
    assert_eq!((0..5).map(|number| ground.id(number).as_str()).collect::<Vec<_>>(), ids);
}

#[test]
fn geographic_positions_are_in_metres_also_across_the_date_line() {
    let at = |lat, lon| Pose::Geographic(GeographicPose { lat, lon, alt: None, heading: None });
    let poses = [at(-17.0, 179.9995), at(-17.0, -179.9995), at(-17.001, 179.9995)];
    let images = poses.iter().enumerate();
    let images = images.map(|(slot, pose)| located(slot, &slot.to_string(), *pose)).collect();
    let ground = Ground::new(images);
    for other in [1, 2] {
        let exact = poses[0].distance_m(&poses[other]).unwrap();
        let number = |place: usize| ground.number(&place.to_string().parse().unwrap()).unwrap();
        let found = ground.grid.distance(number(0), number(other));
        assert!((found - exact).abs() < 0.1, "{found} {exact}");
    }
}

#[test]
fn an_image_like_its_neighbours_changes_less_than_one_unlike_them() {
    let images = (0..9).map(|slot| located(slot, &slot.to_string(), metric(slot as f64)));
    let mut ground = Ground::new(images.collect());
    let view = |place: u32| {
        // Three places in a tunnel.
        let mut numbers = vec![0.1; 12];
        numbers[if (3..6).contains(&place) { 11 } else { place as usize }] = 1.0;
        Descriptor::normalised(numbers).unwrap()
    };
    let known: Known = ground.sample_with_neighbours().into_iter().map(|n| (n, view(n))).collect();
    ground.learn_common(&known);
    let changes = ground.changes(&(0..9).collect::<Vec<_>>());
    assert!(changes[4] < 0.01, "{changes:?}");
    assert!((0.9..1.1).contains(&changes[1]), "{changes:?}");
    assert!(ground.unknown(&[4]).is_empty());
}
