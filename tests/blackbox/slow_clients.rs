//! Clients that are slow, silent, endless or rude: each is disconnected within its timeout, and others are
//! served meanwhile.

use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::support::{Server, reference};

/// A deadline that no passing test comes near.
const DEADLINE: Duration = Duration::from_secs(60);

/// Timeouts of a few seconds.
const STRICT: &[(&str, &str)] = &[
    ("WHEREABOUTS_SERVER__HEADER_TIMEOUT_S", "2"),
    ("WHEREABOUTS_SERVER__BODY_PAUSE_S", "1"),
    ("WHEREABOUTS_SERVER__BODY_TIMEOUT_S", "3"),
    ("WHEREABOUTS_SERVER__WRITE_TIMEOUT_S", "2"),
    ("WHEREABOUTS_SERVER__BODY_LIMIT_BYTES", "1000000"),
    ("WHEREABOUTS_SERVER__BODIES_LIMIT_BYTES", "1500000"),
];

fn strict(more: &[(&str, &str)]) -> (TempDir, Server) {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[STRICT, more].concat());
    (dir, server)
}

async fn connect(server: &Server) -> TcpStream {
    TcpStream::connect(server.url.trim_start_matches("http://")).await.unwrap()
}

/// Opens a connection and sends these bytes.
async fn sent(server: &Server, bytes: &[u8]) -> TcpStream {
    let mut stream = connect(server).await;
    stream.write_all(bytes).await.unwrap();
    stream
}

/// The head of a POST request without its body.
fn head(framing: &str) -> String {
    format!(
        "POST /localize?map=m HTTP/1.1\r\nhost: x\r\ncontent-type: image/jpeg\r\n{framing}\r\n\r\n"
    )
}

/// Reads until the server closes the connection.
async fn rest(stream: &mut TcpStream) -> String {
    let mut bytes = Vec::new();
    let reading = stream.read_to_end(&mut bytes);
    // A reset after the response counts as an end.
    let _ = tokio::time::timeout(DEADLINE, reading).await.expect("the connection stays open");
    String::from_utf8(bytes).unwrap()
}

/// Reads to the end while sending `bytes` again and again with pauses.
async fn rest_while_sending(stream: TcpStream, bytes: &[u8], pause: Duration) -> String {
    let (mut from, mut to) = stream.into_split();
    let bytes = bytes.to_vec();
    let sending = tokio::spawn(async move {
        let mut ticks = tokio::time::interval(pause);
        loop {
            ticks.tick().await;
            if to.write_all(&bytes).await.is_err() {
                return;
            }
        }
    });
    let mut answer = Vec::new();
    let _ = tokio::time::timeout(DEADLINE, from.read_to_end(&mut answer))
        .await
        .expect("the connection stays open");
    sending.abort();
    String::from_utf8(answer).unwrap()
}

/// Returns the detail of the problem in a raw response with this status.
#[track_caller]
fn problem(answer: &str, status: u16) -> String {
    assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{answer:?}");
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.contains("content-type: application/problem+json"), "{head}");
    assert!(head.contains("connection: close"), "{head}");
    let problem: Value = serde_json::from_str(body).unwrap();
    assert_eq!(problem["status"], status);
    problem["detail"].as_str().unwrap().to_owned()
}

#[tokio::test]
async fn a_trickling_head_gets_408_and_a_silent_connection_is_closed() {
    let (_dir, server) = strict(&[]);
    let start = Instant::now();
    let mut silent = Vec::new();
    for _ in 0..50 {
        silent.push(connect(&server).await);
    }
    let trickling = sent(&server, b"GET /maps HTTP/1.1\r\nhost: x\r\nx-slow: ").await;
    let trickle = rest_while_sending(trickling, b"a", Duration::from_millis(50));
    let healthy = async {
        for _ in 0..10 {
            server.get("/maps").await.expect(200);
        }
    };
    let (answer, ()) = tokio::join!(trickle, healthy);
    assert!(start.elapsed() >= Duration::from_secs(2), "before its time: {answer}");
    assert!(problem(&answer, 408).contains("server.header_timeout_s"));
    for stream in &mut silent {
        assert_eq!(rest(stream).await, "", "a silent connection gets no response");
    }
}

