//! Connections: how many, how long one may stay silent, and how they end.

mod slots;
mod tls;
mod writes;

use std::convert::Infallible;
use std::io::{ErrorKind, Write as _};
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, HttpBody};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::server::TlsStream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower::ServiceExt;

use self::slots::{Slot, Slots};
pub use self::tls::{Tls, TlsError};
use self::writes::TimedWrites;
use crate::telemetry::{Metrics, RefusedFor};

/// Bounds on connections.
#[derive(Debug, Clone)]
pub struct ConnectionSettings {
    /// The most that are open.
    pub most: usize,
    /// The longest wait for the whole head of a request.
    pub header_timeout: Duration,
    /// The largest head, in bytes, at least 8192.
    pub max_header_bytes: usize,
    /// The most headers.
    pub max_headers: usize,
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
                this.metrics.refused(RefusedFor::Connections);
                // Who expects TLS would not understand a sentence.
                if this.tls.is_none() {
                    refuse(stream);
                }
                continue;
            };
            let (this, shutdown) = (Arc::clone(&this), shutdown.clone());
            open.spawn(async move {
                this.metrics.connection_opened();
                tokio::select! {
                    () = this.serve_one(stream, &slot, shutdown) => {}
                    () = slot.taken_away() => this.metrics.refused(RefusedFor::Connections),
                }
                this.metrics.connection_closed();
            });
        }
        drop(listener);
        open.close();
        open.wait().await;
    }

    async fn serve_one(&self, stream: TcpStream, slot: &Slot, shutdown: CancellationToken) {
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
            Some(Err(_)) => self.metrics.refused(RefusedFor::Slow),
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

    /// Answers the requests of a connection, one after another.
    async fn talk<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: S,
        slot: &Slot,
        shutdown: CancellationToken,
    ) {
        let io = TokioIo::new(stream);
        let answer = |request: hyper::Request<Incoming>| {
            slot.request_began();
            let router = self.router.clone();
            async move {
                let response = router.oneshot(request.map(Body::new)).await?;
                // A connection that streams events does not look idle.
                if response.body().size_hint().exact().is_some() {
                    slot.request_ended();
                }
                Ok::<_, Infallible>(response)
            }
        };
        let mut connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.settings.header_timeout)
            .max_buf_size(self.settings.max_header_bytes)
            .max_headers(self.settings.max_headers)
            .serve_connection(io, service_fn(answer));
        let mut stopping = pin!(shutdown.cancelled());
        let mut draining = false;
        let ended = loop {
            tokio::select! {
                ended = &mut connection => break ended,
                () = &mut stopping, if !draining => {
                    draining = true;
                    std::pin::Pin::new(&mut connection).graceful_shutdown();
                }
            }
        };
        let Err(error) = ended else { return };
        tracing::debug!(%error, "a connection broke off");
        if error.is_timeout() {
            let parts = connection.into_parts();
            // Who has sent nothing has asked for nothing.
            if !parts.read_buf.is_empty() {
                self.metrics.refused(RefusedFor::Slow);
                let answer = self.too_slow();
                let mut io = parts.io.into_inner();
                let _ = io.write_all(answer.as_bytes()).await;
                let _ = io.shutdown().await;
            }
        }
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
