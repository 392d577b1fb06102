//! What kind of archive a body is, by its first bytes, and a reader that expands it.

use std::cell::Cell;
use std::io::{self, BufRead, BufReader, Read};
use std::rc::Rc;

use axum::body::Body;
use bytes::{Bytes, BytesMut};
use flate2::bufread::MultiGzDecoder;
use futures_util::{StreamExt, stream};

use crate::gate::Problem;
use crate::http::batch::unreadable;

/// Media types of archives.
pub(in crate::http::batch) const MEDIA_TYPES: [&str; 8] = [
    "application/x-tar",
    "application/tar",
    "application/x-gtar",
    "application/gzip",
    "application/x-gzip",
    "application/x-compressed-tar",
    "application/x-tgz",
    "application/x-tar+gzip",
];

/// Size of the header of a tar archive.
const BLOCK: usize = 512;

/// An archive may expand to this many times its size,
const MAX_RATIO: u64 = 256;

/// and by this many bytes in any case.
const ALWAYS_ALLOWED: u64 = 64 << 20;

/// The format of an archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::http::batch) enum Format {
    Tar,
    GzippedTar,
}

/// Reads the first bytes of a body. Returns them, and the whole body.
pub(in crate::http::batch) async fn head_of(body: Body) -> Result<(Bytes, Body), Problem> {
    let mut chunks = body.into_data_stream();
    let mut head = BytesMut::new();
    while head.len() < BLOCK
        && let Some(chunk) = chunks.next().await
    {
        head.extend_from_slice(&chunk.map_err(|error| unreadable(&error, &error.to_string()))?);
    }
    let head = head.freeze();
    let first = stream::iter([Ok::<_, axum::Error>(head.clone())]);
    Ok((head, Body::from_stream(first.chain(chunks))))
}

/// The name of a compression that is not read.
pub(in crate::http::batch) fn compression_of(head: &[u8]) -> Option<&'static str> {
    const KNOWN: [(&[u8], &str); 7] = [
        (b"PK\x03\x04", "zip"),
        (b"BZh", "bzip2"),
        (b"\xFD7zXZ\0", "xz"),
        (b"\x28\xB5\x2F\xFD", "zstd"),
        (b"7z\xBC\xAF\x27\x1C", "7z"),
        (b"Rar!\x1A\x07", "RAR"),
        (b"\x1F\x9D", "compress"),
    ];
    KNOWN.iter().find(|(magic, _)| head.starts_with(magic)).map(|(_, name)| *name)
}

impl Format {
    /// Detects the format from the first bytes.
    pub fn of(head: &[u8]) -> Option<Self> {
        if head.starts_with(&[0x1F, 0x8B]) {
            return Some(Self::GzippedTar);
        }
        let block: &[u8; BLOCK] = head.get(..BLOCK)?.try_into().ok()?;
        // An empty archive has blocks of zeros only; the checksum counts its own bytes as spaces.
        let is_header = || {
            let sum: u32 = block.iter().map(|byte| u32::from(*byte)).sum();
            let own: u32 = block[148..156].iter().map(|byte| u32::from(*byte)).sum();
            let stored = tar::Header::from_byte_slice(block).cksum();
            stored.is_ok_and(|stored| stored == sum - own + 8 * u32::from(b' '))
        };
        (block.iter().all(|byte| *byte == 0) || is_header()).then_some(Self::Tar)
    }

    /// A reader of the tar archive in `reader`.
    pub fn reader(self, reader: impl Read + 'static) -> Box<dyn Read> {
        match self {
            Self::Tar => Box::new(reader),
            Self::GzippedTar => {
                let read = Rc::new(Cell::new(0));
                let counted = Counted { reader, read: Rc::clone(&read) };
                let decoder = MultiGzDecoder::new(BufReader::new(counted));
                Box::new(Bounded { decoder, read, made: 0 })
            }
        }
    }
}

/// Counts the bytes that are read.
struct Counted<R> {
    reader: R,
    read: Rc<Cell<u64>>,
}

impl<R: Read> Read for Counted<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.reader.read(buffer)?;
        self.read.set(self.read.get() + read as u64);
        Ok(read)
    }
}

/// Fails when the expanded archive is out of proportion to what was read of it.
struct Bounded<R> {
    decoder: MultiGzDecoder<R>,
    read: Rc<Cell<u64>>,
    made: u64,
}

impl<R: BufRead> Read for Bounded<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let made = self.decoder.read(buffer)?;
        self.made += made as u64;
        let most = ALWAYS_ALLOWED.saturating_add(self.read.get().saturating_mul(MAX_RATIO));
        match self.made > most {
            true => Err(io::Error::other(format!(
                "the archive expands to more than {MAX_RATIO} times its size; send it uncompressed"
            ))),
            false => Ok(made),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;
    use flate2::Compression;
    use flate2::write::GzEncoder;

    fn tar(bytes: &[u8]) -> Vec<u8> {
        let mut builder = tar::Builder::new(Vec::new());
        let mut header = tar::Header::new_old();
        header.set_size(bytes.len() as u64);
        builder.append_data(&mut header, "a.jpg", bytes).unwrap();
        builder.into_inner().unwrap()
    }

    fn gzip(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn the_format_is_detected_from_the_first_bytes() {
        assert_eq!(Format::of(&tar(b"x")), Some(Format::Tar));
        assert_eq!(Format::of(&[0; 1024]), Some(Format::Tar));
        assert_eq!(Format::of(&gzip(&tar(b"x"))), Some(Format::GzippedTar));
        for other in [&b"no archive at all".repeat(100)[..], b"PK\x03\x04", b"\xFF\xD8\xFF", b""] {
            assert_eq!(Format::of(other), None);
        }
        assert_eq!(compression_of(b"BZh91AY&SY"), Some("bzip2"));
        assert_eq!(compression_of(&tar(b"x")), None);
    }

    #[test]
    fn an_archive_of_reasonable_pictures_is_expanded_and_a_bomb_is_not() {
        let plain = tar(&(0..1_000_000_u32).map(|at| (at * at % 251) as u8).collect::<Vec<_>>());
        let mut whole = Vec::new();
        let reader = Format::GzippedTar.reader(io::Cursor::new(gzip(&plain)));
        { reader }.read_to_end(&mut whole).unwrap();
        assert_eq!(whole, plain);
        let bomb = io::Cursor::new(gzip(&vec![0; 200 << 20]));
        let refused = io::copy(&mut Format::GzippedTar.reader(bomb), &mut io::sink()).unwrap_err();
        assert!(refused.to_string().contains("256 times"), "{refused}");
    }
}
