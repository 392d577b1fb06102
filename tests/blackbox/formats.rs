//! Pictures in the formats of robots, industrial cameras and webcams, wherever pictures are taken.

use std::io::Cursor;
use std::process::{Command, Output};

use image::{DynamicImage, ImageBuffer, ImageFormat, Luma};
use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};
use tempfile::TempDir;

use super::support::{Answer, BINARY, frame, reference, server, shared_server, value_of};

fn decoded(jpeg: &[u8]) -> DynamicImage {
    image::load_from_memory(jpeg).unwrap()
}

fn written(picture: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

/// A grey picture with this many bits in samples of 16.
fn deep(picture: &DynamicImage, bits: u32) -> DynamicImage {
    let grey = picture.to_luma8();
    let sample = |value: u8| (u32::from(value) * ((1 << bits) - 1) / 255) as u16;
    let deep = ImageBuffer::<Luma<u16>, Vec<u16>>::from_fn(grey.width(), grey.height(), |x, y| {
        Luma([sample(grey.get_pixel(x, y)[0])])
    });
    DynamicImage::ImageLuma16(deep)
}

/// One picture in every format: its file name, its media type and its bytes.
fn every_format(jpeg: &[u8]) -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let picture = decoded(jpeg);
    let grey = picture.to_luma8();
    let pgm = format!("P5\n# ROS\n{} {}\n255\n", grey.width(), grey.height());
    let twelve: Vec<u8> =
        deep(&picture, 12).to_luma16().iter().flat_map(|v| v.to_be_bytes()).collect();
    let pgm12 = format!("P5\n{} {}\n4095\n", grey.width(), grey.height());
    vec![
        ("frame.tif", "image/tiff", written(&picture, ImageFormat::Tiff)),
        ("frame.bmp", "image/bmp", written(&picture, ImageFormat::Bmp)),
        ("frame.gif", "image/gif", written(&picture, ImageFormat::Gif)),
        ("frame.ppm", "image/x-portable-anymap", written(&picture, ImageFormat::Pnm)),
        ("frame.pgm", "image/x-portable-anymap", [pgm.as_bytes(), grey.as_raw()].concat()),
        ("twelve.pgm", "image/x-portable-anymap", [pgm12.as_bytes(), &twelve].concat()),
        ("ten.png", "image/png", written(&deep(&picture, 10), ImageFormat::Png)),
        ("twelve.png", "image/png", written(&deep(&picture, 12), ImageFormat::Png)),
        ("twelve.tif", "image/tiff", written(&deep(&picture, 12), ImageFormat::Tiff)),
        ("frame.webp", "image/webp", written(&picture, ImageFormat::WebP)),
    ]
}

/// Bytes in the middle of a JPEG are lost.
fn damaged(jpeg: &[u8]) -> Vec<u8> {
    [&jpeg[..jpeg.len() / 2], &jpeg[jpeg.len() / 2 + 600..]].concat()
}

fn run(args: &[&str]) -> Output {
    Command::new(&*BINARY).args(args).env("WHEREABOUTS_MODEL__NAME", "xfeat").output().unwrap()
}

fn text(output: &Output) -> String {
    [&output.stdout[..], &output.stderr].map(String::from_utf8_lossy).concat()
}

#[tokio::test]
async fn a_frame_finds_its_place_in_every_format() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    let path = format!("/localize?map={map}&refine=off");
    for place in [3, 7] {
        for (name, media_type, bytes) in every_format(&reference(place)) {
            for sent_as in [media_type, "application/octet-stream"] {
                let answer = server.post(&path, sent_as, bytes.clone()).await.expect(200);
                let first = &answer["candidates"][0];
                assert_eq!(first["image_id"], format!("place-{place}"), "{name}: {answer}");
                assert!(first["similarity"].as_f64().unwrap() > 0.9, "{name}: {answer}");
                assert_eq!(answer["warnings"], json!([]));
            }
        }
    }
}

