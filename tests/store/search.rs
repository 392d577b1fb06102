//! Search: exact, by a graph, and for hard negatives.

use std::collections::HashSet;
use std::sync::Arc;

use bytes::Bytes;
use futures_util::StreamExt;
use whereabouts_core::{
    CalibrationSettings, Candidate, CoordinateFrame, Descriptor, Digest, Image, Map, MetricPose,
    Pose,
};
use whereabouts_index::SearchMode;
use whereabouts_store::{Store, StoreError};

use crate::support::{Fixture, Random, Tuning, add, descriptor, eventually, image, map};

contract!(
    exact_search_equals_brute_force,
    a_graph_has_high_recall_and_finds_no_removed_image,
    a_search_for_more_images_than_there_are_returns_all,
    equal_images_are_ranked_in_the_order_of_addition,
    the_similarity_is_the_cosine_from_one_to_minus_one,
    a_removed_image_is_not_found,
    a_query_of_another_dimension_is_rejected,
    long_descriptors_are_searched,
    hard_negatives_are_the_most_similar_images_of_other_places,
    slots_are_in_the_order_of_addition,
);

const BOTH: [SearchMode; 2] = [SearchMode::Fast, SearchMode::Exact];

/// Adds images named by their number, some concurrently.
pub async fn add_all(store: &Arc<dyn Store>, map: &Map, descriptors: &[Descriptor]) {
    add_from(0, store, map, descriptors).await;
}

/// Adds images named by their number, beginning with `first`.
pub async fn add_from(first: usize, store: &Arc<dyn Store>, map: &Map, descriptors: &[Descriptor]) {
    let mut pins = Vec::new();
    for bytes in 0..16_u8 {
        let bytes = Bytes::copy_from_slice(&[bytes]);
        pins.push(store.put_blob(Digest::of(&bytes), bytes).await.unwrap());
    }
    let adding = descriptors.iter().zip(first..).map(|(descriptor, number)| async move {
        let image = image(&number.to_string(), &[(number % 16) as u8]);
        store.add_image(map, image, descriptor.clone()).await.unwrap();
    });
    futures_util::stream::iter(adding).buffer_unordered(16).collect::<Vec<()>>().await;
}

pub fn numbers(found: &[Candidate]) -> Vec<usize> {
    found.iter().map(|found| found.image_id.as_str().parse().unwrap()).collect()
}

/// The best matches by brute force.
fn brute_force(descriptors: &[Descriptor], query: &Descriptor, k: usize) -> Vec<(usize, f32)> {
    let all = descriptors.iter().map(|descriptor| descriptor.similarity(query));
    let mut all: Vec<_> = all.enumerate().collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1));
    all.truncate(k);
    all
}

async fn exact_search_equals_brute_force(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 64)).await.unwrap();
    let mut random = Random(1);
    let descriptors: Vec<_> = (0..300).map(|_| random.descriptor(64)).collect();
    add_all(&store, &map, &descriptors).await;
    for mode in BOTH {
        for _ in 0..20 {
            let query = random.descriptor(64);
            let found = store.search(&map, query.clone(), 10, mode).await.unwrap();
            let expected = brute_force(&descriptors, &query, 10);
            assert_eq!(numbers(&found), expected.iter().map(|(n, _)| *n).collect::<Vec<_>>());
            for (place, (found, (_, similarity))) in found.iter().zip(expected).enumerate() {
                assert_eq!(found.rank, place + 1);
                assert!((found.similarity - similarity).abs() < 1e-5);
            }
        }
    }
}

/// Descriptors around a few dozen centres, as those of one building are.
pub fn clustered(count: usize, dim: usize) -> Vec<Descriptor> {
    let mut random = Random(7);
    let centres: Vec<_> = (0..32).map(|_| random.descriptor(dim)).collect();
    (0..count).map(|number| random.near(centres[number % 32].as_slice(), 0.3)).collect()
}

pub async fn graph_is_ready(store: &dyn Store, map: &Map) {
    eventually(async || {
        let state = store.index_state(map).await.unwrap();
        (state.graph && !state.behind).then_some(())
    })
    .await;
}

