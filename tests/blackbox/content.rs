//! What clients send besides a well-labelled JPEG: other types, encodings, times and ids, and pixels without a format.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use flate2::Compression;
use flate2::write::{GzEncoder, ZlibEncoder};
use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::json;

use super::support::{Answer, Server, reference, server, shared_server};

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

#[tokio::test]
async fn whatever_the_content_type_says_the_bytes_decide() {
    let (server, map) = shared_server();
    server.town(&map, 2).await;
    let localize = format!("/localize?map={map}&refine=off");
    let upload = format!("/maps/{map}/images?id=place-0");
    for media_type in [
        None,
        Some("image/jpeg"),
        Some("image/jpg"),
        Some("IMAGE/PNG"),
        Some("image/*"),
        Some("image/heic"),
        Some("*/*"),
        Some("application/octet-stream"),
        Some("application/x-www-form-urlencoded"),
        Some("text/plain; charset=utf-8"),
        Some("application/json"),
    ] {
        for path in [&localize, &upload] {
            let mut request = server.request(Method::POST, path).body(reference(0));
            if let Some(media_type) = media_type {
                request = request.header("content-type", media_type);
            }
            let answer = Answer::of(request).await;
            assert_eq!(answer.status, 200, "{media_type:?} {path}: {answer:?}");
        }
        let form = Part::bytes(reference(0)).mime_str(media_type.unwrap_or("x/y")).unwrap();
        let form =
            server.request(Method::POST, &localize).multipart(Form::new().part("image", form));
        Answer::of(form).await.expect(200);
    }
    for (media_type, status) in [
        // A description has a text.
        ("application/json", 400),
        ("text/plain", 415),
        ("application/x-www-form-urlencoded", 400),
        ("multipart/mixed; boundary=x", 415),
        ("multipart/form-data", 400),
        ("image/jpeg", 422),
        ("application/octet-stream", 422),
    ] {
        let text = b"{\"image\": \"no picture\"}".to_vec();
        let refused = server.post(&localize, media_type, text).await.problem(status);
        assert!(!refused.is_empty());
    }
}

