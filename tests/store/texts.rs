//! The texts that were read in images, and the search in them.

use whereabouts_core::text_search::{TextQuery, grams};
use whereabouts_core::{Digest, Image, ImageId, ImageTexts, Map, TextLine};
use whereabouts_store::{Store, TextCounts};

use crate::support::{Fixture, add, fill, map, next, odd_texts};

contract!(
    texts_are_read_as_they_were_written_also_after_a_restart,
    texts_are_kept_within_bounds,
    images_that_this_reader_has_not_tried_are_unread,
    texts_of_other_bytes_are_not_stored,
    texts_are_removed_with_their_image_and_their_map,
    a_reindex_keeps_the_texts,
    an_export_carries_the_texts,
    candidates_share_most_grams_and_ties_are_in_the_order_of_ids,
    what_readers_get_wrong_is_found,
);

fn reader() -> Digest {
    Digest::of(b"a fake reader")
}

fn texts(lines: &[&str]) -> ImageTexts {
    let line = |(row, text): (usize, &&str)| {
        let y = row as f32 / 8.0;
        TextLine {
            text: (*text).into(),
            confidence: 0.75,
            corners: [[0.25, y], [0.75, y], [0.75, y + 0.125], [0.25, y + 0.125]],
        }
    };
    ImageTexts::read(reader(), lines.iter().enumerate().map(line).collect())
}

async fn read(store: &dyn Store, map: &Map, image: &Image, lines: &[&str]) {
    assert!(store.put_texts(map, image, texts(lines)).await.unwrap());
}

async fn of(store: &dyn Store, map: &Map, id: &str) -> Option<ImageTexts> {
    store.texts(map, &[id.parse().unwrap()]).await.unwrap().remove(0)
}

async fn found(store: &dyn Store, map: &Map, text: &str) -> Vec<(String, usize)> {
    let found = store.text_candidates(map, &TextQuery::grams(text), 100).await.unwrap();
    found.into_iter().map(|found| (found.image.to_string(), found.shared)).collect()
}

async fn texts_are_read_as_they_were_written_also_after_a_restart(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let (a, b) = (add(&*store, &map, "a", b"a").await, add(&*store, &map, "b", b"b").await);
    assert_eq!(of(&*store, &map, "a").await, None);
    let odd = odd_texts();
    read(&*store, &map, &a, &odd.iter().map(String::as_str).collect::<Vec<_>>()).await;
    read(&*store, &map, &b, &["first"]).await;
    read(&*store, &map, &b, &["Kawa", "東京"]).await;
    let expected = [
        Some(texts(&["Kawa", "東京"])),
        None,
        Some(texts(&odd.iter().map(String::as_str).collect::<Vec<_>>())),
    ];
    let ids: Vec<ImageId> = ["b", "none", "a"].map(|id| id.parse().unwrap()).into();
    assert_eq!(store.texts(&map, &ids).await.unwrap(), expected);
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.texts(&map, &ids).await.unwrap(), expected);
    assert_eq!(found(&*store, &map, "kawa").await[0].0, "b");
    assert_eq!(found(&*store, &map, "first").await, [], "what was read before is not found");
}

async fn texts_are_kept_within_bounds(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let image = add(&*store, &map, "a", b"a").await;
    let line = texts(&["x"]).lines.remove(0);
    let long = TextLine { text: "x".repeat(10_000), ..line };
    let huge = ImageTexts { reader: reader(), lines: vec![long; 1000], left_out: 0, error: None };
    assert!(store.put_texts(&map, &image, huge).await.unwrap());
    let kept = of(&*store, &map, "a").await.unwrap();
    assert_eq!((kept.lines.len(), kept.left_out), (ImageTexts::MAX_LINES, 800));
    assert_eq!(kept.lines[0].text.len(), ImageTexts::MAX_CHARS);
}

async fn images_that_this_reader_has_not_tried_are_unread(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let mut images = Vec::new();
    for id in ["a", "b", "c", "d"] {
        images.push(add(&*store, &map, id, id.as_bytes()).await);
    }
    let other = Digest::of(b"another reader");
    let unread = async |reader: Digest, after: Option<&str>, limit: usize| {
        let after = after.map(|id| id.parse().unwrap());
        let unread = store.unread(&map, &reader, after.as_ref(), limit).await.unwrap();
        unread.into_iter().map(|image| image.id.to_string()).collect::<Vec<_>>()
    };
    assert_eq!(unread(reader(), None, 3).await, ["a", "b", "c"]);
    read(&*store, &map, &images[1], &["Bank", "Kawa"]).await;
    read(&*store, &map, &images[0], &[]).await;
    let failed = ImageTexts::failed(reader(), "it cannot be decoded");
    assert!(store.put_texts(&map, &images[3], failed.clone()).await.unwrap());
    assert_eq!(unread(reader(), None, 9).await, ["c"]);
    assert_eq!(unread(reader(), Some("c"), 9).await, Vec::<String>::new());
    assert_eq!(unread(other, Some("a"), 2).await, ["b", "c"]);
    assert_eq!(of(&*store, &map, "d").await, Some(failed));
    let counts = TextCounts { read: 2, failed: 1, lines: 2 };
    assert_eq!(store.text_counts(&map, Some(&reader())).await.unwrap(), counts);
    assert_eq!(store.text_counts(&map, None).await.unwrap(), counts);
    let none = TextCounts::default();
    assert_eq!(store.text_counts(&map, Some(&other)).await.unwrap(), none);
}

