//! Frames that show nothing: they are answered, and never called a known place.

use image::{Rgb, RgbImage};
use serde_json::Value;
use whereabouts_testkit::patterns::colour_bars;

use super::support::{Server, frame, jpeg, reference, shared_server, value_of};
use super::wait::eventually;

const PLACES: usize = 40;

fn uniform(colour: [u8; 3]) -> RgbImage {
    RgbImage::from_pixel(640, 480, Rgb(colour))
}

/// Multiplicative congruential noise, 0 to 255.
fn noise(seed: u32) -> impl FnMut() -> u8 {
    let mut state = seed.wrapping_mul(747_796_405) | 1;
    move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    }
}

/// Blank frames, by name.
fn blanks() -> Vec<(&'static str, Vec<u8>)> {
    let mut sensor = noise(1);
    let covered = RgbImage::from_fn(640, 480, |_, _| Rgb([0; 3].map(|_: u8| 12 + sensor() / 16)));
    let mut white_noise = noise(2);
    let snow = RgbImage::from_fn(640, 480, |_, _| Rgb([white_noise(); 3]));
    let shade = RgbImage::from_fn(640, 480, |x, y| Rgb([(x / 5 + y / 6) as u8; 3]));
    let scene = image::load_from_memory(&frame(3, 0)).unwrap().to_rgb8();
    let fog = RgbImage::from_fn(scene.width(), scene.height(), |x, y| {
        Rgb(scene.get_pixel(x, y).0.map(|value| 200 + value / 50))
    });
    vec![
        ("black", jpeg(&uniform([0; 3]))),
        ("white", jpeg(&uniform([255; 3]))),
        ("grey", jpeg(&uniform([128; 3]))),
        ("an empty YUYV buffer", jpeg(&uniform([0, 135, 0]))),
        ("one pixel", jpeg(&RgbImage::from_pixel(1, 1, Rgb([90, 20, 40])))),
        ("four pixels", jpeg(&RgbImage::from_fn(2, 2, |x, y| Rgb([200 * ((x + y) % 2) as u8; 3])))),
        ("a covered lens", jpeg(&covered)),
        ("noise", jpeg(&snow)),
        ("a gradient", jpeg(&shade)),
        ("fog", jpeg(&fog)),
    ]
}

/// What a broken camera, a cable or a screen sends instead of a scene, by name.
fn test_patterns() -> Vec<(String, Vec<u8>)> {
    let drawn = |value: &dyn Fn(u32, u32) -> [u8; 3]| {
        jpeg(&RgbImage::from_fn(640, 480, |x, y| Rgb(value(x, y))))
    };
    let level = |bright: bool| if bright { [235; 3] } else { [16; 3] };
    let mut random = noise(3);
    let blocks: Vec<[u8; 3]> = (0..20 * 15).map(|_| [0; 3].map(|_: u8| random())).collect();
    let mut pictures = vec![
        ("colour bars".to_owned(), jpeg(&colour_bars(false))),
        ("a test card".into(), jpeg(&colour_bars(true))),
        ("random blocks".into(), drawn(&|x, y| blocks[(y / 32 * 20 + x / 32) as usize])),
        ("a user interface".into(), drawn(&user_interface)),
        ("a vertical gradient".into(), drawn(&|_, y| [(y / 2) as u8; 3])),
        (
            "rings".into(),
            drawn(&|x, y| {
                let distance = (x as f32 - 320.0).hypot(y as f32 - 240.0);
                [(127.0 + 120.0 * (distance / 8.0).sin()) as u8; 3]
            }),
        ),
        (
            "a star".into(),
            drawn(&|x, y| level(((y as f32 - 240.0).atan2(x as f32 - 320.0) * 18.0).sin() > 0.0)),
        ),
    ];
    for size in [8, 32, 60] {
        pictures.extend([
            (format!("squares of {size}"), drawn(&|x, y| level((x / size + y / size) % 2 == 0))),
            (format!("columns of {size}"), drawn(&|x, _| level((x / size) % 2 == 0))),
            (format!("rows of {size}"), drawn(&|_, y| level((y / size) % 2 == 0))),
            (format!("diagonals of {size}"), drawn(&|x, y| level(((x + y) / size) % 2 == 0))),
        ]);
    }
    for (width, height) in [(2, 2), (3, 3), (4, 3), (8, 6)] {
        let mut random = noise(width * 100 + height);
        let few = RgbImage::from_fn(width, height, |_, _| Rgb([0; 3].map(|_: u8| random())));
        pictures.push((format!("{width}×{height} pixels"), jpeg(&few)));
    }
    for place in [3, 17] {
        let scene = image::load_from_memory(&frame(place, 0)).unwrap().to_rgb8();
        let half = RgbImage::from_fn(scene.width(), scene.height(), |x, y| {
            if 2 * y < scene.height() { *scene.get_pixel(x, y) } else { Rgb([128; 3]) }
        });
        pictures.push((format!("the upper half of frame {place}"), jpeg(&half)));
    }
    pictures
}

