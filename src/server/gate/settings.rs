//! Settings of the server: where it listens, and what bounds its clients.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::connections::{Tls, TlsError};
use whereabouts_core::units::seconds;

/// `[server]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerSettings {
    /// Where to listen.
    pub listen: SocketAddr,
    /// The certificates in PEM, the server's first; empty for none.
    pub tls_certificate: PathBuf,
    /// Their key in PEM; empty for none.
    pub tls_key: PathBuf,
    /// The largest request body, in bytes.
    pub body_limit_bytes: usize,
    /// The most memory for all bodies, in bytes.
    pub bodies_limit_bytes: usize,
    /// The longest wait for the head of a request.
    #[serde(rename = "header_timeout_s", with = "seconds")]
    pub header_timeout: Duration,
    /// The largest head, in bytes.
    pub max_header_bytes: usize,
    /// The most headers, of HTTP/1.
    pub max_headers: usize,
    /// The most requests in progress on one connection, of HTTP/2.
    pub max_concurrent: u32,
    /// The longest time that a body takes.
    #[serde(rename = "body_timeout_s", with = "seconds")]
    pub body_timeout: Duration,
    /// The longest pause within a body.
    #[serde(rename = "body_pause_s", with = "seconds")]
    pub body_pause: Duration,
    /// The longest time that a client takes nothing of an answer.
    #[serde(rename = "write_timeout_s", with = "seconds")]
    pub write_timeout: Duration,
    /// The most connections that are open.
    pub max_connections: usize,
    /// The longest request.
    #[serde(rename = "request_timeout_s", with = "seconds")]
    pub request_timeout: Duration,
    /// The most requests in progress.
    pub max_requests: usize,
    /// The most event streams and gRPC streams that are open.
    pub max_streams: usize,
    /// The longest pause between two messages of a gRPC stream.
    #[serde(rename = "stream_idle_s", with = "seconds")]
    pub stream_idle: Duration,
    /// The longest drain.
    #[serde(rename = "drain_timeout_s", with = "seconds")]
    pub drain_timeout: Duration,
}

impl ServerSettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        let zero = [
            ("body_limit_bytes", self.body_limit_bytes == 0),
            ("max_requests", self.max_requests == 0),
            ("max_streams", self.max_streams == 0),
            ("max_connections", self.max_connections == 0),
            ("max_headers", self.max_headers == 0),
            ("max_concurrent", self.max_concurrent == 0),
            ("stream_idle_s", self.stream_idle.is_zero()),
            ("header_timeout_s", self.header_timeout.is_zero()),
            ("body_timeout_s", self.body_timeout.is_zero()),
            ("body_pause_s", self.body_pause.is_zero()),
            ("write_timeout_s", self.write_timeout.is_zero()),
        ];
        if let Some((key, _)) = zero.iter().find(|(_, zero)| *zero) {
            return Some(format!("server.{key} must be at least 1"));
        }
        if self.tls_certificate.as_os_str().is_empty() != self.tls_key.as_os_str().is_empty() {
            return Some("server.tls_certificate and server.tls_key go together".into());
        }
        if self.max_header_bytes < 8192 {
            return Some("server.max_header_bytes must be at least 8192".into());
        }
        if self.bodies_limit_bytes < self.body_limit_bytes {
            return Some("server.bodies_limit_bytes must not be less than body_limit_bytes".into());
        }
        if self.body_timeout >= self.request_timeout {
            return Some(format!(
                "server.request_timeout_s ({}) must outlast server.body_timeout_s ({}), or a slow \
                 body would be reported as a slow server",
                self.request_timeout.as_secs(),
                self.body_timeout.as_secs()
            ));
        }
        None
    }

    /// The certificate, if there is one.
    pub fn tls(&self) -> Result<Option<Tls>, TlsError> {
        let given = !self.tls_certificate.as_os_str().is_empty();
        given.then(|| Tls::load(&self.tls_certificate, &self.tls_key)).transpose()
    }
}
