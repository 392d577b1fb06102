//! The commands as a user types them.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use tempfile::TempDir;

use super::backup::in_order;
use super::deployment;
use super::keys::{Guarded, get};
use super::support::{BINARY, Server, frame, reference, server, shared_server};

fn whereabouts(args: &[&str]) -> Output {
    // The built-in model, whatever else is installed in the checkout.
    Command::new(&*BINARY).args(args).env("WHEREABOUTS_MODEL__NAME", "xfeat").output().unwrap()
}

fn json(output: &Output) -> Value {
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(&text).unwrap_or_else(|_| panic!("{text}\n{}", error(output)))
}

fn error(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn write_places(dir: &Path, names: &[&str]) {
    for (place, name) in names.iter().enumerate() {
        let file = dir.join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, reference(place)).unwrap();
    }
}

fn index(server: &Server, dir: &Path, map: &str) -> Output {
    let dir = dir.to_str().unwrap();
    whereabouts(&["index", dir, "--map", map, "--json", "--server", &server.url])
}

#[tokio::test]
async fn indexing_a_folder_again_adds_nothing() {
    let (server, map) = shared_server();
    let folder = TempDir::new().unwrap();
    let names = ["@0100.50@0200.25@.jpg", "north/@0110.50@0200.25@.jpg"];
    write_places(folder.path(), &names);
    let first = json(&index(server, folder.path(), &map));
    assert_eq!((&first["added"], &first["present"]), (&2.into(), &0.into()));
    let again = json(&index(server, folder.path(), &map));
    assert_eq!((&again["added"], &again["present"]), (&0.into(), &2.into()));
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["frame"], "metric");
    let image = server
        .get(&format!("/maps/{map}/images/north%2F%400110.50%400200.25%40.jpg"))
        .await
        .expect(200);
    assert_eq!(image["pose"], serde_json::json!({"x": 110.5, "y": 200.25}));
}

#[tokio::test]
async fn a_folder_is_a_recording_in_the_order_of_its_names() {
    let (server, map) = shared_server();
    let folder = TempDir::new().unwrap();
    let names: Vec<String> = (0..72).map(|place| format!("{place}.jpg")).collect();
    write_places(folder.path(), &names.iter().map(String::as_str).collect::<Vec<_>>());
    // The first arrive last.
    let late = names[..20].iter().map(|name| {
        let path = folder.path().join(name);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, b"no picture").unwrap();
        (path, bytes)
    });
    let late: Vec<_> = late.collect();
    assert_eq!(json(&index(server, folder.path(), &map))["added"], 52);
    late.iter().for_each(|(path, bytes)| std::fs::write(path, bytes).unwrap());
    assert_eq!(json(&index(server, folder.path(), &map))["added"], 20);
    assert_eq!(in_order(server, &map).await, names);
}

#[tokio::test]
async fn poses_come_from_a_csv_and_a_bad_file_fails_alone() {
    let (server, map) = shared_server();
    let folder = TempDir::new().unwrap();
    write_places(folder.path(), &["a.jpg", "b.jpg"]);
    std::fs::write(folder.path().join("c.jpg"), "text").unwrap();
    std::fs::write(folder.path().join("poses.csv"), "file,lat,lon\na.jpg,45.5,7.25\n").unwrap();
    let output = index(server, folder.path(), &map);
    assert_eq!(output.status.code(), Some(1));
    assert!(error(&output).contains("c.jpg"), "{}", error(&output));
    let outcome = json(&output);
    assert_eq!((&outcome["added"], &outcome["without_pose"]), (&2.into(), &1.into()));
    let image = server.get(&format!("/maps/{map}/images/a.jpg")).await.expect(200);
    assert_eq!(image["pose"], serde_json::json!({"lat": 45.5, "lon": 7.25}));
}

