//! `/localize`.

use std::time::{Duration, Instant};

use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::json;
use tempfile::TempDir;

use super::support::{Answer, Server, frame, reference, shared_server, value_of};

#[tokio::test]
async fn a_map_image_finds_itself_and_the_response_is_complete() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    let answer =
        server.post_jpeg(&format!("/localize?map={map}&k=3"), reference(4)).await.expect(200);
    let candidates = answer["candidates"].as_array().unwrap();
    assert_eq!(candidates.len(), 3);
    assert_eq!(candidates[0]["image_id"], "place-4");
    assert!(candidates[0]["similarity"].as_f64().unwrap() > 0.9999);
    let ranks: Vec<_> = candidates.iter().map(|c| c["rank"].as_u64().unwrap()).collect();
    assert_eq!(ranks, [1, 2, 3]);
    let similarity = |i: usize| candidates[i]["similarity"].as_f64().unwrap();
    assert!(similarity(0) >= similarity(1) && similarity(1) >= similarity(2));

    assert_eq!(answer["estimate"]["image_id"], "place-4");
    assert_eq!(answer["estimate"]["pose"], json!({"lat": 45.004, "lon": 7.0, "heading": 90.0}));
    // See confidence.rs. It is null until it is measured.
    let confidence = answer["estimate"].get("confidence");
    assert!(confidence.is_some_and(|value| value.is_number() || value.is_null()));
    assert!(answer["estimate"]["known"].is_boolean());
    assert_eq!((&answer["map"], &answer["model"]), (&json!(map), &json!("xfeat")));
    let job = &answer["job"];
    assert_eq!(job["href"], format!("/jobs/{}", job["id"].as_str().unwrap()));
    for stage in ["decode", "extract", "search", "total"] {
        assert!(answer["timing_ms"][stage].as_f64().unwrap() >= 0.0, "{stage}");
    }
}

#[tokio::test]
async fn graph_searches_are_sampled_against_exact_search() {
    let dir = TempDir::new().unwrap();
    let settings = [("WHEREABOUTS_INDEX__EXACT_UP_TO", "0"), ("WHEREABOUTS_INDEX__CHECK_S", "1")];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 12).await;
    let checked =
        |found| format!("whereabouts_neighbours_checked_total{{map=\"m\",found=\"{found}\"}}");
    let deadline = Instant::now() + Duration::from_secs(60);
    // The first searches may come before the graph is built.
    let metrics = loop {
        server.post_jpeg("/localize?map=m&refine=off", reference(4)).await.expect(200);
        let metrics = server.metrics().await;
        if metrics.contains(&checked("yes")) {
            break metrics;
        }
        assert!(Instant::now() < deadline, "{metrics}");
    };
    let value =
        |name: &str| value_of(&metrics, name).unwrap_or_else(|| panic!("{name}: {metrics}"));
    assert!(value(&checked("yes")) >= 10.0, "{metrics}");
    // In a map this small a graph misses nothing.
    assert_eq!(value(&checked("no")), 0.0);
    assert!(value("whereabouts_index_bytes{map=\"m\"}") > 12.0 * 512.0 * 4.0);
    assert!(value("whereabouts_batch_pictures_count") >= 13.0);
    assert_eq!(value("whereabouts_oldest_job_seconds"), 0.0);
}

#[tokio::test]
async fn png_webp_and_forms_are_accepted() {
    let (server, map) = shared_server();
    server.town(&map, 4).await;
    let pixels = image::load_from_memory(&reference(2)).unwrap();
    for (format, media_type) in
        [(image::ImageFormat::Png, "image/png"), (image::ImageFormat::WebP, "image/webp")]
    {
        let mut bytes = std::io::Cursor::new(Vec::new());
        pixels.write_to(&mut bytes, format).unwrap();
        let answer = server
            .post(&format!("/localize?map={map}&refine=off"), media_type, bytes.into_inner())
            .await
            .expect(200);
        assert_eq!(answer["candidates"][0]["image_id"], "place-2", "{media_type}");
        assert!(answer["job"].is_null());
    }
    let form = Form::new().part("image", Part::bytes(reference(3)));
    let request = server.request(Method::POST, &format!("/localize?map={map}")).multipart(form);
    let answer = Answer::of(request).await.expect(200);
    assert_eq!(answer["candidates"][0]["image_id"], "place-3");
}

#[tokio::test]
async fn refine_wait_returns_an_ended_job() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    let answer = server
        .post_jpeg(&format!("/localize?map={map}&refine=wait"), frame(5, 0))
        .await
        .expect(200);
    assert_eq!(answer["job"]["state"], "succeeded");
    let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
    assert_eq!(answer["estimate"]["image_id"], job["ranking"][0]["image_id"]);
    assert_eq!(answer["estimate"], job["estimate"]);
}
