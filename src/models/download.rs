//! Downloading one large file over a bad line: continue, try again, give up with a sentence.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use reqwest::header::{CONTENT_RANGE, ETAG, HeaderMap, IF_RANGE, RANGE, RETRY_AFTER};
use reqwest::{Client, Response, StatusCode};

use super::partial::{Origin, Partial, remove_if_there};
use whereabouts_core::Digest;

/// Bounds on a download.
#[derive(Debug, Clone, Copy)]
pub struct DownloadSettings {
    /// The largest file, in bytes.
    pub max_bytes: u64,
    /// The longest time without a byte.
    pub stall: Duration,
    /// How often the server is asked while nothing comes of it.
    pub attempts: u32,
    /// The pause before the second attempt; it doubles each time.
    pub backoff: Duration,
}

/// One file to get.
#[derive(Debug, Clone, Copy)]
pub struct Download<'a> {
    /// Where it is.
    pub url: &'a str,
    /// Where it goes. What an earlier run left there is continued.
    pub to: &'a Path,
    /// The digest it must have, if known.
    pub pinned: Option<Digest>,
    /// Bounds.
    pub settings: DownloadSettings,
}

/// How a download goes on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Progress {
    /// Bytes will come, the first of them at this position.
    Started {
        /// How many bytes are there already.
        at: u64,
        /// How many there will be, if the server says so.
        total: Option<u64>,
    },
    /// So many bytes are there.
    Received(u64),
    /// An attempt failed; another follows.
    Retrying {
        /// After this pause.
        pause: Duration,
        /// What failed.
        why: String,
    },
}

