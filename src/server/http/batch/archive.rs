//! Reads the images of a tar archive while it arrives. A picture and the file that describes it, `a.jpg.json`, may be
//! anywhere in it: a description waits for its picture, a picture does not wait for its description.

mod format;
mod names;

use std::collections::{HashMap, HashSet};
use std::io::Read;
use std::sync::Arc;

use axum::body::Body;
use bytes::Bytes;
use futures_util::{Stream, TryStreamExt, stream};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio_util::io::{StreamReader, SyncIoBridge};

pub(super) use self::format::{Format, MEDIA_TYPES, compression_of, head_of};
use self::names::{Member, member};
use super::{LARGEST_META, Room, described, unreadable};
use crate::gate::Problem;
use whereabouts_api::{ErrorKind, ImageMeta};
use whereabouts_service::{BulkImage, BulkItem, ServiceError};

/// Suffix of the file that describes a picture, after the name of the picture.
const META: &str = ".json";

type Next = Result<(usize, BulkItem), Problem>;

/// The images of an archive. A blocking thread reads it, no faster than the images are consumed.
pub(super) fn images(body: Body, format: Format, room: Room) -> impl Stream<Item = Next> + Send {
    let (items, received) = mpsc::channel(1);
    let body = body.into_data_stream().map_err(std::io::Error::other);
    let reader = SyncIoBridge::new(StreamReader::new(body));
    tokio::task::spawn_blocking(move || {
        let mut entries = Entries {
            room,
            runtime: Handle::current(),
            items,
            pending: None,
            waiting: HashMap::new(),
            waiting_bytes: 0,
            sent: HashMap::new(),
            described: HashSet::new(),
        };
        if let Err(problem) = entries.read(format.reader(reader)) {
            let _ = entries.items.blocking_send(Err(problem));
        }
    });
    stream::unfold(received, |mut received| async { Some((received.recv().await?, received)) })
}

struct Entries {
    room: Room,
    runtime: Handle,
    items: mpsc::Sender<Next>,
    /// The last picture, whose description may follow.
    pending: Option<Picture>,
    /// Descriptions whose picture has not come yet, by the name of the picture.
    waiting: HashMap<Arc<str>, Waiting>,
    /// Their size.
    waiting_bytes: usize,
    /// Pictures that were sent on without a description, and their numbers.
    sent: HashMap<Arc<str>, usize>,
    /// Pictures that have their description.
    described: HashSet<Arc<str>>,
}

struct Picture {
    number: usize,
    name: Arc<str>,
    bytes: Bytes,
    memory: OwnedSemaphorePermit,
}

/// A description that waits for its picture.
struct Waiting {
    number: usize,
    text: Result<Vec<u8>, ServiceError>,
}

/// The images are no longer consumed.
struct Closed;

impl Entries {
    /// Reads all entries, or until the images are no longer consumed.
    fn read(&mut self, reader: impl Read) -> Result<(), Problem> {
        let broken = |error: std::io::Error| unreadable(&error, &error.to_string());
        let mut archive = tar::Archive::new(reader);
        for (number, entry) in archive.entries().map_err(broken)?.enumerate() {
            let mut entry = entry.map_err(broken)?;
            let size = usize::try_from(entry.size()).unwrap_or(usize::MAX);
            self.room.allow(size);
            if self.items.is_closed() {
                return Ok(());
            }
            let name = match member(entry.header().entry_type(), &entry.path_bytes()) {
                Member::Nothing => continue,
                Member::Skipped { name, why } => {
                    if self.send(number, BulkItem::Skipped(name, why)).is_err() {
                        return Ok(());
                    }
                    continue;
                }
                Member::File(name) => name,
            };
            let done = match name.strip_suffix(META) {
                Some(of) => {
                    let text = if size > LARGEST_META {
                        Err(ServiceError::new(
                            ErrorKind::TooLarge,
                            format!("{name:?} exceeds {LARGEST_META} bytes"),
                        ))
                    } else {
                        let mut text = Vec::with_capacity(size);
                        entry.read_to_end(&mut text).map_err(broken)?;
                        Ok(text)
                    };
                    self.description(number, of.into(), text)
                }
                None => {
                    // Holding two pictures at a time could deadlock, the second waiting for the memory of the first.
                    if self.flush().is_err() {
                        return Ok(());
                    }
                    if self.room.is_too_small(size) {
                        self.send(number, BulkItem::Failed(self.room.too_large()))
                    } else {
                        let memory = self.runtime.block_on(self.room.reserve(size))?;
                        let mut bytes = Vec::with_capacity(size);
                        entry.read_to_end(&mut bytes).map_err(broken)?;
                        let name: Arc<str> = name.into();
                        self.picture(Picture { number, name, bytes: bytes.into(), memory })
                    }
                }
            };
            if done.is_err() {
                return Ok(());
            }
        }
        let _ = self.end();
        Ok(())
    }

