//! Backup to one file, and restore on this server or another.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use serde_json::{Value, json};
use tempfile::TempDir;
use uuid::Uuid;
use whereabouts_core::{Digest, ExportedImage, Recording};

use super::support::{BINARY, Server, frame, reference, server, shared_server};

fn run(server: &Server, args: &[&str]) -> Output {
    command(server, args).output().unwrap()
}

fn command(server: &Server, args: &[&str]) -> Command {
    let mut command = Command::new(&*BINARY);
    command.args(args).args(["--server", &server.url]);
    command
}

#[track_caller]
fn ok(output: &Output) -> Value {
    assert!(output.status.success(), "{}", error(output));
    serde_json::from_slice(&output.stdout).unwrap_or(Value::Null)
}

#[track_caller]
fn refused(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(1), "{}", error(output));
    error(output)
}

fn error(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn backup(server: &Server, dir: &Path) -> PathBuf {
    let file = dir.join("backup.tar");
    ok(&run(server, &["backup", file.to_str().unwrap(), "--json"]));
    file
}

fn restore(server: &Server, file: &Path) -> Output {
    run(server, &["restore", file.to_str().unwrap(), "--json"])
}

/// The candidates of three frames, each with its similarity.
async fn answers(server: &Server, map: &str) -> Vec<(String, f64)> {
    let mut answers = Vec::new();
    for place in 0..3 {
        let path = format!("/localize?map={map}&refine=off");
        let answer = server.post_jpeg(&path, frame(place, 0)).await.expect(200);
        for candidate in answer["candidates"].as_array().unwrap() {
            let found = json!([candidate["image_id"], candidate["pose"], answer["model"]]);
            answers.push((found.to_string(), candidate["similarity"].as_f64().unwrap()));
        }
    }
    answers
}

/// Two servers may run the model in different ways, so that frames differ in the last bits.
#[track_caller]
fn same(a: &[(String, f64)], b: &[(String, f64)]) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        assert!(a.0 == b.0 && (a.1 - b.1).abs() < 1e-4, "{a:?} {b:?}");
    }
}

/// The images of a map with their descriptors, to the last bit.
async fn images(server: &Server, map: &str) -> Value {
    let mut images =
        server.get(&format!("/maps/{map}/export?limit=1000")).await.expect(200)["images"].take();
    for image in images.as_array_mut().unwrap() {
        // A restored map has the order, but in other words.
        let image = image.as_object_mut().unwrap();
        assert!(image.remove("position").is_some_and(|position| position.is_u64()));
        image.remove("recording");
        // Each server reads its images in its own time.
        assert!(image.remove("texts").is_some());
    }
    images
}

/// The ids of the images of a map in the order of recording, from which the paths of tracks follow.
pub(crate) async fn in_order(server: &Server, map: &str) -> Vec<String> {
    let path = format!("/maps/{map}/export?limit=1000");
    let images = server.get(&path).await.expect(200)["images"].take();
    let mut images: Vec<ExportedImage> = serde_json::from_value(images).unwrap();
    Recording::sort(&mut images, |image| (image.position.unwrap() as usize, image.recording));
    images.into_iter().map(|image| image.image.id.to_string()).collect()
}

#[tokio::test]
async fn a_restored_map_has_its_images_in_the_order_of_recording() {
    let ((a, from), (b, to)) = (server(), server());
    from.put("/maps/m", json!({"scene": "outdoor", "frame": "metric"})).await.expect(201);
    // Neither the ids nor the order of arrival are that of the recordings.
    let drives = [Uuid::now_v7(), Uuid::now_v7()];
    for arrived in 0..30_usize {
        let (drive, number) = (arrived % 3, arrived * 7 % 30);
        let id = Digest::of(&[number as u8]).hex()[..8].to_owned();
        let place = match drives.get(drive) {
            Some(recording) => format!("&recording={recording}&number={number}"),
            None => String::new(),
        };
        let path = format!("/maps/m/images?id={id}&x={number}&y={drive}{place}");
        from.post_jpeg(&path, reference(number)).await.expect(201);
    }
    let before = in_order(&from, "m").await;
    let file = backup(&from, b.path());
    ok(&restore(&to, &file));
    assert_eq!(in_order(&to, "m").await, before);
    // Once more, and what is added later comes last.
    to.post_jpeg("/maps/m/images?id=0&x=99&y=0", reference(40)).await.expect(201);
    let file = backup(&to, a.path());
    ok(&run(&from, &["restore", file.to_str().unwrap(), "--as", "again", "--json"]));
    assert_eq!(in_order(&from, "again").await, [before, vec!["0".to_owned()]].concat());
}