/// Why a file was not downloaded.
#[derive(Debug, thiserror::Error)]
pub enum DownloadError {
    /// The HTTP client cannot be built.
    #[error("cannot start an HTTP client: {0}")]
    Client(reqwest::Error),
    /// The server refuses.
    #[error(
        "{url} answered {status}; if the hub has moved, set model.hub to a mirror, or download \
         the file by hand and install it with `whereabouts model add FILE --manifest TOML`"
    )]
    Refused {
        /// The address.
        url: String,
        /// The answer.
        status: StatusCode,
    },
    /// Nothing came of so many attempts.
    #[error(
        "gave up on {url} after {attempts} attempts: {why}; {kept} bytes are kept, so run the same \
         command again to continue, or set model.hub to a mirror"
    )]
    GaveUp {
        /// The address.
        url: String,
        /// How many there were.
        attempts: u32,
        /// How the last one ended.
        why: String,
        /// Bytes on disk.
        kept: u64,
    },
    /// The file is larger than allowed.
    #[error("{url} has more than {max} bytes; raise model.max_download_bytes if that is right")]
    TooLarge {
        /// The address.
        url: String,
        /// The bound.
        max: u64,
    },
    /// The bytes are not those that are pinned.
    #[error(
        "{url} gave a file of {got}, but {pinned} is pinned; it was removed. Run the same command \
         again; if that happens again, the hub or a proxy changed the file: set model.hub to a \
         mirror you trust"
    )]
    Mismatch {
        /// The address.
        url: String,
        /// What came.
        got: Digest,
        /// What should have come.
        pinned: Digest,
    },
    /// The disk.
    #[error("cannot write {path}: {source}; make room or choose another folder with --assets")]
    Disk {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// How an attempt failed.
enum Failure {
    /// Another one may succeed, but not before `after`.
    Passing { why: String, after: Duration },
    /// None will.
    Lasting(DownloadError),
}

/// So many new bytes make an attempt a success, however it ended.
const WORTHWHILE_BYTES: u64 = 1 << 20;

/// A `Retry-After` is followed up to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

impl Download<'_> {
    /// Gets the file, continuing it as often as necessary. Returns its digest once it is durable.
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
                Err(Failure::Lasting(error)) => {
                    if matches!(error, DownloadError::TooLarge { .. }) {
                        partial.discard().map_err(|error| self.disk(error))?;
                    }
                    return Err(error);
                }
                Err(Failure::Passing { why, after }) => {
                    failures = match partial.length() >= before.saturating_add(WORTHWHILE_BYTES) {
                        true => 1,
                        false => failures + 1,
                    };
                    if failures >= self.settings.attempts {
                        return Err(self.gave_up(failures, why, partial.length()));
                    }
                    let pause = self.settings.backoff * 2u32.saturating_pow(failures - 1).min(64);
                    let pause = pause.max(after).min(LONGEST_PAUSE);
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

    /// Asks once and appends what comes. A disk is fast beside a line, so writing does not leave
    /// the thread.
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
        let mut response = request.send().await.map_err(|error| broke_off(&error))?;
        if self.accept(&response, partial)? == Accepted::Whole {
            return Ok(());
        }
        let total = partial.origin().total;
        if total.is_some_and(|total| total > self.settings.max_bytes) {
            return Err(self.too_large());
        }
        on_progress(Progress::Started { at: partial.length(), total });
        while let Some(bytes) = response.chunk().await.map_err(|error| broke_off(&error))? {
            if partial.length() + bytes.len() as u64 > self.settings.max_bytes {
                return Err(self.too_large());
            }
            partial.append(&bytes).map_err(|error| Failure::Lasting(self.disk(error)))?;
            on_progress(Progress::Received(partial.length()));
        }
        match total {
            Some(total) if partial.length() != total => Err(passing(format!(
                "the server ended after {} of {total} bytes",
                partial.length()
            ))),
            _ => Ok(()),
        }
    }

    /// Makes the partial file ready for the body of this answer.
    fn accept(&self, response: &Response, partial: &mut Partial) -> Result<Accepted, Failure> {
        let disk = |error| Failure::Lasting(self.disk(error));
        let headers = response.headers();
        let whole = |total| Origin { url: self.url.to_owned(), etag: strong_etag(headers), total };
        match response.status() {
            StatusCode::OK => {
                partial.restart(whole(response.content_length())).map_err(disk)?;
                Ok(Accepted::Body)
            }
            StatusCode::PARTIAL_CONTENT if continues(headers, partial) => Ok(Accepted::Body),
            StatusCode::RANGE_NOT_SATISFIABLE if total_of(headers) == Some(partial.length()) => {
                Ok(Accepted::Whole)
            }
            StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE
                if partial.length() > 0 =>
            {
                partial.restart(whole(None)).map_err(disk)?;
                Err(passing("the file on the server is another one than before".to_owned()))
            }
            status if is_passing(status) => Err(Failure::Passing {
                why: format!("the server answered {status}"),
                after: retry_after(headers),
            }),
            status => {
                Err(Failure::Lasting(DownloadError::Refused { url: self.url.to_owned(), status }))
            }
        }
    }

    fn gave_up(&self, attempts: u32, why: String, kept: u64) -> DownloadError {
        DownloadError::GaveUp { url: self.url.to_owned(), attempts, why, kept }
    }

    fn too_large(&self) -> Failure {
        let max = self.settings.max_bytes;
        Failure::Lasting(DownloadError::TooLarge { url: self.url.to_owned(), max })
    }

    fn disk(&self, source: io::Error) -> DownloadError {
        DownloadError::Disk { path: self.to.to_owned(), source }
    }
}

#[derive(PartialEq, Eq)]
enum Accepted {
    /// Its body is to be appended.
    Body,
    /// Everything is there already.
    Whole,
}

fn passing(why: String) -> Failure {
    Failure::Passing { why, after: Duration::ZERO }
}

fn broke_off(error: &reqwest::Error) -> Failure {
    let mut why = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(cause) = source {
        why = format!("{why}: {cause}");
        source = cause.source();
    }
    passing(why)
}

fn is_passing(status: StatusCode) -> bool {
    matches!(status.as_u16(), 408 | 425 | 429 | 500..)
}

/// Whether the body starts where the partial file ends, and both are of the same whole.
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

/// The length of the whole in `Content-Range: bytes 2-9/10` or `bytes */10`.
fn total_of(headers: &HeaderMap) -> Option<u64> {
    text(headers, CONTENT_RANGE.as_str())?.rsplit('/').next()?.parse().ok()
}

/// An entity tag that names bytes; a weak one (`W/"…"`) does not, and RFC 9110 bars it from
/// `If-Range`.
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
