//! Vocabularies of maps' own: fitted in the background, kept over restarts, backups and growth.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::support::{BINARY, Server, frame, reference};
use super::wait::eventually_within;

/// Maps of this many images get a vocabulary.
const PLACES: usize = 12;

fn serve(data: &Path, settings: &[(&str, &str)]) -> Server {
    let ours = [("WHEREABOUTS_VOCABULARY__MIN_IMAGES", "12")];
    Server::start(data, &[&ours, settings].concat())
}

async fn map(server: &Server) -> Value {
    server.get("/maps/m").await.expect(200)
}

/// Waits until the vocabulary of the map is as `wanted` says, and returns the map.
async fn until(server: &Server, wanted: impl Fn(&Value) -> bool) -> Value {
    eventually_within(Duration::from_secs(90), async || {
        let state = map(server).await;
        if wanted(&state["vocabulary"]) { Ok(state) } else { Err(state) }
    })
    .await
}

async fn own(server: &Server) -> Value {
    until(server, |vocabulary| vocabulary["source"] == "own").await
}

async fn reindex(server: &Server, request: Value) -> Value {
    let body = request.to_string().into_bytes();
    server.post("/maps/m/reindex", "application/json", body).await.expect(202);
    eventually_within(Duration::from_secs(60), async || {
        let state = map(server).await;
        if state["reindex"]["state"] == "running" { Err(state) } else { Ok(state) }
    })
    .await
}

/// Finds every place by its frame.
async fn finds_its_places(server: &Server, places: usize) {
    let mut found = 0;
    for place in 0..places {
        let answer = server.post_jpeg("/localize?map=m&refine=off", frame(place, 0)).await;
        let first = answer.expect(200)["candidates"][0]["image_id"].clone();
        found += usize::from(first == format!("place-{place}"));
        let itself = server.post_jpeg("/localize?map=m&refine=off", reference(place)).await;
        let first = itself.expect(200)["candidates"][0].clone();
        assert_eq!(first["image_id"], format!("place-{place}"));
        assert!(first["similarity"].as_f64().unwrap() > 0.999, "{first}");
    }
    assert!(found * 4 >= places * 3, "only {found} of {places} places were found");
}

#[tokio::test]
async fn a_map_with_enough_images_gets_its_own_vocabulary_and_says_so() {
    let dir = TempDir::new().unwrap();
    let server = serve(dir.path(), &[]);
    server.town("m", PLACES - 1).await;
    let before = map(&server).await;
    assert_eq!(before["vocabulary"]["source"], "shipped");
    assert!(before["vocabulary"]["digest"].as_str().unwrap().starts_with("sha256:"), "{before}");
    assert!(before["vocabulary"]["reason"].as_str().unwrap().contains("fewer than 12 images"));
    server.get("/maps/m/vocabulary").await.problem(404);

    server.town_more("m", PLACES - 1..PLACES).await;
    let after = own(&server).await;
    assert_eq!(after["vocabulary"]["images"], PLACES);
    assert_eq!((&after["dim"], &after["reindex"]["state"]), (&before["dim"], &json!("succeeded")));
    assert_ne!(after["model_digest"], before["model_digest"]);
    assert!(
        after["vocabulary"]["fitted_at"].is_string() && after["vocabulary"]["reason"].is_null()
    );
    let bytes = server.get("/maps/m/vocabulary").await.bytes;
    let digest = whereabouts_core::Digest::of(&bytes).to_string();
    assert_eq!(after["vocabulary"]["digest"], digest);
    finds_its_places(&server, PLACES).await;

    // A few more images are found, and do not change it.
    server.town_more("m", PLACES..PLACES + 2).await;
    finds_its_places(&server, PLACES + 2).await;
    assert_eq!(map(&server).await["vocabulary"], after["vocabulary"]);
    // Many do.
    server.town_more("m", PLACES + 2..PLACES + 5).await;
    until(&server, |vocabulary| vocabulary["images"] == PLACES + 5).await;
    finds_its_places(&server, PLACES + 5).await;
    // Frames are refined, and confidence is calibrated, as with any other.
    let path = "/localize?map=m&refine=wait&refiner=local";
    let answer = server.post_jpeg(path, frame(3, 0)).await.expect(200);
    assert_eq!(answer["job"]["state"], "succeeded", "{answer}");
    eventually_within(Duration::from_secs(30), async || {
        let state = map(&server).await;
        if state["calibration"]["images"] == PLACES + 5 { Ok(()) } else { Err(state) }
    })
    .await;
}

