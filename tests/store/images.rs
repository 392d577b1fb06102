//! Images: added, listed, removed, and exported with their descriptors.

use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::join_all;
use uuid::Uuid;
use whereabouts_core::ExportedImage;
use whereabouts_core::{
    CoordinateFrame, GeographicPose, Image, ImageId, Map, MetricPose, Pose, Recording, dot,
};
use whereabouts_index::SearchMode;
use whereabouts_store::{Added, Store, StoreError};

use crate::support::{Fixture, add, descriptor, fill, image, map, next, odd_texts};

contract!(
    the_same_bytes_again_change_nothing_and_other_bytes_are_a_conflict,
    images_are_paged_by_the_bytes_of_their_ids,
    images_are_looked_up_by_id_in_the_order_asked_for,
    all_fields_of_an_image_are_kept,
    poses_are_returned_in_the_order_of_addition,
    descriptors_and_similarities_are_those_of_the_slots_in_their_order,
    the_count_and_the_changes_follow_every_addition_and_removal,
    of_concurrent_additions_of_an_image_one_creates_it,
    of_concurrent_additions_of_different_bytes_under_one_id_one_succeeds,
    concurrent_additions_and_removals_of_the_same_bytes_succeed,
    images_of_maps_do_not_mix,
    images_are_exported_in_pages_with_bit_identical_descriptors,
    images_of_a_recording_are_in_its_order_also_after_a_restart,
);

async fn the_same_bytes_again_change_nothing_and_other_bytes_are_a_conflict(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let first = add(&*store, &map, "a", b"a").await;
    let again = Image { width: 2, tags: vec!["new".into()], ..image("a", b"a") };
    let added = store.add_image(&map, again.clone(), descriptor(&again, 3)).await.unwrap();
    assert_eq!(added, Added::Present(first.clone()));
    let other = image("a", b"other");
    let refused = store.add_image(&map, other.clone(), descriptor(&other, 3)).await.unwrap_err();
    assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    assert_eq!(store.images(&map, None, 9).await.unwrap(), [first]);
    // The same bytes may have several ids.
    add(&*store, &map, "b", b"a").await;
    // An id that was removed is free.
    assert!(store.delete_image(&map, &other.id).await.unwrap());
    assert!(!store.delete_image(&map, &other.id).await.unwrap());
    add(&*store, &map, "a", b"other").await;
}

async fn images_are_paged_by_the_bytes_of_their_ids(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    assert!(store.images(&map, None, 9).await.unwrap().is_empty());
    let longest = "東".repeat(66) + "!!";
    let mut ids = vec![
        "b",
        "B",
        "a",
        "Z",
        "é",
        "e\u{301}",
        "ß",
        "東京-01",
        "😀",
        "a/b",
        "a b",
        "ab",
        "a-b",
        "%",
        "_",
        "\\",
        "\\u0000",
        "\"q\"",
        "'; DROP TABLE images; --",
        "@0543256.12@4178901.33@.jpg",
        "!",
        "~",
        "\u{ffff}",
        &longest,
    ];
    for id in &ids {
        add(&*store, &map, id, id.as_bytes()).await;
    }
    ids.sort();
    for limit in [1, 5, 100] {
        let (mut walked, mut after) = (Vec::new(), None);
        loop {
            let page = store.images(&map, after.as_ref(), limit).await.unwrap();
            assert!(page.len() <= limit);
            let Some(last) = page.last() else { break };
            after = Some(last.id.clone());
            walked.extend(page);
        }
        assert_eq!(walked.iter().map(|image| image.id.as_str()).collect::<Vec<_>>(), ids);
    }
    // A page may begin after an id that is not there.
    let after: ImageId = "a.".parse().unwrap();
    assert_eq!(store.images(&map, Some(&after), 1).await.unwrap()[0].id.as_str(), "a/b");
    for id in ids {
        let id: ImageId = id.parse().unwrap();
        assert_eq!(store.image(&map, &id).await.unwrap().unwrap().id, id);
        assert!(store.delete_image(&map, &id).await.unwrap());
        assert_eq!(store.image(&map, &id).await.unwrap(), None);
    }
}

