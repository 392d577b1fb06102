//! Archives as tar writes them: in any order, compressed, and with more in them than pictures.

use std::collections::BTreeMap;
use std::io::Write;

use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::{Value, json};

use super::support::{Server, frame, reference, shared_server};

/// A member of an archive.
#[derive(Clone)]
enum Member {
    File(String, Vec<u8>),
    Link(String),
    Folder(String),
}

fn file(name: &str, bytes: impl Into<Vec<u8>>) -> Member {
    Member::File(name.to_owned(), bytes.into())
}

fn archive(members: &[Member]) -> Vec<u8> {
    let mut builder = tar::Builder::new(Vec::new());
    for member in members {
        let mut header = tar::Header::new_gnu();
        header.set_mode(0o644);
        header.set_size(0);
        match member {
            Member::File(name, bytes) => {
                header.set_size(bytes.len() as u64);
                builder.append_data(&mut header, name, &bytes[..]).unwrap();
            }
            Member::Link(name) => {
                header.set_entry_type(tar::EntryType::Symlink);
                builder.append_link(&mut header, name, "elsewhere.jpg").unwrap();
            }
            Member::Folder(name) => {
                header.set_entry_type(tar::EntryType::Directory);
                builder.append_data(&mut header, name, std::io::empty()).unwrap();
            }
        }
    }
    builder.into_inner().unwrap()
}

async fn send(server: &Server, map: &str, media_type: &str, archive: Vec<u8>) -> Value {
    server.post(&format!("/maps/{map}/images:batch"), media_type, archive).await.expect(200)
}

/// What an answer says, without the order of the members.
fn told(answer: &Value) -> (Vec<String>, Vec<u64>) {
    let line = |result: &Value| {
        let kind = &result["problem"]["kind"];
        format!("{} {} {} {kind}", result["id"], result["outcome"], result["changed"])
    };
    let mut lines: Vec<_> = answer["results"].as_array().unwrap().iter().map(line).collect();
    lines.sort();
    let counts = ["stored", "present", "updated", "failed", "skipped"];
    (lines, counts.iter().map(|count| answer[*count].as_u64().unwrap()).collect())
}

/// What a map contains.
async fn stored(server: &Server, map: &str) -> BTreeMap<String, Value> {
    let page = server.get(&format!("/maps/{map}/images?limit=1000")).await.expect(200);
    let image = |image: &Value| {
        let id = image["id"].as_str().unwrap().to_owned();
        (id, json!([image["digest"], image["pose"], image["tags"], image["captured_at"]]))
    };
    page["images"].as_array().unwrap().iter().map(image).collect()
}

fn shuffled(members: &[Member], seed: u64) -> Vec<Member> {
    let mut members = members.to_vec();
    let mut state = seed;
    for last in (1..members.len()).rev() {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        members.swap(last, (state >> 33) as usize % (last + 1));
    }
    members
}