#[tokio::test]
async fn a_picture_is_localized_and_its_job_is_shown() {
    let (dir, server) = server();
    server.town("m", 6).await;
    let file = dir.path().join("frame.jpg");
    std::fs::write(&file, frame(2, 0)).unwrap();
    let (file, url) = (file.to_str().unwrap(), server.url.as_str());
    let args = ["localize", file, "--map", "m", "--refine", "--server", url];
    let output = whereabouts(&args);
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    assert!(text.contains("estimate: place-") && text.contains("succeeded"), "{text}");
    let answer = json(&whereabouts(&[&args[..], &["--json"]].concat()));
    let id = answer["job"]["id"].as_str().unwrap();
    let listed = whereabouts(&["jobs", "--map", "m", "--server", url]);
    assert!(String::from_utf8_lossy(&listed.stdout).contains(id));
    let found = json(&whereabouts(&["jobs", "--search", "PLACE-3", "--json", "--server", url]));
    assert_eq!((&found["jobs"][0]["id"], &found["next_cursor"]), (&id.into(), &().into()));
    let none = whereabouts(&["jobs", "--search", "no such thing", "--server", url]);
    assert!(String::from_utf8_lossy(&none.stdout).contains("no job contains that text"));
    let shown = whereabouts(&["jobs", id, "--wait", "10", "--server", url]);
    assert!(String::from_utf8_lossy(&shown.stdout).contains("place-"), "{}", error(&shown));
    assert_eq!(whereabouts(&["healthcheck", "--server", url]).status.code(), Some(0));
}

#[test]
fn an_unreachable_server_is_named_with_a_hint() {
    // Port 9 (discard) of this machine has no listener.
    let url = "http://127.0.0.1:9";
    for args in [&["healthcheck", "--server", url][..], &["jobs", "--server", url]] {
        let output = whereabouts(args);
        assert_eq!(output.status.code(), Some(1));
        assert!(error(&output).contains("whereabouts serve"), "{}", error(&output));
    }
}

#[test]
fn wrong_usage_exits_with_2_and_every_command_has_help() {
    assert_eq!(whereabouts(&["serve", "--no-such-flag"]).status.code(), Some(2));
    assert_eq!(whereabouts(&[]).status.code(), Some(2));
    for command in [
        "serve",
        "index",
        "localize",
        "jobs",
        "model",
        "demo",
        "eval",
        "config",
        "openapi",
        "healthcheck",
    ] {
        let output = whereabouts(&[command, "--help"]);
        assert_eq!(output.status.code(), Some(0), "{command}");
        assert!(output.stdout.len() > 80, "{command}");
    }
}

#[test]
fn a_missing_prerequisite_is_reported_at_startup_with_a_hint() {
    let dir = TempDir::new().unwrap();
    let start = |name: &str, value: &str| {
        let output = Command::new(&*BINARY)
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(dir.path().join("data"))
            .env(name, value)
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1));
        error(&output)
    };
    let missing = start("ORT_DYLIB_PATH", "/no/such/libonnxruntime.so");
    assert!(missing.contains("make build"), "{missing}");
    let model = start("WHEREABOUTS_MODEL__NAME", "no-such-model");
    assert!(model.contains("no-such-model") && model.contains("make build"), "{model}");
    let bad = start("WHEREABOUTS_JOBS__LEASE_S", "1");
    assert!(bad.contains("must outlast"), "{bad}");
    let number = start("WHEREABOUTS_SERVER__MAX_REQUESTS", "many");
    assert!(number.contains("MAX_REQUESTS"), "{number}");
}