/// A page with a bar, a menu, boxes and lines of something like text.
fn user_interface(x: u32, y: u32) -> [u8; 3] {
    let is_ink = (x * 7 + y / 3 * 31) % 11 < 5 && y % 25 > 8 && y % 25 < 18;
    match (x, y) {
        (_, ..34) => {
            if is_ink && x < 300 {
                [255; 3]
            } else {
                [45, 90, 160]
            }
        }
        (..140, _) => {
            if is_ink && x > 14 && x < 90 {
                [30; 3]
            } else {
                [235, 238, 242]
            }
        }
        (160..625, 140..) => match (y % 25, is_ink && x < 560) {
            (0, _) => [200; 3],
            (_, true) => [30; 3],
            (_, false) => [250; 3],
        },
        (160..300 | 320..460 | 480..620, 50..120) => [220, 226, 240],
        _ => [250; 3],
    }
}

async fn is_calibrated(server: &Server, map: &str) {
    eventually(async || {
        let calibration = &server.get(&format!("/maps/{map}")).await.expect(200)["calibration"];
        (calibration["images"] == PLACES && calibration["refined"] != 0).then_some(())
    })
    .await;
}

fn assert_unknown(name: &str, estimate: &Value) {
    assert_eq!(estimate["known"], false, "{name}: {estimate}");
    assert_eq!(estimate["confidence"].as_f64(), Some(0.0), "{name}: {estimate}");
    let reason = estimate["reason"].as_str().unwrap_or_else(|| panic!("{name}: {estimate}"));
    assert!(reason.contains("the place cannot be known"), "{name}: {reason}");
}

#[tokio::test]
async fn a_frame_that_shows_nothing_is_answered_but_never_known() {
    let (server, map) = shared_server();
    server.town(&map, PLACES).await;
    is_calibrated(server, &map).await;
    for (name, blank) in blanks() {
        let path = format!("/localize?map={map}&refine=wait");
        let answer = server.post_jpeg(&path, blank).await.expect(200);
        assert_eq!(answer["candidates"].as_array().unwrap().len(), 10, "{name}");
        assert_unknown(name, &answer["estimate"]);
        let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
        assert_eq!(job["state"], "succeeded");
        assert_unknown(name, &job["estimate"]);
    }
    let metrics = server.metrics().await;
    for why in ["blank", "noise"] {
        let name = format!("whereabouts_uninformative_frames_total{{why=\"{why}\"}}");
        assert!(value_of(&metrics, &name).unwrap_or(0.0) >= 1.0, "{why}: {metrics}");
    }
}

#[tokio::test]
async fn a_test_pattern_is_never_known_at_once_or_refined() {
    let (server, map) = shared_server();
    server.town(&map, PLACES).await;
    is_calibrated(server, &map).await;
    let mut known = Vec::new();
    for (name, picture) in test_patterns() {
        let path = format!("/localize?map={map}&refine=wait");
        let answer = server.post_jpeg(&path, picture.clone()).await.expect(200);
        let at_once = server.post_jpeg(&format!("/localize?map={map}&refine=off"), picture).await;
        for (when, estimate) in
            [("refined", &answer["estimate"]), ("at once", &at_once.expect(200)["estimate"])]
        {
            if estimate["known"] != false {
                known.push(format!("{name}, {when}: {estimate}"));
            }
        }
    }
    assert!(known.is_empty(), "{known:#?}");
}

#[tokio::test]
async fn a_frame_that_shows_a_place_has_no_such_reason() {
    let (server, map) = shared_server();
    server.town(&map, PLACES).await;
    for place in 0..PLACES {
        for picture in [reference(place), frame(place, 0)] {
            let path = format!("/localize?map={map}&refine=off");
            let answer = server.post_jpeg(&path, picture).await.expect(200);
            assert_eq!(answer["estimate"]["reason"], Value::Null, "place {place}");
        }
    }
}

#[tokio::test]
async fn a_blank_frame_is_no_evidence_for_a_track() {
    let (server, map) = shared_server();
    server.town(&map, PLACES).await;
    let blank = blanks().swap_remove(0).1;
    let path = format!("/localize?map={map}&refine=off&track=r1&moved_m=0");
    let mut last = Value::Null;
    for _ in 0..3 {
        last = server.post_jpeg(&path, reference(5)).await.expect(200);
    }
    assert_eq!(last["track"]["image_id"], "place-5");
    for _ in 0..3 {
        last = server.post_jpeg(&path, blank.clone()).await.expect(200);
    }
    assert_eq!(last["track"]["image_id"], "place-5", "{last}");
}