#[tokio::test]
async fn another_server_answers_as_the_first_without_running_the_model() {
    let ((_a, from), (b, to)) = (server(), server());
    from.town("m", 6).await;
    from.put("/maps/indoors", json!({"scene": "indoor", "frame": "metric"})).await.expect(201);
    from.post_jpeg("/maps/indoors/images?id=a%2Fb&x=1.5&y=-2&tags=x,y", reference(9))
        .await
        .expect(201);
    let file = backup(&from, b.path());

    let outcome = ok(&restore(&to, &file));
    assert_eq!(outcome["maps"][0]["added"], 1);
    assert_eq!(outcome["maps"][1]["added"], 6);
    for map in ["m", "indoors"] {
        assert_eq!(images(&to, map).await, images(&from, map).await);
    }
    same(&answers(&to, "m").await, &answers(&from, "m").await);
    let picture = to.get("/maps/m/images/place-3/content").await;
    assert_eq!(picture.bytes, reference(3));
    let state = |map: Value| json!([map["scene"], map["model_digest"], map["created_at"]]);
    let (there, here) = (to.get("/maps/indoors").await, from.get("/maps/indoors").await);
    assert_eq!(state(there.expect(200)), state(here.expect(200)));
    // The model ran only for the three frames above.
    let metrics = to.metrics().await;
    let runs = metrics
        .lines()
        .find(|l| l.starts_with("whereabouts_stage_seconds_count{stage=\"extract\""))
        .unwrap();
    assert!(runs.ends_with(" 3"), "{runs}");
}

#[tokio::test]
async fn a_map_is_restored_without_its_model_and_names_the_missing_model() {
    let ((_a, from), (_b, to)) = (server(), server());
    from.town("m", 1).await;
    let mut page = from.get("/maps/m/export").await.expect(200);
    page["map"]["model"] = "elsewhere".into();
    to.put("/maps/m/import", page["map"].clone()).await.expect(201);
    to.put("/maps/m/import", page["map"].clone()).await.expect(200);
    let meta = json!({"map": page["map"], "image": page["images"][0]}).to_string();
    import(&to, "m", reference(0), meta.clone()).await.expect(201);
    import(&to, "m", reference(0), meta).await.expect(200);
    let why = to.post_jpeg("/localize?map=m", frame(0, 0)).await.problem(409);
    assert!(why.contains("whereabouts model pull elsewhere"), "{why}");
}

#[tokio::test]
async fn restoring_again_adds_only_what_is_missing() {
    let (dir, server) = server();
    server.town("m", 5).await;
    let (file, before) = (backup(&server, dir.path()), answers(&server, "m").await);
    let listed = images(&server, "m").await;
    for id in ["place-1", "place-4"] {
        server.delete(&format!("/maps/m/images/{id}")).await.expect(204);
    }
    let outcome = ok(&restore(&server, &file));
    assert_eq!(
        (&outcome["maps"][0]["added"], &outcome["maps"][0]["present"]),
        (&json!(2), &json!(3))
    );
    let outcome = ok(&restore(&server, &file));
    assert_eq!(
        (&outcome["maps"][0]["added"], &outcome["maps"][0]["present"]),
        (&json!(0), &json!(5))
    );
    same(&answers(&server, "m").await, &before);
    assert_eq!(images(&server, "m").await, listed);

    // An id that has other bytes by now is left alone and reported.
    server.delete("/maps/m/images/place-0").await.expect(204);
    server.post_jpeg("/maps/m/images?id=place-0", reference(70)).await.expect(201);
    let output = restore(&server, &file);
    assert!(refused(&output).contains("ids are taken"));
    let outcome: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(outcome["maps"][0]["conflicts"][0]["id"], "place-0");

    // Under another name nothing conflicts.
    let file = file.to_str().unwrap();
    let outcome = ok(&run(&server, &["restore", file, "--as", "m2", "--json"]));
    assert_eq!(
        (&outcome["maps"][0]["name"], &outcome["maps"][0]["added"]),
        (&json!("m2"), &json!(5))
    );
    same(&answers(&server, "m2").await, &before);
}

