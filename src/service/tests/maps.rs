use super::{Fixture, MODEL};
use whereabouts_api::{ErrorKind, MapChange};
use whereabouts_core::MapName;

fn name(name: &str) -> MapName {
    name.parse().unwrap()
}

#[tokio::test]
async fn maps_are_listed_by_name_until_they_are_deleted() {
    let fixture = Fixture::new().await;
    let maps = &fixture.service.maps;
    fixture.map("yard", &[None, None]).await;
    fixture.map("hall", &[]).await;
    let listed = maps.list().await.unwrap();
    let listed: Vec<_> = listed.iter().map(|map| (map.name.as_str(), map.images)).collect();
    assert_eq!(listed, [("hall", 0), ("yard", 2)]);
    maps.delete(&name("hall")).await.unwrap();
    assert_eq!(maps.list().await.unwrap().len(), 1);
    let gone = maps.delete(&name("hall")).await.unwrap_err();
    assert_eq!(gone.kind, ErrorKind::NotFound);
}

#[tokio::test]
async fn an_unknown_map_is_not_found() {
    let fixture = Fixture::new().await;
    let (maps, images) = (&fixture.service.maps, &fixture.service.images);
    let (map, id) = (name("nowhere"), super::image_id(0));
    let kinds = [
        maps.get(&map).await.unwrap_err().kind,
        images.list(&map, None, None).await.unwrap_err().kind,
        images.get(&map, &id).await.unwrap_err().kind,
        images.delete(&map, &id).await.unwrap_err().kind,
    ];
    assert_eq!(kinds, [ErrorKind::NotFound; 4]);
}

#[tokio::test]
async fn a_new_map_needs_a_model_that_is_installed() {
    let fixture = Fixture::new().await;
    let refused = fixture.service.maps.put(name("yard"), MapChange::default()).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Unprocessable);
    assert!(refused.detail.contains(MODEL), "{refused}");
    assert!(fixture.service.maps.list().await.unwrap().is_empty());
}

#[tokio::test]
async fn the_description_of_a_map_can_change_while_its_model_is_not_installed() {
    let fixture = Fixture::new().await;
    let maps = &fixture.service.maps;
    fixture.map("yard", &[None]).await;
    let describe =
        |length| MapChange { description: Some("ö".repeat(length)), ..MapChange::default() };
    let (state, new) = maps.put(name("yard"), describe(2000)).await.unwrap();
    assert!(!new);
    assert_eq!(state.description.unwrap().chars().count(), 2000);
    let refused = maps.put(name("yard"), describe(2001)).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Unprocessable);
}

#[tokio::test]
async fn images_are_listed_by_id_a_page_at_a_time_and_can_be_deleted() {
    let fixture = Fixture::new().await;
    let (images, map) = (&fixture.service.images, name("yard"));
    fixture.map("yard", &[None, Some(1.0), None]).await;
    let first = images.list(&map, None, Some(2)).await.unwrap();
    assert_eq!((first.images.len(), first.next_cursor.as_deref()), (2, Some("image-1")));
    let after = first.next_cursor.unwrap().parse().unwrap();
    let last = images.list(&map, Some(&after), Some(2)).await.unwrap();
    assert_eq!((last.images.len(), last.next_cursor), (1, None));

    let id = super::image_id(1);
    let (_, bytes) = images.content(&map, &id, None).await.unwrap();
    assert_eq!(bytes, super::image(1, None).0);
    for max_edge in [15, 4097] {
        let refused = images.content(&map, &id, Some(max_edge)).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Unprocessable);
    }
    images.delete(&map, &id).await.unwrap();
    assert_eq!(images.get(&map, &id).await.unwrap_err().kind, ErrorKind::NotFound);
    assert_eq!(images.delete(&map, &id).await.unwrap_err().kind, ErrorKind::NotFound);
}
