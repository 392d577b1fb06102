//! The version of the data folder.

use std::fs;
use std::process::Command;

use tempfile::TempDir;

use crate::support::{BINARY, Server, frame, reference};

#[tokio::test]
async fn a_folder_without_a_version_is_backed_up_and_migrated() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 3).await;
    let answer = server.post_jpeg("/localize?map=m", frame(1, 0)).await.expect(200);
    let href = answer["job"]["href"].as_str().unwrap().to_owned();
    server.get(&format!("{href}?wait=30")).await.expect(200);
    assert!(server.terminate().success());
    let version = dir.path().join("version");
    assert_eq!(fs::read_to_string(&version).unwrap(), "3\n");
    fs::remove_file(&version).unwrap();

    let server = Server::start(dir.path(), &[]);
    assert!(server.log().contains("the data folder is brought to a newer version"));
    assert!(server.log().contains("the copy may be deleted"));
    assert_eq!(fs::read_to_string(&version).unwrap(), "3\n");
    for version in [2, 3] {
        assert!(dir.path().join(format!("before-version-{version}/db")).is_dir());
    }
    assert_eq!(server.get(&href).await.expect(200)["state"], "succeeded");
    let answer = server.post_jpeg("/localize?map=m&k=1", reference(2)).await.expect(200);
    assert_eq!(answer["candidates"][0]["image_id"], "place-2");
}

#[tokio::test]
async fn a_folder_of_a_newer_version_is_rejected_with_a_hint() {
    let dir = TempDir::new().unwrap();
    assert!(Server::start(dir.path(), &[]).terminate().success());
    fs::write(dir.path().join("version"), "4\n").unwrap();
    let refused = Command::new(&*BINARY)
        .args(["serve", "--listen", "127.0.0.1:0", "--data"])
        .arg(dir.path())
        .output()
        .unwrap();
    assert_eq!(refused.status.code(), Some(1));
    let why = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(why.contains("is of version 4") && why.contains("whereabouts backup"), "{why}");
}
