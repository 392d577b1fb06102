//! HTTP/2 frame by frame: clients that withhold flow control, send half a preface, or reset their requests.

use std::time::{Duration, Instant};

use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::support::Server;

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Frame types (RFC 9113, section 6).
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const GOAWAY: u8 = 7;
const WINDOW_UPDATE: u8 = 8;

/// Identifier of a setting.
const INITIAL_WINDOW_SIZE: u16 = 4;

/// A window larger than any response.
const LARGE: u32 = 1 << 24;

const ACK: u8 = 1;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;

/// A deadline that no passing test comes near.
const DEADLINE: Duration = Duration::from_secs(60);

fn server(more: &[(&str, &str)]) -> (TempDir, Server) {
    let dir = TempDir::new().unwrap();
    let strict = [
        ("WHEREABOUTS_SERVER__HEADER_TIMEOUT_S", "1"),
        ("WHEREABOUTS_SERVER__WRITE_TIMEOUT_S", "1"),
    ];
    let server = Server::start(dir.path(), &[&strict, more].concat());
    (dir, server)
}

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = (payload.len() as u32).to_be_bytes();
    let mut frame = vec![length[1], length[2], length[3], kind, flags];
    frame.extend(stream.to_be_bytes());
    frame.extend(payload);
    frame
}

/// The head of a GET: indexed `:method` and `:scheme`, literal `:path` and `:authority` (RFC 7541).
fn get(path: &str) -> Vec<u8> {
    let mut head = vec![0x82, 0x86, 0x04, path.len() as u8];
    head.extend(path.as_bytes());
    head.extend(b"\x01\x01x");
    head
}

/// A received frame: its type, flags, stream and payload.
type Came = (u8, u8, u32, Vec<u8>);

struct Client(TcpStream);

impl Client {
    /// Connects with an initial flow-control window of this many bytes for each stream.
    async fn connect(server: &Server, window: u32) -> Self {
        let mut client = Self::silent(server).await;
        client.send(PREFACE).await;
        let setting = [&INITIAL_WINDOW_SIZE.to_be_bytes()[..], &window.to_be_bytes()].concat();
        client.send(&frame(SETTINGS, 0, 0, &setting)).await;
        client.send(&frame(WINDOW_UPDATE, 0, 0, &LARGE.to_be_bytes())).await;
        client
    }

    async fn silent(server: &Server) -> Self {
        Self(TcpStream::connect(server.url.trim_start_matches("http://")).await.unwrap())
    }

    async fn send(&mut self, bytes: &[u8]) {
        self.0.write_all(bytes).await.unwrap();
    }

    async fn request(&mut self, stream: u32, path: &str) {
        self.send(&frame(HEADERS, END_HEADERS | END_STREAM, stream, &get(path))).await;
    }

    /// The next frame; `None` once the server has closed the connection.
    async fn next(&mut self) -> Option<Came> {
        let mut head = [0; 9];
        let reading = async {
            self.0.read_exact(&mut head).await.ok()?;
            let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
            let mut payload = vec![0; length as usize];
            self.0.read_exact(&mut payload).await.ok()?;
            let stream = u32::from_be_bytes([head[5], head[6], head[7], head[8]]);
            Some((head[3], head[4], stream, payload))
        };
        let came =
            tokio::time::timeout(DEADLINE, reading).await.expect("the connection stays open")?;
        if let (PING, 0, 0, payload) = &came {
            // The server may have closed the connection since.
            let _ = self.0.write_all(&frame(PING, ACK, 0, payload)).await;
        }
        Some(came)
    }

    /// The body of the response on a stream.
    async fn body(&mut self, stream: u32) -> Vec<u8> {
        let mut body = Vec::new();
        while let Some((kind, flags, of, payload)) = self.next().await {
            if kind == DATA && of == stream {
                body.extend(payload);
                if flags & END_STREAM != 0 {
                    return body;
                }
            }
        }
        panic!("the answer broke off after {} bytes", body.len());
    }
}

async fn refused(server: &Server, reason: &str) -> u64 {
    let metrics = server.metrics().await;
    let label = format!("reason=\"{reason}\"");
    let line = metrics.lines().find(|line| line.contains("refused") && line.contains(&label));
    line.and_then(|line| line.rsplit(' ').next()?.parse().ok()).unwrap_or(0)
}

