//! Resumable download of one large file over an unreliable connection, with retries.
//!
//! Ours, because hf-hub neither resumes a partial file nor verifies a SHA-256.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use reqwest::header::{CONTENT_RANGE, ETAG, HeaderMap, IF_RANGE, RANGE, RETRY_AFTER};
use reqwest::{Client, Response, StatusCode};

use super::partial::{Origin, Partial, remove_if_there};
use whereabouts_core::Digest;

/// Limits and retry policy of a download.
#[derive(Debug, Clone, Copy)]
pub struct DownloadSettings {
    /// Maximum size of a file in bytes.
    pub max_bytes: u64,
    /// Maximum time without receiving a byte.
    pub stall: Duration,
    /// Maximum consecutive attempts without progress.
    pub attempts: u32,
    /// Pause before the second attempt; doubles with each further attempt.
    pub backoff: Duration,
}

/// A file to download.
#[derive(Debug, Clone, Copy)]
pub struct Download<'a> {
    /// URL of the file.
    pub url: &'a str,
    /// Target path. A partial file of an earlier run is resumed.
    pub to: &'a Path,
    /// Expected digest, if pinned.
    pub pinned: Option<Digest>,
    /// Limits and retry policy.
    pub settings: DownloadSettings,
}

/// Progress of a download.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Progress {
    /// The server has started sending.
    Started {
        /// Offset of the first byte: the bytes already on disk.
        at: u64,
        /// Total size of the file, if the server reports it.
        total: Option<u64>,
    },
    /// This many bytes are on disk.
    Received(u64),
    /// An attempt failed; another follows.
    Retrying {
        /// Pause before the next attempt.
        pause: Duration,
        /// Why the attempt failed.
        why: String,
    },
}

/// Why a download failed.
#[derive(Debug, thiserror::Error)]
pub enum DownloadError {
    /// The HTTP client cannot be built.
    #[error("cannot start an HTTP client: {0}")]
    Client(reqwest::Error),
    /// The server rejected the request.
    #[error(
        "{url} answered {status}; if the hub has moved, set model.hub to a mirror, or download \
         the file by hand and install it with `whereabouts model add FILE --manifest TOML`"
    )]
    Refused {
        /// URL of the file.
        url: String,
        /// Status of the response.
        status: StatusCode,
    },
    /// All attempts failed.
    #[error(
        "gave up on {url} after {attempts} attempts: {why}; {kept} bytes are kept, so run the same \
         command again to continue, or set model.hub to a mirror"
    )]
    GaveUp {
        /// URL of the file.
        url: String,
        /// Number of attempts.
        attempts: u32,
        /// Why the last attempt failed.
        why: String,
        /// Bytes kept on disk.
        kept: u64,
    },
    /// The file exceeds the maximum size.
    #[error("{url} has more than {max} bytes; raise model.max_download_bytes if that is expected")]
    TooLarge {
        /// URL of the file.
        url: String,
        /// The limit.
        max: u64,
    },
    /// The digest of the file does not match the pinned one.
    #[error(
        "{url} gave a file of {got}, but {pinned} is pinned; it was removed. Run the same command \
         again; if that happens again, the hub or a proxy changed the file: set model.hub to a \
         mirror you trust"
    )]
    Mismatch {
        /// URL of the file.
        url: String,
        /// Digest of the downloaded file.
        got: Digest,
        /// Pinned digest.
        pinned: Digest,
    },
    /// The file cannot be written.
    #[error("cannot write {path}: {source}; make room or choose another folder with --assets")]
    Disk {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
}

/// How an attempt failed.
enum Failure {
    /// Another attempt may succeed, but not earlier than in `retry_after`.
    Transient { why: String, retry_after: Duration },
    /// No further attempt can succeed.
    Permanent(DownloadError),
}

/// An attempt that received at least this many bytes counts as progress, even if it failed.
const PROGRESS_BYTES: u64 = 1 << 20;

/// Maximum pause between attempts, even if `Retry-After` asks for more.
const MAX_PAUSE: Duration = Duration::from_secs(60);

