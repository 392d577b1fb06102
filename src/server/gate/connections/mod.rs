//! Connections: how many, how long one may stay silent, and how they end.

mod answers;
mod preface;
mod slots;
mod tls;
mod writes;

use std::convert::Infallible;
use std::io::{ErrorKind, Write as _};
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::header::CONNECTION;
use hyper::body::Incoming;
use hyper::server::conn::{http1, http2};
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::server::TlsStream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower::ServiceExt;

use self::answers::Answers;
use self::preface::{Looked, Version};
use self::slots::{Slot, Slots};
pub use self::tls::{Tls, TlsError};
use self::writes::TimedWrites;
use crate::Metrics;
use whereabouts_service::Rejection;

/// What a client of HTTP/2 may send of one request before it is read, in bytes.
const STREAM_WINDOW: u32 = 512 << 10;

/// The same of all requests on its connection.
const CONNECTION_WINDOW: u32 = 1 << 20;

/// Bounds on connections.
#[derive(Debug, Clone)]
pub struct ConnectionSettings {
    /// The most that are open.
    pub most: usize,
    /// The longest wait for the whole head of a request.
    pub header_timeout: Duration,
    /// The largest head, in bytes, at least 8192.
    pub max_header_bytes: usize,
    /// The most headers, of HTTP/1.
    pub max_headers: usize,
    /// The most requests in progress on one connection, of HTTP/2.
    pub max_concurrent: u32,
    /// The longest time that a client takes nothing of an answer.
    pub write_timeout: Duration,
}

/// Serves a router on connections.
pub struct Connections {
    /// Bounds.
    pub settings: ConnectionSettings,
    /// What answers.
    pub router: Router,
    /// What is counted.
    pub metrics: Arc<Metrics>,
    /// The certificate, where connections are encrypted.
    pub tls: Option<Arc<Tls>>,
}

impl Connections {
    /// Takes connections until `shutdown`, then returns when the last request has been answered.
    pub async fn serve(self, listener: TcpListener, shutdown: CancellationToken) {
        let (this, open) = (Arc::new(self), TaskTracker::new());
        let slots = Slots::new(this.settings.most);
        if let Some(tls) = this.tls.clone() {
            let shutdown = shutdown.clone();
            open.spawn(async move { tls.follow(shutdown).await });
        }
        while let Some(stream) = shutdown.run_until_cancelled(accept(&listener)).await {
            let Some(slot) = slots.take() else {
                this.metrics.refused(Rejection::Connections);
                // Who expects TLS would not understand a sentence.
                if this.tls.is_none() {
                    refuse(stream);
                }
                continue;
            };
            let (this, shutdown) = (Arc::clone(&this), shutdown.clone());
            open.spawn(async move {
                this.metrics.connection_opened();
                let slot = Arc::new(slot);
                tokio::select! {
                    () = this.serve_one(stream, &slot, shutdown) => {}
                    () = slot.taken_away() => this.metrics.refused(Rejection::Connections),
                }
                this.metrics.connection_closed();
            });
        }
        drop(listener);
        open.close();
        open.wait().await;
    }

    async fn serve_one(&self, stream: TcpStream, slot: &Arc<Slot>, shutdown: CancellationToken) {
        // An answer should not wait for the acknowledgement of the one before.
        let _ = stream.set_nodelay(true);
        let Some(tls) = &self.tls else {
            let plain = TimedWrites::new(stream, self.settings.write_timeout);
            return self.talk(plain, slot, shutdown).await;
        };
        let shaken = tokio::time::timeout(self.settings.header_timeout, self.encrypt(tls, stream));
        match shutdown.run_until_cancelled(shaken).await {
            Some(Ok(Ok(encrypted))) => self.talk(encrypted, slot, shutdown.clone()).await,
            Some(Ok(Err(error))) => tracing::debug!(%error, "a connection was not encrypted"),
            Some(Err(_)) => self.metrics.refused(Rejection::Slow),
            None => {}
        }
    }

    /// Shakes hands. Who speaks without TLS is told so.
    async fn encrypt(
        &self,
        tls: &Tls,
        stream: TcpStream,
    ) -> std::io::Result<TlsStream<TimedWrites>> {
        const HANDSHAKE: u8 = 22;
        let mut first = [0];
        if stream.peek(&mut first).await? == 1 && first != [HANDSHAKE] {
            let detail = "this port speaks HTTPS; begin the address with https://";
            let answer = bare("400 Bad Request", "malformed", "Malformed request", detail);
            let mut plain = TimedWrites::new(stream, self.settings.write_timeout);
            plain.write_all(answer.as_bytes()).await?;
            return Err(ErrorKind::InvalidData.into());
        }
        tls.acceptor().accept(TimedWrites::new(stream, self.settings.write_timeout)).await
    }

