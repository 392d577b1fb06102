//! Connections: bounds on their number, heads and slowness, and graceful shutdown.

mod answers;
mod preface;
mod slots;
mod tls;
mod writes;

use std::convert::Infallible;
use std::io::{ErrorKind, Write as _};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
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
use self::preface::{Peeked, Version};
use self::slots::{Slot, Slots};
pub use self::tls::{Tls, TlsError};
use self::writes::TimedWrites;
use super::ServerSettings;
use crate::Metrics;
use whereabouts_service::Rejection;

/// Flow-control window of one HTTP/2 stream, in bytes.
const STREAM_WINDOW: u32 = 512 << 10;

/// Flow-control window of an HTTP/2 connection, in bytes.
const CONNECTION_WINDOW: u32 = 1 << 20;

/// While draining, how often idle HTTP/2 connections whose client does not answer are closed.
const DRAIN_CHECK: Duration = Duration::from_secs(1);

/// Serves a router on connections.
pub struct Connections {
    /// Bounds.
    pub settings: ServerSettings,
    /// Answers the requests.
    pub router: Router,
    /// Counts connections and rejections.
    pub metrics: Arc<Metrics>,
    /// The certificate; `None` for plain HTTP.
    pub tls: Option<Arc<Tls>>,
}

impl Connections {
    /// Accepts connections until `shutdown`, then returns once the last request has been answered.
    pub async fn serve(self, listener: TcpListener, shutdown: CancellationToken) {
        let (this, open) = (Arc::new(self), TaskTracker::new());
        let slots = Slots::new(this.settings.max_connections);
        if let Some(tls) = this.tls.clone() {
            let shutdown = shutdown.clone();
            open.spawn(async move { tls.reload_until(shutdown).await });
        }
        while let Some(stream) = shutdown.run_until_cancelled(accept(&listener)).await {
            let Some(slot) = slots.take() else {
                this.metrics.refused(Rejection::Connections);
                // A client in a TLS handshake could not read a plain answer.
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
                    () = slot.evicted() => this.metrics.refused(Rejection::Connections),
                }
                this.metrics.connection_closed();
            });
        }
        drop(listener);
        open.close();
        open.wait().await;
    }

    async fn serve_one(&self, stream: TcpStream, slot: &Arc<Slot>, shutdown: CancellationToken) {
        // Nagle's algorithm would delay a response until the previous one is acknowledged.
        let _ = stream.set_nodelay(true);
        let answers = Answers::new(Arc::clone(slot));
        let pending = answers.unwritten();
        let Some(tls) = &self.tls else {
            let plain = TimedWrites::new(stream, self.settings.write_timeout, pending);
            return self.answer_all(plain, answers, shutdown).await;
        };
        let handshake =
            tokio::time::timeout(self.settings.header_timeout, self.encrypt(tls, stream, pending));
        match shutdown.run_until_cancelled(handshake).await {
            Some(Ok(Ok(encrypted))) => self.answer_all(encrypted, answers, shutdown.clone()).await,
            Some(Ok(Err(error))) => tracing::debug!(%error, "a TLS handshake failed"),
            Some(Err(_)) => self.metrics.refused(Rejection::Slow),
            None => {}
        }
    }

    /// Performs the TLS handshake. A client that speaks plain HTTP gets a plain answer that says so.
    async fn encrypt(
        &self,
        tls: &Tls,
        stream: TcpStream,
        pending: Arc<AtomicBool>,
    ) -> std::io::Result<TlsStream<TimedWrites>> {
        const HANDSHAKE: u8 = 22;
        let mut first = [0];
        if stream.peek(&mut first).await? == 1 && first != [HANDSHAKE] {
            let detail = "this port speaks HTTPS; begin the address with https://";
            let answer = raw_problem("400 Bad Request", "malformed", "Malformed request", detail);
            let mut plain = TimedWrites::new(stream, self.settings.write_timeout, pending);
            plain.write_all(answer.as_bytes()).await?;
            return Err(ErrorKind::InvalidData.into());
        }
        let timed = TimedWrites::new(stream, self.settings.write_timeout, pending);
        tls.acceptor().accept(timed).await
    }

    /// Answers the requests of a connection, in the version of HTTP that the client speaks.
    async fn answer_all<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: S,
        answers: Answers,
        shutdown: CancellationToken,
    ) {
        let mut stream = Peeked::new(stream);
        let detected = tokio::time::timeout(self.settings.header_timeout, stream.version());
        match shutdown.run_until_cancelled(detected).await {
            Some(Ok(Ok(Version::Http1))) => {
                self.answer_http1(stream, answers, shutdown.clone()).await
            }
            Some(Ok(Ok(Version::Http2))) => {
                self.answer_http2(stream, answers, shutdown.clone()).await
            }
            Some(Ok(Err(error))) => tracing::debug!(%error, "a connection failed"),
            // A client that has sent nothing expects no answer.
            Some(Err(_)) if stream.has_begun() => self.reject_slow_head(stream).await,
            Some(Err(_)) | None => {}
        }
    }

    /// Answers HTTP/1, one request after another.
    async fn answer_http1<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: Peeked<S>,
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
        tracing::debug!(%error, "a connection failed");
        if error.is_timeout() {
            let parts = connection.into_parts();
            if !parts.read_buf.is_empty() {
                self.reject_slow_head(parts.io.into_inner()).await;
            }
        }
    }

    /// Answers HTTP/2, several requests at a time. The connection is closed if the client stops reading any
    /// one response, even if it reads others. A drain does not wait for an idle client to agree to it.
    async fn answer_http2<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: Peeked<S>,
        answers: Answers,
        shutdown: CancellationToken,
    ) {
        let answer = |request| {
            let answer = self.answer(&answers, request);
            async {
                let mut response = answer.await?;
                // HTTP/2 has no such header, and its connection need not be closed.
                response.headers_mut().remove(CONNECTION);
                Ok::<_, Infallible>(response)
            }
        };
        let timeout = self.settings.write_timeout;
        let header_bytes = u32::try_from(self.settings.max_header_bytes).unwrap_or(u32::MAX);
        let mut connection = pin!(
            http2::Builder::new(TokioExecutor::new())
                .timer(TokioTimer::new())
                .max_concurrent_streams(self.settings.max_concurrent)
                .max_header_list_size(header_bytes)
                .initial_stream_window_size(STREAM_WINDOW)
                .initial_connection_window_size(CONNECTION_WINDOW)
                .keep_alive_interval(timeout)
                .keep_alive_timeout(timeout)
                .serve_connection(TokioIo::new(stream), service_fn(answer))
        );
        let mut stopping = pin!(shutdown.cancelled());
        let mut draining = false;
        let mut stall_checks = tokio::time::interval(timeout / 4);
        let mut drain_checks = tokio::time::interval(DRAIN_CHECK);
        let ended = loop {
            tokio::select! {
                ended = &mut connection => break ended,
                () = &mut stopping, if !draining => {
                    draining = true;
                    connection.as_mut().graceful_shutdown();
                    drain_checks.reset();
                }
                _ = drain_checks.tick(), if draining => if answers.are_over() {
                    return tracing::debug!("an idle client did not answer that the server stops");
                },
                _ = stall_checks.tick() => if answers.are_stalled(timeout) {
                    self.metrics.refused(Rejection::Slow);
                    return tracing::debug!("a client reads nothing of a response");
                },
            }
        };
        if let Err(error) = ended {
            tracing::debug!(%error, "a connection failed");
        }
    }

    /// Answers one request, which stays in progress until its response has ended.
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

    /// Answers 408 and closes, because the head of a request did not arrive in time.
    async fn reject_slow_head(&self, mut stream: impl AsyncWrite + Unpin) {
        self.metrics.refused(Rejection::Slow);
        let _ = stream.write_all(self.too_slow().as_bytes()).await;
        let _ = stream.shutdown().await;
    }

    fn too_slow(&self) -> String {
        let detail = format!(
            "the head of the request took longer than {} s (server.header_timeout_s); send it at once",
            self.settings.header_timeout.as_secs()
        );
        raw_problem("408 Request Timeout", "too-slow", "Request timeout", &detail)
    }
}

/// Accepts the next connection. Errors of a single connection are skipped; if files or memory have run out,
/// it retries after a pause, in which others may end.
async fn accept(listener: &TcpListener) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => return stream,
            Err(error) => match error.kind() {
                ErrorKind::ConnectionRefused
                | ErrorKind::ConnectionAborted
                | ErrorKind::ConnectionReset => {}
                _ => {
                    tracing::error!(%error, "no connection can be accepted");
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
        }
    }
}

/// Answers 503 without spending a task or a buffer on it.
fn refuse(stream: TcpStream) {
    let detail = "the limit of open connections is reached (server.max_connections), and all of them have \
                  a request in progress; try again in a moment";
    let answer =
        raw_problem("503 Service Unavailable", "unavailable", "Service unavailable", detail);
    // The answer fits into the empty buffer of a new socket; otherwise it is dropped.
    if let Ok(mut stream) = stream.into_std() {
        let _ = stream.write_all(answer.as_bytes());
    }
}

/// A problem document for a connection whose request was never parsed.
fn raw_problem(status: &str, word: &str, title: &str, detail: &str) -> String {
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

#[cfg(test)]
mod tests;