async fn a_graph_has_high_recall_and_finds_no_removed_image(fixture: &Fixture) {
    let tuning = Tuning { exact_up_to: 100, ..Tuning::default() };
    let store = fixture.open_with(tuning).await;
    let (map, _) = store.put_map(map("m", 48)).await.unwrap();
    let descriptors = clustered(2000, 48);
    add_all(&store, &map, &descriptors).await;
    graph_is_ready(&*store, &map).await;
    let bytes = store.index_bytes().await.unwrap();
    assert!(bytes.len() == 1 && bytes[0].0 == map.name, "{bytes:?}");
    assert!((2000 * 48 * 4..2_000_000).contains(&bytes[0].1), "{bytes:?}");
    let recall = async |store: &dyn Store, removed: &HashSet<usize>| {
        let (mut hits, mut all) = (0, 0);
        for query in descriptors.iter().step_by(20) {
            let fast = store.search(&map, query.clone(), 10, SearchMode::Fast).await.unwrap();
            let exact = store.search(&map, query.clone(), 10, SearchMode::Exact).await.unwrap();
            let (fast, exact) = (numbers(&fast), numbers(&exact));
            assert_eq!((fast.len(), exact.len()), (10, 10));
            assert!(fast.iter().chain(&exact).all(|number| !removed.contains(number)));
            hits += fast.iter().filter(|number| exact.contains(number)).count();
            all += exact.len();
        }
        hits as f32 / all as f32
    };
    let found = recall(&*store, &HashSet::new()).await;
    assert!(found >= 0.95, "{found}");
    for (number, descriptor) in descriptors.iter().enumerate().step_by(20) {
        let found = store.search(&map, descriptor.clone(), 1, SearchMode::Fast).await.unwrap();
        let similarity = found[0].similarity;
        assert!((similarity - 1.0).abs() < 1e-3, "{number}: {similarity}");
    }
    // More than one graph search returns.
    for k in [150, 2000, 2100] {
        let query = descriptors[0].clone();
        let found = store.search(&map, query, k, SearchMode::Fast).await.unwrap();
        assert_eq!(found.len(), k.min(2000));
    }

    // An image that is added later is found at once.
    let late = image("2000", &[0]);
    let query = Random(3).descriptor(48);
    store.add_image(&map, late.clone(), query.clone()).await.unwrap();
    let found = store.search(&map, query, 1, SearchMode::Fast).await.unwrap();
    assert_eq!(found[0].image_id, late.id);
    store.delete_image(&map, &late.id).await.unwrap();

    // Nearly all of three quarters of the clusters.
    let removed: HashSet<usize> = (0..2000).filter(|n| n % 32 < 24 && n % 33 > 0).collect();
    let removing = removed.iter().map(|number| {
        let (store, map) = (&store, &map);
        let id = number.to_string().parse().unwrap();
        async move { assert!(store.delete_image(map, &id).await.unwrap()) }
    });
    futures_util::stream::iter(removing).buffer_unordered(16).collect::<Vec<()>>().await;
    let found = recall(&*store, &removed).await;
    assert!(found >= 0.95, "{found}");
    drop(store);
    let store = fixture.open_with(tuning).await;
    let found = recall(&*store, &removed).await;
    assert!(found >= 0.95, "{found}");
}

async fn a_search_for_more_images_than_there_are_returns_all(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 8)).await.unwrap();
    let mut random = Random(5);
    for mode in BOTH {
        let found = store.search(&map, random.descriptor(8), 5, mode).await.unwrap();
        assert!(found.is_empty());
    }
    let descriptors: Vec<_> = (0..7).map(|_| random.descriptor(8)).collect();
    add_all(&store, &map, &descriptors).await;
    for mode in BOTH {
        for k in [1, 7, 8, 1000] {
            let found = store.search(&map, random.descriptor(8), k, mode).await.unwrap();
            assert_eq!(found.len(), k.min(7));
        }
    }
}

