//! Maps with many equal or nearly equal images, among which no other may be lost.

use whereabouts_index::SearchMode;

use crate::search::{add_all, add_from, clustered, graph_is_ready, numbers};
use crate::support::{Fixture, Random, Tuning, map};

contract!(identical_images_crowd_no_other_image_out, a_robot_that_stands_still_hides_no_place);

/// A robot that stood still, or tiles without imagery: one descriptor very often, and others around few centres.
async fn identical_images_crowd_no_other_image_out(fixture: &Fixture) {
    const TWINS: usize = 600;
    let store = fixture.open_with(Tuning { exact_up_to: 100, ..Tuning::default() }).await;
    let (map, _) = store.put_map(map("m", 48)).await.unwrap();
    let others = clustered(900, 48);
    let mut descriptors = vec![others[0].clone(); TWINS];
    descriptors.extend(others);
    let lost = async |numbers: Vec<usize>| {
        let mut lost = 0;
        for number in numbers {
            let query = descriptors[number].clone();
            let found = store.search(&map, query, 10, SearchMode::Fast).await.unwrap();
            assert_eq!(found.len(), 10, "{number}");
            lost += usize::from((found[0].similarity - 1.0).abs() > 1e-3);
        }
        lost
    };
    // Some are there before the graph is built, and some are added to it.
    add_all(&store, &map, &descriptors[..TWINS / 2]).await;
    graph_is_ready(&*store, &map).await;
    add_from(TWINS / 2, &store, &map, &descriptors[TWINS / 2..]).await;
    graph_is_ready(&*store, &map).await;
    assert_eq!(lost((0..descriptors.len()).collect()).await, 0);
    // All twins but the last one go, each while the others are found.
    for number in 0..TWINS - 1 {
        let id = number.to_string().parse().unwrap();
        assert!(store.delete_image(&map, &id).await.unwrap());
        if number % 100 == 0 {
            assert_eq!(lost(vec![number + 1, TWINS - 1]).await, 0, "{number}");
        }
    }
    assert_eq!(lost(vec![TWINS - 1]).await, 0);
}

/// What a robot sees that stands still at each of several places: frames that are nearly equal. A search in PostgreSQL may
/// find others of the same place than the nearest.
async fn a_robot_that_stands_still_hides_no_place(fixture: &Fixture) {
    const PLACES: usize = 25;
    const FRAMES: usize = 120;
    let store = fixture.open_with(Tuning { exact_up_to: 100, ..Tuning::default() }).await;
    let (map, _) = store.put_map(map("m", 48)).await.unwrap();
    let mut random = Random(11);
    let mut descriptors = Vec::new();
    for _ in 0..PLACES {
        let place = random.descriptor(48);
        descriptors.extend((0..FRAMES).map(|_| random.near(place.as_slice(), 0.02)));
    }
    add_all(&store, &map, &descriptors).await;
    graph_is_ready(&*store, &map).await;
    for (number, descriptor) in descriptors.iter().enumerate() {
        let found = store.search(&map, descriptor.clone(), 10, SearchMode::Fast).await.unwrap();
        assert!(found[0].similarity > 0.995, "{number}: {found:?}");
        let here = |found: &usize| found / FRAMES == number / FRAMES;
        assert!(numbers(&found).iter().all(here), "{number}: {found:?}");
    }
}
