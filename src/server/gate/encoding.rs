//! `Content-Encoding`: bodies compressed with gzip or deflate, expanded as they arrive.

use std::io::{self, Write};

use axum::body::{Body, BodyDataStream};
use axum::extract::Request;
use axum::http::header::{ACCEPT_ENCODING, CONTENT_ENCODING, CONTENT_LENGTH};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::Response;
use bytes::{Buf, Bytes};
use flate2::write::{MultiGzDecoder, ZlibDecoder};
use futures_util::{StreamExt, stream};

use super::body;
use super::problem::Problem;
use whereabouts_api::ErrorKind;

/// Compressed bytes that are expanded at a time: they become half a megabyte at most.
const STEP: usize = 512;

/// A body may expand to this many times its size,
const MAX_RATIO: u64 = 256;

/// and by this many bytes in any case.
const ALWAYS_ALLOWED: u64 = 64 << 20;

/// How a body is compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Gzip,
    Deflate,
}

/// The encoding that the headers of a request name; `None` if the body is not compressed.
pub(super) fn of(headers: &HeaderMap) -> Result<Option<Encoding>, Problem> {
    let mut names = headers.get_all(CONTENT_ENCODING).iter();
    let Some(value) = names.next() else { return Ok(None) };
    let name = value.to_str().unwrap_or_default().trim().to_ascii_lowercase();
    match (name.as_str(), names.next()) {
        ("" | "identity", None) => Ok(None),
        ("gzip" | "x-gzip", None) => Ok(Some(Encoding::Gzip)),
        ("deflate", None) => Ok(Some(Encoding::Deflate)),
        _ => Err(Problem::new(
            ErrorKind::UnsupportedMedia,
            format!(
                "the Content-Encoding is {value:?}; send the body uncompressed, or compressed once with gzip or \
                 deflate"
            ),
        )),
    }
}

/// Answers a request whose encoding is unknown, and names those that are known.
pub(super) fn refuse(request: Request, problem: Problem) -> Response {
    let mut response = body::refuse(request, problem);
    let known = HeaderValue::from_static("gzip, deflate, identity");
    response.headers_mut().insert(ACCEPT_ENCODING, known);
    response
}

/// A request whose body is expanded as it is read.
pub(super) fn expanded(request: Request, encoding: Option<Encoding>) -> Request {
    let Some(encoding) = encoding else { return request };
    let (mut head, body) = request.into_parts();
    head.headers.remove(CONTENT_ENCODING);
    head.headers.remove(CONTENT_LENGTH);
    Request::from_parts(head, body_of(body, encoding))
}

fn body_of(body: Body, encoding: Encoding) -> Body {
    let decoder = match encoding {
        Encoding::Gzip => Decoder::Gzip(Box::new(MultiGzDecoder::new(Vec::new()))),
        Encoding::Deflate => Decoder::Deflate(Box::new(ZlibDecoder::new(Vec::new()))),
    };
    let expanding = Expanding {
        body: body.into_data_stream(),
        input: Bytes::new(),
        decoder,
        ended: false,
        read: 0,
        made: 0,
    };
    Body::from_stream(stream::unfold(Some(expanding), |expanding| async {
        let mut expanding = expanding?;
        match expanding.next().await? {
            Ok(chunk) => Some((Ok(chunk), Some(expanding))),
            Err(error) => Some((Err(error), None)),
        }
    }))
}

enum Decoder {
    Gzip(Box<MultiGzDecoder<Vec<u8>>>),
    Deflate(Box<ZlibDecoder<Vec<u8>>>),
}

impl Decoder {
    fn write(&mut self, piece: &[u8]) -> io::Result<()> {
        match self {
            Self::Gzip(decoder) => decoder.write_all(piece),
            Self::Deflate(decoder) => decoder.write_all(piece),
        }
    }

    /// What is expanded so far.
    fn take(&mut self) -> Vec<u8> {
        std::mem::take(match self {
            Self::Gzip(decoder) => decoder.get_mut(),
            Self::Deflate(decoder) => decoder.get_mut(),
        })
    }

    fn finish(&mut self) -> io::Result<()> {
        match self {
            Self::Gzip(decoder) => decoder.try_finish(),
            Self::Deflate(decoder) => decoder.try_finish(),
        }
    }
}

struct Expanding {
    body: BodyDataStream,
    /// Compressed bytes that have arrived.
    input: Bytes,
    decoder: Decoder,
    /// Whether the compressed body has ended.
    ended: bool,
    /// Compressed bytes so far.
    read: u64,
    /// Expanded bytes so far.
    made: u64,
}