async fn equal_images_are_ranked_in_the_order_of_addition(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 8)).await.unwrap();
    let ids = ["z", "a", "m", "b", "y", "0"];
    for id in ids {
        add(&*store, &map, id, b"same").await;
    }
    add(&*store, &map, "other", b"other").await;
    let query = descriptor(&image("z", b"same"), 8);
    for mode in BOTH {
        let found = store.search(&map, query.clone(), 6, mode).await.unwrap();
        assert_eq!(found.iter().map(|found| found.image_id.as_str()).collect::<Vec<_>>(), ids);
        let first = store.search(&map, query.clone(), 2, mode).await.unwrap();
        assert_eq!(first, found[..2]);
    }
}

async fn the_similarity_is_the_cosine_from_one_to_minus_one(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 4)).await.unwrap();
    let towards = |numbers: [f32; 4]| Descriptor::normalised(numbers.to_vec()).unwrap();
    let descriptors = [[1.0, 2.0, 3.0, 4.0], [-1.0, -2.0, -3.0, -4.0], [4.0, -3.0, 2.0, -1.0]];
    let descriptors = descriptors.map(towards);
    add_all(&store, &map, &descriptors).await;
    for mode in BOTH {
        let found = store.search(&map, descriptors[0].clone(), 3, mode).await.unwrap();
        assert_eq!(numbers(&found), [0, 2, 1]);
        for (found, expected) in found.iter().zip([1.0, 0.0, -1.0]) {
            assert!((-1.0..=1.0).contains(&found.similarity));
            assert!((found.similarity - expected).abs() < 1e-6);
        }
    }
}

async fn a_removed_image_is_not_found(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 8)).await.unwrap();
    let first = add(&*store, &map, "a", b"first").await;
    let stays = add(&*store, &map, "b", b"stays").await;
    assert!(store.delete_image(&map, &first.id).await.unwrap());
    let found = async |store: &dyn Store, like: &Image| -> Vec<_> {
        let query = descriptor(like, 8);
        let found = store.search(&map, query, 9, SearchMode::Fast).await.unwrap();
        found.into_iter().map(|found| (found.image_id, found.similarity > 0.999)).collect()
    };
    assert_eq!(found(&*store, &first).await, [(stays.id.clone(), false)]);
    let second = add(&*store, &map, "a", b"second").await;
    let expected = [(second.id.clone(), true), (stays.id.clone(), false)];
    assert_eq!(found(&*store, &second).await, expected);
    assert!(found(&*store, &first).await.iter().all(|(_, same)| !same));
    drop(store);
    let store = fixture.open().await;
    assert_eq!(found(&*store, &second).await, expected);
    assert!(found(&*store, &first).await.iter().all(|(_, same)| !same));
}

async fn a_query_of_another_dimension_is_rejected(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 8)).await.unwrap();
    add(&*store, &map, "a", b"a").await;
    for mode in BOTH {
        for dim in [7, 9] {
            let query = Random(1).descriptor(dim);
            let refused = store.search(&map, query, 1, mode).await.unwrap_err();
            assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
        }
    }
}

async fn long_descriptors_are_searched(fixture: &Fixture) {
    let store = fixture.open_with(Tuning { exact_up_to: 4, ..Tuning::default() }).await;
    for (name, dim) in [("long", 2048), ("longer", 8192)] {
        let (map, _) = store.put_map(map(name, dim)).await.unwrap();
        let mut random = Random(9);
        let descriptors: Vec<_> = (0..20).map(|_| random.descriptor(dim)).collect();
        add_all(&store, &map, &descriptors).await;
        for (number, descriptor) in descriptors.iter().enumerate() {
            for mode in BOTH {
                let found = store.search(&map, descriptor.clone(), 3, mode).await.unwrap();
                assert_eq!((found.len(), numbers(&found)[0]), (3, number));
            }
        }
        let exported = store.export(&map, None, 100).await.unwrap();
        for exported in exported {
            let number: usize = exported.image.id.as_str().parse().unwrap();
            assert_eq!(exported.descriptor.as_ref(), Some(&descriptors[number]));
        }
    }
}

