//! `/maps`.

use serde_json::json;

use super::deployment;
use super::support::{frame, reference, server, shared_server};

#[tokio::test]
async fn a_map_is_created_changed_listed_and_deleted() {
    let (_dir, server) = server();
    let made =
        server.put("/maps/yard", json!({"scene": "indoor", "frame": "metric"})).await.expect(201);
    assert_eq!(made["scene"], "indoor");
    assert_eq!(made["model"], "xfeat");
    assert_eq!((&made["descriptor"], &made["dim"]), (&json!("vlad"), &json!(512)));
    assert_eq!(made["images"], 0);
    assert_eq!(made["index"], "exact");

    let changed =
        server.put("/maps/yard", json!({"description": "behind the house"})).await.expect(200);
    assert_eq!(changed["description"], "behind the house");
    assert_eq!((&changed["scene"], &changed["frame"]), (&json!("indoor"), &json!("metric")));

    server.put("/maps/attic", json!({})).await.expect(201);
    let list = server.get("/maps").await.expect(200);
    let names: Vec<_> = list["maps"].as_array().unwrap().iter().map(|map| &map["name"]).collect();
    assert_eq!(names, ["attic", "yard"]);

    server.delete("/maps/yard").await.expect(204);
    server.get("/maps/yard").await.problem(404);
    server.delete("/maps/yard").await.problem(404);
}

#[tokio::test]
async fn frame_and_descriptor_are_fixed_once_there_are_images() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({"frame": "metric"})).await.expect(201);
    server.put(&format!("/maps/{map}"), json!({"frame": "wgs84"})).await.expect(200);
    server.post_jpeg(&format!("/maps/{map}/images?lat=1&lon=2"), reference(0)).await.expect(201);
    let why = server.put(&format!("/maps/{map}"), json!({"frame": "metric"})).await.problem(409);
    assert!(why.contains("fixed"), "{why}");
    server.put(&format!("/maps/{map}"), json!({"scene": "indoor"})).await.expect(200);
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["frame"], "wgs84");
}

#[tokio::test]
async fn an_unsupported_descriptor_or_model_is_rejected_with_a_hint() {
    let (server, map) = shared_server();
    let why = server.put(&format!("/maps/{map}"), json!({"descriptor": "cls"})).await.problem(422);
    assert!(why.contains("no descriptor \"cls\"") && why.contains("gem"), "{why}");
    for name in ["GEM", "", "a b", &"a".repeat(25)] {
        let body = json!({ "descriptor": name });
        let why = server.put(&format!("/maps/{map}"), body).await.problem(400);
        assert!(why.contains("kind of descriptor"), "{why}");
    }
    let why =
        server.put(&format!("/maps/{map}"), json!({"model": "dinov2-small"})).await.problem(422);
    assert!(why.contains("model pull dinov2-small"), "{why}");
}

#[tokio::test]
async fn a_map_created_again_under_the_name_of_a_deleted_one_is_empty() {
    let (dir, server) = server();
    server.town("m", 3).await;
    server.delete("/maps/m").await.expect(204);
    server.put("/maps/m", json!({})).await.expect(201);
    assert_eq!(server.get("/maps/m").await.expect(200)["images"], 0);
    let answer = server.post_jpeg("/localize?map=m", frame(0, 0)).await.expect(200);
    assert_eq!(answer["candidates"], json!([]));
    assert!(answer["estimate"].is_null() && answer["job"].is_null());
    // An object store keeps them for a while (objects.keep_unneeded_s); the tests of the stores cover that.
    if !deployment::is_scale_out() {
        let files = walk(&dir.path().join("images"));
        assert_eq!(files, 0, "the bytes of deleted images are removed");
    }
}

fn walk(dir: &std::path::Path) -> usize {
    let entries = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| if path.is_dir() { walk(&path) } else { 1 }).sum()
}