async fn images_are_looked_up_by_id_in_the_order_asked_for(fixture: &Fixture) {
    let store = fixture.open().await;
    let (one, _) = store.put_map(map("one", 3)).await.unwrap();
    let (two, _) = store.put_map(map("two", 3)).await.unwrap();
    let b = Some(add(&*store, &one, "b", b"b").await);
    let a = Some(add(&*store, &one, "a", b"a").await);
    let tokyo = Some(add(&*store, &one, "東京-01", b"t").await);
    let quoted = Some(add(&*store, &one, "'; DROP TABLE images; --", b"q").await);
    add(&*store, &two, "only in two", b"2").await;
    let ids = |ids: &[&str]| -> Vec<ImageId> { ids.iter().map(|id| id.parse().unwrap()).collect() };
    let wanted =
        ids(&["東京-01", "never added", "a", "only in two", "'; DROP TABLE images; --", "b", "a"]);
    let expected = [tokyo, None, a.clone(), None, quoted, b.clone(), a];
    assert_eq!(store.images_by_id(&one, &wanted).await.unwrap(), expected);
    assert_eq!(store.images_by_id(&one, &[]).await.unwrap(), []);
    assert!(store.delete_image(&one, &wanted[2]).await.unwrap());
    assert_eq!(store.images_by_id(&one, &ids(&["a", "b"])).await.unwrap(), [None, b]);
    assert_eq!(store.images_by_id(&two, &ids(&["b"])).await.unwrap(), [None]);
}

async fn all_fields_of_an_image_are_kept(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let pose = Pose::Geographic(GeographicPose {
        lat: 0.1 + 0.2,
        lon: -179.999_999_999_999_97,
        alt: Some(5e-324),
        heading: None,
    });
    let image = Image {
        pose: Some(pose),
        captured_at: Some("1969-07-20T20:17:40.123456789Z".parse().unwrap()),
        tags: odd_texts(),
        width: u32::MAX,
        ..image("a", b"a")
    };
    let _pin = store.put_blob(image.digest, Bytes::from_static(b"a")).await.unwrap();
    let query = descriptor(&image, 3);
    store.add_image(&map, image.clone(), query.clone()).await.unwrap();
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.image(&map, &image.id).await.unwrap(), Some(image.clone()));
    assert_eq!(store.images(&map, None, 9).await.unwrap(), std::slice::from_ref(&image));
    let located = store.positions(&map).await.unwrap();
    assert_eq!((&located[0].id, located[0].pose, located.len()), (&image.id, pose, 1));
    let found = store.search(&map, query, 1, SearchMode::Exact).await.unwrap();
    assert_eq!((&found[0].image_id, found[0].pose), (&image.id, Some(pose)));
    let exported = store.export(&map, None, 1).await.unwrap();
    assert_eq!(exported[0].image, image);
}

async fn descriptors_and_similarities_are_those_of_the_slots_in_their_order(fixture: &Fixture) {
    let store = fixture.open().await;
    let in_metres = Map { frame: CoordinateFrame::Metric, ..map("m", 3) };
    let (map, _) = store.put_map(in_metres).await.unwrap();
    let mut expected = Vec::new();
    for (number, id) in ["z", "a", "q"].into_iter().enumerate() {
        let (z, qx, qy, qz, qw) = (None, None, None, None, None);
        let pose = Pose::Metric(MetricPose { x: number as f64, y: 0.0, z, qx, qy, qz, qw });
        let image = Image { pose: Some(pose), ..image(id, id.as_bytes()) };
        let _pin =
            store.put_blob(image.digest, Bytes::copy_from_slice(id.as_bytes())).await.unwrap();
        store.add_image(&map, image.clone(), descriptor(&image, 3)).await.unwrap();
        expected.push(descriptor(&image, 3));
    }
    let slots: Vec<usize> =
        store.positions(&map).await.unwrap().into_iter().map(|located| located.slot).collect();
    assert!(store.delete_image(&map, &"a".parse().unwrap()).await.unwrap());
    let asked = vec![slots[2], slots[1], slots[0], 999_999, slots[2]];
    let found = store.descriptors(&map, asked.clone()).await.unwrap();
    let [first, last] = [&expected[0], &expected[2]].map(|descriptor| Some(descriptor.clone()));
    assert_eq!(found, [last.clone(), None, first, None, last]);
    let vector = vec![2.0, -1.0, 0.5];
    let similarities = store.similarities(&map, vector.clone(), asked).await.unwrap();
    assert!(store.similarities(&map, Vec::new(), Vec::new()).await.unwrap().is_empty());
    for (similarity, descriptor) in similarities.iter().zip(&found) {
        let exact = descriptor.as_ref().map(|descriptor| dot(&vector, descriptor.as_slice()));
        assert_eq!(similarity.is_some(), exact.is_some());
        let off = similarity.unwrap_or_default() - exact.unwrap_or_default();
        assert!(off.abs() < 1e-5, "{similarity:?} {exact:?}");
    }
    let reindexed = Map { revision: 7, ..map.clone() };
    let refused = store.similarities(&reindexed, vector, slots).await.unwrap_err();
    assert!(matches!(refused, StoreError::Superseded(_)), "{refused}");
}

