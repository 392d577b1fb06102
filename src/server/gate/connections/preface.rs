//! Detects the version of HTTP that a connection speaks, by its first bytes.
//!
//! Not `hyper_util::server::conn::auto`: it waits for the preface without a timeout, and does not give the
//! connection back, so that a client that sends its head too slowly could not be answered 408.

use std::io::{Error, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf};

/// The first bytes of an HTTP/2 connection (RFC 9113, section 3.4).
pub(super) const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// A version of HTTP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Version {
    Http1,
    Http2,
}

/// A connection whose first bytes were peeked at, and are replayed to its reader.
#[derive(Debug)]
pub(super) struct Peeked<S> {
    stream: S,
    first: [u8; PREFACE.len()],
    /// Length of what was read into `first`.
    peeked: usize,
    /// How much of it was read again.
    replayed: usize,
}

impl<S> Peeked<S> {
    pub fn new(stream: S) -> Self {
        Self { stream, first: [0; PREFACE.len()], peeked: 0, replayed: 0 }
    }

    /// Whether any byte has arrived.
    pub fn has_begun(&self) -> bool {
        self.peeked > 0
    }
}

impl<S: AsyncRead + Unpin> Peeked<S> {
    /// Reads until the version is certain. For HTTP/1, whose methods do not begin like the preface of HTTP/2,
    /// a byte or two are enough.
    pub async fn version(&mut self) -> Result<Version, Error> {
        while self.first[..self.peeked] == PREFACE[..self.peeked] {
            if self.peeked == PREFACE.len() {
                return Ok(Version::Http2);
            }
            let more = self.stream.read(&mut self.first[self.peeked..]).await?;
            if more == 0 {
                break;
            }
            self.peeked += more;
        }
        Ok(Version::Http1)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Peeked<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        into: &mut ReadBuf<'_>,
    ) -> Poll<Result<(), Error>> {
        let replay = &self.first[self.replayed..self.peeked];
        if replay.is_empty() {
            return Pin::new(&mut self.stream).poll_read(context, into);
        }
        let fits = replay.len().min(into.remaining());
        into.put_slice(&replay[..fits]);
        self.replayed += fits;
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Peeked<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<Result<usize, Error>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Result<(), Error>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Result<(), Error>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<Result<usize, Error>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::AsyncWriteExt;

    async fn detect(pieces: &[&[u8]]) -> (Version, Vec<u8>) {
        let (mut client, server) = tokio::io::duplex(1024);
        let mut peeked = Peeked::new(server);
        let pieces: Vec<Vec<u8>> = pieces.iter().map(|piece| piece.to_vec()).collect();
        tokio::spawn(async move {
            for piece in pieces {
                client.write_all(&piece).await.unwrap();
                tokio::task::yield_now().await;
            }
        });
        let version = peeked.version().await.unwrap();
        let mut all = Vec::new();
        peeked.read_to_end(&mut all).await.unwrap();
        (version, all)
    }

    #[tokio::test]
    async fn the_version_is_detected_and_no_byte_is_lost() {
        for piece in [1, 3, 24] {
            let pieces: Vec<&[u8]> = PREFACE.chunks(piece).chain([&b"frames"[..]]).collect();
            let (version, all) = detect(&pieces).await;
            assert_eq!((version, &all[24..]), (Version::Http2, &b"frames"[..]));
        }
        for head in
            ["GET / HTTP/1.1\r\n", "POST /x HTTP/1.1\r\n", "PRI * HTTP/2.0\r\n\r\nXX", "P", ""]
        {
            let (version, all) = detect(&[head.as_bytes()]).await;
            assert_eq!((version, all), (Version::Http1, head.as_bytes().to_vec()), "{head:?}");
        }
    }
}
