//! Overload: excess frames are rejected at once, and jobs and indexing are shed before frames.

use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::Value;
use tempfile::TempDir;
use tokio::task::JoinSet;

use crate::support::{Answer, Server, frame, reference, value_of};

/// One permit, so that other pictures wait, and timeouts that no machine reaches.
const NARROW: &[(&str, &str)] = &[
    ("WHEREABOUTS_IMAGE__PERMITS", "1"),
    ("WHEREABOUTS_IMAGE__MAX_WAIT_MS", "600000"),
    ("WHEREABOUTS_SERVER__REQUEST_TIMEOUT_S", "600"),
];

fn narrow(more: &[(&str, &str)]) -> (TempDir, Server) {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[NARROW, more].concat());
    (dir, server)
}

/// Posts this many frames at once.
fn post_all(server: &Server, path: &str, frames: usize) -> JoinSet<Answer> {
    let bytes = frame(0, 0);
    let requests = (0..frames).map(|_| {
        let request = server.request(Method::POST, path).header("content-type", "image/jpeg");
        Answer::of(request.body(bytes.clone()))
    });
    requests.collect()
}

async fn metric(server: &Server, name: &str) -> f64 {
    value_of(&server.metrics().await, name).unwrap_or(0.0)
}

/// Waits until this many frames are queued.
async fn wait_for_queue(server: &Server, length: f64) {
    let start = Instant::now();
    while metric(server, r#"whereabouts_pictures_waiting{class="localize"}"#).await < length {
        assert!(start.elapsed() < Duration::from_secs(60), "the queue stays short");
    }
}

#[track_caller]
fn retry_after(answer: &Answer) -> u64 {
    answer.headers["retry-after"].to_str().unwrap().parse().unwrap()
}