async fn texts_of_other_bytes_are_not_stored(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let before = add(&*store, &map, "a", b"before").await;
    assert!(store.delete_image(&map, &before.id).await.unwrap());
    assert!(!store.put_texts(&map, &before, texts(&["Bank"])).await.unwrap());
    add(&*store, &map, "a", b"after").await;
    assert!(!store.put_texts(&map, &before, texts(&["Bank"])).await.unwrap());
    assert_eq!(of(&*store, &map, "a").await, None);
    assert_eq!(found(&*store, &map, "bank").await, []);
}

async fn texts_are_removed_with_their_image_and_their_map(fixture: &Fixture) {
    let store = fixture.open().await;
    let (first, _) = store.put_map(map("m", 3)).await.unwrap();
    let (other, _) = store.put_map(map("other", 3)).await.unwrap();
    let a = add(&*store, &first, "a", b"a").await;
    let b = add(&*store, &first, "b", b"b").await;
    let kept = add(&*store, &other, "a", b"a").await;
    for (map, image) in [(&first, &a), (&first, &b), (&other, &kept)] {
        read(&*store, map, image, &["Bank"]).await;
    }
    assert!(store.delete_image(&first, &a.id).await.unwrap());
    assert_eq!(of(&*store, &first, "a").await, None);
    assert_eq!(found(&*store, &first, "bank").await, [("b".to_owned(), 3)]);
    assert!(store.delete_map(&first.name).await.unwrap());
    assert_eq!(of(&*store, &first, "b").await, None);
    assert_eq!(found(&*store, &first, "bank").await, []);
    assert_eq!(store.text_counts(&first, None).await.unwrap(), TextCounts::default());
    assert_eq!(found(&*store, &other, "bank").await, [("a".to_owned(), 3)]);
}

async fn a_reindex_keeps_the_texts(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let image = add(&*store, &map, "a", b"a").await;
    read(&*store, &map, &image, &["Bank"]).await;
    let mut draft = store.draft(next(&map, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    assert!(draft.replace().await.unwrap());
    let map = store.map(&map.name).await.unwrap().unwrap();
    assert_eq!(of(&*store, &map, "a").await, Some(texts(&["Bank"])));
    assert_eq!(store.unread(&map, &reader(), None, 9).await.unwrap(), []);
}

async fn an_export_carries_the_texts(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let image = add(&*store, &map, "a", b"a").await;
    add(&*store, &map, "b", b"b").await;
    read(&*store, &map, &image, &["Bank"]).await;
    let exported = store.export(&map, None, 9).await.unwrap();
    let carried: Vec<_> = exported.into_iter().map(|image| image.texts).collect();
    assert_eq!(carried, [Some(texts(&["Bank"])), None]);
}

async fn candidates_share_most_grams_and_ties_are_in_the_order_of_ids(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    for (id, lines) in
        [("z", &["KAWA", "COFFEE"][..]), ("c", &["coffee"]), ("a", &["COFFEE"]), ("b", &["Bank"])]
    {
        let image = add(&*store, &map, id, id.as_bytes()).await;
        read(&*store, &map, &image, lines).await;
    }
    let most = grams(["kawa coffee"]).len();
    let expected = [("z", most), ("a", 5), ("c", 5)].map(|(id, n)| (id.to_owned(), n));
    assert_eq!(found(&*store, &map, "kawa coffee").await, expected);
    let first = store.text_candidates(&map, &TextQuery::grams("kawa coffee"), 2).await.unwrap();
    assert_eq!(first.len(), 2);
    assert_eq!(store.text_candidates(&map, &Default::default(), 2).await.unwrap(), []);
}

async fn what_readers_get_wrong_is_found(fixture: &Fixture) {
    let store = fixture.open().await;
    let (map, _) = store.put_map(map("m", 3)).await.unwrap();
    let table = [
        ("o", "BOOKS 10", &["B00KS 1O"][..]),
        ("l", "milling", &["MlLLlNG"]),
        ("rn", "modern", &["modem"]),
        ("spaces", "kawa coffee", &["KAWACOFFEE"]),
        ("split", "city bank", &["CITY", "BANK"]),
        ("apostrophe", "mario's", &["MARIOS"]),
        ("accent", "żabka", &["ZABKA"]),
        ("wide", "tokyo", &["ＴＯＫＹＯ"]),
        ("han", "東京駅", &["東京駅前"]),
        ("typo", "pharmcay", &["PHARMACY"]),
        ("one", "7", &["7"]),
    ];
    for (id, _, lines) in &table {
        let image = add(&*store, &map, id, id.as_bytes()).await;
        read(&*store, &map, &image, lines).await;
    }
    for (id, typed, _) in &table {
        let query = TextQuery::new(typed).unwrap();
        let candidates = store.text_candidates(&map, &TextQuery::grams(typed), 100).await.unwrap();
        let ids: Vec<ImageId> = candidates.into_iter().map(|found| found.image).collect();
        let texts = store.texts(&map, &ids).await.unwrap();
        let matching: Vec<&str> = ids
            .iter()
            .zip(&texts)
            .filter(|(_, texts)| query.matches(&texts.as_ref().unwrap().lines).is_some())
            .map(|(id, _)| id.as_str())
            .collect();
        assert_eq!(matching, [*id], "{typed:?}");
    }
}
