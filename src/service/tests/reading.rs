//! Reading in the background, with a fake reader: it reads the text that is written in the values of the pixels.

use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use image::{ImageFormat, RgbImage};
use tokio_util::sync::CancellationToken;
use whereabouts_core::{ImageTexts, TextLine};
use whereabouts_reading::{ReadError, Reader};
use whereabouts_refine::FrameReader;
use whereabouts_store::TextStore;
use whereabouts_vision::{AdmissionRequest, Picture, WorkClass};

use super::*;

/// A fake: reads what [`written`] wrote.
#[derive(Debug, Default)]
struct Fake {
    version: u8,
    calls: AtomicUsize,
}

impl Reader for Fake {
    fn digest(&self) -> Digest {
        Digest::of(&[b"fake", [self.version].as_slice()].concat())
    }

    fn read(&self, picture: &Picture) -> Result<Vec<TextLine>, ReadError> {
        self.calls.fetch_add(1, Ordering::Relaxed);
        let bytes: Vec<u8> =
            picture.pixels.pixels().map(|pixel| pixel[0]).take_while(|byte| *byte > 0).collect();
        let text = String::from_utf8(bytes).map_err(|_| ReadError::Model("not text".into()))?;
        let line = |text: &str| TextLine {
            text: text.to_owned(),
            confidence: 0.9,
            corners: [[0.0; 2]; 4],
        };
        Ok(text.lines().map(line).collect())
    }
}

/// A picture with a text for the fake.
fn written(text: &[u8]) -> Vec<u8> {
    let mut pixels = RgbImage::new(64, 4);
    for (pixel, byte) in pixels.pixels_mut().zip(text) {
        pixel[0] = *byte;
    }
    let mut png = std::io::Cursor::new(Vec::new());
    pixels.write_to(&mut png, ImageFormat::Png).unwrap();
    png.into_inner()
}

async fn with_reader(reader: &Arc<Fake>) -> Fixture {
    Fixture::reading(Some(reader.clone()), 0, |_| {}).await
}

/// Adds an image with these bytes.
pub(super) async fn add(fixture: &Fixture, map: &Map, number: usize, bytes: Vec<u8>) -> Image {
    let image = Image { digest: Digest::of(&bytes), ..image(number, None).1 };
    let _pin = fixture.store.put_blob(image.digest, bytes.into()).await.unwrap();
    fixture.store.add_image(map, image.clone(), descriptor(number)).await.unwrap();
    image
}

