//! Damaged files.

use std::path::{Path, PathBuf};

use serde_json::Value;
use tempfile::TempDir;

use super::support::{Server, reference};
use super::wait::{eventually, until};

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

pub async fn first_of(server: &Server, place: usize) -> Value {
    let answer = server.post_jpeg("/localize?map=m&refine=off", reference(place)).await;
    answer.expect(200)["candidates"][0]["image_id"].clone()
}

async fn until_graphed(server: &Server) {
    until(async || server.get("/maps/m").await.expect(200)["index"] == "hnsw").await;
}

#[tokio::test]
async fn a_truncated_or_damaged_graph_file_is_rebuilt() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[GRAPH]);
    server.town("m", 30).await;
    until_graphed(&server).await;
    let graph = |files: Vec<PathBuf>| files.into_iter().find(|file| file.ends_with("graph"));
    // The graph is written after its first use.
    let file = eventually(async || graph(files(&dir.path().join("descriptors")))).await;
    server.kill();
    let whole = std::fs::read(&file).unwrap();
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 0x10;
    for bytes in [&whole[..whole.len() / 2], &[], &damaged] {
        std::fs::write(&file, bytes).unwrap();
        let server = Server::start(dir.path(), &[GRAPH]);
        assert!(server.log().contains("rebuilding the graph"), "{}", server.log());
        // While the graph is being built, and afterwards.
        assert_eq!(first_of(&server, 7).await, "place-7");
        until_graphed(&server).await;
        assert_eq!(first_of(&server, 7).await, "place-7");
        server.kill();
    }
}

#[tokio::test]
async fn a_damaged_database_loses_nothing_silently() {
    const IMAGES: usize = 24;
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", IMAGES).await;
    server.kill();
    let db = dir.path().join("db");
    let original: Vec<(PathBuf, Vec<u8>)> =
        files(&db).into_iter().map(|file| (file.clone(), std::fs::read(file).unwrap())).collect();
    // A server writes further files when it starts.
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
    // An operator can accept the loss and start with what is left.
    restore();
    std::fs::write(&log, &whole[..written / 2]).unwrap();
    assert!(Server::try_start(dir.path(), &[]).is_err());
    std::fs::remove_file(dir.path().join("commits")).unwrap();
    let server = Server::start(dir.path(), &[]);
    let images = server.get("/maps/m").await.expect(200)["images"].as_u64().unwrap();
    assert!((1..IMAGES as u64).contains(&images), "{images}");
    assert_eq!(first_of(&server, 0).await, "place-0");
}
