//! Maps: created, changed, deleted, and calibrated.

use std::sync::Arc;

use futures_util::future::join_all;
use whereabouts_core::{
    Calibration, CalibrationSettings, DescriptorKind, Digest, Map, Precision, Scene,
};
use whereabouts_index::SearchMode;
use whereabouts_store::{IndexState, Store, StoreError};

use crate::support::{Fixture, add, descriptor, fill, image, is_kept, map, next, odd_texts};

contract!(
    a_map_is_created_once_and_its_scene_and_description_can_change,
    descriptor_settings_are_fixed_once_there_are_images,
    maps_are_listed_by_the_bytes_of_their_names,
    of_concurrent_creations_of_a_map_one_succeeds,
    a_deleted_map_is_gone_for_good_and_its_name_is_free,
    a_deleted_map_is_deleted_with_its_bytes,
    a_map_may_be_deleted_while_images_are_added,
    a_map_with_its_images_survives_a_restart,
    a_calibration_is_kept_for_its_revision,
);

async fn a_map_is_created_once_and_its_scene_and_description_can_change(fixture: &Fixture) {
    let store = fixture.open().await;
    let requested = map("m", 3);
    assert_eq!(store.map(&requested.name).await.unwrap(), None);
    assert_eq!(store.put_map(requested.clone()).await.unwrap(), (requested.clone(), true));
    assert_eq!(store.map(&requested.name).await.unwrap(), Some(requested.clone()));
    // The same again, with another uid.
    assert_eq!(store.put_map(map("m", 3)).await.unwrap(), (requested.clone(), false));
    add(&*store, &requested, "a", b"a").await;
    for text in odd_texts() {
        let other = Map { scene: Scene::Indoor, description: Some(text), ..map("m", 3) };
        let (changed, new) = store.put_map(other.clone()).await.unwrap();
        let expected = Map { uid: requested.uid, created_at: requested.created_at, ..other };
        assert_eq!((&changed, new), (&expected, false));
        assert_eq!(store.map(&requested.name).await.unwrap(), Some(expected));
    }
    assert_eq!(store.index_state(&requested).await.unwrap().images, 1);
}

async fn descriptor_settings_are_fixed_once_there_are_images(fixture: &Fixture) {
    let store = fixture.open().await;
    let (mut known, _) = store.put_map(map("m", 3)).await.unwrap();
    let others: [fn(Map) -> Map; 4] = [
        |map| Map { model: "other".into(), model_digest: Digest::of(b"other"), ..map },
        |map| Map { precision: Precision::Bf16, ..map },
        |map| Map { descriptor: DescriptorKind::CLS, ..map },
        |map| Map { dim: 5, ..map },
    ];
    for other in others {
        // Also after an image was added and removed.
        let gone = add(&*store, &known, "a", b"a").await;
        let requested = other(Map { uid: map("m", 3).uid, ..known.clone() });
        let refused = store.put_map(requested.clone()).await.unwrap_err();
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
        assert_eq!(store.map(&known.name).await.unwrap(), Some(known.clone()));
        assert!(store.delete_image(&known, &gone.id).await.unwrap());
        let (changed, new) = store.put_map(requested.clone()).await.unwrap();
        assert_eq!((&changed, new), (&requested, false));
        // The former revision is superseded.
        let query = descriptor(&gone, known.dim);
        let refused = store.search(&known, query, 1, SearchMode::Fast).await.unwrap_err();
        assert!(matches!(refused, StoreError::NotFound(_)), "{refused}");
        known = changed;
        let empty =
            IndexState { images: 0, graph: false, behind: false, changes: 0, moved: 0, located: 0 };
        assert_eq!(store.index_state(&known).await.unwrap(), empty);
    }
    let superseded = store.put_map(Map { revision: 7, ..known }).await.unwrap_err();
    assert!(matches!(superseded, StoreError::Superseded(_)), "{superseded}");
}

