//! `/maps/{map}/images`.

use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::json;

use super::support::{Answer, Server, reference, shared_server};

async fn post_form(server: &Server, path: &str, picture: Vec<u8>, meta: &str) -> Answer {
    let form = Form::new().part("image", Part::bytes(picture)).text("meta", meta.to_owned());
    Answer::of(server.request(Method::POST, path).multipart(form)).await
}

#[tokio::test]
async fn an_image_is_posted_as_a_form_or_raw_with_its_pose_in_the_query() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({"frame": "metric"})).await.expect(201);
    let meta = r#"{"id": "a/1.jpg", "pose": {"x": 1.5, "y": -2}, "tags": ["east"],
                   "captured_at": "2026-01-02T03:04:05Z"}"#;
    let stored =
        post_form(server, &format!("/maps/{map}/images"), reference(0), meta).await.expect(201);
    assert_eq!(stored["id"], "a/1.jpg");
    assert_eq!(stored["pose"], json!({"x": 1.5, "y": -2.0}));
    assert!(stored["digest"].as_str().unwrap().starts_with("sha256:"));
    let raw = &format!("/maps/{map}/images?id=b&x=1&y=2&z=3&tags=one,two");
    let stored = server.post_jpeg(raw, reference(1)).await.expect(201);
    assert_eq!(stored["tags"], json!(["one", "two"]));

    let one = server.get(&format!("/maps/{map}/images/a%2F1.jpg")).await.expect(200);
    assert_eq!(one["captured_at"], "2026-01-02T03:04:05Z");
    assert_eq!((&one["width"], &one["height"]), (&json!(320), &json!(240)));
}

#[tokio::test]
async fn the_same_image_again_is_200_and_other_bytes_are_409() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let first =
        server.post_jpeg(&format!("/maps/{map}/images?id=a"), reference(0)).await.expect(201);
    let again =
        server.post_jpeg(&format!("/maps/{map}/images?id=a"), reference(0)).await.expect(200);
    assert_eq!(first, again);
    server.post_jpeg(&format!("/maps/{map}/images?id=a"), reference(1)).await.problem(409);
    let unnamed = server.post_jpeg(&format!("/maps/{map}/images"), reference(2)).await.expect(201);
    server.post_jpeg(&format!("/maps/{map}/images"), reference(2)).await.expect(200);
    assert_eq!(unnamed["pose"], json!(null));
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["images"], 2);
}

#[tokio::test]
async fn images_are_listed_page_by_page() {
    let (server, map) = shared_server();
    server.town(&map, 5).await;
    let mut seen = Vec::new();
    let mut path = format!("/maps/{map}/images?limit=2");
    loop {
        let page = server.get(&path).await.expect(200);
        let ids = page["images"].as_array().unwrap().iter().map(|image| image["id"].clone());
        seen.extend(ids);
        let Some(cursor) = page["next_cursor"].as_str() else { break };
        path = format!("/maps/{map}/images?limit=2&cursor={cursor}");
    }
    assert_eq!(seen, ["place-0", "place-1", "place-2", "place-3", "place-4"]);
    server.get(&format!("/maps/{map}/images?limit=0")).await.problem(422);
}

#[tokio::test]
async fn a_picture_is_returned_as_sent_or_scaled_down() {
    let (server, map) = shared_server();
    server.town(&map, 1).await;
    let sent = server.get(&format!("/maps/{map}/images/place-0/content")).await;
    assert_eq!(sent.bytes, reference(0));
    assert_eq!(sent.headers["content-type"], "image/jpeg");
    let small = server.get(&format!("/maps/{map}/images/place-0/content?max_edge=64")).await;
    let small = image::load_from_memory(&small.bytes).unwrap();
    assert_eq!((small.width(), small.height()), (64, 48));
    server.get(&format!("/maps/{map}/images/place-0/content?max_edge=1")).await.problem(422);
}

#[tokio::test]
async fn a_deleted_image_is_never_a_candidate_again() {
    let (server, map) = shared_server();
    server.town(&map, 3).await;
    server.delete(&format!("/maps/{map}/images/place-1")).await.expect(204);
    let answer = server
        .post_jpeg(&format!("/localize?map={map}&refine=off"), reference(1))
        .await
        .expect(200);
    let ids: Vec<_> =
        answer["candidates"].as_array().unwrap().iter().map(|c| c["image_id"].clone()).collect();
    assert_eq!(ids.len(), 2);
    assert!(!ids.contains(&json!("place-1")));
    server.get(&format!("/maps/{map}/images/place-1")).await.problem(404);
    server.get(&format!("/maps/{map}/images/place-1/content")).await.problem(404);
    server.delete(&format!("/maps/{map}/images/place-1")).await.problem(404);
    // The id may be used for other bytes.
    server.post_jpeg(&format!("/maps/{map}/images?id=place-1"), reference(7)).await.expect(201);
}