    /// Answers the requests of a connection, in the version of HTTP that the client speaks.
    async fn talk<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: S,
        slot: &Arc<Slot>,
        shutdown: CancellationToken,
    ) {
        let answers = Answers::new(Arc::clone(slot));
        let mut stream = Looked::new(stream);
        let looked = tokio::time::timeout(self.settings.header_timeout, stream.version());
        match shutdown.run_until_cancelled(looked).await {
            Some(Ok(Ok(Version::Http1))) => {
                self.talk_http1(stream, answers, shutdown.clone()).await
            }
            Some(Ok(Ok(Version::Http2))) => {
                self.talk_http2(stream, answers, shutdown.clone()).await
            }
            Some(Ok(Err(error))) => tracing::debug!(%error, "a connection broke off"),
            // Who has sent nothing has asked for nothing.
            Some(Err(_)) if stream.has_begun() => self.give_up(stream).await,
            Some(Err(_)) | None => {}
        }
    }

    /// Answers one request after another.
    async fn talk_http1<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: Looked<S>,
        answers: Answers,
        shutdown: CancellationToken,
    ) {
        let answer = |request| self.answer(&answers, request);
        let mut connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.settings.header_timeout)
            .max_buf_size(self.settings.max_header_bytes)
            .max_headers(self.settings.max_headers)
            .serve_connection(TokioIo::new(stream), service_fn(answer));
        let mut stopping = pin!(shutdown.cancelled());
        let mut draining = false;
        let ended = loop {
            tokio::select! {
                ended = &mut connection => break ended,
                () = &mut stopping, if !draining => {
                    draining = true;
                    Pin::new(&mut connection).graceful_shutdown();
                }
            }
        };
        let Err(error) = ended else { return };
        tracing::debug!(%error, "a connection broke off");
        if error.is_timeout() {
            let parts = connection.into_parts();
            if !parts.read_buf.is_empty() {
                self.give_up(parts.io.into_inner()).await;
            }
        }
    }

    /// Answers several requests at a time. A client that takes nothing of an answer is given up, though
    /// it takes others.
    async fn talk_http2<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: Looked<S>,
        answers: Answers,
        shutdown: CancellationToken,
    ) {
        let answer = |request| {
            let answer = self.answer(&answers, request);
            async {
                let mut response = answer.await?;
                // There is no such header in HTTP/2, and no need to hang up.
                response.headers_mut().remove(CONNECTION);
                Ok::<_, Infallible>(response)
            }
        };
        let patience = self.settings.write_timeout;
        let header_bytes = u32::try_from(self.settings.max_header_bytes).unwrap_or(u32::MAX);
        let mut connection = pin!(
            http2::Builder::new(TokioExecutor::new())
                .timer(TokioTimer::new())
                .max_concurrent_streams(self.settings.max_concurrent)
                .max_header_list_size(header_bytes)
                .initial_stream_window_size(STREAM_WINDOW)
                .initial_connection_window_size(CONNECTION_WINDOW)
                .keep_alive_interval(patience)
                .keep_alive_timeout(patience)
                .serve_connection(TokioIo::new(stream), service_fn(answer))
        );
        let mut stopping = pin!(shutdown.cancelled());
        let mut draining = false;
        let mut looking = tokio::time::interval(patience / 4);
        let ended = loop {
            tokio::select! {
                ended = &mut connection => break ended,
                () = &mut stopping, if !draining => {
                    draining = true;
                    connection.as_mut().graceful_shutdown();
                }
                _ = looking.tick() => if answers.are_stalled(patience) {
                    self.metrics.refused(Rejection::Slow);
                    return tracing::debug!("a client takes nothing of an answer");
                },
            }
        };
        if let Err(error) = ended {
            tracing::debug!(%error, "a connection broke off");
        }
    }

    /// The answer to a request, which is in progress as long as there is more of the answer.
    fn answer(
        &self,
        answers: &Answers,
        request: hyper::Request<Incoming>,
    ) -> impl Future<Output = Result<axum::response::Response, Infallible>> + Send + use<> {
        let in_progress = answers.begin();
        let router = self.router.clone();
        async move {
            let response = router.oneshot(request.map(Body::new)).await?;
            Ok(response.map(|body| in_progress.over(body)))
        }
    }

    /// Says that the head of a request did not come in time.
    async fn give_up(&self, mut stream: impl AsyncWrite + Unpin) {
        self.metrics.refused(Rejection::Slow);
        let _ = stream.write_all(self.too_slow().as_bytes()).await;
        let _ = stream.shutdown().await;
    }

    fn too_slow(&self) -> String {
        let detail = format!(
            "the head of the request took longer than {} s (server.header_timeout_s); send it at once",
            self.settings.header_timeout.as_secs()
        );
        bare("408 Request Timeout", "too-slow", "Request timeout", &detail)
    }
}

/// The next connection. Errors of one connection are its own; when files or memory run out, others
/// have to end first.
async fn accept(listener: &TcpListener) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => return stream,
            Err(error) => match error.kind() {
                ErrorKind::ConnectionRefused
                | ErrorKind::ConnectionAborted
                | ErrorKind::ConnectionReset => {}
                _ => {
                    tracing::error!(%error, "no connection can be taken");
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
        }
    }
}

/// Answers 503 without a task or a buffer of its own.
fn refuse(stream: TcpStream) {
    let detail = "as many connections are open as may be (server.max_connections), all of them with \
                  a request in progress; try again in a moment";
    let answer = bare("503 Service Unavailable", "unavailable", "Service unavailable", detail);
    // What does not fit into the socket's empty buffer at once is not worth waiting for.
    if let Ok(mut stream) = stream.into_std() {
        let _ = stream.write_all(answer.as_bytes());
    }
}

/// A problem from before there is a request.
fn bare(status: &str, word: &str, title: &str, detail: &str) -> String {
    let number = status.split(' ').next().unwrap_or_default();
    let body = serde_json::json!({
        "type": format!("about:blank#{word}"),
        "title": title,
        "status": number.parse::<u16>().unwrap_or_default(),
        "detail": detail,
        "request_id": uuid::Uuid::now_v7(),
    })
    .to_string();
    let retry = if number == "503" { "retry-after: 2\r\n" } else { "" };
    format!(
        "HTTP/1.1 {status}\r\ncontent-type: application/problem+json\r\n{retry}connection: \
         close\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    )
}
