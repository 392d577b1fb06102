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
async fn confidence_is_0_before_calibration_and_is_calibrated_again_when_a_map_grows() {
    let (server, map) = shared_server();
    server.town(&map, 1).await;
    let answer =
        server.post_jpeg(&format!("/localize?map={map}&refine=off"), frame(0, 0)).await.expect(200);
    assert_eq!(
        (&answer["estimate"]["confidence"], &answer["estimate"]["known"]),
        (&0.0.into(), &false.into())
    );
    server.town_more(&map, 1..12).await;
    calibrated(server, &map, 12).await;
    server.town_more(&map, 12..24).await;
    calibrated(server, &map, 24).await;
}