impl Expanding {
    async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        loop {
            if self.ended {
                return None;
            }
            if self.input.is_empty() {
                match self.body.next().await {
                    Some(Ok(chunk)) => self.input = chunk,
                    Some(Err(error)) => return Some(Err(error)),
                    None => {
                        self.ended = true;
                        let ended = self.decoder.finish().map_err(damaged);
                        let rest = self.decoder.take();
                        return match ended {
                            Err(error) => Some(Err(error)),
                            Ok(()) if rest.is_empty() => None,
                            Ok(()) => Some(self.counted(rest)),
                        };
                    }
                }
            }
            let piece = &self.input[..self.input.len().min(STEP)];
            let (length, written) = (piece.len(), self.decoder.write(piece));
            self.input.advance(length);
            self.read += length as u64;
            if let Err(error) = written {
                return Some(Err(damaged(error)));
            }
            let expanded = self.decoder.take();
            if !expanded.is_empty() {
                return Some(self.counted(expanded));
            }
        }
    }

    fn counted(&mut self, expanded: Vec<u8>) -> Result<Bytes, axum::Error> {
        self.made += expanded.len() as u64;
        match self.made > ALWAYS_ALLOWED.saturating_add(self.read.saturating_mul(MAX_RATIO)) {
            true => Err(axum::Error::new(io::Error::other(format!(
                "it expands to more than {MAX_RATIO} times its size; send it uncompressed"
            )))),
            false => Ok(expanded.into()),
        }
    }
}

fn damaged(error: io::Error) -> axum::Error {
    axum::Error::new(io::Error::new(
        error.kind(),
        format!(
            "it is not what its Content-Encoding says ({error}); send it whole, or uncompressed"
        ),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::Compression;
    use flate2::write::{GzEncoder, ZlibEncoder};

    fn gzip(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    }

    async fn read(chunks: Vec<Vec<u8>>, encoding: Encoding) -> Result<Vec<u8>, String> {
        // A stream that panics when it is polled after its end, as bodies may.
        let chunks = stream::unfold(chunks.into_iter(), |mut chunks| async {
            let next = chunks.next()?;
            Some((Ok::<_, axum::Error>(next), chunks))
        });
        let mut body = body_of(Body::from_stream(chunks), encoding).into_data_stream();
        let mut whole = Vec::new();
        while let Some(chunk) = body.next().await {
            let chunk = chunk.map_err(|error| error.to_string())?;
            assert!(chunk.len() <= 1 << 20);
            whole.extend_from_slice(&chunk);
        }
        Ok(whole)
    }

    fn text(bytes: usize) -> Vec<u8> {
        (0..bytes).map(|at| (at * at % 251) as u8).collect()
    }

    #[tokio::test]
    async fn a_body_is_expanded_however_it_is_cut() {
        let plain = text(200_000);
        let mut zlib = ZlibEncoder::new(Vec::new(), Compression::fast());
        zlib.write_all(&plain).unwrap();
        let zlib = zlib.finish().unwrap();
        let two_members = [gzip(&plain[..70_000]), gzip(&plain[70_000..])].concat();
        for cut in [1, 7, 511, 100_000] {
            let cut = |bytes: &[u8]| bytes.chunks(cut).map(<[u8]>::to_vec).collect();
            assert_eq!(read(cut(&gzip(&plain)), Encoding::Gzip).await.unwrap(), plain);
            assert_eq!(read(cut(&two_members), Encoding::Gzip).await.unwrap(), plain);
            assert_eq!(read(cut(&zlib), Encoding::Deflate).await.unwrap(), plain);
        }
    }

    #[tokio::test]
    async fn a_damaged_or_truncated_body_is_an_error() {
        let whole = gzip(&text(200_000));
        let cut = whole[..whole.len() / 2].to_vec();
        for (bytes, encoding) in [
            (cut, Encoding::Gzip),
            (b"no gzip at all".to_vec(), Encoding::Gzip),
            (whole, Encoding::Deflate),
        ] {
            let refused = read(vec![bytes], encoding).await.unwrap_err();
            assert!(refused.contains("send it whole, or uncompressed"), "{refused}");
        }
    }

    #[tokio::test]
    async fn a_body_that_expands_without_measure_is_cut_off() {
        let bomb = gzip(&vec![0; 200 << 20]);
        let chunks = bomb.chunks(1 << 16).map(<[u8]>::to_vec).collect();
        let refused = read(chunks, Encoding::Gzip).await.unwrap_err();
        assert!(refused.contains("256 times"), "{refused}");
    }

    #[test]
    fn an_unknown_encoding_is_refused_in_words() {
        let headers = |names: &[&'static str]| -> HeaderMap {
            let header = |name: &&'static str| (CONTENT_ENCODING, HeaderValue::from_static(name));
            names.iter().map(header).collect()
        };
        assert_eq!(of(&headers(&[])).unwrap(), None);
        assert_eq!(of(&headers(&["identity"])).unwrap(), None);
        assert_eq!(of(&headers(&["GZip"])).unwrap(), Some(Encoding::Gzip));
        assert_eq!(of(&headers(&["deflate"])).unwrap(), Some(Encoding::Deflate));
        for unknown in [&["zstd"][..], &["br"], &["gzip, gzip"], &["gzip", "gzip"]] {
            assert!(of(&headers(unknown)).is_err(), "{unknown:?}");
        }
    }
}
