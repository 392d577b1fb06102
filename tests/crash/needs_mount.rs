//! A full disk, and a read-only one. `tests/optional.sh` runs these tests where the user may mount a file system.

use super::disk::SmallDisk;
use super::faults::first_of;
use super::support::{Server, reference};

#[tokio::test]
#[ignore = "needs the right to mount a file system"]
async fn a_full_disk_is_reported_and_acknowledged_changes_are_kept() {
    let disk = SmallDisk::mount(16);
    let little = ("WHEREABOUTS_DATA__MIN_FREE_BYTES", "4000000");
    let server = Server::start(&disk.data(), &[little]);
    server.put("/maps/m", serde_json::json!({})).await.expect(201);
    let mut stored = 0;
    let why = loop {
        let mut bytes = reference(stored);
        // Bytes after the end of a JPEG belong to the file, not to the picture.
        bytes.resize(bytes.len() + 200_000, stored as u8);
        let answer = server.post_jpeg(&format!("/maps/m/images?id=place-{stored}"), bytes).await;
        if answer.status != 201 {
            break answer.problem(507);
        }
        stored += 1;
        assert!(stored < 200, "the disk is never full");
    };
    assert!(why.contains("disk") && stored > 3, "{stored}: {why}");
    // It still answers.
    assert_eq!(first_of(&server, 2).await, "place-2");
    let mut frame = reference(1);
    frame.resize(200_000, 0);
    let answer = server.post_jpeg("/localize?map=m", frame).await.expect(200);
    assert_eq!(answer["no_job"]["reason"], "disk_full", "{answer}");
    server.kill();
    let server = Server::start(&disk.data(), &[little]);
    assert_eq!(server.get("/maps/m").await.expect(200)["images"], stored);
    for place in 0..stored {
        assert_eq!(server.get(&format!("/maps/m/images/place-{place}/content")).await.status, 200);
    }
    // Deleting images frees space.
    for place in 0..stored / 2 {
        server.delete(&format!("/maps/m/images/place-{place}")).await.expect(204);
    }
    server.post_jpeg("/maps/m/images?id=late", reference(90)).await.expect(201);
}

#[tokio::test]
#[ignore = "needs the right to mount a file system"]
async fn a_read_only_folder_is_rejected_with_the_reason() {
    let disk = SmallDisk::mount(64);
    let settings = [("WHEREABOUTS_DATA__MIN_FREE_BYTES", "0")];
    let server = Server::start(&disk.data(), &settings);
    server.town("m", 3).await;
    server.kill();
    disk.read_only(true);
    let Err(said) = Server::try_start(&disk.data(), &settings) else { panic!("it cannot write") };
    assert!(said.contains("ead-only"), "{said}");
    disk.read_only(false);
    let server = Server::start(&disk.data(), &settings);
    assert_eq!(server.get("/maps/m").await.expect(200)["images"], 3);
    server.post_jpeg("/maps/m/images?id=late", reference(9)).await.expect(201);
}
