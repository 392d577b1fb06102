//! Several models in one server, and maps that are reindexed from one to another.

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::deployment;
use super::support::{BINARY, Server, frame, reference};
use super::wait::eventually_within;

const XFEAT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/models/xfeat");

/// Models in addition to the built-in one, and a data folder.
struct Bench {
    dir: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self { dir: TempDir::new().unwrap() }
    }

    fn assets(&self) -> PathBuf {
        self.dir.path().join("assets")
    }

    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    /// Installs XFeat with another input size and grid, which gives other descriptors, and with `gem` only.
    fn install(&self, name: &str, (width, height): (u32, u32), grid: usize) {
        let manifest = std::fs::read_to_string(format!("{XFEAT}/manifest.toml")).unwrap();
        let (manifest, _) = manifest.split_once("[descriptors").unwrap();
        let manifest = manifest
            .replace("default_descriptor = \"vlad\"", "")
            .replace("width = 320", &format!("width = {width}"))
            .replace("height = 240", &format!("height = {height}"))
            .replace("dimension = 576", &format!("dimension = {}", 64 * grid * grid));
        let grids = ["grid = [3, 3]", "grid = [\n    3,\n    3,\n]"];
        let manifest = grids
            .iter()
            .fold(manifest, |text, old| text.replace(old, &format!("grid = [{grid}, {grid}]")));
        let file = self.dir.path().join("manifest.toml");
        std::fs::write(&file, manifest).unwrap();
        let output = Command::new(&*BINARY)
            .args(["model", "add", &format!("{XFEAT}/model.onnx"), "--name", name, "--manifest"])
            .arg(&file)
            .arg("--assets")
            .arg(self.assets())
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }

    /// Installs a slow model.
    fn install_slow(&self) {
        self.install("slow", (960, 720), 1);
    }

    fn server(&self, settings: &[(&str, &str)]) -> Server {
        let assets = self.assets();
        let ours = [("WHEREABOUTS_MODEL__ASSETS", assets.to_str().unwrap())];
        Server::start(&self.data(), &[&ours, settings].concat())
    }

    /// Waits until the descriptors of only one model are left. A folder is removed at once; a table once no process
    /// can be using it.
    async fn has_descriptors_of_one_model(&self) {
        let deadline = match deployment::is_scale_out() {
            true => Duration::from_secs(20),
            false => Duration::ZERO,
        };
        eventually_within(deadline, async || {
            let found = match deployment::is_scale_out() {
                true => deployment::descriptor_tables(&self.data()),
                false => std::fs::read_dir(self.data().join("descriptors")).unwrap().count(),
            };
            match found {
                1 => Ok(()),
                _ => Err(format!("there are the descriptors of {found} models")),
            }
        })
        .await;
    }
}

/// Creates a map of this model with the first `places` places.
async fn town(server: &Server, map: &str, model: &str, places: usize) {
    server.put(&format!("/maps/{map}"), json!({ "model": model })).await.expect(201);
    for place in 0..places {
        add(server, map, place).await;
    }
}

async fn add(server: &Server, map: &str, place: usize) {
    let path = format!("/maps/{map}/images?id=place-{place}&lat=45.{place:03}&lon=7");
    server.post_jpeg(&path, reference(place)).await.expect(201);
}

/// The ids of the candidates for the map image of a place, and the model that found them.
async fn look(server: &Server, map: &str, place: usize) -> (Vec<String>, String) {
    let path = format!("/localize?map={map}&refine=off&k=3");
    let answer = server.post_jpeg(&path, reference(place)).await.expect(200);
    let ids = answer["candidates"].as_array().unwrap().iter();
    let ids = ids.map(|candidate| candidate["image_id"].as_str().unwrap().to_owned()).collect();
    (ids, answer["model"].as_str().unwrap().to_owned())
}

#[track_caller]
fn first(found: &(Vec<String>, String), place: usize, model: &str) {
    assert_eq!((found.0[0].as_str(), found.1.as_str()), (&*format!("place-{place}"), model));
}

async fn begin(server: &Server, map: &str, request: Value) -> Value {
    let body = request.to_string().into_bytes();
    server.post(&format!("/maps/{map}/reindex"), "application/json", body).await.expect(202)
}