#[tokio::test]
async fn a_restore_does_not_mix_descriptors_of_two_models() {
    let ((_a, from), (b, to)) = (server(), server());
    from.town("m", 2).await;
    let file = backup(&from, b.path());
    let mut map = from.get("/maps/m/export").await.expect(200)["map"].take();
    map["model_digest"] = format!("sha256:{}", "0".repeat(64)).into();
    to.put("/maps/m/import", map.clone()).await.expect(201);
    let exported = from.get("/maps/m/export?limit=1").await.expect(200)["images"][0].take();
    let other = json!({"map": map, "image": exported}).to_string();
    import(&to, "m", reference(0), other).await.expect(201);

    let why = refused(&restore(&to, &file));
    assert!(why.contains("restore under another name"), "{why}");
    assert_eq!(to.get("/maps/m").await.expect(200)["images"], 1);
    // The map names the model that it needs, like any map whose model was replaced.
    let why = to.post_jpeg("/localize?map=m", frame(0, 0)).await.problem(409);
    assert!(why.contains("install the former again"), "{why}");
}

async fn import(
    server: &Server,
    map: &str,
    bytes: Vec<u8>,
    meta: String,
) -> super::support::Answer {
    let form = reqwest::multipart::Form::new()
        .part("image", reqwest::multipart::Part::bytes(bytes))
        .text("meta", meta);
    let path = format!("/maps/{map}/import");
    super::support::Answer::of(server.request(reqwest::Method::POST, &path).multipart(form)).await
}

#[tokio::test]
async fn an_inconsistent_import_is_rejected() {
    let (server, map) = shared_server();
    server.town(&map, 2).await;
    let page = server.get(&format!("/maps/{map}/export")).await.expect(200);
    let of = |image: Value| json!({"map": page["map"], "image": image}).to_string();
    let with = |field: &str, value: Value| {
        let mut image = page["images"][0].clone();
        image["image"]["id"] = "new".into();
        image["image"][field] = value;
        of(image)
    };
    import(server, &map, reference(1), with("id", "new".into())).await.problem(422);
    let cases = [
        (with("id", "..".into()), 400),
        (with("media_type", "image/png".into()), 422),
        (with("pose", json!({"lat": 91.0, "lon": 7.0})), 422),
        (with("pose", json!({"x": 1.0, "y": 7.0})), 422),
        (with("tags", vec!["x"; 33].into()), 422),
        (with("id", "place-1".into()), 409),
        ("{".into(), 400),
    ];
    for (meta, status) in cases {
        import(server, &map, reference(0), meta).await.problem(status);
    }
    let mut short = page["images"][0].clone();
    short["image"]["id"] = "new".into();
    short["descriptor"] = "AACAPwAAAAA=".into();
    let why = import(server, &map, reference(0), of(short)).await.problem(422);
    assert!(why.contains("2 numbers"), "{why}");
    for (field, value) in [("dim", json!(0)), ("model", json!("../../etc"))] {
        let mut wrong = page["map"].clone();
        wrong[field] = value;
        server.put(&format!("/maps/{map}-new/import"), wrong).await.problem(422);
    }
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["images"], 2);
    server.get(&format!("/maps/{map}-new")).await.problem(404);
}

#[tokio::test]
async fn a_damaged_or_truncated_archive_is_rejected_before_anything_changes() {
    let ((_a, from), (b, to)) = (server(), server());
    from.town("m", 3).await;
    let file = backup(&from, b.path());
    let bytes = std::fs::read(&file).unwrap();
    let damaged = b.path().join("damaged.tar");
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 1;
    let cases: [(&str, &[u8]); 4] = [
        ("damaged", &flipped),
        ("truncated", &bytes[..bytes.len() - 2000]),
        ("truncated", &bytes[..bytes.len() / 2]),
        ("manifest.json", b"no archive"),
    ];
    for (word, bytes) in cases {
        std::fs::write(&damaged, bytes).unwrap();
        let why = refused(&restore(&to, &damaged));
        assert!(why.contains(word) && why.contains("nothing was changed"), "{why}");
    }
    assert_eq!(to.get("/maps").await.expect(200)["maps"], json!([]));
    let check = |file: &Path| {
        Command::new(&*BINARY).args(["restore", "--check"]).arg(file).output().unwrap()
    };
    assert!(check(&file).status.success());
    assert!(refused(&check(&damaged)).contains("manifest.json"));
}