#[tokio::test]
async fn the_order_of_an_archive_does_not_matter() {
    let (server, prefix) = shared_server();
    let members = [
        Member::Folder("cam".into()),
        file("cam/a.jpg", reference(0)),
        file("cam/a.jpg.json", r#"{"pose": {"lat": 1, "lon": 2}, "tags": ["x"]}"#),
        file("b.jpg", reference(1)),
        file("b.jpg.json", r#"{"id": "gate", "captured_at": 1777636800.5}"#),
        file("c.jpg", reference(2)),
        file("c.jpg.json", r#"{"pose": {"lat": 91, "lon": 2}}"#),
        file("d.jpg", reference(3)),
        file("d.jpg.json", "{"),
        file("e.jpg", reference(4)),
        file("f.jpg", reference(5)),
        file("f.jpg.json", r#"{"pose": {"lat": 3, "lon": 4}}"#),
        file("none.jpg.json", "{}"),
        file("._a.jpg", "not a picture"),
        file("text.jpg", "not a picture"),
        file("text.jpg.json", r#"{"pose": {"lat": 3, "lon": 4}}"#),
        Member::Link("link.jpg".into()),
    ];
    let mut first = None;
    for seed in 0..24 {
        let map = format!("{prefix}-{seed}");
        server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
        let members = if seed == 0 { members.to_vec() } else { shuffled(&members, seed) };
        let answer = send(server, &map, "application/x-tar", archive(&members)).await;
        let images = stored(server, &map).await;
        let again = send(server, &map, "application/x-tar", archive(&members)).await;
        assert_eq!(stored(server, &map).await, images);
        let all = (told(&answer), images, told(&again));
        match &first {
            None => first = Some(all),
            Some(first) => assert_eq!(all, *first, "seed {seed}"),
        }
    }
    let ((lines, counts), images, (_, again)) = first.unwrap();
    assert_eq!(counts, [4, 0, 0, 4, 2], "{lines:?}");
    assert_eq!(again, [0, 4, 0, 4, 2]);
    assert_eq!(lines.len(), 10);
    let ids: Vec<_> = images.keys().map(String::as_str).collect();
    assert_eq!(ids, ["cam/a.jpg", "e.jpg", "f.jpg", "gate"]);
    assert_eq!(images["cam/a.jpg"][1], json!({"lat": 1.0, "lon": 2.0}));
    assert_eq!(images["gate"][3], "2026-05-01T12:00:00.5Z");
}

#[tokio::test]
async fn a_description_changes_an_image_that_is_there_already_wherever_it_comes() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let pictures: Vec<_> =
        (0..5).map(|place| file(&format!("{place}.jpg"), reference(place))).collect();
    let poses = |lat: usize| {
        let pose = move |place| {
            let pose = format!(r#"{{"pose": {{"lat": {lat}, "lon": {place}}}}}"#);
            file(&format!("{place}.jpg.json"), pose)
        };
        (0..5).map(pose).collect::<Vec<_>>()
    };
    let bare = send(server, &map, "application/x-tar", archive(&pictures)).await;
    assert_eq!((&bare["stored"], &bare["updated"]), (&json!(5), &json!(0)));
    for (lat, members) in [
        (1, [pictures.clone(), poses(1)].concat()),
        (2, [poses(2), pictures.clone()].concat()),
        (3, shuffled(&[poses(3), pictures.clone()].concat(), 7)),
    ] {
        let answer = send(server, &map, "application/x-tar", archive(&members)).await;
        assert_eq!((&answer["present"], &answer["updated"]), (&json!(5), &json!(5)), "{answer}");
        assert!(
            answer["results"]
                .as_array()
                .unwrap()
                .iter()
                .all(|one| one["changed"] == json!(["pose"]))
        );
        let images = stored(server, &map).await;
        for (place, image) in images.values().enumerate() {
            assert_eq!(image[1], json!({"lat": lat as f64, "lon": place as f64}));
        }
        let again = send(server, &map, "application/x-tar", archive(&members)).await;
        assert_eq!(again["updated"], 0, "{again}");
    }
    // Without descriptions, the poses stay.
    let bare = send(server, &map, "application/x-tar", archive(&pictures)).await;
    assert_eq!(bare["updated"], 0);
    assert_eq!(stored(server, &map).await["4.jpg"][1], json!({"lat": 3.0, "lon": 4.0}));
}

#[tokio::test]
async fn an_archive_may_be_compressed_and_its_bytes_decide_what_it_is() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let plain = archive(&[file("a.jpg", reference(0)), file("b.jpg", frame(1, 0))]);
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(&plain).unwrap();
    let gzip = encoder.finish().unwrap();
    for (media_type, body) in [
        ("application/x-tar", &plain),
        ("application/x-tar", &gzip),
        ("application/gzip", &gzip),
        ("application/x-gzip", &gzip),
        ("application/octet-stream", &gzip),
        ("application/x-www-form-urlencoded", &plain),
        ("image/jpeg", &plain),
    ] {
        let answer = send(server, &map, media_type, body.clone()).await;
        assert_eq!(answer["results"].as_array().unwrap().len(), 2, "{media_type}: {answer}");
        assert_eq!(answer["failed"], 0);
    }
    let path = format!("/maps/{map}/images:batch");
    let zip = b"PK\x03\x04".repeat(300);
    let refused = server.post(&path, "application/zip", zip).await.problem(415);
    assert!(refused.contains("unpack it") && refused.contains("tar c"), "{refused}");
    let cut = gzip[..gzip.len() / 2].to_vec();
    let refused = server.post(&path, "application/gzip", cut).await.problem(400);
    assert!(refused.contains("cannot be read"), "{refused}");
    let mut bomb = GzEncoder::new(Vec::new(), Compression::best());
    let large = [file("a.jpg", vec![0; 300 << 20])];
    bomb.write_all(&archive(&large)).unwrap();
    let bomb = bomb.finish().unwrap();
    assert!(bomb.len() < 4 << 20);
    let refused = server.post(&path, "application/gzip", bomb).await.problem(400);
    assert!(refused.contains("256 times"), "{refused}");
}

#[tokio::test]
async fn every_member_of_an_archive_has_one_line() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let answer = send(
        server,
        &map,
        "application/x-tar",
        archive(&[
            Member::Folder("cam/".into()),
            Member::Link("cam/link.jpg".into()),
            file("cam/.DS_Store", "x"),
            file("__MACOSX/cam/._a.jpg", "x"),
            file("cam/a.jpg", reference(0)),
            file("cam/a.jpg.json", " ".repeat(70_000)),
            file("poses.json", "{}"),
            file("b.jpg", reference(1)),
            file("b.jpg.json", "{}"),
            file("b.jpg.json", r#"{"pose": {"lat": 1, "lon": 1}}"#),
            file("empty.jpg", ""),
            file(&format!("{}.jpg", "n".repeat(300)), reference(2)),
        ]),
    )
    .await;
    let lines: Vec<_> = answer["results"]
        .as_array()
        .unwrap()
        .iter()
        .map(|result| {
            let word =
                |value: &Value| value.as_str().unwrap_or("-").chars().take(20).collect::<String>();
            (word(&result["id"]), word(&result["outcome"]), word(&result["problem"]["kind"]))
        })
        .collect();
    let expected = [
        ("cam/link.jpg", "skipped", "skipped"),
        ("cam/.DS_Store", "skipped", "skipped"),
        ("__MACOSX/cam/._a.jpg", "skipped", "skipped"),
        ("-", "failed", "too-large"),
        ("-", "failed", "malformed"),
        ("b.jpg", "stored", "-"),
        ("-", "failed", "malformed"),
        ("empty.jpg", "failed", "malformed"),
        ("-", "failed", "malformed"),
    ];
    let expected: Vec<_> =
        expected.map(|(a, b, c)| (a.to_owned(), b.to_owned(), c.to_owned())).into();
    assert_eq!(lines, expected, "{answer}");
    let detail = |at: usize| answer["results"][at]["problem"]["detail"].as_str().unwrap();
    assert!(detail(0).contains("tar ch"), "{answer}");
    assert!(detail(4).contains("poses"), "{answer}");
    assert!(detail(6).contains("twice"), "{answer}");
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["images"], 1);
}
