//! Many images in a tar archive, as it comes in.

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

/// What the name of a picture is followed by in the name of what is said about it.
const META: &str = ".json";

type Next = Result<Result<BulkImage, ServiceError>, Problem>;

/// The images of an archive. It is read by a thread of its own, no faster than the images are taken.
pub(super) fn images(body: Body, room: Room) -> impl Stream<Item = Next> + Send {
    let (images, taken) = mpsc::channel(1);
    let body = body.into_data_stream().map_err(std::io::Error::other);
    let reader = SyncIoBridge::new(StreamReader::new(body));
    tokio::task::spawn_blocking(move || {
        let mut entries =
            Entries { room, runtime: Handle::current(), images, before: Before::Nothing };
        if let Err(problem) = entries.read(reader) {
            let _ = entries.images.blocking_send(Err(problem));
        }
    });
    stream::unfold(taken, |mut taken| async { Some((taken.recv().await?, taken)) })
}

struct Entries {
    room: Room,
    runtime: Handle,
    images: mpsc::Sender<Next>,
    before: Before,
}

/// The entry before, whose other half may follow.
enum Before {
    Nothing,
    Picture { name: Arc<str>, bytes: Bytes, memory: OwnedSemaphorePermit },
    Meta { of: Arc<str>, text: Vec<u8> },
}

impl Entries {
    /// Reads all entries; `Ok` also when nobody takes them any more.
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
            let go_on = match name.strip_suffix(META) {
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
                    if !self.makes_way_for(&name) {
                        return Ok(());
                    }
                    if self.room.is_too_small(size) {
                        self.images.blocking_send(Ok(Err(self.room.too_large()))).is_ok()
                    } else {
                        let memory = self.runtime.block_on(self.room.take(size))?;
                        let mut bytes = Vec::with_capacity(size);
                        entry.read_to_end(&mut bytes).map_err(broken)?;
                        self.picture(name, bytes.into(), memory)
                    }
                }
            };
            if !go_on {
                return Ok(());
            }
        }
        self.pass_on();
        Ok(())
    }

    fn meta(&mut self, of: Arc<str>, text: Vec<u8>) -> bool {
        match std::mem::replace(&mut self.before, Before::Nothing) {
            Before::Picture { name, bytes, memory } if name == of => {
                self.send(&name, Some(&text), bytes, memory)
            }
            before => {
                self.before = before;
                let go_on = self.pass_on();
                self.before = Before::Meta { of, text };
                go_on
            }
        }
    }

    /// Passes the entry before on, unless it is about the picture that comes now: of two pictures one would
    /// wait for the memory of the other.
    fn makes_way_for(&mut self, picture: &str) -> bool {
        matches!(&self.before, Before::Meta { of, .. } if **of == *picture) || self.pass_on()
    }

    fn picture(&mut self, name: Arc<str>, bytes: Bytes, memory: OwnedSemaphorePermit) -> bool {
        match std::mem::replace(&mut self.before, Before::Nothing) {
            Before::Meta { text, .. } => self.send(&name, Some(&text), bytes, memory),
            _ => {
                self.before = Before::Picture { name, bytes, memory };
                true
            }
        }
    }

    /// Passes the entry before on, as its other half is not there.
    fn pass_on(&mut self) -> bool {
        match std::mem::replace(&mut self.before, Before::Nothing) {
            Before::Nothing => true,
            Before::Picture { name, bytes, memory } => self.send(&name, None, bytes, memory),
            Before::Meta { of, .. } => {
                let error = ServiceError::malformed(format!(
                    "{of}{META} is about {of}, which is neither right before nor right after it in the archive"
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
