//! Reads the images of a tar archive while it arrives.

use std::io::Read;
use std::sync::Arc;

use axum::body::Body;
use bytes::Bytes;
use futures_util::{Stream, TryStreamExt, stream};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio_util::io::{StreamReader, SyncIoBridge};

use super::{LARGEST_META, Room, described, unreadable};
use crate::gate::Problem;
use whereabouts_api::ErrorKind;
use whereabouts_service::{BulkImage, ServiceError};

/// Suffix of the file that describes a picture, after the name of the picture.
const META: &str = ".json";

type Next = Result<Result<BulkImage, ServiceError>, Problem>;

/// The images of an archive. A blocking thread reads it, no faster than the images are consumed.
pub(super) fn images(body: Body, room: Room) -> impl Stream<Item = Next> + Send {
    let (images, received) = mpsc::channel(1);
    let body = body.into_data_stream().map_err(std::io::Error::other);
    let reader = SyncIoBridge::new(StreamReader::new(body));
    tokio::task::spawn_blocking(move || {
        let mut entries =
            Entries { room, runtime: Handle::current(), images, pending: Pending::Nothing };
        if let Err(problem) = entries.read(reader) {
            let _ = entries.images.blocking_send(Err(problem));
        }
    });
    stream::unfold(received, |mut received| async { Some((received.recv().await?, received)) })
}

struct Entries {
    room: Room,
    runtime: Handle,
    images: mpsc::Sender<Next>,
    pending: Pending,
}

/// The previous entry, whose counterpart may follow.
enum Pending {
    Nothing,
    Picture { name: Arc<str>, bytes: Bytes, memory: OwnedSemaphorePermit },
    Meta { of: Arc<str>, text: Vec<u8> },
}

impl Entries {
    /// Reads all entries, or until the images are no longer consumed.
    fn read(&mut self, reader: impl Read) -> Result<(), Problem> {
        let broken = |error: std::io::Error| unreadable(&error, &error.to_string());
        let mut archive = tar::Archive::new(reader);
        for entry in archive.entries().map_err(broken)? {
            let mut entry = entry.map_err(broken)?;
            let size = usize::try_from(entry.size()).unwrap_or(usize::MAX);
            self.room.allow(size);
            if self.images.is_closed() {
                return Ok(());
            }
            if !entry.header().entry_type().is_file() {
                continue;
            }
            let path = entry.path_bytes();
            let name = std::str::from_utf8(&path).map_err(|_| {
                let detail = "a file in the archive has a name that is not UTF-8; rename it";
                Problem::new(ErrorKind::Malformed, detail)
            })?;
            let name: Arc<str> = name.strip_prefix("./").unwrap_or(name).into();
            let continues = match name.strip_suffix(META) {
                Some(of) => {
                    if size > LARGEST_META {
                        let detail = format!("{name:?} exceeds {LARGEST_META} bytes");
                        return Err(Problem::new(ErrorKind::TooLarge, detail));
                    }
                    let mut text = Vec::with_capacity(size);
                    entry.read_to_end(&mut text).map_err(broken)?;
                    self.meta(of.into(), text)
                }
                None => {
                    if !self.flush_unless_about(&name) {
                        return Ok(());
                    }
                    if self.room.is_too_small(size) {
                        self.images.blocking_send(Ok(Err(self.room.too_large()))).is_ok()
                    } else {
                        let memory = self.runtime.block_on(self.room.reserve(size))?;
                        let mut bytes = Vec::with_capacity(size);
                        entry.read_to_end(&mut bytes).map_err(broken)?;
                        self.picture(name, bytes.into(), memory)
                    }
                }
            };
            if !continues {
                return Ok(());
            }
        }
        self.flush();
        Ok(())
    }

    fn meta(&mut self, of: Arc<str>, text: Vec<u8>) -> bool {
        match std::mem::replace(&mut self.pending, Pending::Nothing) {
            Pending::Picture { name, bytes, memory } if name == of => {
                self.send(&name, Some(&text), bytes, memory)
            }
            other => {
                self.pending = other;
                let continues = self.flush();
                self.pending = Pending::Meta { of, text };
                continues
            }
        }
    }

    /// Flushes the previous entry, unless it describes the next picture. Holding two pictures at a time could
    /// deadlock, the second waiting for the memory of the first.
    fn flush_unless_about(&mut self, picture: &str) -> bool {
        matches!(&self.pending, Pending::Meta { of, .. } if **of == *picture) || self.flush()
    }

    fn picture(&mut self, name: Arc<str>, bytes: Bytes, memory: OwnedSemaphorePermit) -> bool {
        match std::mem::replace(&mut self.pending, Pending::Nothing) {
            Pending::Meta { text, .. } => self.send(&name, Some(&text), bytes, memory),
            _ => {
                self.pending = Pending::Picture { name, bytes, memory };
                true
            }
        }
    }

    /// Sends the previous entry on without its counterpart.
    fn flush(&mut self) -> bool {
        match std::mem::replace(&mut self.pending, Pending::Nothing) {
            Pending::Nothing => true,
            Pending::Picture { name, bytes, memory } => self.send(&name, None, bytes, memory),
            Pending::Meta { of, .. } => {
                let error = ServiceError::malformed(format!(
                    "{of}{META} describes {of}, which is neither directly before nor directly after it in the archive"
                ));
                self.images.blocking_send(Ok(Err(error))).is_ok()
            }
        }
    }

    fn send(
        &self,
        name: &str,
        meta: Option<&[u8]>,
        bytes: Bytes,
        memory: OwnedSemaphorePermit,
    ) -> bool {
        let meta = described(meta, Some(name));
        let image = meta.map(|meta| BulkImage { bytes, meta, memory: Some(memory) });
        self.images.blocking_send(Ok(image)).is_ok()
    }
}
