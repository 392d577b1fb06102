//! The progress of jobs as server-sent events.

use std::time::{Duration, Instant};

use futures_util::StreamExt;
use reqwest::Method;
use serde_json::Value;
use tempfile::TempDir;

use super::deployment;
use super::mllm::start;
use super::mock_mllm::{MockMllm, Reply, Script};
use super::support::{Server, frame};
use super::wait::eventually;

/// Event names and data of a stream that has ended.
fn events(stream: &[u8]) -> Vec<(String, Value)> {
    let text = String::from_utf8(stream.to_vec()).unwrap();
    let field = |event: &str, name: &str| {
        let line = event.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_default();
        line.trim().to_owned()
    };
    text.split("\n\n")
        .filter(|event| event.contains("event:"))
        .map(|event| {
            (field(event, "event:"), serde_json::from_str(&field(event, "data:")).unwrap())
        })
        .collect()
}

async fn queue(server: &Server) -> String {
    let answer = server.post_jpeg("/localize?map=m", frame(0, 0)).await.expect(200);
    format!("{}/events", answer["job"]["href"].as_str().unwrap())
}

#[tokio::test]
async fn a_job_streams_one_event_for_each_pair_and_can_be_replayed() {
    let dir = TempDir::new().unwrap();
    let mock =
        MockMllm::start(Script { latency: Duration::from_millis(40), ..Script::default() }).await;
    let server = start(&dir, &mock, &[("WHEREABOUTS_MLLM__CONCURRENCY", "1")]);
    server.town("m", 5).await;
    let path = queue(&server).await;
    let stream = server.get(&path).await;
    assert_eq!(stream.headers["content-type"], "text/event-stream");
    let live = events(&stream.bytes);
    let names: Vec<&str> = live.iter().map(|(name, _)| name.as_str()).collect();
    let described: Vec<&Value> =
        live.iter().filter(|(name, _)| name == "description").map(|(_, data)| data).collect();
    assert_eq!(names.last(), Some(&"end"), "{names:?}");
    assert!(live.iter().any(|(name, data)| name == "state" && data["state"] == "running"));
    let counts: Vec<_> = described.iter().map(|pair| pair["described"].as_u64().unwrap()).collect();
    assert_eq!(counts, [1, 2, 3, 4, 5]);
    assert_eq!(described[0]["of"], 5);
    assert!(!described[0]["description"]["text"].as_str().unwrap().is_empty());
    assert_eq!(live.last().unwrap().1["state"], "succeeded");

    // An ended job is replayed at once.
    let again = events(&server.get(&path).await.bytes);
    assert_eq!(again.len(), 6);
    assert_eq!(again[5], *live.last().unwrap());
}

#[tokio::test]
async fn event_streams_are_limited_in_number_and_end_with_the_server() {
    let dir = TempDir::new().unwrap();
    let mock =
        MockMllm::start(Script { describe: Box::new(|_| Reply::Hang), ..Script::default() }).await;
    let server = start(&dir, &mock, &[("WHEREABOUTS_SERVER__MAX_STREAMS", "1")]);
    server.town("m", 3).await;
    let path = queue(&server).await;
    server.get("/jobs/018f0000-0000-7000-8000-000000000000/events").await.problem(404);
    let stream = server.request(Method::GET, &path).send().await.unwrap();
    let mut chunks = stream.bytes_stream();
    let first = chunks.next().await.unwrap().unwrap();
    assert!(first.starts_with(b"event: state"), "{first:?}");
    assert!(server.get(&path).await.problem(429).contains("max_streams"));
    drop(chunks);
    // The slot is free once the server has noticed that the client is gone.
    let stream = eventually(async || {
        let stream = server.request(Method::GET, &path).send().await.unwrap();
        (stream.status() == 200).then_some(stream)
    })
    .await;
    let began = Instant::now();
    let rest = tokio::spawn(async move { stream.bytes().await.unwrap() });
    assert!(server.terminate().success());
    assert!(began.elapsed() < Duration::from_secs(10), "the drain waited for the stream");
    assert!(events(&rest.await.unwrap()).iter().all(|(name, _)| name != "end"));
}

#[tokio::test]
async fn the_event_stream_covers_all_jobs_or_those_of_one_map() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 3).await;
    server.town("n", 3).await;
    let follow = async |path: &str| server.request(Method::GET, path).send().await.unwrap();
    let (mut all, mut of_map) = (follow("/events").await, follow("/events?map=m").await);
    // A browser opens a stream with its first bytes, so they are sent at once.
    let opened = tokio::time::timeout(Duration::from_secs(5), all.chunk()).await;
    assert!(opened.unwrap().unwrap().unwrap().starts_with(b": open"));
    let mut expected = Vec::new();
    for map in ["m", "n", "m"] {
        let path = format!("/localize?map={map}");
        let job = server.post_jpeg(&path, frame(0, 0)).await.expect(200)["job"].clone();
        let (id, href) = (job["id"].as_str().unwrap(), job["href"].as_str().unwrap());
        server.get(&format!("{href}?wait=60")).await.expect(200);
        expected.push((id.to_owned(), map));
    }
    // Notifications of a database take a moment: the streams are read until every end has come.
    let mut streams = [Vec::new(), Vec::new()];
    for (bytes, (stream, ends)) in streams.iter_mut().zip([(&mut all, 3), (&mut of_map, 2)]) {
        while events(bytes).iter().filter(|(_, job)| job["state"] == "succeeded").count() < ends {
            let chunk = tokio::time::timeout(Duration::from_secs(20), stream.chunk()).await;
            bytes.extend(chunk.expect("an end is missing").unwrap().expect("the stream ended"));
        }
    }
    // A drain ends the streams.
    assert!(server.terminate().success());
    streams[0].extend(all.bytes().await.unwrap());
    streams[1].extend(of_map.bytes().await.unwrap());
    for (stream, maps) in streams.iter().zip([&["m", "n"][..], &["m"]]) {
        let received = events(stream);
        assert!(received.iter().all(|(name, _)| name == "job"), "{received:?}");
        let ended = received.iter().filter(|(_, job)| job["state"] == "succeeded");
        let ended: Vec<(String, &str)> = ended
            .map(|(_, job)| (job["id"].as_str().unwrap().to_owned(), job["map"].as_str().unwrap()))
            .collect();
        let of_maps = expected.iter().filter(|(_, map)| maps.contains(map)).cloned();
        assert_eq!(ended, of_maps.collect::<Vec<_>>());
        for pair in received.windows(2) {
            assert_ne!(pair[0], pair[1], "an event came twice");
        }
        let running = received.iter().any(|(_, job)| job["state"] == "running" && job["of"] == 3);
        assert!(running || deployment::is_scale_out(), "{received:?}");
    }
}