async fn hard_negatives_are_the_most_similar_images_of_other_places(fixture: &Fixture) {
    let store = fixture.open().await;
    let in_metres = Map { frame: CoordinateFrame::Metric, ..map("m", 16) };
    let (map, _) = store.put_map(in_metres).await.unwrap();
    let mut random = Random(11);
    // A walk of 60 images, 1 m apart, that comes back to its beginning after 40; a few have no pose.
    let mut known = Vec::new();
    for number in 0..60_usize {
        let (z, qx, qy, qz, qw) = (None, None, None, None, None);
        let pose = Pose::Metric(MetricPose { x: (number % 40) as f64, y: 0.0, z, qx, qy, qz, qw });
        let pose = (number % 7 > 0).then_some(pose);
        let image = Image { pose, ..image(&number.to_string(), &[number as u8]) };
        let descriptor = random.descriptor(16);
        let bytes = Bytes::copy_from_slice(&[number as u8]);
        let _pin = store.put_blob(image.digest, bytes).await.unwrap();
        store.add_image(&map, image.clone(), descriptor.clone()).await.unwrap();
        known.push((image, descriptor));
    }
    for gone in [5, 30] {
        store.delete_image(&map, &known[gone].0.id).await.unwrap();
    }
    let known: Vec<_> = known
        .into_iter()
        .enumerate()
        .filter(|(n, _)| ![5, 30].contains(n))
        .map(|(_, k)| k)
        .collect();
    let settings = CalibrationSettings {
        images: 10,
        place_images: 3,
        place_m: 4.5,
        ..CalibrationSettings::default()
    };
    let found = store.hard_negatives(&map, settings, 5).await.unwrap();
    let asked: Vec<_> = (0..58).step_by(6).collect();
    let ids = |found: &[Candidate]| -> Vec<_> {
        found.iter().map(|found| found.image_id.clone()).collect()
    };
    assert_eq!(found.len(), asked.len());
    for (found, at) in found.iter().zip(asked) {
        let (image, descriptor) = &known[at];
        let mut others: Vec<_> = known
            .iter()
            .enumerate()
            .filter(|(position, (other, _))| {
                let metres = image.pose.zip(other.pose).and_then(|(a, b)| a.distance_m(&b));
                position.abs_diff(at) > 3 && metres.is_none_or(|metres| metres > 4.5)
            })
            .map(|(_, (other, numbers))| (other.id.clone(), numbers.similarity(descriptor)))
            .collect();
        others.sort_by(|a, b| b.1.total_cmp(&a.1));
        let others: Vec<_> = others.into_iter().take(5).map(|(id, _)| id).collect();
        assert_eq!((&found.image_id, ids(&found.others)), (&image.id, others));
        assert!(found.others.iter().map(|other| other.rank).eq(1..=5));
    }
    // Fewer, if there are fewer.
    let wide = CalibrationSettings { place_m: 38.0, ..settings };
    let found = store.hard_negatives(&map, wide, 50).await.unwrap();
    assert!(found.iter().any(|found| (1..50).contains(&found.others.len())));
}

async fn slots_are_in_the_order_of_addition(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 4)).await.unwrap();
    let mut random = Random(5);
    for name in ["z", "a", "m"] {
        let bytes = Bytes::copy_from_slice(name.as_bytes());
        let _pin = store.put_blob(Digest::of(&bytes), bytes).await.unwrap();
        store.add_image(&map, image(name, name.as_bytes()), random.descriptor(4)).await.unwrap();
    }
    let ids = ["m", "nobody", "z", "a"].map(|id| id.parse().unwrap());
    let slots = store.slots(&map, &ids).await.unwrap();
    let [m, nobody, z, a] = slots.as_slice() else { panic!("{slots:?}") };
    assert!(nobody.is_none() && z.is_some() && z < a && a < m, "{slots:?}");
    assert!(store.slots(&map, &[]).await.unwrap().is_empty());
}
