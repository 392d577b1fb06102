//! `[server]`: where it listens, and what bounds its clients.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::gate::{ConnectionSettings, Tls, TlsError};

/// `[server]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Server {
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
    /// The longest wait for the head of a request, in seconds.
    pub header_timeout_s: u64,
    /// The largest head, in bytes.
    pub max_header_bytes: usize,
    /// The most headers, of HTTP/1.
    pub max_headers: usize,
    /// The most requests in progress on one connection, of HTTP/2.
    pub max_concurrent: u32,
    /// The longest time that a body takes, in seconds.
    pub body_timeout_s: u64,
    /// The longest pause within a body, in seconds.
    pub body_pause_s: u64,
    /// The longest time that a client takes nothing of an answer, in seconds.
    pub write_timeout_s: u64,
    /// The most connections that are open.
    pub max_connections: usize,
    /// The longest request, in seconds.
    pub request_timeout_s: u64,
    /// The most requests in progress.
    pub max_requests: usize,
    /// The most event streams and gRPC streams that are open.
    pub max_streams: usize,
    /// The longest pause between two messages of a gRPC stream, in seconds.
    pub stream_idle_s: u64,
    /// The longest drain, in seconds.
    pub drain_timeout_s: u64,
}

impl Server {
    pub(super) fn validate(&self) -> Option<String> {
        if self.tls_certificate.as_os_str().is_empty() != self.tls_key.as_os_str().is_empty() {
            return Some("server.tls_certificate and server.tls_key go together".into());
        }
        if self.max_header_bytes < 8192 {
            return Some("server.max_header_bytes must be at least 8192".into());
        }
        if self.bodies_limit_bytes < self.body_limit_bytes {
            return Some("server.bodies_limit_bytes must not be less than body_limit_bytes".into());
        }
        if self.body_timeout_s >= self.request_timeout_s {
            return Some(format!(
                "server.request_timeout_s ({}) must outlast server.body_timeout_s ({}), or a slow \
                 body would be reported as a slow server",
                self.request_timeout_s, self.body_timeout_s
            ));
        }
        None
    }

    /// Bounds on connections.
    pub fn connections(&self) -> ConnectionSettings {
        ConnectionSettings {
            most: self.max_connections,
            header_timeout: Duration::from_secs(self.header_timeout_s),
            max_header_bytes: self.max_header_bytes,
            max_headers: self.max_headers,
            max_concurrent: self.max_concurrent,
            write_timeout: Duration::from_secs(self.write_timeout_s),
        }
    }

    /// The certificate, if there is one.
    pub fn tls(&self) -> Result<Option<Tls>, TlsError> {
        let given = !self.tls_certificate.as_os_str().is_empty();
        given.then(|| Tls::load(&self.tls_certificate, &self.tls_key)).transpose()
    }

    /// The longest request.
    pub fn request_timeout(&self) -> Duration {
        Duration::from_secs(self.request_timeout_s)
    }

    /// The longest drain.
    pub fn drain_timeout(&self) -> Duration {
        Duration::from_secs(self.drain_timeout_s)
    }
}