#[tokio::test]
async fn compressed_bodies_are_expanded_within_the_limit_of_a_body() {
    let (_dir, server) = server();
    server.town("m", 1).await;
    let post = async |path: &str, encoding: &str, body: Vec<u8>| {
        let request = server.request(Method::POST, path).header("content-encoding", encoding);
        Answer::of(request.header("content-type", "image/jpeg").body(body)).await
    };
    let frame = reference(0);
    let mut zlib = ZlibEncoder::new(Vec::new(), Compression::fast());
    zlib.write_all(&frame).unwrap();
    for (encoding, body) in [
        ("gzip", gzip(&frame)),
        ("x-gzip", gzip(&frame)),
        ("deflate", zlib.finish().unwrap()),
        ("identity", frame.clone()),
    ] {
        for path in ["/localize?map=m&refine=off", "/maps/m/images?id=place-0"] {
            post(path, encoding, body.clone()).await.expect(200);
        }
    }
    for encoding in ["zstd", "br", "gzip, gzip"] {
        let refused = post("/localize?map=m", encoding, frame.clone()).await;
        assert_eq!(refused.headers["accept-encoding"], "gzip, deflate, identity");
        assert!(refused.problem(415).contains("gzip"));
    }
    let damaged = post("/localize?map=m", "gzip", frame.clone()).await.problem(400);
    assert!(damaged.contains("Content-Encoding"), "{damaged}");
    let before = server.resident_bytes();
    let bomb = gzip(&vec![0; 600 << 20]);
    for path in ["/localize?map=m", "/maps/m/images?id=x"] {
        let refused = post(path, "gzip", bomb.clone()).await.problem(413);
        assert!(refused.contains("body_limit_bytes"), "{refused}");
    }
    let grown = server.resident_bytes().saturating_sub(before);
    assert!(grown < 150_000_000, "memory grew by {grown} bytes");
    let patch = server.request(Method::PATCH, "/maps/m/images/place-0");
    let patch = patch.header("content-encoding", "gzip").body(gzip(br#"{"tags": ["x"]}"#));
    assert_eq!(Answer::of(patch).await.expect(200)["changed"], json!(["tags"]));
}

/// Sends a whole request before it reads the answer, as simple clients do. Returns the status.
fn send_first(server: &Server, head: &str, body: usize) -> u16 {
    let address = server.url.strip_prefix("http://").unwrap();
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let head = format!("{head}\r\nhost: x\r\ncontent-length: {body}\r\n\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let chunk = vec![b'x'; 1 << 16];
    let mut left = body;
    while left > 0 {
        let length = left.min(chunk.len());
        stream.write_all(&chunk[..length]).unwrap_or_else(|error| {
            panic!("{head}: the connection broke {left} bytes before the end: {error}")
        });
        left -= length;
    }
    let mut answer = Vec::new();
    let mut buffer = [0; 4096];
    while !answer.windows(4).any(|end| end == b"\r\n\r\n") {
        match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(read) => answer.extend_from_slice(&buffer[..read]),
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => panic!("{head}: {error}"),
        }
    }
    let answer = String::from_utf8_lossy(&answer).into_owned();
    answer
        .split(' ')
        .nth(1)
        .and_then(|status| status.parse().ok())
        .unwrap_or_else(|| panic!("{answer:?}"))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_refusal_reaches_a_client_that_sends_everything_first() {
    let (_dir, server) = server();
    server.town("m", 1).await;
    for (head, body, status) in [
        ("POST /localize?map=m HTTP/1.1\r\ncontent-type: text/plain", 20_000_000, 415),
        ("POST /localize?map=m HTTP/1.1\r\ncontent-type: multipart/mixed", 20_000_000, 415),
        ("POST /localize?map=m HTTP/1.1\r\ncontent-encoding: br", 20_000_000, 415),
        ("POST /localize?map=m HTTP/1.1\r\ncontent-type: multipart/form-data", 20_000_000, 400),
        ("POST /localize?map=m&k=ten HTTP/1.1", 20_000_000, 400),
        ("POST /localize?map=none HTTP/1.1", 20_000_000, 404),
        ("POST /localize?map=m HTTP/1.1\r\nx-deadline-ms: never", 20_000_000, 400),
        ("POST /maps/m/images?id=%ff HTTP/1.1", 20_000_000, 400),
        ("POST /maps/m/images?encoding=rgb9 HTTP/1.1", 20_000_000, 422),
        ("POST /maps/m/images:batch HTTP/1.1\r\ncontent-type: application/zip", 20_000_000, 415),
        ("POST /maps/none/images:batch HTTP/1.1", 20_000_000, 404),
        ("POST /nowhere HTTP/1.1", 20_000_000, 404),
        ("DELETE /localize HTTP/1.1", 20_000_000, 405),
        ("PATCH /maps/m/images/place-0 HTTP/1.1", 20_000_000, 400),
        ("POST /localize?map=m HTTP/1.1", 200_000_000, 413),
        ("POST /localize?map=m HTTP/1.1\r\ncontent-type: image/jpeg", 20_000_000, 422),
    ] {
        let found = tokio::task::block_in_place(|| send_first(&server, head, body));
        assert_eq!(found, status, "{head}");
    }
    server.get("/maps").await.expect(200);
}

#[tokio::test]
async fn times_are_taken_as_robots_and_urls_write_them() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let path = format!("/maps/{map}/images?id=a&captured_at=");
    server.post_jpeg(&format!("{path}2000-01-01T00:00:00Z"), reference(0)).await.expect(201);
    for time in [
        "2026-05-01T14:00:00+02:00",
        "2026-05-01T14:00:00%2B02:00",
        "2026-05-01T14:00:00%2B0200",
        "2026-05-01%2014:00:00+02:00",
        "2026-05-01T12:00:00Z",
        "2026-05-01t12:00:00z",
        "1777636800",
        "1777636800.0",
        "1777636800.000000000",
        "1777636800000",
        "1777636800000000000",
    ] {
        let stored = server.post_jpeg(&format!("{path}{time}"), reference(0)).await.expect(200);
        assert_eq!(stored["captured_at"], "2026-05-01T12:00:00Z", "{time}");
        let track = format!("/localize?map={map}&refine=off&track=t&captured_at={time}");
        let refused = server.post_jpeg(&track, reference(0)).await;
        assert_ne!(refused.status, 400, "{time}: {refused:?}");
    }
    for time in ["yesterday", "2026-05-01T12:00:00", "2026-05-01", "20260501", "17776368000000"] {
        let refused = server.post_jpeg(&format!("{path}{time}"), reference(0)).await.problem(400);
        assert!(refused.contains("captured_at") && refused.contains("1777636800.25"), "{refused}");
    }
    for (meta, expected) in [
        (r#"{"captured_at": 1777636800}"#, "2026-05-01T12:00:00Z"),
        (r#"{"captured_at": 1777636800.125}"#, "2026-05-01T12:00:00.125Z"),
        (r#"{"captured_at": {"sec": 1777636801, "nanosec": 5}}"#, "2026-05-01T12:00:01.000000005Z"),
    ] {
        let form = Form::new().text("meta", meta).part("image", Part::bytes(reference(1)));
        let path = format!("/maps/{map}/images");
        let stored = Answer::of(server.request(Method::POST, &path).multipart(form)).await;
        let stored: serde_json::Value = serde_json::from_slice(&stored.bytes).unwrap();
        assert_eq!(stored["captured_at"], expected, "{meta}");
    }
}

#[tokio::test]
async fn an_id_is_stored_as_it_is_or_refused() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let path = format!("/maps/{map}/images?id=");
    let long = "x".repeat(201);
    for (id, word) in [
        ("%FF.jpg", "\"id\" is not UTF-8"),
        ("a%C3", "UTF-8"),
        ("caf%E9", "UTF-8"),
        (long.as_str(), "1 to 200 bytes"),
        ("", "1 to 200 bytes"),
        ("a%0Ab", "control characters"),
        ("a%00b", "control characters"),
        ("..", "cannot be addressed"),
        ("%20a", "space"),
    ] {
        let refused = server.post_jpeg(&format!("{path}{id}"), reference(0)).await.problem(400);
        assert!(refused.contains(word), "{id}: {refused}");
    }
    let tags = format!("/maps/{map}/images?id=a&tags=%FF");
    assert!(server.post_jpeg(&tags, reference(0)).await.problem(400).contains("\"tags\""));
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["images"], 0);
    let longest = "y".repeat(200);
    for (id, stored) in [
        ("caf%C3%A9%2F1.jpg", "café/1.jpg"),
        ("cam1/0001.jpg", "cam1/0001.jpg"),
        ("100%25", "100%"),
        ("%E6%9D%B1%E4%BA%AC", "東京"),
        (longest.as_str(), longest.as_str()),
    ] {
        let image = server.post_jpeg(&format!("{path}{id}"), reference(0)).await.expect(201);
        assert_eq!(image["id"], stored);
        let segment = id.replace('/', "%2F");
        let image = server.get(&format!("/maps/{map}/images/{segment}")).await.expect(200);
        assert_eq!(image["id"], stored);
    }
    server.get(&format!("/maps/{map}/images/%FF")).await.problem(400);
}

#[tokio::test]
async fn pixels_without_a_file_format_are_localized_like_the_picture() {
    let (server, map) = shared_server();
    server.town(&map, 4).await;
    let rgb = image::load_from_memory(&reference(2)).unwrap().into_rgb8();
    let (width, height) = rgb.dimensions();
    let swapped = |pixel: &image::Rgb<u8>| [pixel.0[2], pixel.0[1], pixel.0[0]];
    let bgr: Vec<u8> = rgb.pixels().flat_map(swapped).collect();
    let bgra: Vec<u8> = rgb.pixels().flat_map(|p| [p.0[2], p.0[1], p.0[0], 255]).collect();
    let grey = image::DynamicImage::from(rgb.clone()).into_luma8();
    let deep: Vec<u8> =
        grey.iter().flat_map(|byte| (u16::from(*byte) * 257).to_le_bytes()).collect();
    let step = width as usize * 3 + 5;
    let padded: Vec<u8> = rgb
        .as_raw()
        .chunks(width as usize * 3)
        .flat_map(|row| row.iter().copied().chain(std::iter::repeat_n(9, 5)))
        .collect();
    let size = format!("width={width}&height={height}");
    for (layout, body) in [
        (format!("encoding=rgb8&{size}"), rgb.as_raw().clone()),
        (format!("encoding=bgr8&{size}"), bgr),
        (format!("encoding=bgra8&{size}"), bgra),
        (format!("encoding=mono8&{size}"), grey.into_raw()),
        (format!("encoding=mono16&{size}"), deep),
        (format!("encoding=rgb8&{size}&step={step}"), padded),
    ] {
        let path = format!("/localize?map={map}&refine=off&{layout}");
        let answer = server.post(&path, "application/octet-stream", body.clone()).await.expect(200);
        assert_eq!(answer["candidates"][0]["image_id"], "place-2", "{layout}");
        assert!(answer["candidates"][0]["similarity"].as_f64().unwrap() > 0.95, "{answer}");
        let path = format!("/maps/{map}/images?{layout}&lat=1&lon=2");
        let stored = server.post(&path, "", body.clone()).await.expect(201);
        assert_eq!((&stored["width"], &stored["height"]), (&json!(width), &json!(height)));
        assert_eq!(stored["media_type"], "image/png");
        let same = server.post(&path, "", body).await.expect(200);
        assert_eq!(same["id"], stored["id"]);
        server
            .delete(&format!("/maps/{map}/images/{}", stored["id"].as_str().unwrap()))
            .await
            .expect(204);
    }
    for (layout, bytes, status, word) in [
        ("encoding=rgb8&width=4&height=4", 47, 422, "are 48"),
        ("encoding=rgb8&width=4&height=4&step=3", 12, 422, "step is 3"),
        ("encoding=yuv422&width=4&height=4", 32, 422, "mono8, mono16"),
        ("encoding=rgb8&width=4", 48, 400, "width and height"),
        ("width=4&height=4", 48, 400, "encoding=rgb8"),
        ("encoding=rgb8&width=-4&height=4", 48, 400, "width"),
        ("encoding=rgb8&width=4000000000&height=4000000000", 48, 422, "image.max_pixels"),
    ] {
        let path = format!("/localize?map={map}&refine=off&{layout}");
        let refused =
            server.post(&path, "application/octet-stream", vec![0; bytes]).await.problem(status);
        assert!(refused.contains(word), "{layout}: {refused}");
    }
}