async fn maps_are_listed_by_the_bytes_of_their_names(fixture: &Fixture) {
    let store = fixture.open().await;
    assert!(store.maps().await.unwrap().is_empty());
    let mut names = ["a-b", "ab", "a.b", "a_b", "a", "10", "9", "a--", "b"];
    for name in names {
        store.put_map(map(name, 3)).await.unwrap();
    }
    names.sort();
    let maps = store.maps().await.unwrap();
    assert_eq!(maps.iter().map(|map| map.name.as_str()).collect::<Vec<_>>(), names);
}

async fn of_concurrent_creations_of_a_map_one_succeeds(fixture: &Fixture) {
    let store = fixture.open().await;
    let put = join_all((0..8).map(|_| store.put_map(map("m", 3)))).await;
    let put: Vec<_> = put.into_iter().map(Result::unwrap).collect();
    assert_eq!(put.iter().filter(|(_, new)| *new).count(), 1);
    let stored = store.map(&"m".parse().unwrap()).await.unwrap().unwrap();
    assert!(put.iter().all(|(map, _)| *map == stored));
    add(&*store, &stored, "a", b"a").await;
}

async fn a_deleted_map_is_gone_for_good_and_its_name_is_free(fixture: &Fixture) {
    let store = fixture.open().await;
    let (old, _) = store.put_map(map("m", 3)).await.unwrap();
    let kept = add(&*store, &old, "a", b"a").await;
    assert!(store.delete_map(&old.name).await.unwrap());
    assert!(!store.delete_map(&old.name).await.unwrap());
    assert_eq!(store.map(&old.name).await.unwrap(), None);
    is_gone(&*store, &old).await;
    let (new, is_new) = store.put_map(map("m", 3)).await.unwrap();
    assert!(is_new && new.uid != old.uid);
    is_gone(&*store, &old).await;
    assert_eq!(store.index_state(&new).await.unwrap().images, 0);
    assert_eq!(store.image(&new, &kept.id).await.unwrap(), None);
    add(&*store, &new, "a", b"other").await;
}

/// Asserts that every operation on a deleted map fails.
async fn is_gone(store: &dyn Store, map: &Map) {
    let image = image("a", b"a");
    let query = descriptor(&image, map.dim);
    let measured = Calibration::default();
    for refused in [
        store.index_state(map).await.map(drop),
        store.add_image(map, image.clone(), query.clone()).await.map(drop),
        store.delete_image(map, &image.id).await.map(drop),
        store.positions(map).await.map(drop),
        store.search(map, query.clone(), 1, SearchMode::Fast).await.map(drop),
        store.search(map, query, 1, SearchMode::Exact).await.map(drop),
        store.export(map, None, 1).await.map(drop),
        store.hard_negatives(map, CalibrationSettings::default(), 1).await.map(drop),
        store.put_calibration(map, measured).await,
        store.draft(next(map, 5)).await.map(drop),
    ] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, StoreError::NotFound(_)), "{refused}");
    }
    assert_eq!(store.calibration(map).await.unwrap(), None);
    assert_eq!(store.image(map, &image.id).await.unwrap(), None);
    assert!(store.images(map, None, 9).await.unwrap().is_empty());
}

async fn a_deleted_map_is_deleted_with_its_bytes(fixture: &Fixture) {
    let store = fixture.open().await;
    let (gone, _) = store.put_map(map("gone", 3)).await.unwrap();
    let (stays, _) = store.put_map(map("stays", 3)).await.unwrap();
    // More than one step of the sweep removes.
    let frames: Vec<_> = (0..300).map(|number| format!("frame {number}")).collect();
    join_all(frames.iter().map(|frame| add(&*store, &gone, frame, frame.as_bytes()))).await;
    add(&*store, &stays, "a", frames[7].as_bytes()).await;
    assert!(store.delete_map(&gone.name).await.unwrap());
    for (number, frame) in frames.iter().enumerate() {
        assert_eq!(is_kept(&*store, frame.as_bytes()).await, number == 7);
    }
}