impl Download<'_> {
    /// Downloads the file, resuming as often as necessary. Returns its digest once the file is durable.
    pub async fn run(
        &self,
        mut on_progress: impl FnMut(Progress),
    ) -> Result<Digest, DownloadError> {
        let client = self.client()?;
        let mut partial = Partial::open(self.to, self.url, self.pinned.is_some())
            .map_err(|error| self.disk(error))?;
        let mut failures = 0;
        loop {
            let before = partial.length();
            match self.attempt(&client, &mut partial, &mut on_progress).await {
                Ok(()) => break,
                Err(Failure::Permanent(error)) => {
                    if matches!(error, DownloadError::TooLarge { .. }) {
                        partial.discard().map_err(|error| self.disk(error))?;
                    }
                    return Err(error);
                }
                Err(Failure::Transient { why, retry_after }) => {
                    failures = match partial.length() >= before.saturating_add(PROGRESS_BYTES) {
                        true => 1,
                        false => failures + 1,
                    };
                    if failures >= self.settings.attempts {
                        return Err(self.gave_up(failures, why, partial.length()));
                    }
                    let pause = self.settings.backoff * 2u32.saturating_pow(failures - 1).min(64);
                    let pause = pause.max(retry_after).min(MAX_PAUSE);
                    on_progress(Progress::Retrying { pause, why });
                    tokio::time::sleep(pause).await;
                }
            }
        }
        let got = partial.finish().map_err(|error| self.disk(error))?;
        match self.pinned {
            Some(pinned) if pinned != got => {
                remove_if_there(self.to).map_err(|error| self.disk(error))?;
                Err(DownloadError::Mismatch { url: self.url.to_owned(), got, pinned })
            }
            _ => Ok(got),
        }
    }

    fn client(&self) -> Result<Client, DownloadError> {
        Client::builder()
            .https_only(self.url.starts_with("https://"))
            .connect_timeout(self.settings.stall)
            .read_timeout(self.settings.stall)
            .user_agent(concat!("whereabouts/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(DownloadError::Client)
    }

    /// Sends one request and appends the body to the partial file. Writes block the task, because the disk is
    /// much faster than the network.
    async fn attempt(
        &self,
        client: &Client,
        partial: &mut Partial,
        on_progress: &mut impl FnMut(Progress),
    ) -> Result<(), Failure> {
        let mut request = client.get(self.url);
        if partial.length() > 0 {
            request = request.header(RANGE, format!("bytes={}-", partial.length()));
            if let Some(etag) = &partial.origin().etag {
                request = request.header(IF_RANGE, etag);
            }
        }
        let mut response = request.send().await.map_err(|error| interrupted(&error))?;
        if self.accept(&response, partial)? == Accepted::Complete {
            return Ok(());
        }
        let total = partial.origin().total;
        if total.is_some_and(|total| total > self.settings.max_bytes) {
            return Err(self.too_large());
        }
        on_progress(Progress::Started { at: partial.length(), total });
        while let Some(bytes) = response.chunk().await.map_err(|error| interrupted(&error))? {
            if partial.length() + bytes.len() as u64 > self.settings.max_bytes {
                return Err(self.too_large());
            }
            partial.append(&bytes).map_err(|error| Failure::Permanent(self.disk(error)))?;
            on_progress(Progress::Received(partial.length()));
        }
        match total {
            Some(total) if partial.length() != total => Err(transient(format!(
                "the server closed the connection after {} of {total} bytes",
                partial.length()
            ))),
            _ => Ok(()),
        }
    }

    /// Prepares the partial file for the body of a response.
    fn accept(&self, response: &Response, partial: &mut Partial) -> Result<Accepted, Failure> {
        let disk = |error| Failure::Permanent(self.disk(error));
        let headers = response.headers();
        let whole = |total| Origin { url: self.url.to_owned(), etag: strong_etag(headers), total };
        match response.status() {
            StatusCode::OK => {
                partial.restart(whole(response.content_length())).map_err(disk)?;
                Ok(Accepted::Body)
            }
            StatusCode::PARTIAL_CONTENT if continues(headers, partial) => Ok(Accepted::Body),
            StatusCode::RANGE_NOT_SATISFIABLE if total_of(headers) == Some(partial.length()) => {
                Ok(Accepted::Complete)
            }
            StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE
                if partial.length() > 0 =>
            {
                partial.restart(whole(None)).map_err(disk)?;
                Err(transient("the file on the server has changed".to_owned()))
            }
            status if is_transient(status) => Err(Failure::Transient {
                why: format!("the server answered {status}"),
                retry_after: retry_after(headers),
            }),
            status => {
                Err(Failure::Permanent(DownloadError::Refused { url: self.url.to_owned(), status }))
            }
        }
    }

    fn gave_up(&self, attempts: u32, why: String, kept: u64) -> DownloadError {
        DownloadError::GaveUp { url: self.url.to_owned(), attempts, why, kept }
    }

    fn too_large(&self) -> Failure {
        let max = self.settings.max_bytes;
        Failure::Permanent(DownloadError::TooLarge { url: self.url.to_owned(), max })
    }

    fn disk(&self, source: io::Error) -> DownloadError {
        DownloadError::Disk { path: self.to.to_owned(), source }
    }
}

#[derive(PartialEq, Eq)]
enum Accepted {
    /// The body is to be appended.
    Body,
    /// The partial file is already complete.
    Complete,
}

fn transient(why: String) -> Failure {
    Failure::Transient { why, retry_after: Duration::ZERO }
}

fn interrupted(error: &reqwest::Error) -> Failure {
    let mut why = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(cause) = source {
        why = format!("{why}: {cause}");
        source = cause.source();
    }
    transient(why)
}

fn is_transient(status: StatusCode) -> bool {
    matches!(status.as_u16(), 408 | 425 | 429 | 500..)
}

/// Whether the body continues the partial file: it starts where that ends, and both are of the same version.
fn continues(headers: &HeaderMap, partial: &Partial) -> bool {
    let range =
        text(headers, CONTENT_RANGE.as_str()).and_then(|range| range.strip_prefix("bytes "));
    let start = range.and_then(|range| range.split('-').next()?.parse().ok());
    let known = partial.origin();
    let same_length =
        total_of(headers).is_none() || known.total.is_none() || total_of(headers) == known.total;
    let etag = strong_etag(headers);
    let same_tag = etag.is_none() || known.etag.is_none() || etag == known.etag;
    start == Some(partial.length()) && same_length && same_tag
}

/// The total length in `Content-Range: bytes 2-9/10` or `bytes */10`.
fn total_of(headers: &HeaderMap) -> Option<u64> {
    text(headers, CONTENT_RANGE.as_str())?.rsplit('/').next()?.parse().ok()
}

/// A strong entity tag. Weak tags (`W/"…"`) do not identify bytes, and RFC 9110 does not allow them in `If-Range`.
fn strong_etag(headers: &HeaderMap) -> Option<String> {
    text(headers, ETAG.as_str()).filter(|etag| etag.starts_with('"')).map(str::to_owned)
}

fn retry_after(headers: &HeaderMap) -> Duration {
    let seconds = text(headers, RETRY_AFTER.as_str()).and_then(|seconds| seconds.parse().ok());
    Duration::from_secs(seconds.unwrap_or(0))
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}