/// Waits until the reindex of a map has reached the state that `far` describes, and returns the map.
async fn until(server: &Server, map: &str, far: impl Fn(&Value) -> bool) -> Value {
    eventually_within(Duration::from_secs(60), async || {
        let state = server.get(&format!("/maps/{map}")).await.expect(200);
        if far(&state["reindex"]) { Ok(state) } else { Err(state) }
    })
    .await
}

async fn ended(server: &Server, map: &str) -> Value {
    until(server, map, |reindex| reindex["state"] != "running").await
}

async fn in_the_middle(server: &Server, map: &str) -> Value {
    until(server, map, |reindex| reindex["done"].as_u64().unwrap() >= 2).await
}

#[tokio::test]
async fn a_map_keeps_its_kind_of_descriptor_until_a_reindex_names_another() {
    let bench = Bench::new();
    bench.install("xfeat-gem", (320, 240), 3);
    let server = bench.server(&[]);
    let kind = |map: &Value| (map["descriptor"].as_str().unwrap().to_owned(), map["dim"].clone());
    let (gem, vlad) = (("gem".to_owned(), json!(576)), ("vlad".to_owned(), json!(512)));
    let made = json!({"model": "xfeat", "descriptor": "gem"});
    assert_eq!(kind(&server.put("/maps/m", made).await.expect(201)), gem);
    for place in 0..5 {
        add(&server, "m", place).await;
    }
    let changed = server.put("/maps/m", json!({"description": "old"})).await.expect(200);
    assert_eq!(kind(&changed), gem);
    server.put("/maps/m", json!({"descriptor": "vlad"})).await.problem(409);

    begin(&server, "m", json!({})).await;
    assert_eq!(kind(&ended(&server, "m").await), gem);
    begin(&server, "m", json!({"descriptor": "vlad"})).await;
    let moved = ended(&server, "m").await;
    assert_eq!(kind(&moved), vlad);
    for place in 0..5 {
        first(&look(&server, "m", place).await, place, "xfeat");
    }
    // A model that does not have the map's kind computes its default.
    begin(&server, "m", json!({"model": "xfeat-gem"})).await;
    assert_eq!(kind(&ended(&server, "m").await), gem);
    first(&look(&server, "m", 3).await, 3, "xfeat-gem");
}

#[tokio::test]
async fn descriptors_of_pictures_of_another_size_are_never_mixed() {
    let bench = Bench::new();
    bench.install("small", (160, 120), 2);
    let server = bench.server(&[]);
    town(&server, "m", "small", 4).await;
    drop(server);

    // The setting, and then a manifest that crops: each makes another model of it.
    let sizes = ("WHEREABOUTS_MODEL__SIZES", "[\"small=240x160\"]");
    let server = bench.server(&[sizes]);
    let path = "/localize?map=m&refine=off";
    let why = server.post_jpeg(path, reference(2)).await.problem(409);
    assert!(why.contains("stretched to 240×160") && why.contains("model.sizes"), "{why}");
    assert!(why.contains("index --reindex --map m --model small"), "{why}");
    let path = "/maps/m/images?id=more&lat=45.9&lon=7";
    server.post_jpeg(path, reference(9)).await.problem(409);
    begin(&server, "m", json!({})).await;
    assert_eq!(ended(&server, "m").await["reindex"]["state"], "succeeded");
    first(&look(&server, "m", 2).await, 2, "small");
    drop(server);

    // Without the setting the map waits for its model again; with it, nothing has to be done.
    let server = bench.server(&[]);
    server.post_jpeg("/localize?map=m&refine=off", reference(2)).await.problem(409);
    drop(server);
    let server = bench.server(&[sizes]);
    first(&look(&server, "m", 2).await, 2, "small");
}

