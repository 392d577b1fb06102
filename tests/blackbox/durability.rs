//! Acknowledged changes survive a restart, after a clean shutdown as after a kill.

use serde_json::Value;
use tempfile::TempDir;

use super::support::{Server, frame, reference};

#[tokio::test]
async fn everything_is_there_after_kill_9() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 8).await;
    server.delete("/maps/m/images/place-7").await.expect(204);
    let before = server.post_jpeg("/localize?map=m", frame(2, 0)).await.expect(200);
    let list = server.get("/maps/m/images").await.expect(200);
    server.kill();

    let server = Server::start(dir.path(), &[]);
    assert_eq!(server.get("/maps/m/images").await.expect(200), list);
    assert_eq!(server.get("/maps/m").await.expect(200)["images"], 7);
    let after = server.post_jpeg("/localize?map=m&refine=off", frame(2, 0)).await.expect(200);
    same_candidates(&after["candidates"], &before["candidates"]);
    // The job was acknowledged, so one of the two processes finishes it.
    let href = before["job"]["href"].as_str().unwrap();
    let job = server.get(&format!("{href}?wait=30")).await.expect(200);
    assert_eq!(job["state"], "succeeded", "{job}");
    let content = server.get("/maps/m/images/place-3/content").await;
    assert_eq!(content.bytes, reference(3));
}

/// The same images in the same order. Two runs of a model may differ in the last bit.
#[track_caller]
fn same_candidates(a: &Value, b: &Value) {
    let (a, b) = (a.as_array().unwrap(), b.as_array().unwrap());
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        assert_eq!((&a["image_id"], &a["pose"]), (&b["image_id"], &b["pose"]));
        let similarity = |c: &Value| c["similarity"].as_f64().unwrap();
        assert!((similarity(a) - similarity(b)).abs() < 1e-5, "{a} {b}");
    }
}

#[tokio::test]
async fn a_track_goes_on_after_a_restart() {
    let dir = TempDir::new().unwrap();
    let mut server = Server::start(dir.path(), &[]);
    server.town("m", 16).await;
    for place in 0..12 {
        if place == 6 {
            assert!(server.terminate().success());
            server = Server::start(dir.path(), &[]);
        }
        let at = format!("2026-03-01T12:00:{:02}Z", 2 * place);
        let path = format!("/localize?map=m&refine=off&track=r&captured_at={at}");
        let track = server.post_jpeg(&path, frame(place, 0)).await.expect(200)["track"].take();
        assert_eq!(track["frames"], place + 1, "{track}");
    }
    let way = server.get("/maps/m/tracks/r").await.expect(200);
    assert_eq!(way["places"].as_array().unwrap().len(), 12);
}

#[tokio::test]
async fn images_can_be_added_after_a_restart() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 3).await;
    assert!(server.terminate().success());
    let server = Server::start(dir.path(), &[]);
    server.post_jpeg("/maps/m/images?id=late", reference(20)).await.expect(201);
    for (place, id) in [(1, "place-1"), (20, "late")] {
        let answer = server.post_jpeg("/localize?map=m&k=1", reference(place)).await.expect(200);
        assert_eq!(answer["candidates"][0]["image_id"], id);
    }
}

#[tokio::test]
async fn sigterm_drains_and_exits_with_0() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 4).await;
    let answer = server.post_jpeg("/localize?map=m", frame(0, 0)).await.expect(200);
    assert!(server.terminate().success());
    let server = Server::start(dir.path(), &[]);
    let href = answer["job"]["href"].as_str().unwrap();
    let job = server.get(&format!("{href}?wait=30")).await.expect(200);
    assert_eq!(job["state"], "succeeded", "{job}");
}

/// The files of a data folder.
mod embedded_only {
    use serde_json::json;
    use tempfile::TempDir;

    use crate::support::{BINARY, Server, reference};

    #[tokio::test]
    async fn a_second_server_on_the_same_data_folder_does_not_start() {
        let dir = TempDir::new().unwrap();
        let _server = Server::start(dir.path(), &[]);
        let second = std::process::Command::new(&*BINARY)
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(dir.path())
            .output()
            .unwrap();
        assert_eq!(second.status.code(), Some(1));
        let why = String::from_utf8_lossy(&second.stderr).into_owned();
        assert!(why.contains("another process uses the data folder"), "{why}");
    }

    #[tokio::test]
    async fn a_damaged_descriptor_is_skipped_and_reported_and_the_rest_is_found() {
        let dir = TempDir::new().unwrap();
        let server = Server::start(dir.path(), &[]);
        server.town("m", 3).await;
        assert!(server.terminate().success());
        let maps = std::fs::read_dir(dir.path().join("descriptors")).unwrap();
        let segment = maps.map(|map| map.unwrap().path().join("000000.seg")).next().unwrap();
        let mut bytes = std::fs::read(&segment).unwrap();
        // Somewhere inside the second row: header 64, row 16 + 4 × 512 bytes.
        bytes[64 + (16 + 4 * 512) + 500] ^= 0x55;
        std::fs::write(&segment, bytes).unwrap();

        let server = Server::start(dir.path(), &[]);
        assert!(server.log().contains("its descriptor is damaged"));
        let answer = server.post_jpeg("/localize?map=m&refine=off", reference(2)).await.expect(200);
        let ids: Vec<_> = answer["candidates"]
            .as_array()
            .unwrap()
            .iter()
            .map(|c| c["image_id"].clone())
            .collect();
        assert_eq!(ids.len(), 2);
        assert!(!ids.contains(&json!("place-1")), "{ids:?}");
        // As the log says: delete it and add it again.
        server.delete("/maps/m/images/place-1").await.expect(204);
        server.post_jpeg("/maps/m/images?id=place-1", reference(1)).await.expect(201);
        let answer = server.post_jpeg("/localize?map=m&refine=off", reference(1)).await.expect(200);
        assert_eq!(answer["candidates"][0]["image_id"], "place-1");
    }
}
