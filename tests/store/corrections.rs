//! Corrections: poses, times and tags of stored images, and the coordinate frame of a map without poses.

use std::sync::Arc;

use bytes::Bytes;
use futures_util::future::join_all;
use whereabouts_core::{
    CalibrationSettings, CoordinateFrame, Descriptor, GeographicPose, Image, Map, MetricPose, Pose,
    Scene,
};
use whereabouts_index::SearchMode;
use whereabouts_store::{LocatedImage, Store, StoreError};

use crate::support::{Fixture, add, descriptor, fill, image, is_kept, map, next, odd_texts};

contract!(
    a_corrected_image_is_found_everywhere_and_after_a_restart,
    a_correction_changes_neither_descriptor_nor_bytes_nor_order,
    a_correction_of_another_record_than_the_stored_one_changes_nothing,
    of_concurrent_corrections_each_is_made_once,
    only_changed_poses_count_as_changes,
    a_pose_corrected_during_a_reindex_is_in_both_revisions,
    hard_negatives_follow_corrected_poses,
    a_map_without_poses_can_change_its_coordinate_frame,
    a_pose_of_the_former_coordinate_frame_is_refused,
    a_coordinate_frame_changed_during_a_reindex_stays_changed,
);

fn at(lat: f64) -> Option<Pose> {
    Some(Pose::Geographic(GeographicPose { lat, lon: 2.0, alt: None, heading: None }))
}

fn metric(x: f64) -> Option<Pose> {
    let (y, z, qx, qy, qz, qw) = (0.0, None, None, None, None, None);
    Some(Pose::Metric(MetricPose { x, y, z, qx, qy, qz, qw }))
}

/// Corrects an image whose record is `current`.
async fn correct(store: &dyn Store, map: &Map, current: &Image, next: Image) -> Image {
    assert!(store.replace_image(map, current, next.clone()).await.unwrap());
    next
}

async fn a_corrected_image_is_found_everywhere_and_after_a_restart(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let a = add(&*store, &map, "a", b"a").await;
    add(&*store, &map, "b", b"b").await;
    let captured_at = Some("2026-05-01T12:00:00.5Z".parse().unwrap());
    let wrong = Image { pose: at(-1.5), captured_at, tags: odd_texts(), ..a.clone() };
    correct(&*store, &map, &a, wrong.clone()).await;
    let right = Image { pose: at(1.5), tags: vec!["north".into()], ..wrong.clone() };
    correct(&*store, &map, &wrong, right.clone()).await;
    let is_found = async |store: &dyn Store, pose: Option<Pose>, image: &Image| {
        assert_eq!(store.image(&map, &a.id).await.unwrap().as_ref(), Some(image));
        assert_eq!(store.images(&map, None, 1).await.unwrap(), std::slice::from_ref(image));
        let by_id = store.images_by_id(&map, std::slice::from_ref(&a.id)).await.unwrap();
        assert_eq!(by_id, [Some(image.clone())]);
        let positions: Vec<_> = pose.map(|pose| (a.id.clone(), pose)).into_iter().collect();
        let located = store.positions(&map).await.unwrap().into_iter();
        let located: Vec<_> = located.map(|located| (located.id, located.pose)).collect();
        assert_eq!(located, positions);
        let query = descriptor(&a, 3);
        let found = store.search(&map, query, 1, SearchMode::Fast).await.unwrap();
        assert_eq!((&found[0].image_id, found[0].pose), (&a.id, pose));
        assert_eq!(store.export(&map, None, 1).await.unwrap()[0].image, *image);
    };
    is_found(&*store, at(1.5), &right).await;
    drop(store);
    let store = fixture.open().await;
    is_found(&*store, at(1.5), &right).await;
    let nowhere = Image { pose: None, captured_at: None, tags: Vec::new(), ..right.clone() };
    correct(&*store, &map, &right, nowhere.clone()).await;
    is_found(&*store, None, &nowhere).await;
    drop(store);
    is_found(&*fixture.open().await, None, &a).await;
}

