//! Health, metrics, the OpenAPI description, and the limits of every request.

use reqwest::Method;
use serde_json::Value;
use tempfile::TempDir;

use super::support::{Answer, BINARY, Server, frame, server, shared_server};

#[tokio::test]
async fn a_ready_server_is_healthy_and_serves_its_docs() {
    let (server, _) = shared_server();
    server.get("/livez").await.expect(200);
    server.get("/readyz").await.expect(200);
    let docs = server.get("/docs").await;
    assert!(String::from_utf8(docs.bytes).unwrap().contains("/openapi.json"));
}

#[tokio::test]
async fn the_committed_openapi_file_matches_the_handlers() {
    let (server, _) = shared_server();
    let served = server.get("/openapi.json").await.expect(200);
    let committed = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/openapi.json");
    let committed: Value =
        serde_json::from_str(&std::fs::read_to_string(committed).unwrap()).unwrap();
    assert_eq!(served, committed, "run `make openapi` and commit docs/openapi.json");
    assert_eq!(served["openapi"], "3.1.0");
    let printed = std::process::Command::new(&*BINARY).arg("openapi").output().unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&printed.stdout).unwrap(), committed);
}

#[tokio::test]
async fn metrics_count_requests_jobs_and_images() {
    let (_dir, server) = server();
    server.town("m", 3).await;
    server.post_jpeg("/localize?map=m&refine=wait", frame(0, 0)).await.expect(200);
    server.get("/maps/none").await.problem(404);
    let metrics = server.metrics().await;
    for line in [
        r#"whereabouts_http_requests_total{method="POST",route="/localize",status="200"} 1"#,
        r#"whereabouts_http_requests_total{method="GET",route="/maps/{map}",status="404"} 1"#,
        r#"whereabouts_jobs_ended_total{refiner="local",state="succeeded"} 1"#,
        r#"whereabouts_map_images{map="m"} 3"#,
        r#"whereabouts_stage_seconds_count{stage="extract"} 4"#,
        "whereabouts_jobs_queued 0",
    ] {
        assert!(metrics.contains(line), "{line} is not in\n{metrics}");
    }
}

#[tokio::test]
async fn a_request_keeps_its_x_request_id() {
    let (server, _) = shared_server();
    let request = server.request(Method::GET, "/maps/none").header("x-request-id", "robot-7/42");
    let answer = Answer::of(request).await;
    answer.problem(404);
    assert_eq!(answer.headers["x-request-id"], "robot-7/42");
    let request = server.request(Method::GET, "/livez").header("x-request-id", "a b");
    assert_ne!(Answer::of(request).await.headers["x-request-id"], "a b");
}

#[tokio::test]
async fn requests_beyond_the_limit_are_429_while_health_is_answered() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[("WHEREABOUTS_SERVER__MAX_REQUESTS", "1")]);
    server.town("m", 1).await;
    // A body that never ends occupies the only slot.
    let hold = || {
        let (sender, body) = tokio::sync::mpsc::channel::<Result<Vec<u8>, std::io::Error>>(1);
        let body = futures_util::stream::unfold(body, |mut body| async {
            let chunk = body.recv().await?;
            Some((chunk, body))
        });
        let request = server
            .request(Method::POST, "/localize?map=m")
            .header("content-type", "image/jpeg")
            .body(reqwest::Body::wrap_stream(body));
        (sender, tokio::spawn(request.send()))
    };
    let (mut sender, mut held) = hold();
    sender.send(Ok(vec![0xFF])).await.unwrap();
    let refused = loop {
        let answer = server.get("/maps").await;
        if answer.status == 429 {
            break answer;
        }
        // The request for the maps had the slot, so that this one was rejected.
        if held.is_finished() {
            (sender, held) = hold();
            sender.send(Ok(vec![0xFF])).await.unwrap();
        }
    };
    assert!(refused.problem(429).contains("server.max_requests"));
    assert!(refused.headers.contains_key("retry-after"));
    server.get("/readyz").await.expect(200);
    drop(sender);
    let _ = held.await;
    server.get("/maps").await.expect(200);
}