async fn a_map_may_be_deleted_while_images_are_added(fixture: &Fixture) {
    let store = fixture.open().await;
    let frames: Vec<_> = (0..8).map(|number| format!("frame {number}")).collect();
    let mut pins = Vec::new();
    for frame in &frames {
        let bytes = frame.clone().into_bytes();
        pins.push(store.put_blob(Digest::of(&bytes), bytes.into()).await.unwrap());
    }
    for _ in 0..5 {
        let (map, _) = store.put_map(map("m", 3)).await.unwrap();
        let adding = frames.iter().map(|frame| {
            let (store, map, frame) = (Arc::clone(&store), map.clone(), frame.clone());
            tokio::spawn(async move {
                for number in 0.. {
                    let image = image(&format!("{frame}/{number}"), frame.as_bytes());
                    let descriptor = descriptor(&image, 3);
                    match store.add_image(&map, image, descriptor).await {
                        Ok(_) => {}
                        Err(StoreError::NotFound(_)) => return,
                        Err(error) => panic!("{error}"),
                    }
                }
            })
        });
        let adding: Vec<_> = adding.collect();
        // Wait until there is something to delete.
        crate::support::eventually(async || {
            let state = store.index_state(&map).await.unwrap();
            (state.images > 20).then_some(())
        })
        .await;
        assert!(store.delete_map(&map.name).await.unwrap());
        join_all(adding).await.into_iter().for_each(Result::unwrap);
        is_gone(&*store, &map).await;
    }
    drop(pins);
}

async fn a_map_with_its_images_survives_a_restart(fixture: &Fixture) {
    let store = fixture.open().await;
    let (known, _) = store.put_map(map("m", 16)).await.unwrap();
    let mut images = Vec::new();
    for id in ["a", "b", "c"] {
        images.push(add(&*store, &known, id, id.as_bytes()).await);
    }
    let (gone, _) = store.put_map(map("gone", 3)).await.unwrap();
    assert!(store.delete_map(&gone.name).await.unwrap());
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.maps().await.unwrap(), std::slice::from_ref(&known));
    assert_eq!(store.images(&known, None, 9).await.unwrap(), images);
    assert_eq!(store.index_state(&known).await.unwrap().images, 3);
    for image in &images {
        let query = descriptor(image, 16);
        let found = store.search(&known, query, 1, SearchMode::Fast).await.unwrap();
        assert_eq!(found[0].image_id, image.id);
        assert!(store.blob(&image.digest).await.unwrap().is_some());
    }
    add(&*store, &known, "d", b"d").await;
}

async fn a_calibration_is_kept_for_its_revision(fixture: &Fixture) {
    let store = fixture.open().await;
    let (known, _) = store.put_map(map("m", 3)).await.unwrap();
    assert_eq!(store.calibration(&known).await.unwrap(), None);
    let measured = Calibration {
        images: 7,
        complete: true,
        similarity: vec![0.125, 0.1, f32::MIN_POSITIVE].into(),
        ..Calibration::default()
    };
    store.put_calibration(&known, Calibration::default()).await.unwrap();
    store.put_calibration(&known, measured.clone()).await.unwrap();
    let changed = Map { scene: Scene::Indoor, ..known.clone() };
    store.put_map(changed).await.unwrap();
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.calibration(&known).await.unwrap().as_deref(), Some(&measured));

    let mut draft = store.draft(next(&known, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    assert!(draft.replace().await.unwrap());
    assert_eq!(store.calibration(&known).await.unwrap(), None);
    assert_eq!(store.calibration(&next(&known, 5)).await.unwrap(), None);
    let late = store.put_calibration(&known, measured).await.unwrap_err();
    assert!(matches!(late, StoreError::Superseded(_)), "{late}");
    let settings = CalibrationSettings::default();
    let late = store.hard_negatives(&known, settings, 1).await.unwrap_err();
    assert!(matches!(late, StoreError::Superseded(_)), "{late}");
}