#[test]
fn the_demo_runs_and_refinement_helps() {
    let dir = TempDir::new().unwrap();
    let out = dir.path().join("out");
    let out_text = out.to_str().unwrap();
    let args = ["demo", "--places", "40", "--model", "xfeat", "--out", out_text, "--json"];
    let outcome = json(&whereabouts(&args));
    assert_eq!(outcome["queries"], 40);
    let recall = |when: &str| outcome["recall_at_1"][when].as_f64().unwrap();
    assert!((80.0..=97.5).contains(&recall("before")), "{outcome}");
    assert!(recall("after") > recall("before"), "{outcome}");
    let pictures = std::fs::read_dir(out.join("pictures")).unwrap().count();
    assert_eq!(pictures, 40);
    // A folder that no demo has written is left alone.
    let other = dir.path().join("other");
    std::fs::create_dir(&other).unwrap();
    std::fs::write(other.join("thesis.tex"), "years of work").unwrap();
    let refused = whereabouts(&["demo", "--out", other.to_str().unwrap()]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(other.join("thesis.tex").is_file());
}

#[tokio::test]
async fn the_commands_take_the_key_from_the_environment() {
    let Guarded { dir, server, admin, .. } = Guarded::start().await;
    let run = |key: Option<&str>, args: &[&str]| {
        let mut command = Command::new(&*BINARY);
        command.args(args).env("WHEREABOUTS_SERVER", &server.url);
        if let Some(key) = key {
            command.env("WHEREABOUTS_API_KEY", key);
        }
        let output = command.output().unwrap();
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (output.status.success(), text(&output.stdout), text(&output.stderr))
    };
    let (ok, _, said) = run(None, &["jobs"]);
    assert!(!ok && said.contains("keys create"), "{said}");
    let (ok, _, said) = run(Some(&admin), &["jobs"]);
    assert!(ok, "{said}");
    let create = ["keys", "create", "--name", "robot 7", "--role", "robot", "--map", "yard"];
    let (ok, key, said) = run(Some(&admin), &create);
    assert!(ok && key.starts_with("wab_"), "{said}");
    get(&server, key.trim(), "/maps/yard").await.expect(200);
    let (_, listed, _) = run(Some(&admin), &["keys", "list"]);
    assert!(listed.contains("robot 7") && listed.contains("yard"), "{listed}");
    let (ok, _, said) = run(Some(&admin), &["keys", "revoke", &key[4..16]]);
    assert!(ok, "{said}");
    get(&server, key.trim(), "/maps/yard").await.problem(401);
    // The whole token is accepted instead of the id; anything else must not get into a URL.
    let (_, other, _) = run(Some(&admin), &create);
    let (ok, _, said) = run(Some(&admin), &["keys", "revoke", other.trim()]);
    assert!(ok, "{said}");
    get(&server, other.trim(), "/maps/yard").await.problem(401);
    let (ok, _, said) = run(Some(&admin), &["keys", "revoke", "../maps/vault"]);
    assert!(!ok && said.contains("hexadecimal"), "{said}");
    get(&server, &admin, "/maps/vault").await.expect(200);
    let whole = get(&server, &admin, &format!("/keys/{}", other.trim())).await;
    assert!(whole.status.is_client_error());
    assert!(!server.log().contains(&other[20..70]), "a key is in the log");
    // A database is not locked by a server, and needs no folder.
    if !deployment::is_scale_out() {
        let absent = dir.path().join("absent");
        let (ok, _, said) = run(None, &["keys", "list", "--data", absent.to_str().unwrap()]);
        assert!(!ok && said.contains("not a data folder") && !absent.exists(), "{said}");
        // A running server locks its data folder.
        let data = dir.path().to_str().unwrap();
        let (ok, _, said) = run(None, &["keys", "list", "--data", data]);
        assert!(!ok && said.contains("leave --data out"), "{said}");
    }
}

#[test]
fn a_reader_that_leaves_ends_a_command_quietly_and_a_full_disk_with_a_message() {
    for command in [&["openapi"][..], &["model", "list"], &["model", "list", "--json"], &["--help"]]
    {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let run = Command::new(&*BINARY).args(command).stdout(writer).output().unwrap();
        assert_eq!((run.status.code(), error(&run).as_str()), (Some(0), ""), "{command:?}");
    }
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let run = Command::new(&*BINARY).arg("openapi").stdout(full).output().unwrap();
    assert_eq!(run.status.code(), Some(1));
    assert!(error(&run).contains("standard output cannot be written"), "{}", error(&run));
}
