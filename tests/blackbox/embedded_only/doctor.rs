//! `whereabouts doctor` on healthy and on damaged data folders.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{BINARY, Server, frame, reference};

fn doctor(dir: &Path, args: &[&str]) -> Output {
    Command::new(&*BINARY).arg("doctor").args(args).arg("--data").arg(dir).output().unwrap()
}

/// The report, and the exit code.
fn report(dir: &Path, args: &[&str]) -> (Value, i32) {
    let output = doctor(dir, &[args, &["--json"]].concat());
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    (serde_json::from_slice(&output.stdout).expect(&error), output.status.code().unwrap())
}

/// The findings, one line each.
fn findings(report: &Value) -> Vec<String> {
    let findings = report["findings"].as_array().unwrap().iter();
    findings.map(|finding| format!("{} ({})", finding["what"], finding["advice"])).collect()
}

/// A folder with a map of four places and an ended job.
async fn folder() -> TempDir {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 4).await;
    let answer = server.post_jpeg("/localize?map=m&refine=wait", frame(1, 0)).await.expect(200);
    assert_eq!(answer["job"]["state"], "succeeded");
    assert!(server.terminate().success());
    dir
}

fn blob(dir: &Path, bytes: &[u8]) -> PathBuf {
    let hex = whereabouts_core::Digest::of(bytes).hex();
    dir.join("images").join(&hex[..2]).join(&hex[2..])
}

#[tokio::test]
async fn a_healthy_folder_is_reported_as_healthy() {
    let dir = folder().await;
    let output = doctor(dir.path(), &["--deep"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains("no problems found") && said.contains("m: 4 images, model xfeat"),
        "{said}"
    );
    let (report, code) = report(dir.path(), &[]);
    assert_eq!((code, &report["version"]), (0, &3.into()));
    assert_eq!(report["jobs"]["succeeded"], 1);
    assert_eq!(report["maps"][0]["images"], 4);
    for part in ["db", "descriptors", "images", "free"] {
        assert!(report["sizes"][part].as_u64().unwrap() > 0, "{part} of {report}");
    }
}

#[tokio::test]
async fn orphans_and_derived_files_are_repaired() {
    let dir = folder().await;
    let orphan = blob(dir.path(), b"orphan");
    fs::create_dir_all(orphan.parent().unwrap()).unwrap();
    fs::write(&orphan, b"orphan").unwrap();
    let half = dir.path().join("images/half.tmp");
    fs::write(&half, b"half").unwrap();
    let folder = fs::read_dir(dir.path().join("descriptors")).unwrap().next().unwrap().unwrap();
    let graph = folder.path().join("graph");
    fs::write(&graph, b"torn").unwrap();
    fs::create_dir(dir.path().join("descriptors/nobody")).unwrap();

    let (before, code) = report(dir.path(), &[]);
    assert_eq!(code, 0, "nothing is lost");
    let said = findings(&before).join("\n");
    for word in ["2 files in images/", "graph of m is damaged", "1 folders in descriptors/"] {
        assert!(said.contains(word), "{said}");
    }
    assert!(orphan.exists() && graph.exists(), "looking changes nothing");
    report(dir.path(), &["--repair"]);
    assert!(!orphan.exists() && !half.exists() && !graph.exists());
    assert_eq!(findings(&report(dir.path(), &["--deep"]).0), Vec::<String>::new());
    let server = Server::start(dir.path(), &[]);
    let answer = server.post_jpeg("/localize?map=m&k=1", reference(3)).await.expect(200);
    assert_eq!(answer["candidates"][0]["image_id"], "place-3");
}

#[tokio::test]
async fn lost_data_is_named_with_a_hint() {
    let dir = folder().await;
    fs::remove_file(blob(dir.path(), &reference(2))).unwrap();
    let picture = blob(dir.path(), &reference(1));
    let mut bytes = fs::read(&picture).unwrap();
    bytes[99] ^= 1;
    fs::write(&picture, bytes).unwrap();
    let folder = fs::read_dir(dir.path().join("descriptors")).unwrap().next().unwrap().unwrap();
    let segment = folder.path().join("000000.seg");
    let mut bytes = fs::read(&segment).unwrap();
    bytes[64 + 40] ^= 1;
    fs::write(&segment, bytes).unwrap();

    let (quick, code) = report(dir.path(), &[]);
    assert_eq!((code, findings(&quick).len()), (1, 2));
    let (deep, code) = report(dir.path(), &["--deep", "--repair"]);
    let said = findings(&deep);
    assert_eq!((code, said.len()), (1, 3), "{said:?}");
    assert!(said[0].contains("place-0") && said[0].contains("--reindex --map m"), "{said:?}");
    assert!(said[1].contains("m/place-2") && said[1].contains("restore"), "{said:?}");
    assert!(said[2].contains("m/place-1"), "{said:?}");
}

#[tokio::test]
async fn a_folder_in_use_a_newer_folder_and_a_missing_folder_are_reported() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    let output = doctor(dir.path(), &[]);
    let why = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(why.contains("another process uses") && why.contains("stop it first"), "{why}");
    assert_eq!(output.status.code(), Some(1));
    assert!(server.terminate().success());

    fs::write(dir.path().join("version"), "9").unwrap();
    let (newer, code) = report(dir.path(), &[]);
    assert_eq!(code, 1);
    assert!(findings(&newer)[0].contains("of version 9"), "{newer}");
    fs::remove_file(dir.path().join("version")).unwrap();
    let (older, code) = report(dir.path(), &[]);
    assert_eq!(code, 0);
    assert!(findings(&older)[0].contains("of version 1"), "{older}");

    let output = doctor(&dir.path().join("nothing"), &[]);
    assert!(String::from_utf8_lossy(&output.stderr).contains("there is no data folder"));
    assert!(!dir.path().join("nothing").exists());
}

#[tokio::test]
async fn a_compacted_database_still_serves() {
    let dir = folder().await;
    let (report, code) = report(dir.path(), &["--compact"]);
    assert_eq!(code, 0, "{report}");
    assert!(report["compacted"]["bytes_after"].as_u64().unwrap() > 0);
    let server = Server::start(dir.path(), &[]);
    assert_eq!(server.get("/maps/m").await.expect(200)["images"], 4);
    assert_eq!(server.get("/jobs").await.expect(200)["jobs"].as_array().unwrap().len(), 1);
}