#[tokio::test]
async fn images_are_stored_returned_shown_and_refined_in_every_format() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let mut form = Form::new();
    let pictures: Vec<_> =
        (0..10).flat_map(|place| every_format(&reference(place)).into_iter().nth(place)).collect();
    for (name, _, bytes) in &pictures {
        form = form.part("image", Part::bytes(bytes.clone()).file_name(*name));
    }
    let path = format!("/maps/{map}/images:batch");
    let answer = Answer::of(server.request(Method::POST, &path).multipart(form)).await.expect(200);
    assert_eq!(answer["stored"], 10, "{answer}");
    for (name, media_type, bytes) in &pictures {
        let image = server.get(&format!("/maps/{map}/images/{name}")).await.expect(200);
        assert_eq!(image["media_type"], *media_type);
        let content = server.get(&format!("/maps/{map}/images/{name}/content")).await;
        assert_eq!(content.headers["content-type"], *media_type);
        assert!(content.bytes == *bytes, "{name}");
        // What a browser cannot show is shown as a JPEG, as bright as the picture of 8 bits.
        let path = format!("/maps/{map}/images/{name}/content?max_edge=64");
        let shown = server.get(&path).await;
        assert_eq!(shown.headers["content-type"], "image/jpeg");
        let brightness = |picture: DynamicImage| {
            let grey = picture.to_luma8();
            grey.iter().map(|&v| f64::from(v)).sum::<f64>()
                / f64::from(grey.width() * grey.height())
        };
        let place = pictures.iter().position(|(other, ..)| other == name).unwrap();
        let (got, expected) =
            (brightness(decoded(&shown.bytes)), brightness(decoded(&reference(place))));
        assert!((got - expected).abs() < 4.0, "{name}: {got}, not {expected}");
    }
    // The refiner reads the stored pictures again.
    let (_, media_type, bytes) = every_format(&frame(4, 0)).swap_remove(8);
    let path = format!("/localize?map={map}&refine=wait");
    let answer = server.post(&path, media_type, bytes).await.expect(200);
    assert_eq!(answer["job"]["state"], "succeeded");
    let href = answer["job"]["href"].as_str().unwrap();
    let shown = server.get(&format!("{href}/frame?max_edge=64")).await;
    assert_eq!(shown.headers["content-type"], "image/jpeg");
}

#[tokio::test]
async fn a_folder_of_every_format_is_indexed_and_localized_by_the_commands() {
    let (server, map) = shared_server();
    let folder = TempDir::new().unwrap();
    for (place, (name, _, bytes)) in every_format(&reference(0)).into_iter().enumerate() {
        let bytes =
            if place == 0 { bytes } else { every_format(&reference(place)).swap_remove(place).2 };
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    std::fs::write(folder.path().join("broken.jpg"), damaged(&reference(10))).unwrap();
    let dir = folder.path().to_str().unwrap();
    let indexed = run(&["index", dir, "--map", &map, "--server", &server.url]);
    assert!(indexed.status.success(), "{}", text(&indexed));
    let said = text(&indexed);
    let warning = said.lines().find(|line| line.contains("the JPEG is damaged"));
    assert!(said.contains("11 added"), "{said}");
    assert!(warning.is_some_and(|line| line.ends_with("(1): broken.jpg")), "{said}");
    let file = folder.path().join("twelve.tif");
    let file = file.to_str().unwrap();
    let said = run(&["localize", file, "--map", &map, "--server", &server.url]);
    assert!(said.status.success() && text(&said).contains("twelve.tif"), "{}", text(&said));
    let file = folder.path().join("broken.jpg");
    let said = run(&["localize", file.to_str().unwrap(), "--map", &map, "--server", &server.url]);
    assert!(text(&said).contains("warning: the JPEG is damaged"), "{}", text(&said));
}

#[tokio::test]
async fn a_backup_and_a_reindex_keep_every_format() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    for (name, media_type, bytes) in every_format(&reference(1)) {
        let path = format!("/maps/{map}/images?id={name}");
        server.post(&path, media_type, bytes).await.expect(201);
    }
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("backup.tar");
    let file = file.to_str().unwrap();
    let said = run(&["backup", file, "--map", &map, "--server", &server.url]);
    assert!(said.status.success(), "{}", text(&said));
    let (_dir, other) = self::server();
    let said = run(&["restore", file, "--server", &other.url]);
    assert!(said.status.success(), "{}", text(&said));
    for (name, media_type, bytes) in every_format(&reference(1)) {
        let content = other.get(&format!("/maps/{map}/images/{name}/content")).await;
        assert_eq!(content.headers["content-type"], media_type);
        assert!(content.bytes == bytes, "{name}");
    }
    let said =
        run(&["index", "--reindex", "--map", &map, "--model", "xfeat", "--server", &other.url]);
    assert!(said.status.success(), "{}", text(&said));
}