#[tokio::test]
async fn a_full_queue_answers_429_with_retry_after() {
    let (_dir, server) = narrow(&[("WHEREABOUTS_IMAGE__QUEUE", "2")]);
    server.town("m", 2).await;
    let answers = post_all(&server, "/localize?map=m&refine=off", 60).join_all().await;
    let (served, refused): (Vec<_>, Vec<_>) =
        answers.iter().partition(|answer| answer.status == 200);
    assert!(!served.is_empty() && !refused.is_empty());
    for answer in &refused {
        assert!(answer.problem(429).contains("image.queue"));
        assert!((1..=60).contains(&retry_after(answer)));
    }
    server.post_jpeg("/localize?map=m&refine=off", frame(0, 0)).await.expect(200);
    let counted = metric(&server, r#"whereabouts_refused_total{reason="queue"}"#).await;
    assert_eq!(counted, refused.len() as f64);
    assert_eq!(metric(&server, "whereabouts_permits").await, 1.0);
    assert_eq!(metric(&server, "whereabouts_permits_in_use").await, 0.0);
}

#[tokio::test]
async fn a_hopeless_deadline_is_rejected_at_once_and_abandoned_requests_are_not_served() {
    const FRAMES: usize = 400;
    let (_dir, server) = narrow(&[("WHEREABOUTS_IMAGE__QUEUE", "500")]);
    server.town("m", 2).await;
    let mut load = post_all(&server, "/localize?map=m&refine=off", FRAMES);
    wait_for_queue(&server, 200.0).await;
    let request = server
        .request(Method::POST, "/localize?map=m&refine=off")
        .header("content-type", "image/jpeg")
        .header("x-deadline-ms", "50")
        .body(frame(1, 0));
    let refused = Answer::of(request).await;
    assert!(refused.problem(429).contains("X-Deadline-Ms"));
    assert!(retry_after(&refused) >= 1);
    load.shutdown().await;
    server.post_jpeg("/localize?map=m&refine=off", frame(1, 0)).await.expect(200);
    let served = metric(&server, r#"whereabouts_stage_seconds_count{stage="decode"}"#).await;
    assert!(served < (FRAMES - 50) as f64, "{served} pictures were decoded");
}

#[tokio::test]
async fn a_missed_deadline_is_504_and_a_malformed_one_400() {
    let (_dir, server) = narrow(&[]);
    server.town("m", 2).await;
    let post = |deadline: &str| {
        server
            .request(Method::POST, "/localize?map=m&refine=wait")
            .header("content-type", "image/jpeg")
            .header("x-deadline-ms", deadline)
    };
    for rubbish in ["", "soon", "0", "-1", "1.5", "1e3", "99999999999"] {
        let answer = Answer::of(post(rubbish).body(frame(0, 0))).await;
        assert!(answer.problem(400).contains("X-Deadline-Ms"), "{rubbish}");
    }
    // A body that never comes misses the deadline.
    let never = futures_util::stream::pending::<Result<Vec<u8>, std::io::Error>>();
    let answer = Answer::of(post("200").body(reqwest::Body::wrap_stream(never))).await;
    assert!(answer.problem(504).contains("200 ms"));
    Answer::of(post("60000").body(frame(0, 0))).await.expect(200);
}

#[tokio::test]
async fn waiting_for_a_refinement_ends_before_the_deadline() {
    // The endpoint of the model is unreachable, so the job waits for it.
    let (_dir, server) = narrow(&[
        ("WHEREABOUTS_REFINE__REFINER", "mllm"),
        ("WHEREABOUTS_MLLM__BASE_URL", "http://127.0.0.1:1/v1"),
        ("WHEREABOUTS_MLLM__ON_UNAVAILABLE", "wait"),
    ]);
    server.town("m", 2).await;
    let request = server
        .request(Method::POST, "/localize?map=m&refine=wait")
        .header("content-type", "image/jpeg")
        .header("x-deadline-ms", "3000")
        .body(frame(0, 0));
    let answer = Answer::of(request).await.expect(200);
    assert!(matches!(answer["job"]["state"].as_str(), Some("queued" | "running")), "{answer}");
    assert!(answer["timing_ms"]["total"].as_f64().unwrap() < 3000.0, "{answer}");
}

#[tokio::test]
async fn under_load_jobs_are_shed_before_frames() {
    let settings = [("WHEREABOUTS_IMAGE__QUEUE", "200"), ("WHEREABOUTS_JOBS__SHED_AT", "0.05")];
    let (_dir, server) = narrow(&settings);
    server.town("m", 2).await;
    let load = post_all(&server, "/localize?map=m&refine=async", 200);
    wait_for_queue(&server, 120.0).await;
    let waits = server.post_jpeg("/localize?map=m&refine=wait", frame(0, 0)).await;
    assert!(waits.problem(429).contains("jobs.shed_at"));
    let answers = load.join_all().await;
    let answers: Vec<Value> = answers.iter().map(|answer| answer.expect(200)).collect();
    let without = answers.iter().filter(|answer| answer["job"].is_null());
    let reasons: Vec<_> = without.map(|answer| &answer["no_job"]["reason"]).collect();
    assert!(
        !reasons.is_empty() && reasons.iter().all(|reason| *reason == "overload"),
        "{reasons:?}"
    );
    let with = answers.iter().filter(|answer| answer["no_job"].is_null());
    assert_eq!(with.count(), answers.len() - reasons.len());
    assert!(reasons.len() < answers.len(), "the last frames have no queue behind them");
}

#[tokio::test]
async fn indexing_yields_to_localization() {
    let (_dir, server) = narrow(&[("WHEREABOUTS_IMAGE__QUEUE", "4")]);
    server.town("m", 1).await;
    let picture = reference(2);
    let upload = |number: usize| {
        let path = format!("/maps/m/images?id=more-{number}&lat=45&lon=7");
        let request = server.request(Method::POST, &path).header("content-type", "image/jpeg");
        Answer::of(request.body(picture.clone()))
    };
    let mut uploads: JoinSet<Answer> = (0..8).map(upload).collect();
    let (mut number, mut refused) = (8, 0);
    for _ in 0..20 {
        let mut localizing = Box::pin(server.post_jpeg("/localize?map=m&refine=off", reference(0)));
        let answer = loop {
            tokio::select! {
                answer = &mut localizing => break answer,
                Some(upload_ended) = uploads.join_next() => {
                    let status = upload_ended.unwrap().status.as_u16();
                    assert!(matches!(status, 201 | 429), "{status}");
                    refused += usize::from(status == 429);
                    number += 1;
                    uploads.spawn(upload(number));
                }
            }
        };
        answer.expect(200);
    }
    assert!(refused > 0, "the queue never filled");
}
