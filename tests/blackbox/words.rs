//! Signs in jobs, and localization from words alone, over HTTP and the command line.

use std::process::Command;

use serde_json::{Value, json};

use whereabouts_town::{Town, TownScene, TownSpec};

use super::support::{Server, jpeg, reference, server};
use super::wait::eventually;

/// A town with pictures that are large enough to be read.
fn readable(scene: TownScene) -> Town {
    Town::new(TownSpec { scene, places: 40, ..TownSpec::default() })
}

/// Indexes the first places of a town, and waits until their images are read.
async fn index_and_read(server: &Server, map: &str, town: &Town, places: usize) {
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    for place in 0..places {
        let shot = town.reference(place);
        let path = format!("/maps/{map}/images?id=place-{place}&lat=45.{place:03}&lon=7");
        server.post_jpeg(&path, jpeg(&shot.image)).await.expect(201);
    }
    eventually(async || {
        let state = server.get(&format!("/maps/{map}")).await.expect(200);
        (state["texts"]["waiting"] == 0).then_some(())
    })
    .await;
}

async fn said(server: &Server, text: &str) -> Value {
    let body = json!({ "text": text }).to_string();
    server.post("/localize?map=m", "application/json", body.into()).await.expect(200)
}

#[tokio::test]
async fn a_place_is_found_by_the_signs_that_a_description_names() {
    let (_dir, server) = server();
    index_and_read(&server, "m", &readable(TownScene::Streets), 8).await;
    let found = said(&server, "opposite the pharmacy, MARIO'S is on the left").await;
    let first = &found["candidates"][0];
    assert_eq!(first["image_id"], "place-0", "{found}");
    let named: Vec<&Value> =
        first["signs"].as_array().unwrap().iter().map(|sign| &sign["text"]).collect();
    assert_eq!(named, ["pharmacy", "MARIO'S"]);
    assert_eq!(first["signs"][0]["lines"][0]["text"], "PHARMACY");
    assert_eq!(found["estimate"]["image_id"], "place-0");
    assert!(found["estimate"]["pose"].is_object() && found["unread"] == 0);
    let sure = found["estimate"]["probability"].as_f64().unwrap();
    assert!(sure > 0.5 && sure <= 1.0, "{found}");
    assert_eq!(found["estimate"]["known"], sure >= 0.9);
    assert_eq!(found["reason"].is_null(), sure >= 0.9);

    // The same as a parameter, by curl -d, and by the command line.
    let query =
        "/localize?map=m&k=1&text=opposite%20the%20pharmacy%2C%20MARIO%27S%20is%20on%20the%20left";
    let answer = server.post(query, "", Vec::new()).await.expect(200);
    assert_eq!(answer["estimate"], found["estimate"]);
    assert_eq!(answer["candidates"].as_array().unwrap().len(), 1);
    let form = r#" {"text": "opposite the pharmacy, MARIO'S is on the left"}"#;
    let answer =
        server.post("/localize?map=m", "application/x-www-form-urlencoded", form.into()).await;
    assert_eq!(answer.expect(200)["candidates"], found["candidates"]);
    let output = Command::new(env!("CARGO_BIN_EXE_whereabouts"))
        .args(["localize", "--map", "m", "--text", "opposite the pharmacy, MARIO'S", "--server"])
        .arg(&server.url)
        .output()
        .unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(
        printed.contains("  1  ")
            && printed.contains("place-0")
            && printed.contains("PHARMACY / MARIO'S"),
        "{printed}"
    );

    // A name that was read nowhere is evidence against the map.
    let other =
        said(&server, "opposite the pharmacy, MARIO'S is on the left, and ZENITH TYRES").await;
    assert!(other["estimate"]["probability"].as_f64().unwrap() < sure, "{other}");
    assert_eq!(other["signs"][2], json!({"text": "ZENITH TYRES", "is_name": true, "images": 0}));

    // What names nothing of the map is no place, and says so.
    for text in ["“Zenith Tyres” and “Quokka”", "there is a tree on the left", "我在星巴克旁边"]
    {
        let nothing = said(&server, text).await;
        assert_eq!(
            (&nothing["candidates"], &nothing["estimate"]),
            (&json!([]), &Value::Null),
            "{text}"
        );
        assert!(nothing["reason"].as_str().unwrap().starts_with("no "), "{nothing}");
    }

    // A frame is still a frame, whatever its type is called.
    let frame = server.post("/localize?map=m", "application/json", reference(3)).await.expect(200);
    assert!(frame["query_id"].is_string(), "{frame}");
}

