//! Which version of HTTP a connection speaks, told by its first bytes.

use std::io::{Error, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf};

/// What a connection of HTTP/2 begins with (RFC 9113, section 3.4).
const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// A version of HTTP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Version {
    Http1,
    Http2,
}

/// A connection whose first bytes have been looked at, and are read again.
#[derive(Debug)]
pub(super) struct Looked<S> {
    stream: S,
    first: [u8; PREFACE.len()],
    seen: usize,
    read_again: usize,
}

impl<S> Looked<S> {
    pub fn new(stream: S) -> Self {
        Self { stream, first: [0; PREFACE.len()], seen: 0, read_again: 0 }
    }

    /// Whether any byte has come.
    pub fn has_begun(&self) -> bool {
        self.seen > 0
    }
}

impl<S: AsyncRead + Unpin> Looked<S> {
    /// Reads as much as tells the versions apart: of HTTP/1, whose methods do not begin like the preface
    /// of HTTP/2, that is a byte or two.
    pub async fn version(&mut self) -> Result<Version, Error> {
        while self.first[..self.seen] == PREFACE[..self.seen] {
            if self.seen == PREFACE.len() {
                return Ok(Version::Http2);
            }
            let more = self.stream.read(&mut self.first[self.seen..]).await?;
            if more == 0 {
                break;
            }
            self.seen += more;
        }
        Ok(Version::Http1)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Looked<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        into: &mut ReadBuf<'_>,
    ) -> Poll<Result<(), Error>> {
        let again = &self.first[self.read_again..self.seen];
        if again.is_empty() {
            return Pin::new(&mut self.stream).poll_read(context, into);
        }
        let fits = again.len().min(into.remaining());
        into.put_slice(&again[..fits]);
        self.read_again += fits;
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Looked<S> {
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

    async fn told(pieces: &[&[u8]]) -> (Version, Vec<u8>) {
        let (mut client, server) = tokio::io::duplex(1024);
        let mut looked = Looked::new(server);
        let pieces: Vec<Vec<u8>> = pieces.iter().map(|piece| piece.to_vec()).collect();
        tokio::spawn(async move {
            for piece in pieces {
                client.write_all(&piece).await.unwrap();
                tokio::task::yield_now().await;
            }
        });
        let version = looked.version().await.unwrap();
        let mut all = Vec::new();
        looked.read_to_end(&mut all).await.unwrap();
        (version, all)
    }

    #[tokio::test]
    async fn the_versions_are_told_apart_and_nothing_is_lost() {
        for piece in [1, 3, 24] {
            let pieces: Vec<&[u8]> = PREFACE.chunks(piece).chain([&b"frames"[..]]).collect();
            let (version, all) = told(&pieces).await;
            assert_eq!((version, &all[24..]), (Version::Http2, &b"frames"[..]));
        }
        for head in
            ["GET / HTTP/1.1\r\n", "POST /x HTTP/1.1\r\n", "PRI * HTTP/2.0\r\n\r\nXX", "P", ""]
        {
            let (version, all) = told(&[head.as_bytes()]).await;
            assert_eq!((version, all), (Version::Http1, head.as_bytes().to_vec()), "{head:?}");
        }
    }
}