async fn poses_are_returned_in_the_order_of_addition(fixture: &Fixture) {
    let store = fixture.open().await;
    let in_metres = Map { frame: CoordinateFrame::Metric, ..map("m", 3) };
    let (map, _) = store.put_map(in_metres).await.unwrap();
    assert!(store.positions(&map).await.unwrap().is_empty());
    let at = |x: f64| {
        let (z, qx, qy, qz, qw) = (None, None, None, None, None);
        Pose::Metric(MetricPose { x, y: -0.0, z, qx, qy, qz, qw })
    };
    let add_at = async |id: &str, pose: Option<Pose>| {
        let image = Image { pose, ..image(id, id.as_bytes()) };
        let bytes = Bytes::copy_from_slice(id.as_bytes());
        let _pin = store.put_blob(image.digest, bytes).await.unwrap();
        store.add_image(&map, image.clone(), descriptor(&image, 3)).await.unwrap();
    };
    for (id, pose) in [("z", Some(1.5)), ("m", None), ("a", Some(2.5)), ("q", Some(3.5))] {
        add_at(id, pose.map(at)).await;
    }
    let positions = async || -> Vec<(String, Pose)> {
        let positions = store.positions(&map).await.unwrap();
        positions.into_iter().map(|located| (located.id.into(), located.pose)).collect()
    };
    let expected = |of: &[(&str, f64)]| -> Vec<(String, Pose)> {
        of.iter().map(|(id, x)| ((*id).to_owned(), at(*x))).collect()
    };
    assert_eq!(positions().await, expected(&[("z", 1.5), ("a", 2.5), ("q", 3.5)]));
    store.delete_image(&map, &"z".parse().unwrap()).await.unwrap();
    add_at("z", Some(at(4.5))).await;
    assert_eq!(positions().await, expected(&[("a", 2.5), ("q", 3.5), ("z", 4.5)]));
}

async fn the_count_and_the_changes_follow_every_addition_and_removal(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let state = async || {
        let state = store.index_state(&map).await.unwrap();
        assert!(!state.graph && !state.behind);
        (state.images, state.changes)
    };
    assert_eq!(state().await, (0, 0));
    for id in ["a", "b", "c"] {
        add(&*store, &map, id, id.as_bytes()).await;
    }
    assert_eq!(state().await, (3, 3));
    let again = image("a", b"a");
    store.add_image(&map, again.clone(), descriptor(&again, 3)).await.unwrap();
    assert_eq!(state().await, (3, 3));
    assert!(store.delete_image(&map, &again.id).await.unwrap());
    assert!(!store.delete_image(&map, &again.id).await.unwrap());
    assert_eq!(state().await, (2, 4));
    drop(store);
    assert_eq!(fixture.open().await.index_state(&map).await.unwrap().images, 2);
}

/// Adds images concurrently; returns how many were created, and how many were rejected.
async fn add_at_once(store: &Arc<dyn Store>, map: &Map, images: Vec<Image>) -> (usize, usize) {
    let adding = images.into_iter().map(|image| {
        let (store, map) = (Arc::clone(store), map.clone());
        tokio::spawn(async move {
            let bytes = Bytes::copy_from_slice(b"whatever");
            let _pin = store.put_blob(image.digest, bytes).await.unwrap();
            let descriptor = descriptor(&image, map.dim);
            store.add_image(&map, image, descriptor).await
        })
    });
    let added = join_all(adding).await.into_iter().map(Result::unwrap);
    added.fold((0, 0), |(created, refused), added| match added {
        Ok(Added::Created(_)) => (created + 1, refused),
        Ok(Added::Present(_)) => (created, refused),
        Err(StoreError::Conflict(_)) => (created, refused + 1),
        Err(error) => panic!("{error}"),
    })
}

async fn of_concurrent_additions_of_an_image_one_creates_it(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    for round in 1..=5 {
        let id = format!("image {round}");
        let images = (0..8).map(|_| image(&id, b"whatever")).collect();
        assert_eq!(add_at_once(&store, &map, images).await, (1, 0));
        assert_eq!(store.index_state(&map).await.unwrap().images, round);
    }
}

async fn of_concurrent_additions_of_different_bytes_under_one_id_one_succeeds(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let images = (0..8_u8).map(|number| image("a", &[number])).collect();
    assert_eq!(add_at_once(&store, &map, images).await, (1, 7));
    assert_eq!(store.images(&map, None, 9).await.unwrap().len(), 1);
}