#[tokio::test]
async fn a_body_that_pauses_or_trickles_gets_408() {
    let (_dir, server) = strict(&[]);
    server.town("m", 1).await;
    let part = [head("content-length: 90000").as_bytes(), &reference(0)[..1000]].concat();
    let mut paused = sent(&server, &part).await;
    let trickling = sent(&server, &part).await;
    let endless = sent(&server, head("transfer-encoding: chunked").as_bytes()).await;
    let pause = Duration::from_millis(50);
    let (paused, trickle, endless, ()) = tokio::join!(
        rest(&mut paused),
        rest_while_sending(trickling, b"a", pause),
        rest_while_sending(endless, b"1\r\na\r\n", pause),
        async {
            server.get("/maps").await.expect(200);
        }
    );
    assert!(problem(&paused, 408).contains("server.body_pause_s"));
    assert!(problem(&trickle, 408).contains("server.body_timeout_s"));
    assert!(problem(&endless, 408).contains("server.body_timeout_s"));
    let metrics = server.metrics().await;
    assert!(metrics.contains(r#"whereabouts_refused_total{reason="slow"} 3"#), "{metrics}");
}

#[tokio::test]
async fn an_endless_chunked_body_gets_413() {
    let (_dir, server) = strict(&[]);
    server.town("m", 1).await;
    let stream = sent(&server, head("transfer-encoding: chunked").as_bytes()).await;
    let chunk = [b"10000\r\n".as_slice(), &[0xFF; 0x10000], b"\r\n"].concat();
    let answer = rest_while_sending(stream, &chunk, Duration::from_millis(1)).await;
    assert!(answer.starts_with("HTTP/1.1 413 "), "{answer}");
    server.get("/maps").await.expect(200);
}

#[tokio::test]
async fn bodies_beyond_the_shared_memory_budget_get_429() {
    // The timeouts are long, so that neither is disconnected for being slow.
    let (_dir, server) = strict(&[
        ("WHEREABOUTS_SERVER__BODY_PAUSE_S", "29"),
        ("WHEREABOUTS_SERVER__BODY_TIMEOUT_S", "29"),
    ]);
    server.town("m", 1).await;
    let part = [head("content-length: 900001").as_bytes(), &[0xFF; 900_000]].concat();
    let (mut first, mut second) = (sent(&server, &part).await, sent(&server, &part).await);
    let refused = tokio::select! {
        answer = rest(&mut first) => answer,
        answer = rest(&mut second) => answer,
    };
    assert!(problem(&refused, 429).contains("server.bodies_limit_bytes"));
    drop((first, second));
    let answered =
        async { while server.post_jpeg("/localize?map=m", reference(0)).await.status == 429 {} };
    tokio::time::timeout(DEADLINE, answered).await.expect("the memory is not given back");
}

#[tokio::test]
async fn a_client_that_disconnects_halfway_frees_its_slot_at_once() {
    let (_dir, server) = strict(&[
        ("WHEREABOUTS_SERVER__MAX_REQUESTS", "2"),
        ("WHEREABOUTS_SERVER__BODY_PAUSE_S", "29"),
        ("WHEREABOUTS_SERVER__BODY_TIMEOUT_S", "29"),
    ]);
    server.town("m", 1).await;
    let start = Instant::now();
    let part = [head("content-length: 90000").as_bytes(), &[0xFF; 1000]].concat();
    for _ in 0..8 {
        let mut stream = sent(&server, &part).await;
        stream.shutdown().await.unwrap();
        rest(&mut stream).await;
    }
    assert!(start.elapsed() < Duration::from_secs(25), "a timeout ended them");
    server.get("/maps").await.expect(200);
    let mut stream = sent(&server, b"GET /maps HTTP/1.1\r\nhost: x\r\n\r\n").await;
    stream.shutdown().await.unwrap();
    rest(&mut stream).await;
    server.get("/maps").await.expect(200);
}

#[tokio::test]
async fn pipelined_requests_are_answered_in_order() {
    let (_dir, server) = strict(&[]);
    let mut requests = String::new();
    for number in 0..100 {
        requests += &format!("GET /livez HTTP/1.1\r\nhost: x\r\nx-request-id: {number}\r\n\r\n");
    }
    requests += "GET /livez HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";
    let mut stream = sent(&server, requests.as_bytes()).await;
    let answers = rest(&mut stream).await;
    assert_eq!(answers.matches("HTTP/1.1 200 OK").count(), 101);
    let ids: Vec<_> =
        answers.lines().filter_map(|line| line.strip_prefix("x-request-id: ")).take(100).collect();
    assert_eq!(ids, (0..100).map(|number| number.to_string()).collect::<Vec<_>>());
}

#[tokio::test]
async fn heads_that_are_too_large_get_431() {
    let (_dir, server) = strict(&[]);
    let start = "GET /maps HTTP/1.1\r\nhost: x\r\n";
    let long = format!("{start}x-long: {}", "a".repeat(200_000));
    let many = format!("{start}{}\r\n", "a: b\r\n".repeat(200));
    for head in [long, many] {
        let mut stream = connect(&server).await;
        // The server may close the connection before it has read everything.
        let _ = stream.write_all(head.as_bytes()).await;
        let answer = rest(&mut stream).await;
        assert!(answer.is_empty() || answer.starts_with("HTTP/1.1 431 "), "{answer}");
        assert!(!answer.is_empty() || head.len() > 100_000, "no answer");
    }
    server.get("/maps").await.expect(200);
}

#[tokio::test]
async fn a_client_that_reads_no_response_is_disconnected() {
    let (_dir, server) = strict(&[]);
    let (from, mut to) = connect(&server).await.into_split();
    let request = b"GET /openapi.json HTTP/1.1\r\nhost: x\r\n\r\n".repeat(100);
    let failed = async { while to.write_all(&request).await.is_ok() {} };
    tokio::time::timeout(DEADLINE, failed).await.expect("the server still waits");
    drop(from);
    server.get("/maps").await.expect(200);
}

#[tokio::test]
async fn idle_connections_are_evicted_and_busy_ones_are_not() {
    let dir = TempDir::new().unwrap();
    let settings = [("WHEREABOUTS_SERVER__MAX_CONNECTIONS", "4")];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 1).await;
    let mut silent = Vec::new();
    for _ in 0..40 {
        silent.push(connect(&server).await);
    }
    server.get("/maps").await.expect(200);
    // Thirty-six were evicted by later ones, and one by the healthy request.
    for stream in &mut silent[..37] {
        assert_eq!(rest(stream).await, "");
    }
    let mut busy = Vec::new();
    for _ in 0..4 {
        // The interim response shows that the request is being read before the next connection is opened.
        let expecting = head("content-length: 90000\r\nexpect: 100-continue");
        let mut stream = sent(&server, expecting.as_bytes()).await;
        let mut interim = [0; 25];
        stream.read_exact(&mut interim).await.unwrap();
        assert_eq!(&interim[..], b"HTTP/1.1 100 Continue\r\n\r\n");
        busy.push(stream);
    }
    let mut refused = connect(&server).await;
    assert!(problem(&rest(&mut refused).await, 503).contains("server.max_connections"));
    drop(busy);
    // Their requests end as soon as the server notices the disconnect.
    let room = async {
        loop {
            let mut stream = connect(&server).await;
            let request = b"GET /maps HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";
            let _ = stream.write_all(request).await;
            if rest(&mut stream).await.starts_with("HTTP/1.1 200 ") {
                return;
            }
        }
    };
    tokio::time::timeout(DEADLINE, room).await.expect("no room is made");
}
