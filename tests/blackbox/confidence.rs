//! Confidence: calibration, and how well `known` separates mapped places from others.

use serde_json::Value;

use super::support::{Server, frame, shared_server};
use super::wait::eventually;

const PLACES: usize = 40;
const ASKED: usize = 20;

/// Waits until the map is calibrated with this many images, and returns its calibration.
async fn calibrated(server: &Server, map: &str, images: usize) -> Value {
    eventually(async || {
        let calibration =
            server.get(&format!("/maps/{map}")).await.expect(200)["calibration"].take();
        (calibration["images"] == images && calibration["refined"] != 0).then_some(calibration)
    })
    .await
}

/// The confidence of the coarse estimate and of the refined one, for frames of these places.
async fn confidences(server: &Server, map: &str, places: std::ops::Range<usize>) -> Vec<[f64; 2]> {
    let mut found = Vec::new();
    for place in places {
        let answer =
            server.post_jpeg(&format!("/localize?map={map}"), frame(place, 0)).await.expect(200);
        let href = answer["job"]["href"].as_str().unwrap();
        let job = server.get(&format!("{href}?wait=60")).await.expect(200);
        found.push([&answer, &job].map(|response| {
            let confidence = response["estimate"]["confidence"].as_f64().unwrap();
            assert_eq!(response["estimate"]["known"], confidence >= 0.9);
            confidence
        }));
    }
    found
}

#[tokio::test]
async fn frames_of_mapped_places_are_known_and_others_are_not() {
    let (server, map) = shared_server();
    server.town(&map, PLACES).await;
    let calibration = calibrated(server, &map, PLACES).await;
    assert_eq!(calibration["asked"], PLACES);
    let known = |answers: &[[f64; 2]], which: usize| {
        answers.iter().filter(|answer| answer[which] >= 0.9).count()
    };
    let mapped = confidences(server, &map, 0..ASKED).await;
    let unmapped = confidences(server, &map, 500..500 + ASKED).await;
    // At most a tenth is expected; a sample of twenty frames may exceed it.
    for which in [0, 1] {
        assert!(known(&unmapped, which) <= 5, "{unmapped:?}");
    }
    assert!(known(&mapped, 1) >= ASKED * 7 / 10, "{mapped:?}");
}

#[tokio::test]
async fn confidence_is_null_before_calibration_and_is_filled_in_for_a_job_that_ended_before() {
    let (server, map) = shared_server();
    server.town(&map, 1).await;
    let answer = server.post_jpeg(&format!("/localize?map={map}"), frame(0, 0)).await.expect(200);
    let path = answer["job"]["href"].as_str().unwrap().to_owned();
    let job = server.get(&format!("{path}?wait=60")).await.expect(200);
    for response in [&answer, &job] {
        let estimate = &response["estimate"];
        assert_eq!((&estimate["confidence"], &estimate["known"]), (&Value::Null, &false.into()));
    }
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["calibration"], Value::Null);
    server.town_more(&map, 1..12).await;
    calibrated(server, &map, 12).await;
    let measured = eventually(async || {
        let job = server.get(&path).await.expect(200);
        job["estimate"]["confidence"].is_number().then_some(job)
    })
    .await;
    // It had a single candidate, which was compared with none.
    assert_eq!(measured["estimate"]["confidence"], 0.0);
    let page = server.get(&format!("/jobs?map={map}")).await.expect(200);
    assert_eq!(page["jobs"][0]["estimate"], measured["estimate"]);
    let events = server.get(&format!("{path}/events")).await.bytes;
    let events = String::from_utf8(events).unwrap();
    assert!(!events.contains("\"confidence\":null"), "{events}");
}

#[tokio::test]
async fn a_map_is_calibrated_again_when_it_grows() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    calibrated(server, &map, 12).await;
    server.town_more(&map, 12..24).await;
    calibrated(server, &map, 24).await;
}

#[tokio::test]
async fn the_words_of_a_description_follow_from_the_confidence() {
    let (server, map) = shared_server();
    server.town(&map, PLACES).await;
    calibrated(server, &map, PLACES).await;
    for place in (0..6).chain(500..506) {
        let path = format!("/localize?map={map}&refine=wait");
        let answer = server.post_jpeg(&path, frame(place, 0)).await.expect(200);
        let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
        let estimate = &job["estimate"];
        let descriptions = job["descriptions"].as_array().unwrap();
        let is_strong = |description: &&Value| {
            description["text"].as_str().unwrap().contains("Strong agreement: ")
        };
        for description in descriptions.iter().filter(is_strong) {
            // No other candidate agrees as much as a known one, unless it shows the same place.
            assert_eq!(description["image_id"], estimate["image_id"], "place {place}: {job}");
        }
        let first = descriptions.iter().find(|one| one["image_id"] == estimate["image_id"]);
        let is_known = estimate["known"].as_bool().unwrap();
        assert_eq!(is_strong(&first.unwrap()), is_known, "place {place}: {job}");
    }
}