#[tokio::test]
async fn an_interrupted_backup_is_resumed() {
    let ((a, from), (b, to)) = (server(), server());
    from.town("m", 6).await;
    from.town("n", 2).await;
    let file = backup(&from, b.path());
    let bytes = std::fs::read(&file).unwrap();
    let again = a.path().join("again.tar");
    let partial = a.path().join("again.tar.partial");
    std::fs::write(&partial, &bytes[..bytes.len() / 2]).unwrap();
    // Its id sorts after the point of the interruption, so it is in the archive.
    from.post_jpeg("/maps/m/images?id=place-9", reference(9)).await.expect(201);
    let outcome = ok(&run(&from, &["backup", again.to_str().unwrap(), "--json"]));
    let continued = outcome["continued"].as_u64().unwrap();
    assert!((1..6).contains(&continued), "{outcome}");
    assert_eq!(outcome["images"], 9);
    assert!(!partial.exists());
    ok(&restore(&to, &again));
    for map in ["m", "n"] {
        assert_eq!(images(&to, map).await, images(&from, map).await);
    }
    same(&answers(&to, "m").await, &answers(&from, "m").await);
    let why = refused(&run(&from, &["backup", again.to_str().unwrap()]));
    assert!(why.contains("already exists"), "{why}");

    // If the map was created again meanwhile, the backup starts from the beginning.
    std::fs::write(&partial, &bytes[..bytes.len() / 2]).unwrap();
    std::fs::remove_file(&again).unwrap();
    from.delete("/maps/m").await.expect(204);
    from.town("m", 1).await;
    let output = run(&from, &["backup", again.to_str().unwrap(), "--json"]);
    assert_eq!(ok(&output)["images"], 3);
    assert!(error(&output).contains("from its beginning"), "{}", error(&output));
}

#[tokio::test]
async fn a_restore_is_resumed_after_the_server_was_killed() {
    let (b, from) = server();
    from.town("m", 24).await;
    let (file, before) = (backup(&from, b.path()), answers(&from, "m").await);
    let dir = TempDir::new().unwrap();
    let to = Server::start(dir.path(), &[]);
    let mut restoring = command(&to, &["restore", file.to_str().unwrap(), "--concurrency", "1"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Kill the server as soon as a few images have been restored.
    loop {
        let map = to.get("/maps/m").await;
        if map.status == 200 && map.expect(200)["images"].as_u64().unwrap() > 2 {
            break;
        }
        assert!(restoring.try_wait().unwrap().is_none_or(|status| status.success()));
    }
    to.kill();
    let output = restoring.wait_with_output().unwrap();
    if !output.status.success() {
        assert!(error(&output).contains("The same command adds the rest"), "{}", error(&output));
    }

    let to = Server::start(dir.path(), &[]);
    let outcome = ok(&restore(&to, &file));
    let count = |field: &str| outcome["maps"][0][field].as_u64().unwrap();
    assert!(count("present") > 2, "{outcome}");
    assert_eq!(count("added") + count("present"), 24);
    assert_eq!(images(&to, "m").await, images(&from, "m").await);
    same(&answers(&to, "m").await, &before);
}

#[tokio::test]
async fn a_backup_omits_and_reports_an_image_that_is_damaged_on_the_server() {
    let dir = TempDir::new().unwrap();
    let from = Server::start(dir.path(), &[]);
    from.town("m", 3).await;
    let digest = from.get("/maps/m/images/place-1").await.expect(200)["digest"].take();
    let hex = digest.as_str().unwrap().trim_start_matches("sha256:").to_owned();
    let blob = dir.path().join("images").join(&hex[..2]).join(&hex[2..]);
    let mut bytes = std::fs::read(&blob).unwrap();
    bytes[100] ^= 1;
    std::fs::write(&blob, bytes).unwrap();
    let file = dir.path().join("backup.tar");
    let output = run(&from, &["backup", file.to_str().unwrap(), "--json"]);
    assert!(refused(&output).contains("1 images could not be saved"));
    let outcome: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(outcome["maps"][0]["left_out"][0]["id"], "place-1");
    let (_to, to) = server();
    assert_eq!(ok(&restore(&to, &file))["maps"][0]["added"], 2);
}
