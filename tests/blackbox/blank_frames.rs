//! Frames that show nothing: they are answered, and never called a known place.

use image::{Rgb, RgbImage};
use serde_json::Value;

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
