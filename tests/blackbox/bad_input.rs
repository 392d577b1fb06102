//! Bad input gets a clear error, costs little, and leaves the server working.

use futures_util::StreamExt;
use image::RgbImage;
use reqwest::Method;
use serde_json::json;

use super::support::{Answer, Server, jpeg, reference, server, shared_server};

async fn still_works(server: &Server, map: &str) {
    let path = format!("/localize?map={map}&refine=off");
    let answer = server.post_jpeg(&path, reference(0)).await.expect(200);
    assert_eq!(answer["candidates"][0]["image_id"], "place-0");
}

#[tokio::test]
async fn a_body_that_is_not_an_image_is_rejected_and_the_next_frame_is_answered() {
    let (server, map) = shared_server();
    server.town(&map, 2).await;
    let whole = reference(1);
    let text = b"I am not a picture.\n".to_vec();
    for (path, wrong_id) in
        [(&format!("/localize?map={map}"), false), (&format!("/maps/{map}/images?id=x"), true)]
    {
        let cut = server.post_jpeg(path, whole[..whole.len() / 2].to_vec()).await.problem(422);
        assert!(cut.contains("truncated"), "{cut}");
        let no_picture = server.post_jpeg(path, text.clone()).await.problem(422);
        assert!(no_picture.contains("JPEG, PNG, WebP"), "{no_picture}");
        let empty = server.post_jpeg(path, Vec::new()).await.problem(400);
        assert!(empty.contains("empty"), "{empty}");
        let typed = server.post(path, "text/plain", text.clone()).await.problem(415);
        assert!(typed.contains("image/jpeg"), "{typed}");
        if wrong_id {
            server.get(&format!("/maps/{map}/images/x")).await.problem(404);
        }
        still_works(server, &map).await;
    }
}

#[tokio::test]
async fn a_decompression_bomb_is_rejected_by_its_header() {
    let (_dir, server) = server();
    server.town("m", 1).await;
    let mut bomb = std::io::Cursor::new(Vec::new());
    image::GrayImage::new(10_000, 10_000).write_to(&mut bomb, image::ImageFormat::Png).unwrap();
    let bomb = bomb.into_inner();
    assert!(bomb.len() < 1_000_000, "small on the wire");
    let before = server.resident_bytes();
    for _ in 0..5 {
        let why = server.post("/localize?map=m", "image/png", bomb.clone()).await.problem(422);
        assert!(why.contains("10000×10000"), "{why}");
    }
    let grown = server.resident_bytes().saturating_sub(before);
    assert!(grown < 50_000_000, "memory grew by {grown} bytes");
    still_works(&server, "m").await;
}

#[tokio::test]
async fn a_body_of_a_gigabyte_is_rejected_without_being_buffered() {
    let (_dir, server) = server();
    server.town("m", 1).await;
    let before = server.resident_bytes();
    let chunk = bytes::Bytes::from(vec![0xFF; 1 << 20]);
    let endless = move || {
        let chunk = chunk.clone();
        futures_util::stream::iter(0..1024).map(move |_| Ok::<_, std::io::Error>(chunk.clone()))
    };
    // With a content-length, and chunked.
    for length in [Some(1_u64 << 30), None] {
        let mut request = server
            .request(Method::POST, "/localize?map=m")
            .header("content-type", "image/jpeg")
            .body(reqwest::Body::wrap_stream(endless()));
        if let Some(length) = length {
            request = request.header("content-length", length);
        }
        let why = Answer::of(request).await.problem(413);
        assert!(why.contains("body_limit_bytes"), "{why}");
    }
    let grown = server.resident_bytes().saturating_sub(before);
    assert!(grown < 150_000_000, "memory grew by {grown} bytes");
    still_works(&server, "m").await;
}

#[tokio::test]
async fn a_parameter_out_of_range_is_named_in_the_error() {
    let (server, map) = shared_server();
    server.town(&map, 1).await;
    for (path, status, named) in [
        ("/localize?map=MAP&k=0", 422, "k is 0"),
        ("/localize?map=MAP&k=1000000", 422, "between 1 and 100"),
        ("/localize?map=MAP&k=-1", 400, "k"),
        ("/localize?map=MAP&k=ten", 400, "k"),
        ("/localize?map=nowhere", 404, "no map nowhere"),
        ("/localize", 400, "map"),
        ("/localize?map=MAP&refine=maybe", 400, "refine"),
        ("/localize?map=MAP&colour=red", 400, "colour"),
        ("/localize?map=..%2Fetc", 400, "map name"),
        ("/maps/MAP/images?id=p&lat=91&lon=0", 422, "lat is 91"),
        ("/maps/MAP/images?id=p&lat=NaN&lon=0", 422, "lat"),
        ("/maps/MAP/images?id=p&x=1&y=2", 422, "lat, lon"),
        ("/maps/MAP/images?id=p&lat=1", 422, "lon"),
        ("/maps/nowhere/images", 404, "no map nowhere"),
    ] {
        let why = server.post_jpeg(&path.replace("MAP", &map), reference(1)).await.problem(status);
        assert!(why.contains(named), "{path}: {why}");
    }
    server.get(&format!("/maps/{map}/images/p")).await.problem(404);
    still_works(server, &map).await;
}

#[tokio::test]
async fn json_of_another_schema_is_rejected() {
    let (server, map) = shared_server();
    for body in [json!({"scene": "underwater"}), json!({"seen": 1}), json!([1]), json!("x")] {
        server.put(&format!("/maps/{map}"), body).await.problem(400);
    }
    let request = server.request(Method::PUT, &format!("/maps/{map}")).body("{");
    Answer::of(request).await.problem(400);
    server.get(&format!("/maps/{map}")).await.problem(404);
}

#[tokio::test]
async fn an_unknown_path_or_method_points_to_the_docs() {
    let (server, _) = shared_server();
    assert!(server.get("/nothing").await.problem(404).contains("/docs"));
    assert!(server.delete("/localize").await.problem(405).contains("/docs"));
}

#[tokio::test]
async fn a_picture_without_texture_is_answered_or_rejected_and_breaks_nothing() {
    let (server, map) = shared_server();
    server.town(&map, 2).await;
    for pixels in [RgbImage::new(64, 64), RgbImage::new(1, 1), RgbImage::new(4000, 1)] {
        let answer =
            server.post_jpeg(&format!("/localize?map={map}&refine=wait"), jpeg(&pixels)).await;
        assert!(matches!(answer.status.as_u16(), 200 | 422), "{answer:?}");
    }
    still_works(server, &map).await;
}