#[tokio::test]
async fn the_pose_time_and_tags_of_an_image_are_patched() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let query = "id=a%2F1&lat=1&lon=2&heading=90&captured_at=2026-05-01T12:00:00Z&tags=x,y";
    server.post_jpeg(&format!("/maps/{map}/images?{query}"), reference(0)).await.expect(201);
    let path = format!("/maps/{map}/images/a%2F1");
    let moved = server.patch(&path, json!({"pose": {"lat": 48.5}})).await.expect(200);
    assert_eq!(moved["changed"], json!(["pose"]));
    assert_eq!(moved["pose"], json!({"lat": 48.5, "lon": 2.0, "heading": 90.0}));
    assert_eq!(moved["captured_at"], "2026-05-01T12:00:00Z");
    let change = json!({"pose": {"heading": null}, "tags": ["z"], "captured_at": 1_777_636_860.5});
    let changed = server.patch(&path, change.clone()).await.expect(200);
    assert_eq!(changed["changed"], json!(["pose", "captured_at", "tags"]));
    let stored = server.get(&path).await.expect(200);
    assert_eq!(stored["pose"], json!({"lat": 48.5, "lon": 2.0}));
    assert_eq!(stored["captured_at"], "2026-05-01T12:01:00.5Z");
    assert_eq!(stored["tags"], json!(["z"]));
    assert_eq!(server.patch(&path, change).await.expect(200)["changed"], json!([]));
    let query = format!("/localize?map={map}&refine=off");
    let answer = server.post_jpeg(&query, reference(0)).await.expect(200);
    assert_eq!(answer["candidates"][0]["pose"], json!({"lat": 48.5, "lon": 2.0}));
    let removed = json!({"pose": null, "tags": null, "captured_at": null});
    let removed = server.patch(&path, removed).await.expect(200);
    assert_eq!(removed["changed"], json!(["pose", "captured_at", "tags"]));
    assert_eq!(removed["pose"], json!(null));
    assert_eq!(removed["tags"], json!([]));
    let export = server.get(&format!("/maps/{map}/export")).await.expect(200);
    assert_eq!(export["images"][0]["image"]["pose"], json!(null));
}

#[tokio::test]
async fn a_patch_that_does_not_fit_changes_nothing() {
    let (server, map) = shared_server();
    server.town(&map, 1).await;
    let path = format!("/maps/{map}/images/place-0");
    let before = server.get(&path).await.expect(200);
    for (patch, status, word) in [
        (json!({"pose": {"lat": 91}}), 422, "lat is 91"),
        (json!({"pose": {"x": 1, "y": 2}}), 422, "unknown field `x`"),
        (json!({"pose": {"lat": null}}), 422, "missing field `lat`"),
        (json!({"pose": {"latitude": 1}}), 400, "latitude"),
        (json!({"pose": 5}), 400, "JSON"),
        (json!({"id": "b"}), 400, "id"),
        (json!({"captured_at": "yesterday"}), 400, "2026-05-01T12:00:00Z"),
        (json!({"tags": [""]}), 422, "tags"),
        (json!([]), 400, "JSON"),
    ] {
        let detail = server.patch(&path, patch.clone()).await.problem(status);
        assert!(detail.contains(word), "{patch}: {detail}");
    }
    assert_eq!(server.get(&path).await.expect(200), before);
    server.patch(&format!("/maps/{map}/images/none"), json!({})).await.problem(404);
    server.patch("/maps/none/images/none", json!({})).await.problem(404);
    assert_eq!(server.patch(&path, json!({})).await.expect(200)["changed"], json!([]));
}

#[tokio::test]
async fn uploading_an_image_again_corrects_what_is_stated_and_keeps_the_rest() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let upload = async |query: &str, status: u16| {
        let path = format!("/maps/{map}/images?id=a&{query}");
        server.post_jpeg(&path, reference(0)).await.expect(status)
    };
    assert_eq!(upload("lat=1&lon=2&heading=3&tags=x", 201).await["changed"], json!([]));
    let moved = upload("lat=5&lon=6", 200).await;
    assert_eq!(moved["changed"], json!(["pose"]));
    assert_eq!(moved["pose"], json!({"lat": 5.0, "lon": 6.0}), "a stated pose is whole");
    assert_eq!(upload("lat=5&lon=6", 200).await["changed"], json!([]));
    let dated = upload("captured_at=1777636800&tags=y", 200).await;
    assert_eq!(dated["changed"], json!(["captured_at", "tags"]));
    let bare = upload("", 200).await;
    assert_eq!(bare["changed"], json!([]));
    assert_eq!(bare["pose"], json!({"lat": 5.0, "lon": 6.0}));
    assert_eq!(bare["tags"], json!(["y"]));
    let form = r#"{"id": "a", "pose": {"lat": 7, "lon": 8}}"#;
    let form = post_form(server, &format!("/maps/{map}/images"), reference(0), form).await;
    assert_eq!(form.expect(200)["changed"], json!(["pose"]));
    let other = format!("/maps/{map}/images?id=a&lat=0&lon=0");
    server.post_jpeg(&other, reference(1)).await.problem(409);
    let stored = server.get(&format!("/maps/{map}/images/a")).await.expect(200);
    assert_eq!(stored["pose"], json!({"lat": 7.0, "lon": 8.0}));
}

#[tokio::test]
async fn a_map_without_poses_changes_its_coordinate_frame() {
    let (server, map) = shared_server();
    let path = format!("/maps/{map}");
    server.put(&path, json!({})).await.expect(201);
    server.post_jpeg(&format!("{path}/images?id=a"), reference(0)).await.expect(201);
    let metric = json!({"frame": "metric"});
    assert_eq!(server.put(&path, metric.clone()).await.expect(200)["frame"], "metric");
    assert_eq!(server.get(&path).await.expect(200)["images"], 1);
    let image = format!("{path}/images/a");
    server.patch(&image, json!({"pose": {"lat": 1, "lon": 2}})).await.problem(422);
    server.patch(&image, json!({"pose": {"x": 1, "y": 2}})).await.expect(200);
    let refused = server.put(&path, json!({"frame": "wgs84"})).await.problem(409);
    assert!(refused.contains("poses"), "{refused}");
    server.put(&path, metric).await.expect(200);
    server.patch(&image, json!({"pose": null})).await.expect(200);
    server.put(&path, json!({"frame": "wgs84"})).await.expect(200);
}