#[tokio::test]
async fn a_damaged_jpeg_is_taken_with_a_warning_everywhere() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    let told = |answer: &Value| {
        let warning = answer["warnings"][0].as_str().unwrap_or_else(|| panic!("{answer}"));
        assert!(warning.contains("damaged") && warning.contains("again"), "{warning}");
    };
    let bytes = damaged(&frame(5, 0));
    told(&server.post_jpeg(&format!("/localize?map={map}"), bytes.clone()).await.expect(200));
    told(&server.post_jpeg(&format!("/maps/{map}/images?id=d"), bytes.clone()).await.expect(201));
    told(&server.post_jpeg(&format!("/maps/{map}/images?id=d"), bytes.clone()).await.expect(200));
    let form = Form::new().part("image", Part::bytes(bytes.clone()).file_name("e.jpg"));
    let path = format!("/maps/{map}/images:batch");
    let answer = Answer::of(server.request(Method::POST, &path).multipart(form)).await.expect(200);
    assert_eq!(answer["stored"], 1);
    told(&answer["results"][0]);
    let intact = server.post_jpeg(&format!("/maps/{map}/images?id=f"), reference(30)).await;
    assert_eq!(intact.expect(201)["warnings"], json!([]));
    let metrics = server.metrics().await;
    assert!(value_of(&metrics, "whereabouts_damaged_pictures_total").unwrap() >= 4.0);
}

#[tokio::test]
async fn a_jpeg_without_an_end_marker_finds_its_place_and_half_a_jpeg_is_refused() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    let path = format!("/localize?map={map}&refine=off");
    let whole = reference(6);
    let answer = server.post_jpeg(&path, whole[..whole.len() - 2].to_vec()).await.expect(200);
    assert_eq!(answer["candidates"][0]["image_id"], "place-6");
    assert_eq!(answer["warnings"], json!([]));
    let detail = server.post_jpeg(&path, whole[..whole.len() / 2].to_vec()).await.problem(422);
    assert!(detail.contains("truncated"), "{detail}");
}

#[tokio::test]
async fn formats_that_are_not_read_are_refused_with_the_way_to_convert_them() {
    let (server, map) = shared_server();
    server.town(&map, 1).await;
    for (bytes, words) in [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic".as_slice(), ["HEIC", "heif-convert"]),
        (b"\0\0\0\x1Cftypavif\0\0\0\0mif1avif", ["AVIF", "avifdec"]),
        (b"\0\0\0\x20ftypisom\0\0\x02\0", ["video", "ffmpeg"]),
        (b"<!DOCTYPE html>", ["HTML", "where the file comes from"]),
    ] {
        let path = format!("/localize?map={map}");
        // The second is what curl sends if it is told nothing.
        for sent_as in ["application/octet-stream", "application/x-www-form-urlencoded"] {
            let detail = server.post(&path, sent_as, bytes.to_vec()).await.problem(422);
            assert!(words.iter().all(|word| detail.contains(word)), "{detail}");
        }
        let file = TempDir::new().unwrap();
        std::fs::write(file.path().join("a.jpg"), bytes).unwrap();
        let dir = file.path().to_str().unwrap();
        let said = run(&["index", dir, "--map", &map, "--server", &server.url]);
        assert!(text(&said).contains(words[0]), "{}", text(&said));
    }
}