#[tokio::test]
async fn a_client_that_does_not_read_a_response_is_disconnected() {
    let (_dir, server) = server(&[]);
    let mut client = Client::connect(&server, 1).await;
    let begun = Instant::now();
    client.request(1, "/openapi.json").await;
    let (mut bytes, mut healthy) = (0, 0);
    while let Some((kind, _, stream, payload)) = client.next().await {
        if kind == DATA && stream == 1 {
            bytes += payload.len();
            // Other streams are served meanwhile: the window is per stream.
            client.request(3, "/nothing").await;
        }
        healthy += usize::from(kind == HEADERS && stream == 3);
    }
    assert_eq!((bytes, healthy), (1, 1));
    let took = begun.elapsed();
    assert!(took > Duration::from_secs(1) && took < Duration::from_secs(10), "{took:?}");
    assert_eq!(refused(&server, "slow").await, 1);
}

#[tokio::test]
async fn an_incomplete_preface_times_out() {
    let (_dir, server) = server(&[]);
    let mut client = Client::silent(&server).await;
    client.send(&PREFACE[..10]).await;
    let mut answer = Vec::new();
    let reading = client.0.read_to_end(&mut answer);
    tokio::time::timeout(DEADLINE, reading).await.expect("the connection stays open").unwrap();
    assert!(answer.starts_with(b"HTTP/1.1 408 "), "{}", String::from_utf8_lossy(&answer));
}

#[tokio::test]
async fn an_idle_connection_is_evicted_and_a_busy_one_is_not() {
    let (_dir, server) = server(&[("WHEREABOUTS_SERVER__MAX_CONNECTIONS", "2")]);
    let mut idle = Client::connect(&server, LARGE).await;
    idle.request(1, "/openapi.json").await;
    assert!(idle.body(1).await.len() > 50_000);
    let mut busy = Client::connect(&server, LARGE).await;
    busy.request(1, "/events").await;
    while busy.next().await.unwrap().0 != HEADERS {}
    // Both connections have served a stream; this third one needs a slot.
    server.get("/livez").await.expect(200);
    while let Some((kind, ..)) = idle.next().await {
        assert_ne!(kind, DATA);
    }
    busy.request(3, "/livez").await;
    busy.body(3).await;
}

#[tokio::test]
async fn a_head_that_is_too_large_is_rejected_and_others_are_answered() {
    let (_dir, server) = server(&[("WHEREABOUTS_SERVER__MAX_HEADER_BYTES", "8192")]);
    let mut client = Client::connect(&server, LARGE).await;
    let mut head = get("/livez");
    for index in 0..100 {
        // A literal header with a name of its own.
        let (name, value) = (format!("x-{index:03}"), "v".repeat(100));
        head.extend([0, name.len() as u8]);
        head.extend(name.as_bytes());
        head.push(value.len() as u8);
        head.extend(value.as_bytes());
    }
    client.send(&frame(HEADERS, END_HEADERS | END_STREAM, 1, &head)).await;
    client.request(3, "/livez").await;
    let mut statuses = Vec::new();
    while statuses.len() < 2 {
        let (kind, _, stream, payload) = client.next().await.unwrap();
        if kind == HEADERS || kind == RST_STREAM {
            statuses.push((stream, kind, payload));
        }
    }
    statuses.sort();
    // Indexed `:status 200`.
    assert_eq!((statuses[1].0, statuses[1].2[0]), (3, 0x88));
    assert_ne!(statuses[0].2[0], 0x88, "{statuses:?}");
}

#[tokio::test]
async fn a_rapid_reset_flood_closes_the_connection() {
    let (_dir, server) = server(&[]);
    let mut client = Client::connect(&server, LARGE).await;
    let (mut reader, mut writer) = client.0.into_split();
    let flooding = tokio::spawn(async move {
        for request in 0..20_000_u32 {
            let stream = 2 * request + 1;
            let mut both = frame(HEADERS, END_HEADERS | END_STREAM, stream, &get("/openapi.json"));
            both.extend(frame(RST_STREAM, 0, stream, &[0, 0, 0, 8]));
            if writer.write_all(&both).await.is_err() {
                return;
            }
        }
    });
    let mut answer = Vec::new();
    let reading = reader.read_to_end(&mut answer);
    let _ = tokio::time::timeout(DEADLINE, reading).await.expect("the connection stays open");
    flooding.await.unwrap();
    let (mut kinds, mut rest) = (Vec::new(), &answer[..]);
    while let [a, b, c, kind, tail @ ..] = rest {
        kinds.push(*kind);
        let end = 5 + u32::from_be_bytes([0, *a, *b, *c]) as usize;
        rest = tail.get(end..).unwrap_or_default();
    }
    assert!(kinds.contains(&GOAWAY), "the server says why: {kinds:?}");
    server.get("/livez").await.expect(200);
    client = Client::connect(&server, LARGE).await;
    client.request(1, "/openapi.json").await;
    client.body(1).await;
}
