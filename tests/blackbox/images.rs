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