#[tokio::test]
async fn a_description_that_cannot_be_answered_is_refused_with_what_to_do() {
    let (_dir, server) = server();
    server.put("/maps/m", json!({})).await.expect(201);
    let json = "application/json";
    for (path, media_type, body, status, why) in [
        ("/localize?map=m", json, r#"{"text": ""}"#, 422, "neither letters nor digits"),
        ("/localize?map=m", json, r#"{"text": "?!"}"#, 422, "neither letters nor digits"),
        ("/localize?map=m", json, r#"{"text": 5}"#, 400, "expected a string"),
        ("/localize?map=m", json, r#"{"words": "a"}"#, 400, "unknown field"),
        ("/localize?map=m", json, "{", 400, "the body is not a description"),
        ("/localize?map=m", json, "[]", 415, "not a picture"),
        ("/localize?map=none", json, r#"{"text": "KAWA"}"#, 404, "no map none"),
        ("/localize?map=m&k=0", json, r#"{"text": "KAWA"}"#, 422, "k is 0"),
        ("/localize?map=m&track=r", json, r#"{"text": "KAWA"}"#, 422, "track is for frames"),
        (
            "/localize?map=m&refine=wait",
            json,
            r#"{"text": "KAWA"}"#,
            422,
            "refine=wait is for frames",
        ),
        ("/localize?map=m&text=KAWA", json, r#"{"text": "KAWA"}"#, 422, "a text and a body"),
    ] {
        let problem = server.post(path, media_type, body.into()).await.problem(status);
        assert!(problem.contains(why), "{path} {body}: {problem}");
    }
    let long = json!({ "text": "kawa ".repeat(200) }).to_string();
    let problem = server.post("/localize?map=m", json, long.into()).await.problem(422);
    assert!(problem.contains("1000 characters, more than 500"), "{problem}");
    // An empty map has nothing to find.
    let empty = said(&server, "KAWA").await;
    assert_eq!((&empty["estimate"], &empty["candidates"]), (&Value::Null, &json!([])));
}

#[tokio::test]
async fn without_a_reader_a_description_is_refused_with_what_to_install() {
    let dir = tempfile::TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[("WHEREABOUTS_READING__READER", "")]);
    server.town("m", 2).await;
    let answer = server.post("/localize?map=m&text=KAWA", "", Vec::new()).await;
    let problem = answer.problem(409);
    assert!(problem.contains("make reader"), "{problem}");
}

#[tokio::test]
async fn equal_shop_fronts_are_told_apart_by_their_signs() {
    const PLACES: usize = 12;
    let (_dir, server) = server();
    let mall = readable(TownScene::Mall);
    index_and_read(&server, "m", &mall, PLACES).await;
    let mut right = 0;
    for place in 0..PLACES {
        let frame = jpeg(&mall.query(place, 0).image);
        let answer = server.post_jpeg("/localize?map=m&refine=wait", frame).await.expect(200);
        let first = &answer["ranking"][0]["image_id"];
        let is_right = *first == format!("place-{place}");
        right += usize::from(is_right);
        assert!(
            is_right || answer["estimate"]["known"] == false,
            "a confident wrong answer: {answer}"
        );
        let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
        let of_first =
            job["descriptions"].as_array().unwrap().iter().find(|one| one["image_id"] == *first);
        let text = of_first.unwrap()["text"].as_str().unwrap();
        assert!(!is_right || text.contains("Both show the sign"), "{text}");
    }
    // By chance it would be one in twelve.
    assert!(right >= PLACES - 2, "{right} of {PLACES} frames were right");
}