#[tokio::test]
async fn with_an_own_vocabulary_places_outside_the_map_are_not_known_at_once() {
    const MAPPED: usize = 48;
    let dir = TempDir::new().unwrap();
    let server = serve(dir.path(), &[("WHEREABOUTS_REFINE__REFINER", "off")]);
    server.town("m", MAPPED).await;
    own(&server).await;
    let state = eventually_within(Duration::from_secs(60), async || {
        let state = map(&server).await;
        if state["calibration"]["images"] == MAPPED { Ok(state) } else { Err(state) }
    })
    .await;
    // Each image was asked about once, by a vocabulary that was fitted without it.
    assert_eq!(state["calibration"]["asked"], MAPPED);
    let mut known = Vec::new();
    for first in [0, 500] {
        let mut count = 0;
        for place in first..first + MAPPED {
            let answer = server.post_jpeg("/localize?map=m&refine=off", frame(place, 0)).await;
            count += usize::from(answer.expect(200)["estimate"]["known"] == true);
        }
        known.push(count);
    }
    assert!(known[0] * 3 >= MAPPED, "only {} of {MAPPED} mapped places are known", known[0]);
    assert!(known[1] * 10 <= MAPPED, "{} of {MAPPED} unknown places are known", known[1]);
}

#[tokio::test]
async fn the_vocabulary_survives_kill_9_and_a_backup_carries_it() {
    let dir = TempDir::new().unwrap();
    let data = dir.path().join("data");
    let server = serve(&data, &[]);
    server.town("m", PLACES).await;
    let fitted = own(&server).await;
    server.kill();
    let server = serve(&data, &[]);
    assert_eq!(map(&server).await["vocabulary"], fitted["vocabulary"]);
    finds_its_places(&server, PLACES).await;

    let file = dir.path().join("backup.tar");
    let run = |server: &Server, command: &str| {
        let output = Command::new(&*BINARY)
            .args([command, file.to_str().unwrap(), "--server", &server.url])
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    run(&server, "backup");
    let other_data = TempDir::new().unwrap();
    let other = serve(other_data.path(), &[("WHEREABOUTS_VOCABULARY__OWN", "false")]);
    run(&other, "restore");
    assert_eq!(map(&other).await["vocabulary"], fitted["vocabulary"]);
    finds_its_places(&other, PLACES).await;
    run(&other, "restore");

    // Without its bytes, or with others, a map is refused.
    let exported = server.get("/maps/m/export?limit=1").await.expect(200)["map"].clone();
    let why = other.put("/maps/copy/import", exported.clone()).await.problem(422);
    assert!(why.contains("vocabulary_data"), "{why}");
    let mut damaged = exported;
    damaged["vocabulary_data"] = json!("AAAA");
    let why = other.put("/maps/copy/import", damaged).await.problem(422);
    assert!(why.contains("digest"), "{why}");
    other.get("/maps/copy").await.problem(404);
}

#[tokio::test]
async fn the_vocabulary_of_the_model_can_be_asked_for_and_an_own_one_again() {
    let dir = TempDir::new().unwrap();
    let server = serve(dir.path(), &[("WHEREABOUTS_VOCABULARY__OWN", "false")]);
    server.town("m", 6).await;
    let shipped = map(&server).await;
    assert!(shipped["vocabulary"]["reason"].as_str().unwrap().contains("vocabulary.own"));

    let fitted = reindex(&server, json!({"vocabulary": "own"})).await;
    assert_eq!(fitted["reindex"]["state"], "succeeded", "{fitted}");
    assert_eq!(
        (&fitted["vocabulary"]["source"], &fitted["vocabulary"]["images"]),
        (&json!("own"), &json!(6))
    );
    finds_its_places(&server, 6).await;
    // A change of the map leaves it.
    server.put("/maps/m", json!({"scene": "indoor"})).await.expect(200);
    assert_eq!(map(&server).await["vocabulary"], fitted["vocabulary"]);

    let back = reindex(&server, json!({"vocabulary": "shipped"})).await;
    assert_eq!(back["vocabulary"]["source"], "shipped", "{back}");
    assert!(back["vocabulary"]["reason"].as_str().unwrap().contains("reindexed"));
    assert_eq!(back["model_digest"], shipped["model_digest"]);
    finds_its_places(&server, 6).await;

    // Other descriptors have none.
    let body = json!({"descriptor": "gem", "vocabulary": "own"}).to_string().into_bytes();
    let why = server.post("/maps/m/reindex", "application/json", body).await.problem(422);
    assert!(why.contains("no vocabulary"), "{why}");
    let gem = reindex(&server, json!({"descriptor": "gem"})).await;
    assert!(gem["vocabulary"].is_null(), "{gem}");
}
