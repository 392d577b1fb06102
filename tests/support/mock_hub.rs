//! A mock of a model hub with one file, on a free port, with faults on demand.

use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::header::{CONTENT_LENGTH, CONTENT_RANGE, ETAG, IF_RANGE, RANGE};
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use bytes::Bytes;
use futures_util::{Stream, StreamExt, stream};
use tokio::net::TcpListener;

/// The fault that one request meets.
#[derive(Debug, Clone, Copy)]
pub enum Fault {
    None,
    /// The connection breaks after this many bytes of the body.
    CutAfter(usize),
    /// The body stalls after this many bytes, with the connection open.
    StallAfter(usize),
    /// No response is sent.
    Hang,
    /// One byte is corrupted.
    Corrupt,
    /// A response with this status.
    Status(u16),
    /// The whole file, whatever range was requested.
    IgnoreRange,
    /// No `Content-Length`.
    NoLength,
    /// From this request on, the file has other contents.
    Change,
}

/// A running hub.
pub struct Hub {
    pub url: String,
    shared: Arc<Mutex<Shared>>,
}

struct Shared {
    file: Bytes,
    /// Another file, and how its path ends.
    other: Option<(String, Bytes)>,
    version: u32,
    faults: VecDeque<Fault>,
    requested_paths: Vec<String>,
    ranges: Vec<Option<String>>,
    sent: u64,
}

impl Hub {
    /// Serves `file` under every path; the first requests meet one of `faults` each.
    pub async fn start(file: Vec<u8>, faults: &[Fault]) -> Self {
        Self::serve(file, None, faults).await
    }

    /// Serves `other` under every path that ends in `name`, and `file` under the rest.
    pub async fn start_with(file: Vec<u8>, name: &str, other: Vec<u8>) -> Self {
        Self::serve(file, Some((name.to_owned(), other.into())), &[]).await
    }

    async fn serve(file: Vec<u8>, other: Option<(String, Bytes)>, faults: &[Fault]) -> Self {
        let shared = Arc::new(Mutex::new(Shared {
            file: file.into(),
            other,
            version: 1,
            faults: faults.iter().copied().collect(),
            requested_paths: Vec::new(),
            ranges: Vec::new(),
            sent: 0,
        }));
        let router = Router::new().fallback(answer).with_state(Arc::clone(&shared));
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        tokio::spawn(async move { axum::serve(listener, router).await });
        Self { url, shared }
    }

    /// The requested paths.
    pub fn requested_paths(&self) -> Vec<String> {
        self.shared.lock().unwrap().requested_paths.clone()
    }

    /// The `Range` header of each request.
    pub fn ranges(&self) -> Vec<Option<String>> {
        self.shared.lock().unwrap().ranges.clone()
    }

    /// Number of body bytes sent.
    pub fn sent(&self) -> u64 {
        self.shared.lock().unwrap().sent
    }

    /// The current contents of the file.
    pub fn file(&self) -> Bytes {
        self.shared.lock().unwrap().file.clone()
    }
}

async fn answer(State(shared): State<Arc<Mutex<Shared>>>, request: Request) -> Response {
    let (fault, file, etag) = {
        let mut shared = shared.lock().unwrap();
        let fault = shared.faults.pop_front().unwrap_or(Fault::None);
        shared.requested_paths.push(request.uri().path().to_owned());
        shared.ranges.push(text(request.headers(), RANGE.as_str()));
        if let Fault::Change = fault {
            // A comment in front of an ONNX file moves every other byte and changes nothing else.
            shared.file = [b"2\x05other", &shared.file[..]].concat().into();
            shared.version += 1;
        }
        let other = shared.other.as_ref().filter(|(name, _)| request.uri().path().ends_with(name));
        let file = other.map_or(&shared.file, |(_, other)| other).clone();
        (fault, file, format!("\"{}\"", shared.version))
    };
    let whole = file.len();
    let from = match fault {
        Fault::IgnoreRange => 0,
        _ => range_start(request.headers(), &etag),
    };
    let mut body = file.slice(from..);
    let response = Response::builder().header(ETAG, &etag);
    match fault {
        Fault::Status(status) => {
            return response.status(status).body(Body::from("fault")).unwrap();
        }
        Fault::Hang => std::future::pending().await,
        Fault::Corrupt => {
            let mut bytes = body.to_vec();
            bytes[whole / 2] ^= 1;
            body = bytes.into();
        }
        _ => {}
    }
    let mut response = match from {
        0 => response.status(StatusCode::OK),
        _ => response
            .status(StatusCode::PARTIAL_CONTENT)
            .header(CONTENT_RANGE, format!("bytes {from}-{}/{whole}", whole - 1)),
    };
    if !matches!(fault, Fault::NoLength) {
        response = response.header(CONTENT_LENGTH, body.len());
    }
    response.body(Body::from_stream(in_chunks(body, fault, shared))).unwrap()
}

/// The offset at which a range begins; 0 with an `If-Range` that is out of date.
fn range_start(headers: &HeaderMap, etag: &str) -> usize {
    let current = text(headers, IF_RANGE.as_str()).is_none_or(|tag| tag == etag);
    let range = text(headers, RANGE.as_str()).filter(|_| current);
    range.map_or(0, |range| {
        range.strip_prefix("bytes=").unwrap().strip_suffix('-').unwrap().parse().unwrap()
    })
}

/// The body in chunks, with pauses, so that the bytes before a fault have arrived.
fn in_chunks(
    body: Bytes,
    fault: Fault,
    shared: Arc<Mutex<Shared>>,
) -> impl Stream<Item = io::Result<Bytes>> {
    let good = match fault {
        Fault::CutAfter(bytes) | Fault::StallAfter(bytes) => bytes.min(body.len()),
        _ => body.len(),
    };
    let parts: Vec<Bytes> = body[..good].chunks(1_000).map(Bytes::copy_from_slice).collect();
    let parts = stream::iter(parts).then(move |part| {
        shared.lock().unwrap().sent += part.len() as u64;
        async move {
            tokio::time::sleep(Duration::from_millis(1)).await;
            Ok(part)
        }
    });
    let end = stream::once(async move {
        match fault {
            Fault::CutAfter(_) => {
                // A pause as of a slow network, so that the bytes before the cut have arrived.
                tokio::time::sleep(Duration::from_millis(50)).await;
                Some(Err(io::Error::other("cut")))
            }
            Fault::StallAfter(_) => std::future::pending().await,
            _ => None,
        }
    });
    parts.chain(end.filter_map(std::future::ready)).map(|item: Result<_, io::Error>| item)
}

fn text(headers: &HeaderMap, name: &str) -> Option<String> {
    headers.get(name).map(|value| value.to_str().unwrap().to_owned())
}