#[tokio::test]
async fn maps_of_several_models_are_served_with_a_bounded_number_loaded() {
    let bench = Bench::new();
    bench.install("small", (160, 120), 2);
    bench.install("middle", (240, 160), 2);
    let server = bench.server(&[("WHEREABOUTS_MODEL__LOADED", "2")]);
    for (map, model, dim) in [("a", "xfeat", 512), ("b", "small", 256), ("c", "middle", 256)] {
        town(&server, map, model, 4).await;
        let state = server.get(&format!("/maps/{map}")).await.expect(200);
        assert_eq!((&state["model"], &state["dim"]), (&json!(model), &json!(dim)));
        assert!(state["reindex"].is_null());
    }
    for _ in 0..2 {
        for (map, model) in [("a", "xfeat"), ("b", "small"), ("c", "middle")] {
            first(&look(&server, map, 2).await, 2, model);
        }
    }
    assert!(server.log().contains("model evicted"), "{}", server.log());
    // The refiner uses the model of the map, too.
    for (map, model) in [("a", "xfeat"), ("b", "small")] {
        let path = format!("/localize?map={map}&refine=wait");
        let answer = server.post_jpeg(&path, frame(1, 0)).await.expect(200);
        assert_eq!(
            (&answer["job"]["state"], &answer["model"]),
            (&"succeeded".into(), &model.into())
        );
    }
    // A map with images keeps its model, and the error says how to change it.
    server.put("/maps/b", json!({"description": "b"})).await.expect(200);
    let why = server.put("/maps/b", json!({"model": "xfeat"})).await.problem(409);
    assert!(why.contains("--reindex"), "{why}");
    let why = server.put("/maps/d", json!({"model": "no-such-model"})).await.problem(422);
    assert!(why.contains("model add"), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_can_be_searched_and_changed_while_it_is_reindexed() {
    let bench = Bench::new();
    bench.install_slow();
    // A small map with a graph stands for a large one.
    let graph = [("WHEREABOUTS_INDEX__EXACT_UP_TO", "4")];
    let server = bench.server(&graph);
    town(&server, "m", "xfeat", 24).await;
    let begun = begin(&server, "m", json!({"model": "slow"})).await;
    assert_eq!(begun["model"], "xfeat");
    let reindex = &begun["reindex"];
    assert_eq!((&reindex["model"], &reindex["state"]), (&json!("slow"), &json!("running")));
    assert_eq!((&reindex["total"], &reindex["error"]), (&json!(24), &Value::Null));
    let twice = server.post("/maps/m/reindex", "application/json", Vec::new()).await.problem(409);
    assert!(twice.contains("GET /maps/m"), "{twice}");

    in_the_middle(&server, "m").await;
    // Remove images with and without their new descriptor, and add others.
    for place in [0, 9, 23] {
        server.delete(&format!("/maps/m/images/place-{place}")).await.expect(204);
    }
    for place in [0, 30, 31] {
        add(&server, "m", place).await;
    }
    server.put("/maps/m", json!({"description": "in between"})).await.expect(200);

    let (mut models, mut state) = (Vec::new(), json!({"reindex": begun["reindex"]}));
    while state["reindex"]["state"] == "running" {
        let (ids, model) = look(&server, "m", 30).await;
        assert_eq!(ids[0], "place-30");
        models.push(model);
        state = server.get("/maps/m").await.expect(200);
    }
    assert_eq!(state["reindex"]["state"], "succeeded", "{state}");
    assert_eq!(
        (&state["model"], &state["dim"], &state["images"]),
        (&json!("slow"), &json!(64), &json!(24))
    );
    assert_eq!((&state["description"], &state["index"]), (&json!("in between"), &json!("hnsw")));
    assert!(models.iter().filter(|model| *model == "xfeat").count() > 3, "{models:?}");
    assert!(models.is_sorted_by_key(|model| model == "slow"), "{models:?}");

    async fn check(server: &Server) {
        for place in [0, 1, 22, 30, 31] {
            first(&look(server, "m", place).await, place, "slow");
        }
        for place in [9, 23] {
            assert_ne!(look(server, "m", place).await.0[0], format!("place-{place}"));
        }
    }
    check(&server).await;
    bench.has_descriptors_of_one_model().await;
    add(&server, "m", 32).await;
    server.kill();
    let server = bench.server(&graph);
    check(&server).await;
    first(&look(&server, "m", 32).await, 32, "slow");
    let state = server.get("/maps/m").await.expect(200);
    assert_eq!((&state["images"], &state["model"]), (&json!(25), &json!("slow")));
    assert!(!server.log().contains("damaged"), "{}", server.log());
}

#[tokio::test]
async fn images_added_during_a_reindex_are_neither_lost_nor_rejected() {
    let bench = Bench::new();
    bench.install("small", (160, 120), 2);
    let server = bench.server(&[]);
    town(&server, "m", "xfeat", 8).await;
    begin(&server, "m", json!({"model": "small"})).await;
    for place in 8..24 {
        add(&server, "m", place).await;
    }
    let state = ended(&server, "m").await;
    assert_eq!(state["reindex"]["state"], "succeeded", "{state}");
    assert_eq!(state["images"], 24);
    for place in 0..24 {
        first(&look(&server, "m", place).await, place, "small");
    }
}

#[tokio::test]
async fn a_reindex_interrupted_by_kill_9_loses_nothing_and_can_be_run_again() {
    let bench = Bench::new();
    bench.install_slow();
    let soon = [
        ("WHEREABOUTS_DATABASE__TIMEOUT_MS", "1000"),
        ("WHEREABOUTS_DATABASE__LIFETIME_S", "2"),
        ("WHEREABOUTS_JOBS__SWEEP_S", "1"),
    ];
    let server = bench.server(&soon);
    town(&server, "m", "xfeat", 16).await;
    begin(&server, "m", json!({"model": "slow"})).await;
    in_the_middle(&server, "m").await;
    add(&server, "m", 16).await;
    server.kill();

    let server = bench.server(&soon);
    let state = server.get("/maps/m").await.expect(200);
    assert_eq!((&state["model"], &state["images"]), (&json!("xfeat"), &json!(17)));
    assert!(state["reindex"].is_null());
    bench.has_descriptors_of_one_model().await;
    for place in [0, 15, 16] {
        first(&look(&server, "m", place).await, place, "xfeat");
    }
    begin(&server, "m", json!({"model": "slow"})).await;
    assert_eq!(ended(&server, "m").await["model"], "slow");
    first(&look(&server, "m", 16).await, 16, "slow");
}

#[tokio::test]
async fn a_map_whose_model_was_uninstalled_can_move_to_another() {
    let bench = Bench::new();
    bench.install("small", (160, 120), 2);
    let server = bench.server(&[]);
    town(&server, "m", "small", 4).await;
    let answer = server.post_jpeg("/localize?map=m", frame(1, 0)).await.expect(200);
    server.terminate();
    std::fs::remove_dir_all(bench.assets().join("models/small")).unwrap();

    let server = bench.server(&[]);
    for path in ["/localize?map=m&refine=off", "/maps/m/images?id=late"] {
        let why = server.post_jpeg(path, reference(9)).await.problem(409);
        assert!(why.contains("model pull small") && why.contains("--reindex --map m"), "{why}");
    }
    server.put("/maps/m", json!({"scene": "indoor"})).await.expect(200);
    let href = answer["job"]["href"].as_str().unwrap();
    assert_ne!(server.get(&format!("{href}?wait=20")).await.expect(200)["state"], "queued");
    let why = server.post("/maps/m/reindex", "application/json", b"{}".to_vec()).await.problem(422);
    assert!(why.contains("not installed"), "{why}");
    let cls = json!({"model": "xfeat", "descriptor": "cls"}).to_string().into_bytes();
    let why = server.post("/maps/m/reindex", "application/json", cls).await.problem(422);
    assert!(why.contains("no descriptor \"cls\""), "{why}");
    begin(&server, "m", json!({"model": "xfeat"})).await;
    assert_eq!(ended(&server, "m").await["model"], "xfeat");
    first(&look(&server, "m", 3).await, 3, "xfeat");
}

#[tokio::test]
async fn a_reindex_uses_a_model_that_was_reinstalled() {
    let bench = Bench::new();
    bench.install("mine", (160, 120), 2);
    let server = bench.server(&[]);
    town(&server, "m", "mine", 4).await;
    let before = server.get("/maps/m").await.expect(200);
    // The same graph with other metadata, as a later export would have.
    let file = bench.assets().join("models/mine/model.onnx");
    let bytes = [std::fs::read(&file).unwrap(), b"\x32\x05again".to_vec()].concat();
    std::fs::write(&file, &bytes).unwrap();
    let manifest = bench.assets().join("models/mine/manifest.toml");
    let text = std::fs::read_to_string(&manifest).unwrap();
    let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
    std::fs::write(&manifest, unpinned.join("\n")).unwrap();

    // The loaded model still serves; after a restart only the new one exists.
    first(&look(&server, "m", 2).await, 2, "mine");
    server.terminate();
    let server = bench.server(&[]);
    let why = server.post_jpeg("/localize?map=m", frame(1, 0)).await.problem(409);
    assert!(why.contains("--reindex --map m --model mine"), "{why}");
    begin(&server, "m", json!({})).await;
    let after = ended(&server, "m").await;
    assert_eq!(after["reindex"]["state"], "succeeded", "{after}");
    assert_ne!(after["model_digest"], before["model_digest"]);
    first(&look(&server, "m", 2).await, 2, "mine");

    // The same without a restart.
    std::fs::write(&file, [&bytes[..], b"\x32\x07further"].concat()).unwrap();
    begin(&server, "m", json!({"model": "mine"})).await;
    assert_ne!(ended(&server, "m").await["model_digest"], after["model_digest"]);
    first(&look(&server, "m", 2).await, 2, "mine");
}

#[tokio::test]
async fn an_unreadable_image_fails_the_reindex_and_nothing_else() {
    let bench = Bench::new();
    bench.install("small", (160, 120), 2);
    let server = bench.server(&[]);
    town(&server, "m", "xfeat", 4).await;
    let digest = server.get("/maps/m/images/place-2").await.expect(200)["digest"].clone();
    let hex = digest.as_str().unwrap().strip_prefix("sha256:").unwrap().to_owned();
    std::fs::remove_file(bench.data().join("images").join(&hex[..2]).join(&hex[2..])).unwrap();
    begin(&server, "m", json!({"model": "small"})).await;
    let state = ended(&server, "m").await;
    assert_eq!((&state["reindex"]["state"], &state["model"]), (&json!("failed"), &json!("xfeat")));
    let why = state["reindex"]["error"].as_str().unwrap();
    assert!(why.contains("place-2") && why.contains("delete it"), "{why}");
    bench.has_descriptors_of_one_model().await;
    first(&look(&server, "m", 2).await, 2, "xfeat");
    // As the error advises.
    server.delete("/maps/m/images/place-2").await.expect(204);
    begin(&server, "m", json!({"model": "small"})).await;
    assert_eq!(ended(&server, "m").await["model"], "small");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_reindex_command_waits_and_reports_the_result() {
    let bench = Bench::new();
    bench.install_slow();
    let server = bench.server(&[]);
    town(&server, "m", "xfeat", 6).await;
    let run = async |map: &str, more: &[&str]| {
        let mut command = Command::new(&*BINARY);
        command.args(["index", "--reindex", "--map", map, "--server", &server.url]).args(more);
        tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap()
    };
    let done = run("m", &["--model", "slow"]).await;
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(
        done.status.success() && said.contains("6 images") && said.contains("slow"),
        "{done:?}"
    );
    let again = run("m", &["--model", "xfeat", "--json"]).await;
    let state: Value = serde_json::from_slice(&again.stdout).unwrap();
    assert_eq!((&state["model"], &state["reindex"]["done"]), (&json!("xfeat"), &json!(6)));
    for (map, model, word) in [("m", "no-such-model", "model add"), ("n", "slow", "no map")] {
        let failed = run(map, &["--model", model]).await;
        assert_eq!(failed.status.code(), Some(1));
        let said = String::from_utf8_lossy(&failed.stderr);
        assert!(said.contains(word), "{said}");
    }
    let wrong = Command::new(&*BINARY).args(["index", ".", "--reindex", "--map", "m"]).output();
    assert_eq!(wrong.unwrap().status.code(), Some(2));
}