async fn a_correction_changes_neither_descriptor_nor_bytes_nor_order(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 16)).await.unwrap();
    for (id, lat) in [("b", 1.0), ("a", 2.0)] {
        let image = add(&*store, &map, id, id.as_bytes()).await;
        correct(&*store, &map, &image, Image { pose: at(lat), ..image.clone() }).await;
    }
    let before = store.export(&map, None, 9).await.unwrap();
    let a = before[0].image.clone();
    correct(&*store, &map, &a, Image { pose: at(3.0), ..a.clone() }).await;
    let after = store.export(&map, None, 9).await.unwrap();
    let descriptors: Vec<_> = before.into_iter().map(|exported| exported.descriptor).collect();
    let kept: Vec<_> = after.iter().map(|exported| exported.descriptor.clone()).collect();
    assert_eq!(kept, descriptors);
    assert!(is_kept(&*store, b"a").await);
    let ids = |located: Vec<LocatedImage>| -> Vec<String> {
        located.into_iter().map(|located| located.id.into()).collect()
    };
    assert_eq!(ids(store.positions(&map).await.unwrap()), ["b", "a"]);
    // Its bytes go with it.
    assert!(store.delete_image(&map, &a.id).await.unwrap());
    assert!(!is_kept(&*store, b"a").await);
}

async fn a_correction_of_another_record_than_the_stored_one_changes_nothing(fixture: &Fixture) {
    let store = fixture.open().await;
    let (known, _) = store.put_map(map("m", 3)).await.unwrap();
    let first = add(&*store, &known, "a", b"a").await;
    let second = Image { pose: at(1.0), ..first.clone() };
    correct(&*store, &known, &first, second.clone()).await;
    let late = Image { pose: at(2.0), ..first.clone() };
    assert!(!store.replace_image(&known, &first, late.clone()).await.unwrap());
    assert_eq!(store.image(&known, &first.id).await.unwrap(), Some(second.clone()));
    let missing = image("b", b"b");
    let moved = Image { pose: at(1.0), ..missing.clone() };
    assert!(!store.replace_image(&known, &missing, moved).await.unwrap());
    assert!(store.delete_image(&known, &first.id).await.unwrap());
    assert!(!store.replace_image(&known, &second, late.clone()).await.unwrap());
    assert_eq!(store.image(&known, &first.id).await.unwrap(), None);
    assert!(store.positions(&known).await.unwrap().is_empty());
    assert!(store.delete_map(&known.name).await.unwrap());
    store.put_map(map("m", 3)).await.unwrap();
    let refused = store.replace_image(&known, &second, late).await.unwrap_err();
    assert!(matches!(refused, StoreError::NotFound(_)), "{refused}");
}

async fn of_concurrent_corrections_each_is_made_once(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let id = add(&*store, &map, "a", b"a").await.id;
    let working = (0..8).map(|worker| {
        let (store, map, id) = (Arc::clone(&store), map.clone(), id.clone());
        tokio::spawn(async move {
            loop {
                let current = store.image(&map, &id).await.unwrap().unwrap();
                let mut next = current.clone();
                next.tags.push(format!("tag {worker}"));
                if store.replace_image(&map, &current, next).await.unwrap() {
                    return;
                }
            }
        })
    });
    join_all(working).await.into_iter().for_each(Result::unwrap);
    let mut tags = store.image(&map, &id).await.unwrap().unwrap().tags;
    tags.sort();
    assert_eq!(tags, (0..8).map(|worker| format!("tag {worker}")).collect::<Vec<_>>());
}

async fn only_changed_poses_count_as_changes(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let state = async |store: &dyn Store| {
        let state = store.index_state(&map).await.unwrap();
        (state.images, state.changes, state.moved)
    };
    let mut a = add(&*store, &map, "a", b"a").await;
    assert_eq!(state(&*store).await, (1, 1, 0));
    for (number, pose) in [at(1.0), at(2.0), None].into_iter().enumerate() {
        a = correct(&*store, &map, &a, Image { pose, ..a.clone() }).await;
        assert_eq!(state(&*store).await, (1, number as u64 + 2, number as u64 + 1));
    }
    correct(&*store, &map, &a, Image { tags: vec!["t".into()], ..a.clone() }).await;
    assert_eq!(state(&*store).await, (1, 4, 3));
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.index_state(&map).await.unwrap().moved, 3);
}

