//! Traces as a collector receives them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::routing::post;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message;
use reqwest::Method;
use serde_json::Value;
use tempfile::TempDir;
use tokio::net::TcpListener;

use super::mock_mllm::{MockMllm, Script};
use super::support::{Answer, Server, frame, shared_server};

type Collected = Arc<Mutex<Vec<Span>>>;

/// Starts a trace collector; returns its URL and the spans that it receives.
async fn collector() -> (String, Collected) {
    async fn take(State(collected): State<Collected>, body: Bytes) {
        let sent = ExportTraceServiceRequest::decode(body).unwrap();
        let spans = sent.resource_spans.into_iter().flat_map(|of| of.scope_spans);
        collected.lock().unwrap().extend(spans.flat_map(|of| of.spans));
    }
    let collected = Collected::default();
    let router = Router::new().route("/v1/traces", post(take)).with_state(Arc::clone(&collected));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });
    (url, collected)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_trace_spans_the_request_the_job_and_each_model_call() {
    const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
    let dir = TempDir::new().unwrap();
    let (url, collected) = collector().await;
    let mock = MockMllm::start(Script::default()).await;
    let base_url = mock.url();
    let settings = [
        ("WHEREABOUTS_TRACES__URL", url.as_str()),
        ("WHEREABOUTS_REFINE__REFINER", "mllm"),
        ("WHEREABOUTS_MLLM__BASE_URL", base_url.as_str()),
        ("WHEREABOUTS_MLLM__DESCRIBE_MODEL", "seer"),
        ("WHEREABOUTS_MLLM__REASON_MODEL", "seer"),
    ];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 4).await;
    let request = server
        .request(Method::POST, "/localize?map=m&refine=wait")
        .header("content-type", "image/jpeg")
        .header("traceparent", format!("00-{TRACE}-00f067aa0ba902b7-01"))
        .body(frame(0, 0));
    let answer = Answer::of(request).await.expect(200);
    let href = answer["job"]["href"].as_str().unwrap();
    assert_eq!(server.get(href).await.expect(200)["trace_id"], TRACE);
    assert!(server.terminate().success());

    let spans = collected.lock().unwrap().clone();
    let ours: Vec<_> = spans.iter().filter(|span| hex(&span.trace_id) == TRACE).collect();
    let names = ours.iter().fold(HashMap::<_, usize>::new(), |mut names, span| {
        *names.entry(span.name.as_str()).or_default() += 1;
        names
    });
    let named = |name: &str| *ours.iter().find(|span| span.name == name).unwrap();
    let request = named("POST /localize");
    assert_eq!(hex(&request.parent_span_id), "00f067aa0ba902b7");
    for stage in ["extract", "search", "submit"] {
        assert_eq!(named(stage).parent_span_id, request.span_id, "{stage}");
    }
    let job = named("job mllm");
    assert_eq!(job.parent_span_id, named("submit").span_id);
    assert_eq!((names["chat seer"], job.trace_id.len()), (4 + 1, 16), "{names:?}");
    for call in ours.iter().filter(|span| span.name == "chat seer") {
        assert_eq!(call.parent_span_id, job.span_id);
        assert!(call.attributes.iter().any(|about| about.key == "gen_ai.usage.input_tokens"));
    }
    // The requests that added the images had no trace context, so each has a trace of its own.
    assert!(spans.iter().any(|span| span.name == "POST /maps/{map}/images"));
}

#[tokio::test]
async fn an_unreachable_collector_delays_nothing() {
    let dir = TempDir::new().unwrap();
    let settings = [
        ("WHEREABOUTS_TRACES__URL", "http://127.0.0.1:9"),
        ("WHEREABOUTS_TRACES__TIMEOUT_MS", "500"),
    ];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 3).await;
    let answer = server.post_jpeg("/localize?map=m&refine=wait", frame(0, 0)).await.expect(200);
    assert_eq!(answer["job"]["state"], "succeeded");
    assert!(server.terminate().success());
}

#[tokio::test]
async fn nothing_is_traced_by_default() {
    let (server, map) = shared_server();
    server.town(&map, 3).await;
    let answer = server.post_jpeg(&format!("/localize?map={map}"), frame(0, 0)).await.expect(200);
    let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
    assert_eq!(job["trace_id"], Value::Null);
}
