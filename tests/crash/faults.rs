//! Damaged files, a full disk, a read-only one.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

use super::disk::SmallDisk;
use super::support::{Server, reference};

const GRAPH: (&str, &str) = ("WHEREABOUTS_INDEX__EXACT_UP_TO", "0");

/// All files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let path = entry.path();
        if path.is_dir() { found.extend(files(&path)) } else { found.push(path) }
    }
    found.sort();
    found
}

async fn first_of(server: &Server, place: usize) -> Value {
    let answer = server.post_jpeg("/localize?map=m&refine=off", reference(place)).await;
    answer.expect(200)["candidates"][0]["image_id"].clone()
}

async fn until_graphed(server: &Server) {
    while server.get("/maps/m").await.expect(200)["index"] != "hnsw" {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn a_torn_or_damaged_graph_file_is_built_again() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[GRAPH]);
    server.town("m", 30).await;
    until_graphed(&server).await;
    let graph = |files: Vec<PathBuf>| files.into_iter().find(|file| file.ends_with("graph"));
    // It is written after it is first used.
    let file = loop {
        match graph(files(&dir.path().join("descriptors"))) {
            Some(file) => break file,
            None => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    };
    server.kill();
    let whole = std::fs::read(&file).unwrap();
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 0x10;
    for bytes in [&whole[..whole.len() / 2], &[], &damaged] {
        std::fs::write(&file, bytes).unwrap();
        let server = Server::start(dir.path(), &[GRAPH]);
        assert!(server.log().contains("rebuilding the graph"), "{}", server.log());
        // At once, while it is built, and afterwards.
        assert_eq!(first_of(&server, 7).await, "place-7");
        until_graphed(&server).await;
        assert_eq!(first_of(&server, 7).await, "place-7");
        server.kill();
    }
}

#[tokio::test]
async fn a_damaged_database_loses_nothing_in_silence() {
    const IMAGES: usize = 24;
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", IMAGES).await;
    server.kill();
    let db = dir.path().join("db");
    let original: Vec<(PathBuf, Vec<u8>)> =
        files(&db).into_iter().map(|file| (file.clone(), std::fs::read(file).unwrap())).collect();
    // A start writes files of its own.
    let restore = || {
        std::fs::remove_dir_all(&db).unwrap();
        for (file, bytes) in &original {
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, bytes).unwrap();
        }
    };
    let log = db.join("db");
    let whole = std::fs::read(&log).unwrap();
    let written = whole.iter().rposition(|byte| *byte != 0).unwrap();
    let mut damages: Vec<Vec<u8>> = (0..9)
        .map(|part| {
            let mut damaged = whole.clone();
            let at = written * part / 9;
            damaged[at..at + 40].iter_mut().for_each(|byte| *byte ^= 0xA5);
            damaged
        })
        .collect();
    damages.extend([3, 2].map(|part| whole[..written / part].to_vec()));
    for damaged in damages {
        restore();
        std::fs::write(&log, damaged).unwrap();
        match Server::try_start(dir.path(), &[]) {
            Ok(server) => {
                assert_eq!(server.get("/maps/m").await.expect(200)["images"], IMAGES);
            }
            Err(said) => assert!(said.contains("estore a backup"), "{said}"),
        }
    }
    // What is left can be had by one who says so.
    restore();
    std::fs::write(&log, &whole[..written / 2]).unwrap();
    assert!(Server::try_start(dir.path(), &[]).is_err());
    std::fs::remove_file(dir.path().join("commits")).unwrap();
    let server = Server::start(dir.path(), &[]);
    let images = server.get("/maps/m").await.expect(200)["images"].as_u64().unwrap();
    assert!((1..IMAGES as u64).contains(&images), "{images}");
    assert_eq!(first_of(&server, 0).await, "place-0");
}

#[tokio::test]
async fn a_full_disk_is_said_and_what_was_acknowledged_is_kept() {
    let Some(disk) = SmallDisk::mount(16) else { return };
    let little = ("WHEREABOUTS_DATA__MIN_FREE_BYTES", "4000000");
    let server = Server::start(&disk.data(), &[little]);
    server.put("/maps/m", serde_json::json!({})).await.expect(201);
    let mut stored = 0;
    let why = loop {
        let mut bytes = reference(stored);
        // What follows the end of a JPEG is part of the file, not of the picture.
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
    // Room is made by deleting.
    for place in 0..stored / 2 {
        server.delete(&format!("/maps/m/images/place-{place}")).await.expect(204);
    }
    server.post_jpeg("/maps/m/images?id=late", reference(90)).await.expect(201);
}

#[tokio::test]
async fn a_read_only_folder_is_refused_with_the_reason() {
    let Some(disk) = SmallDisk::mount(64) else { return };
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