async fn a_pose_corrected_during_a_reindex_is_in_both_revisions(fixture: &Fixture) {
    let store = fixture.open().await;
    let (old, _) = store.put_map(map("m", 3)).await.unwrap();
    let a = add(&*store, &old, "a", b"a").await;
    let b = add(&*store, &old, "b", b"b").await;
    let mut draft = store.draft(next(&old, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    let a = correct(&*store, &old, &a, Image { pose: at(1.0), ..a.clone() }).await;
    let pose_of = async |map: &Map, query: Descriptor| {
        store.search(map, query, 1, SearchMode::Exact).await.unwrap()[0].pose
    };
    assert_eq!(pose_of(&old, descriptor(&a, 3)).await, at(1.0));
    assert!(draft.replace().await.unwrap());
    let new = store.map(&old.name).await.unwrap().unwrap();
    assert_eq!(pose_of(&new, descriptor(&a, 5)).await, at(1.0));
    assert_eq!(store.index_state(&new).await.unwrap().moved, 1);
    // A caller that read the map before the reindex corrects the same image.
    correct(&*store, &old, &b, Image { pose: at(2.0), ..b.clone() }).await;
    assert_eq!(pose_of(&new, descriptor(&b, 5)).await, at(2.0));
}

async fn hard_negatives_follow_corrected_poses(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let mut images = Vec::new();
    for id in ["a", "b", "c"] {
        let image = add(&*store, &map, id, id.as_bytes()).await;
        let posed = Image { pose: at(1.0), ..image.clone() };
        images.push(correct(&*store, &map, &image, posed).await);
    }
    let settings = CalibrationSettings {
        images: 9,
        refined: 0,
        candidates: 3,
        place_images: 0,
        place_m: 25.0,
        model_calls: 0,
    };
    let others = async || -> Vec<usize> {
        let asked = store.hard_negatives(&map, settings, 3).await.unwrap();
        asked.iter().map(|asked| asked.others.len()).collect()
    };
    assert_eq!(others().await, [0, 0, 0]);
    let away = Image { pose: at(2.0), ..images[2].clone() };
    correct(&*store, &map, &images[2], away).await;
    assert_eq!(others().await, [1, 1, 2]);
}

async fn a_map_without_poses_can_change_its_coordinate_frame(fixture: &Fixture) {
    let store = fixture.open().await;
    let (known, _) = store.put_map(map("m", 3)).await.unwrap();
    let a = add(&*store, &known, "a", b"a").await;
    add(&*store, &known, "b", b"b").await;
    let in_metres = Map { frame: CoordinateFrame::Metric, ..known.clone() };
    let (changed, new) = store.put_map(in_metres.clone()).await.unwrap();
    assert_eq!((&changed, new), (&in_metres, false));
    assert_eq!(store.index_state(&known).await.unwrap().images, 2);
    let posed = correct(&*store, &known, &a, Image { pose: metric(1.0), ..a.clone() }).await;
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.map(&known.name).await.unwrap(), Some(in_metres));
    let refused = store.put_map(known.clone()).await.unwrap_err();
    assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    assert!(refused.to_string().contains("remove their poses"), "{refused}");
    // Other fields still change, and without its pose the frame does too.
    let indoor = Map { scene: Scene::Indoor, ..changed };
    assert_eq!(store.put_map(indoor.clone()).await.unwrap(), (indoor, false));
    correct(&*store, &known, &posed, a).await;
    assert_eq!(store.put_map(known.clone()).await.unwrap(), (known, false));
}

async fn a_pose_of_the_former_coordinate_frame_is_refused(fixture: &Fixture) {
    let store = fixture.open().await;
    let (known, _) = store.put_map(map("m", 3)).await.unwrap();
    let a = add(&*store, &known, "a", b"a").await;
    store.put_map(Map { frame: CoordinateFrame::Metric, ..known.clone() }).await.unwrap();
    let late = store.replace_image(&known, &a, Image { pose: at(1.0), ..a.clone() }).await;
    assert!(matches!(late, Err(StoreError::Superseded(_))), "{late:?}");
    let late = Image { pose: at(1.0), ..image("b", b"b") };
    let _pin = store.put_blob(late.digest, Bytes::from_static(b"b")).await.unwrap();
    let query = descriptor(&late, 3);
    let refused = store.add_image(&known, late.clone(), query.clone()).await.unwrap_err();
    assert!(matches!(refused, StoreError::Superseded(_)), "{refused}");
    let state = store.index_state(&known).await.unwrap();
    assert_eq!((state.images, state.moved), (1, 0));
    // One without a pose fits any frame.
    store.add_image(&known, Image { pose: None, ..late }, query).await.unwrap();
}

async fn a_coordinate_frame_changed_during_a_reindex_stays_changed(fixture: &Fixture) {
    let store = fixture.open().await;
    let (known, _) = store.put_map(map("m", 3)).await.unwrap();
    add(&*store, &known, "a", b"a").await;
    let mut draft = store.draft(next(&known, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    store.put_map(Map { frame: CoordinateFrame::Metric, ..known.clone() }).await.unwrap();
    assert!(draft.replace().await.unwrap());
    let reindexed = store.map(&known.name).await.unwrap().unwrap();
    assert_eq!((reindexed.frame, reindexed.revision), (CoordinateFrame::Metric, 1));
}