async fn concurrent_additions_and_removals_of_the_same_bytes_succeed(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    add(&*store, &map, "stays", b"bytes").await;
    let working = (0..8).map(|worker| {
        let (store, map) = (Arc::clone(&store), map.clone());
        tokio::spawn(async move {
            for round in 0..25 {
                let image = image(&format!("{worker}/{round}"), b"bytes");
                let descriptor = descriptor(&image, 3);
                store.add_image(&map, image.clone(), descriptor).await.unwrap();
                if round % 5 > 0 {
                    assert!(store.delete_image(&map, &image.id).await.unwrap());
                }
            }
        })
    });
    join_all(working).await.into_iter().for_each(Result::unwrap);
    let state = store.index_state(&map).await.unwrap();
    assert_eq!((state.images, state.changes), (1 + 8 * 5, 1 + 8 * (25 + 20)));
    assert_eq!(store.images(&map, None, 1000).await.unwrap().len(), state.images);
}

async fn images_of_maps_do_not_mix(fixture: &Fixture) {
    let store = fixture.open().await;
    let (one, _) = store.put_map(map("one", 3)).await.unwrap();
    let (two, _) = store.put_map(map("two", 3)).await.unwrap();
    let in_one = add(&*store, &one, "a", b"1").await;
    let in_two = add(&*store, &two, "a", b"2").await;
    assert_eq!(store.image(&one, &in_one.id).await.unwrap(), Some(in_one.clone()));
    assert_eq!(store.images(&two, None, 9).await.unwrap(), std::slice::from_ref(&in_two));
    let query = descriptor(&in_one, 3);
    assert_eq!(store.search(&two, query, 9, SearchMode::Fast).await.unwrap().len(), 1);
    assert!(store.delete_image(&one, &in_one.id).await.unwrap());
    assert_eq!(store.image(&two, &in_two.id).await.unwrap(), Some(in_two));
}

async fn images_of_a_recording_are_in_its_order_also_after_a_restart(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 4)).await.unwrap();
    let drive = Uuid::now_v7();
    let places = [("first", None), ("c", Some(2)), ("a", Some(0)), ("late", None), ("b", Some(1))];
    for (id, number) in places {
        let pose =
            Some(Pose::Geographic(GeographicPose { lat: 1.0, lon: 2.0, alt: None, heading: None }));
        let image = Image { pose, ..image(id, id.as_bytes()) };
        let _pin = store.put_blob(image.digest, Bytes::copy_from_slice(id.as_bytes())).await;
        let recording = number.map(|number| Recording { id: drive, number });
        let descriptor = descriptor(&image, 4);
        store.add_recorded(&map, image, descriptor, recording).await.unwrap();
    }
    let ids = async |store: &dyn Store| -> Vec<String> {
        let images = store.positions(&map).await.unwrap();
        images.into_iter().map(|image| image.id.to_string()).collect()
    };
    let expected = ["first", "a", "b", "c", "late"];
    assert_eq!(ids(&*store).await, expected);
    // A correction of an image keeps its place.
    let current = store.image(&map, &"a".parse().unwrap()).await.unwrap().unwrap();
    let next = Image { tags: vec!["new".into()], ..current.clone() };
    assert!(store.replace_image(&map, &current, next).await.unwrap());
    drop(store);
    let store = fixture.open().await;
    assert_eq!(ids(&*store).await, expected);
    let mut exported = store.export(&map, None, 9).await.unwrap();
    Recording::sort(&mut exported, |image| (image.position.unwrap() as usize, image.recording));
    assert_eq!(exported.iter().map(|e| e.image.id.as_str()).collect::<Vec<_>>(), expected);
}

async fn images_are_exported_in_pages_with_bit_identical_descriptors(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 100)).await.unwrap();
    let mut images = Vec::new();
    for id in ["c", "a", "é", "b"] {
        images.push(add(&*store, &map, id, id.as_bytes()).await);
    }
    images.sort_by(|a, b| a.id.cmp(&b.id));
    let expected: Vec<_> = images
        .into_iter()
        .map(|image| ExportedImage {
            descriptor: Some(descriptor(&image, 100)),
            image,
            position: None,
            recording: None,
            texts: None,
        })
        .collect();
    let exported = async |after, limit| -> Vec<ExportedImage> {
        let images = store.export(&map, after, limit).await.unwrap();
        images.into_iter().map(|image| ExportedImage { position: None, ..image }).collect()
    };
    assert_eq!(exported(None, 9).await, expected);
    assert_eq!(exported(None, 3).await, expected[..3]);
    assert_eq!(exported(Some(&expected[2].image.id), 3).await, expected[3..]);
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    assert!(draft.replace().await.unwrap());
    let late = store.export(&map, None, 9).await.unwrap_err();
    assert!(matches!(late, StoreError::Superseded(_)), "{late}");
    let exported = store.export(&next(&map, 5), None, 9).await.unwrap();
    assert_eq!(exported.len(), 4);
    let fits =
        |exported: &ExportedImage| exported.descriptor == Some(descriptor(&exported.image, 5));
    assert!(exported.iter().all(fits));
}
