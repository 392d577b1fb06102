//! Drafts: changes to a map while its descriptors are computed again.

use whereabouts_core::{Descriptor, Image, Map, Scene};
use whereabouts_index::SearchMode;
use whereabouts_store::{Store, StoreError};

use crate::support::{Fixture, Tuning, add, descriptor, eventually, fill, image, map, next};

contract!(
    changes_made_during_a_draft_are_carried_over,
    a_discarded_draft_leaves_the_map_unchanged_and_another_may_begin,
    a_draft_of_a_process_that_ended_does_not_block_the_next_one,
    a_large_map_is_searched_by_its_graph_from_the_moment_it_is_replaced,
    scene_and_description_changed_during_a_draft_are_kept,
);

/// Small enough that some of these maps have graphs.
fn tuning() -> Tuning {
    Tuning { exact_up_to: 4, ..Tuning::default() }
}

fn new_descriptor(image: &Image) -> Descriptor {
    descriptor(image, 5)
}

/// Asserts that every image is found by its own descriptor, and nothing else is found.
async fn finds(store: &dyn Store, images: &[&Image]) {
    let map = store.map(&"m".parse().unwrap()).await.unwrap().unwrap();
    assert_eq!(store.index_state(&map).await.unwrap().images, images.len());
    for mode in [SearchMode::Fast, SearchMode::Exact] {
        for image in images {
            let query = descriptor(image, map.dim);
            let found = store.search(&map, query, 20, mode).await.unwrap();
            assert_eq!(found.len(), images.len());
            assert_eq!((&found[0].image_id, found[0].similarity > 0.999), (&image.id, true));
        }
    }
}

/// A map of the old model, whose descriptors have three numbers; those of the new one have five.
async fn old_map(store: &dyn Store) -> Map {
    store.put_map(map("m", 3)).await.unwrap().0
}

async fn changes_made_during_a_draft_are_carried_over(fixture: &Fixture) {
    let store = fixture.open_with(tuning()).await;
    let map = old_map(&*store).await;
    let mut images = Vec::new();
    for name in ["a", "b", "c", "d", "e", "f", "g"] {
        images.push(add(&*store, &map, name, name.as_bytes()).await);
    }
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    let page = draft.missing(2).await.unwrap();
    assert_eq!(page, images[..2]);
    draft.write(&page[0], new_descriptor(&page[0])).await.unwrap();
    // Remove an image that has its new descriptor, and one that is about to get it and whose id is used again.
    for gone in ["a", "b", "f"] {
        assert!(store.delete_image(&map, &gone.parse().unwrap()).await.unwrap());
    }
    let other = add(&*store, &map, "b", b"other").await;
    draft.write(&page[1], new_descriptor(&page[1])).await.unwrap();
    let again = add(&*store, &map, "a", b"a").await;
    assert_eq!(fill(draft.as_mut(), 5).await, 4 + 2);
    // Between the last check and the replacement.
    let late = add(&*store, &map, "late", b"late").await;
    let all = [&again, &other, &images[2], &images[3], &images[4], &images[6], &late];
    assert!(!draft.replace().await.unwrap());
    finds(&*store, &all).await;
    assert_eq!(fill(draft.as_mut(), 5).await, 1);
    assert!(store.delete_image(&map, &"g".parse().unwrap()).await.unwrap());
    let all = [&again, &other, &images[2], &images[3], &images[4], &late];
    finds(&*store, &all).await;
    assert!(draft.replace().await.unwrap());
    finds(&*store, &all).await;
    drop(draft);

    // A search with the former map is superseded.
    let superseded = |error| assert!(matches!(error, StoreError::Superseded(_)), "{error}");
    let query = descriptor(&late, 3);
    superseded(store.search(&map, query.clone(), 1, SearchMode::Fast).await.unwrap_err());
    superseded(store.search(&map, query.clone(), 1, SearchMode::Exact).await.unwrap_err());
    superseded(store.add_image(&map, image("x", b"x"), query.clone()).await.unwrap_err());
    superseded(store.add_image(&map, late.clone(), query).await.unwrap_err());
    superseded(store.put_map(map.clone()).await.unwrap_err());
    superseded(store.draft(next(&map, 5)).await.err().unwrap());
    // A removal is the same in both.
    assert!(store.delete_image(&map, &late.id).await.unwrap());
    finds(&*store, &all[..5]).await;
    drop(store);
    let store = fixture.open_with(tuning()).await;
    finds(&*store, &all[..5]).await;
    // And again.
    let known = store.map(&map.name).await.unwrap().unwrap();
    assert_eq!(known, Map { created_at: map.created_at, ..next(&map, 5) });
    let mut draft = store.draft(next(&known, 5)).await.unwrap();
    assert_eq!(fill(draft.as_mut(), 5).await, 5);
    assert!(draft.replace().await.unwrap());
    finds(&*store, &all[..5]).await;
}

