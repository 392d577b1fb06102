//! Requests with an `Idempotency-Key` that are sent again.

use std::time::Duration;

use reqwest::Method;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::support::{Answer, Server, frame, reference, shared_server};
use super::wait::eventually;

async fn post(server: &Server, path: &str, key: &str, picture: Vec<u8>) -> Answer {
    let request = server.request(Method::POST, path).header("content-type", "image/jpeg");
    Answer::of(request.header("idempotency-key", key).body(picture)).await
}

fn is_replay(answer: &Answer) -> bool {
    answer.headers.get("idempotent-replayed").is_some_and(|value| value == "true")
}

async fn jobs(server: &Server, map: &str) -> usize {
    server.get(&format!("/jobs?map={map}")).await.expect(200)["jobs"].as_array().unwrap().len()
}

#[tokio::test]
async fn a_repeated_request_gets_the_stored_response_even_after_a_kill() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 3).await;
    let first = post(&server, "/localize?map=m", "frame-1", frame(0, 0)).await;
    let again = post(&server, "/localize?map=m", "frame-1", frame(0, 0)).await;
    assert_eq!(first.expect(200), again.expect(200));
    assert!(!is_replay(&first) && is_replay(&again));
    assert_eq!(again.headers["content-type"], "application/json");
    assert_ne!(first.headers["x-request-id"], again.headers["x-request-id"]);
    assert_eq!(jobs(&server, "m").await, 1);
    let other = post(&server, "/localize?map=m", "frame-2", frame(0, 0)).await.expect(200);
    assert_ne!(other["query_id"], first.expect(200)["query_id"]);

    // The same key with another picture, and with another query.
    let problem = post(&server, "/localize?map=m", "frame-1", frame(1, 0)).await.problem(422);
    assert!(problem.contains("another request"), "{problem}");
    post(&server, "/localize?map=m&k=2", "frame-1", frame(0, 0)).await.problem(422);
    assert_eq!(jobs(&server, "m").await, 2);

    server.kill();
    let server = Server::start(dir.path(), &[]);
    let again = post(&server, "/localize?map=m", "frame-1", frame(0, 0)).await;
    assert!(is_replay(&again));
    assert_eq!(first.expect(200), again.expect(200));
    assert_eq!(jobs(&server, "m").await, 2);
}

#[tokio::test]
async fn a_repeated_request_conflicts_with_the_one_in_progress_which_outlives_its_client() {
    let (server, map) = shared_server();
    server.town(&map, 12).await;
    let ask = || {
        server
            .request(Method::POST, &format!("/localize?map={map}&refine=wait"))
            .header("content-type", "image/jpeg")
            .header("idempotency-key", "slow")
            .body(frame(0, 0))
    };
    // The client gives up before the job can have ended.
    let impatient = ask().timeout(Duration::from_millis(15)).send().await;
    let mut statuses = Vec::new();
    let done = eventually(async || {
        let answer = Answer::of(ask()).await;
        statuses.push(answer.status.as_u16());
        if answer.status == 409 {
            assert_eq!(answer.headers["retry-after"], "1");
            return None;
        }
        Some(answer)
    })
    .await;
    assert_eq!(done.expect(200)["job"]["state"], "succeeded", "{statuses:?}");
    if impatient.is_err() && statuses.len() > 1 {
        assert!(is_replay(&done), "{statuses:?}");
    }
    assert_eq!(jobs(server, &map).await, 1, "{statuses:?}");
}

#[tokio::test]
async fn an_error_is_not_stored_and_a_malformed_key_is_rejected() {
    let (server, map) = shared_server();
    let path = &format!("/maps/{map}/images?id=a");
    post(server, path, "image-1", reference(0)).await.problem(404);
    server.put(&format!("/maps/{map}"), json!({"scene": "outdoor"})).await.expect(201);
    post(server, path, "image-1", reference(0)).await.expect(201);
    let again = post(server, path, "image-1", reference(0)).await;
    assert!(is_replay(&again));
    // Without the key it would be 200, because the image exists already.
    again.expect(201);
    for key in ["", "a b", &"x".repeat(256)] {
        let problem = post(server, path, key, reference(0)).await.problem(400);
        assert!(problem.contains("Idempotency-Key"), "{problem}");
    }
    let new_key = server.request(Method::POST, "/keys").header("idempotency-key", "k");
    let new_key = new_key.json(&json!({"name": "n", "role": "robot"}));
    assert!(Answer::of(new_key).await.problem(400).contains("leave the header out"));
    // The key of a GET, which is idempotent anyway, is ignored.
    let get = server.request(Method::GET, &format!("/maps/{map}")).header("idempotency-key", "a b");
    Answer::of(get).await.expect(200);
}

#[tokio::test]
async fn stored_responses_are_bounded_in_number() {
    let dir = TempDir::new().unwrap();
    let settings = [("WHEREABOUTS_IDEMPOTENCY__MAX", "1"), ("WHEREABOUTS_JOBS__SWEEP_S", "2")];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 2).await;
    let ask = async |key: &str| -> (bool, Value) {
        let answer = post(&server, "/localize?map=m&refine=off", key, frame(0, 0)).await;
        (is_replay(&answer), answer.expect(200)["query_id"].clone())
    };
    let (_, first) = ask("one").await;
    ask("two").await;
    // The sweep removes the older one.
    let repeated = eventually(async || {
        let (is_replay, query) = ask("one").await;
        (!is_replay).then_some(query)
    })
    .await;
    assert_ne!(repeated, first);
    // Asking has made "one" the newer, but the next sweep is a while away.
    assert!(ask("two").await.0);
}