    fn picture(&mut self, picture: Picture) -> Result<(), Closed> {
        let Some(Waiting { text, .. }) = self.waiting.remove(&picture.name) else {
            self.pending = Some(picture);
            return Ok(());
        };
        self.waiting_bytes -= size_of_waiting(&picture.name, &text);
        self.send_described(picture, text)
    }

    fn description(
        &mut self,
        number: usize,
        of: Arc<str>,
        text: Result<Vec<u8>, ServiceError>,
    ) -> Result<(), Closed> {
        if let Some(picture) = self.pending.take_if(|picture| picture.name == of) {
            return self.send_described(picture, text);
        }
        if let Some(picture) = self.sent.remove(&of) {
            let meta = read_meta(text, &of);
            self.described.insert(of);
            return self.send(picture, BulkItem::Meta(meta));
        }
        if self.described.contains(&of) || self.waiting.contains_key(&of) {
            return self.send(number, BulkItem::Failed(twice(&of)));
        }
        let size = size_of_waiting(&of, &text);
        if self.waiting_bytes + size > self.room.meta_bytes {
            let error = format!(
                "{of}{META} came before its picture, as have {} bytes of such files, the limit (bulk.meta_bytes); put \
                 each next to its picture",
                self.waiting_bytes
            );
            let error = ServiceError::new(ErrorKind::TooLarge, error);
            return self.send(number, BulkItem::Failed(error));
        }
        self.waiting_bytes += size;
        self.waiting.insert(of, Waiting { number, text });
        Ok(())
    }

    /// Sends the last picture on without a description.
    fn flush(&mut self) -> Result<(), Closed> {
        let Some(Picture { number, name, bytes, memory }) = self.pending.take() else {
            return Ok(());
        };
        let meta = ImageMeta { id: Some(name.to_string()), ..ImageMeta::default() };
        self.sent.entry(name).or_insert(number);
        self.send(number, BulkItem::Image(BulkImage { bytes, meta, memory: Some(memory) }))
    }

    /// Sends the last picture on, and says which descriptions have found none.
    fn end(&mut self) -> Result<(), Closed> {
        self.flush()?;
        for (of, Waiting { number, .. }) in std::mem::take(&mut self.waiting) {
            let error = ServiceError::malformed(format!(
                "{of}{META} describes {of}, which is not in the archive"
            ));
            self.send(number, BulkItem::Failed(error))?;
        }
        Ok(())
    }

    fn send_described(
        &mut self,
        picture: Picture,
        text: Result<Vec<u8>, ServiceError>,
    ) -> Result<(), Closed> {
        let Picture { number, name, bytes, memory } = picture;
        let item = match read_meta(text, &name) {
            Ok(meta) => BulkItem::Image(BulkImage { bytes, meta, memory: Some(memory) }),
            Err(error) => BulkItem::Failed(error),
        };
        self.described.insert(name);
        self.send(number, item)
    }

    fn send(&self, number: usize, item: BulkItem) -> Result<(), Closed> {
        self.items.blocking_send(Ok((number, item))).map_err(|_| Closed)
    }
}

fn read_meta(text: Result<Vec<u8>, ServiceError>, of: &str) -> Result<ImageMeta, ServiceError> {
    described(Some(&text?), Some(of))
}

fn size_of_waiting(of: &str, text: &Result<Vec<u8>, ServiceError>) -> usize {
    of.len() + text.as_ref().map_or(0, Vec::len)
}

fn twice(of: &str) -> ServiceError {
    ServiceError::malformed(format!(
        "{of}{META} is in the archive twice; the first describes {of}, and this one is not used"
    ))
}