async fn a_discarded_draft_leaves_the_map_unchanged_and_another_may_begin(fixture: &Fixture) {
    let store = fixture.open_with(tuning()).await;
    let map = old_map(&*store).await;
    let image = add(&*store, &map, "a", b"a").await;
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    let second = store.draft(next(&map, 5)).await.err();
    assert!(matches!(second, Some(StoreError::Conflict(_))));
    fill(draft.as_mut(), 5).await;
    draft.discard().await;
    finds(&*store, &[&image]).await;

    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    assert!(store.delete_map(&map.name).await.unwrap());
    assert!(matches!(draft.missing(3).await, Err(StoreError::NotFound(_))));
    assert!(matches!(draft.replace().await, Err(StoreError::NotFound(_))));
    draft.discard().await;
}

async fn a_draft_of_a_process_that_ended_does_not_block_the_next_one(fixture: &Fixture) {
    let store = fixture.open_with(tuning()).await;
    let map = old_map(&*store).await;
    let image = add(&*store, &map, "a", b"a").await;
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    assert_eq!(draft.missing(9).await.unwrap().len(), 1);
    draft.write(&image, new_descriptor(&image)).await.unwrap();
    drop(draft);
    drop(store);
    let store = fixture.open_with(tuning()).await;
    finds(&*store, &[&image]).await;
    let mut draft = eventually(async || store.draft(next(&map, 5)).await.ok()).await;
    assert_eq!(fill(draft.as_mut(), 5).await, 1);
    assert!(draft.replace().await.unwrap());
    finds(&*store, &[&image]).await;
}

async fn a_large_map_is_searched_by_its_graph_from_the_moment_it_is_replaced(fixture: &Fixture) {
    let store = fixture.open_with(tuning()).await;
    let map = old_map(&*store).await;
    for number in 0..50_u8 {
        add(&*store, &map, &number.to_string(), &[number]).await;
    }
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    assert_eq!(fill(draft.as_mut(), 5).await, 50);
    assert!(draft.replace().await.unwrap());
    let state = store.index_state(&next(&map, 5)).await.unwrap();
    assert_eq!((state.images, state.graph, state.behind), (50, true, false));
}

async fn scene_and_description_changed_during_a_draft_are_kept(fixture: &Fixture) {
    let store = fixture.open_with(tuning()).await;
    let map = old_map(&*store).await;
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    let changed = Map { scene: Scene::Indoor, description: Some("new".into()), ..map.clone() };
    store.put_map(changed.clone()).await.unwrap();
    // A map without images can be moved to another model, too.
    assert_eq!(fill(draft.as_mut(), 5).await, 0);
    assert!(draft.replace().await.unwrap());
    let known = store.map(&map.name).await.unwrap().unwrap();
    assert_eq!(
        known,
        Map { scene: Scene::Indoor, description: changed.description, ..next(&map, 5) }
    );
}