/// Reads in the background until none of the images is unread.
async fn read_all(fixture: &Fixture, map: &Map) {
    let shutdown = CancellationToken::new();
    let (reading, until) = (Arc::clone(&fixture.service.reading), shutdown.clone());
    let running = tokio::spawn(async move { reading.run(until).await });
    let reaches = async {
        while fixture.service.maps.get(&map.name).await.unwrap().texts.unwrap().waiting != Some(0) {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), reaches).await.unwrap();
    shutdown.cancel();
    running.await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn images_are_read_once_and_what_cannot_be_read_is_not_tried_again() {
    let reader = Arc::new(Fake::default());
    let fixture = with_reader(&reader).await;
    let map = fixture.map("m", &[]).await;
    let sign = add(&fixture, &map, 0, written(b"KAWA\nCoffee")).await;
    let blank = add(&fixture, &map, 1, written(b"")).await;
    let unreadable = add(&fixture, &map, 2, written(&[0xFF])).await;
    let damaged = add(&fixture, &map, 3, image(3, None).0).await;
    let before = fixture.service.maps.get(&map.name).await.unwrap().texts.unwrap();
    assert_eq!((before.read, before.waiting), (0, Some(4)));
    read_all(&fixture, &map).await;
    let ids = [sign, blank, unreadable, damaged].map(|image| image.id);
    let read = fixture.store.texts(&map, &ids).await.unwrap();
    let texts: Vec<Vec<&str>> = read
        .iter()
        .map(|texts| texts.as_ref().unwrap().lines.iter().map(|line| line.text.as_str()).collect())
        .collect();
    assert_eq!(texts, [vec!["KAWA", "Coffee"], vec![], vec![], vec![]]);
    let failed: Vec<bool> = read.iter().flatten().map(|texts| texts.error.is_some()).collect();
    assert_eq!(failed, [false, false, true, true]);
    let after = fixture.service.maps.get(&map.name).await.unwrap().texts.unwrap();
    assert_eq!((after.read, after.failed, after.waiting, after.lines), (2, 2, Some(0), 2));
    let calls = reader.calls.load(Ordering::Relaxed);
    add(&fixture, &map, 4, written(b"Bank")).await;
    read_all(&fixture, &map).await;
    assert_eq!(reader.calls.load(Ordering::Relaxed), calls + 1, "only the new image is read");
}

#[tokio::test(flavor = "multi_thread")]
async fn another_reader_reads_all_images_again() {
    let reader = Arc::new(Fake { version: 2, ..Fake::default() });
    let fixture = with_reader(&reader).await;
    let map = fixture.map("m", &[]).await;
    let image = add(&fixture, &map, 0, written(b"new")).await;
    let earlier = ImageTexts::failed(Fake::default().digest(), "an earlier reader could not");
    assert!(fixture.store.put_texts(&map, &image, earlier).await.unwrap());
    read_all(&fixture, &map).await;
    let read = fixture.store.texts(&map, &[image.id]).await.unwrap().remove(0).unwrap();
    assert_eq!((read.reader, read.lines[0].text.as_str()), (reader.digest(), "new"));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_image_is_begun_only_when_no_frame_waits() {
    let reader = Arc::new(Fake::default());
    let fixture = with_reader(&reader).await;
    let map = fixture.map("m", &[]).await;
    add(&fixture, &map, 0, written(b"Bank")).await;
    let admission = fixture.service.maps.imaging.admission.clone();
    let frame = AdmissionRequest { class: WorkClass::Localize, deadline: None };
    let in_progress = admission.acquire(frame).await.unwrap();
    let shutdown = CancellationToken::new();
    let (reading, until) = (Arc::clone(&fixture.service.reading), shutdown.clone());
    let running = tokio::spawn(async move { reading.run(until).await });
    while admission.levels().background == 0 {
        tokio::task::yield_now().await;
    }
    assert_eq!(reader.calls.load(Ordering::Relaxed), 0);
    // A frame that arrives later than the image is admitted before it.
    let later = admission.clone();
    let next = tokio::spawn(async move { later.acquire(frame).await.unwrap() });
    while admission.levels().localize == 0 {
        tokio::task::yield_now().await;
    }
    drop(in_progress);
    let next = next.await.unwrap();
    assert_eq!((admission.levels().background, reader.calls.load(Ordering::Relaxed)), (1, 0));
    drop(next);
    while reader.calls.load(Ordering::Relaxed) == 0 {
        tokio::task::yield_now().await;
    }
    shutdown.cancel();
    running.await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_are_read_where_there_are_texts_to_compare_them_with() {
    let reader = Arc::new(Fake::default());
    let fixture = with_reader(&reader).await;
    let map = fixture.map("m", &[]).await;
    let frame = Bytes::from(written(b"Pharmacy"));
    let digest = Digest::of(&frame);
    let _pin = fixture.store.put_blob(digest, frame).await.unwrap();
    let read = async |digest| fixture.service.reading.read_frame(&map.name, &digest).await;
    assert_eq!(read(digest).await, None, "nothing was read in the map");
    assert_eq!(reader.calls.load(Ordering::Relaxed), 0);
    add(&fixture, &map, 0, written(b"Bank")).await;
    read_all(&fixture, &map).await;
    assert_eq!(read(digest).await.unwrap()[0].text, "Pharmacy");
    assert_eq!(read(Digest::of(b"none")).await, None);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_image_whose_bytes_are_missing_is_read_when_they_are_back() {
    let fixture = with_reader(&Arc::default()).await;
    let map = fixture.map("m", &[]).await;
    let bytes = written(b"Bank");
    let lost = Image { digest: Digest::of(&bytes), ..image(0, None).1 };
    fixture.store.add_image(&map, lost.clone(), descriptor(0)).await.unwrap();
    let last = add(&fixture, &map, 1, written(b"Cafe")).await;
    let shutdown = CancellationToken::new();
    let (reading, until) = (Arc::clone(&fixture.service.reading), shutdown.clone());
    let running = tokio::spawn(async move { reading.run(until).await });
    let texts = async |image: &Image| {
        fixture.store.texts(&map, std::slice::from_ref(&image.id)).await.unwrap().remove(0)
    };
    let is_read = async |image: &Image| {
        while texts(image).await.is_none() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), is_read(&last)).await.unwrap();
    assert_eq!(texts(&lost).await, None, "it is not marked as one that cannot be read");
    shutdown.cancel();
    running.await.unwrap();
    let _pin = fixture.store.put_blob(lost.digest, bytes.into()).await.unwrap();
    read_all(&fixture, &map).await;
    assert_eq!(texts(&lost).await.unwrap().lines[0].text, "Bank");
}

#[tokio::test]
async fn without_a_reader_a_map_says_nothing_of_texts() {
    let fixture = Fixture::new().await;
    let map = fixture.map("m", &[None]).await;
    assert_eq!(fixture.service.maps.get(&map.name).await.unwrap().texts, None);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_search_finds_pages_of_what_was_read_the_best_first() {
    let fixture = with_reader(&Arc::default()).await;
    let map = fixture.map("m", &[]).await;
    let pages = async |text: &str, limit: usize| {
        let (mut found, mut cursor) = (Vec::new(), None);
        loop {
            let page = fixture.service.images.find(&map.name, text, cursor.as_deref(), Some(limit));
            let page = page.await.unwrap();
            let matches = page.matches.unwrap();
            assert!(
                page.images
                    .iter()
                    .map(|image| &image.id)
                    .eq(matches.iter().map(|found| &found.image_id))
            );
            assert!(matches.len() <= limit);
            found.extend(matches);
            cursor = page.next_cursor;
            if cursor.is_none() {
                return found;
            }
        }
    };
    assert!(pages("kawa", 5).await.is_empty(), "an empty map has nothing to find");
    for (number, text) in
        ["KAWA\nCOFFEE", "Bank", "Kawa Coffee", "KAVVA C0FFEE", "coffee"].into_iter().enumerate()
    {
        add(&fixture, &map, number, written(text.as_bytes())).await;
    }
    let error = fixture.service.images.find(&map.name, "kawa", None, None).await.unwrap_err();
    assert_eq!(error.kind, whereabouts_api::ErrorKind::Conflict);
    assert!(error.detail.contains("5 images wait"), "{}", error.detail);
    read_all(&fixture, &map).await;
    let all = pages("kawa coffea", 10).await;
    let ids: Vec<&str> = all.iter().map(|found| found.image_id.as_str()).collect();
    assert_eq!(ids, ["image-0", "image-2", "image-3"]);
    assert!(all.windows(2).all(|pair| pair[0].score >= pair[1].score), "{all:?}");
    assert_eq!(
        all[0].lines.iter().map(|line| line.text.as_str()).collect::<Vec<_>>(),
        ["KAWA", "COFFEE"]
    );
    for limit in 1..4 {
        assert_eq!(pages("kawa coffea", limit).await, all, "{limit} in a page");
    }
    for (text, cursor) in [("", None), ("- '", None), (&*"a".repeat(101), None), ("a", Some("x"))] {
        assert!(fixture.service.images.find(&map.name, text, cursor, None).await.is_err());
    }
    let state = fixture.service.images.state(&map.name, &image_id(1)).await.unwrap();
    assert_eq!(state.texts.unwrap().lines[0].text, "Bank");
}

#[tokio::test]
async fn a_search_without_a_reader_says_how_to_get_one() {
    let fixture = Fixture::new().await;
    let map = fixture.map("m", &[None]).await;
    let error = fixture.service.images.find(&map.name, "kawa", None, None).await.unwrap_err();
    assert_eq!(error.kind, whereabouts_api::ErrorKind::Conflict);
    assert!(error.detail.contains("make reader"), "{}", error.detail);
}
