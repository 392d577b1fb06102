//! Reads the text in images, in the background, and in the frames of jobs.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;
use whereabouts_api::MapTexts;
use whereabouts_core::{Digest, Image, ImageTexts, Map, MapName, TextLine};
use whereabouts_reading::Reader;
use whereabouts_refine::FrameReader;
use whereabouts_store::{IndexState, Store, StoreError, TextCounts, TextStore};
use whereabouts_vision::{Admission, AdmissionRequest, CpuPool, ImageLimits, decode};

use super::{ServiceError, ServiceMetrics};

/// Pause between two scans for images that were not read.
const SCAN_PAUSE: Duration = Duration::from_secs(1);

/// The pause is at least this many times the duration of the scans, so that many maps do not keep the store busy.
const PAUSE_PER_SCAN: u32 = 10;

/// Images that are looked up at a time.
const PAGE: usize = 64;

/// How long an image is left to the process that began to read it: longer than that takes.
const CLAIMED: SignedDuration = SignedDuration::from_mins(10);

/// Frames and images that wait for the thread that reads. More than jobs can be in progress.
const QUEUE: usize = 4096;

/// How long counts of a map with many images are used again: counting takes time.
const COUNTS_AGE: Duration = Duration::from_secs(30);

/// Maps with at most this many images are counted each time.
const COUNTED_AT_ONCE: usize = 10_000;

/// `[reading]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReadingSettings {
    /// The reader: a folder among the assets; empty for none.
    pub reader: String,
    /// Threads of its models.
    pub threads: usize,
    /// The most lines that are read in a picture.
    pub max_lines: usize,
}

impl ReadingSettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        let most = ImageTexts::MAX_LINES;
        match (self.max_lines, self.threads) {
            (lines, _) if !(1..=most).contains(&lines) => {
                Some(format!("reading.max_lines must be 1 to {most}"))
            }
            (_, 0) => Some("reading.threads must be at least 1".into()),
            _ => None,
        }
    }
}

/// Reads the text in images and frames, one picture at a time, with a thread of its own, so that no request waits for it.
pub struct Reading {
    reader: Option<Arc<dyn Reader>>,
    store: Arc<dyn Store>,
    admission: Admission,
    limits: ImageLimits,
    pool: CpuPool,
    metrics: Arc<ServiceMetrics>,
    counts: Mutex<BTreeMap<Uuid, (Instant, TextCounts)>>,
    /// Limits searches for text to one at a time.
    pub(super) searching: Semaphore,
}

/// A map at the last scan.
struct Seen {
    name: MapName,
    /// Its number of images and its version when all of them were read.
    settled: Option<(usize, u64)>,
}

/// What became of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Done,
    /// Another process reads it.
    Elsewhere,
    /// It can be read another time: its bytes are missing, or the process ends.
    Later,
}

/// A picture that was not read.
enum NotRead {
    /// It cannot be: it is damaged, or the model fails on it.
    Never(String),
    /// It may be readable later.
    Later(String),
}

impl Reading {
    /// Starts the thread that reads. Without a reader, nothing is read, and what was read before is still found.
    pub fn new(
        reader: Option<Arc<dyn Reader>>,
        store: Arc<dyn Store>,
        admission: Admission,
        limits: ImageLimits,
        metrics: Arc<ServiceMetrics>,
    ) -> std::io::Result<Self> {
        let pool = CpuPool::new("reading", 1, QUEUE)?;
        let (counts, searching) = (Mutex::default(), Semaphore::new(1));
        Ok(Self { reader, store, admission, limits, pool, metrics, counts, searching })
    }

    /// What was read.
    pub(super) fn texts(&self) -> &dyn TextStore {
        self.store.as_ref()
    }

    /// Whether there is a reader.
    pub fn is_installed(&self) -> bool {
        self.reader.is_some()
    }

    /// What identifies the reader; `None` without one.
    pub fn digest(&self) -> Option<Digest> {
        self.reader.as_ref().map(|reader| reader.digest())
    }

    /// Reads the images of a map that were not read, now, and calls `on_read` after each.
    ///
    /// # Errors
    /// The store is unavailable.
    pub async fn read_map(&self, map: &Map, on_read: impl Fn()) -> Result<(), ServiceError> {
        let Some(reader) = &self.reader else { return Ok(()) };
        let mut after = None;
        loop {
            let page = self.store.unread(map, &reader.digest(), after.as_ref(), PAGE).await?;
            let Some(last) = page.last() else { return Ok(()) };
            after = Some(last.id.clone());
            for image in &page {
                self.read_image(reader, map, image).await?;
                on_read();
            }
        }
    }

    /// The thread that reads. The process waits for it before it exits.
    pub fn pool(&self) -> CpuPool {
        self.pool.clone()
    }

    /// Reads the images that were not read, until `shutdown`.
    pub async fn run(&self, shutdown: CancellationToken) {
        let Some(reader) = &self.reader else { return };
        let mut seen = BTreeMap::new();
        let mut pause = SCAN_PAUSE;
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(pause) => {}
            }
            let read = tokio::select! {
                () = shutdown.cancelled() => return,
                read = self.read_new(reader, &mut seen) => read,
            };
            pause = SCAN_PAUSE;
            match read {
                Ok(scanned) => pause = pause.max(scanned * PAUSE_PER_SCAN).min(SCAN_PAUSE * 60),
                // The next scan tries again if a map was deleted meanwhile, or the store is unavailable.
                Err(error) => tracing::debug!(%error, "images could not be read"),
            }
        }
    }

    /// Reads the images of the maps that have changed since all of their images were read. Returns how long looking for
    /// them took.
    async fn read_new(
        &self,
        reader: &Arc<dyn Reader>,
        seen: &mut BTreeMap<Uuid, Seen>,
    ) -> Result<Duration, ServiceError> {
        let began = Instant::now();
        let maps = self.store.maps().await?;
        let is_there = |uid: &Uuid| maps.iter().any(|map| map.uid == *uid);
        for (_, gone) in seen.extract_if(.., |uid, _| !is_there(uid)) {
            self.metrics.forget_images_unread(gone.name.as_str());
        }
        self.counts.lock().retain(|uid, _| is_there(uid));
        let mut reading = Duration::ZERO;
        for map in maps {
            let IndexState { images, changes, .. } = self.store.index_state(&map).await?;
            let state = (images, changes);
            let name = map.name.clone();
            let seen = seen.entry(map.uid).or_insert(Seen { name, settled: None });
            if seen.settled == Some(state) {
                continue;
            }
            let (mut after, mut elsewhere) = (None, false);
            loop {
                let page = self.store.unread(&map, &reader.digest(), after.as_ref(), PAGE).await?;
                let Some(last) = page.last() else { break };
                after = Some(last.id.clone());
                let began = Instant::now();
                for image in &page {
                    elsewhere |= self.read_image(reader, &map, image).await? == Outcome::Elsewhere;
                }
                reading += began.elapsed();
                self.show_waiting(reader, &map).await?;
            }
            if !elsewhere {
                seen.settled = Some(state);
            }
        }
        Ok(began.elapsed().saturating_sub(reading))
    }

    async fn show_waiting(&self, reader: &Arc<dyn Reader>, map: &Map) -> Result<(), ServiceError> {
        let IndexState { images, .. } = self.store.index_state(map).await?;
        let TextCounts { read, failed, .. } =
            self.counted(map, images, Some(&reader.digest())).await?;
        self.metrics.images_unread(map.name.as_str(), images.saturating_sub(read + failed));
        Ok(())
    }

    /// Reads an image and stores its texts, unless another process does.
    async fn read_image(
        &self,
        reader: &Arc<dyn Reader>,
        map: &Map,
        image: &Image,
    ) -> Result<Outcome, ServiceError> {
        let key = claim_of(map, image, &reader.digest());
        if !self.store.acquire_lease(&key, Timestamp::now() + CLAIMED).await? {
            return Ok(Outcome::Elsewhere);
        }
        let read = self.read_claimed(reader, map, image).await;
        self.store.release_lease(&key).await?;
        read
    }

    async fn read_claimed(
        &self,
        reader: &Arc<dyn Reader>,
        map: &Map,
        image: &Image,
    ) -> Result<Outcome, ServiceError> {
        // Another process may have read it since it was listed.
        let known = self.store.texts(map, std::slice::from_ref(&image.id)).await?.pop().flatten();
        if known.is_some_and(|known| known.reader == reader.digest()) {
            return Ok(Outcome::Done);
        }
        let began = Instant::now();
        let texts = match self.read(reader, &image.digest, true).await? {
            Ok(lines) => ImageTexts::read(reader.digest(), lines),
            Err(NotRead::Never(why)) => {
                tracing::warn!(map = %map.name, image = %image.id, why, "the text of an image cannot be read");
                ImageTexts::failed(reader.digest(), &why)
            }
            Err(NotRead::Later(why)) => {
                tracing::warn!(map = %map.name, image = %image.id, why, "the text of an image was not read");
                return Ok(Outcome::Later);
            }
        };
        self.metrics.image_read(texts.error.is_none(), texts.lines.len(), began.elapsed());
        // An image that was removed meanwhile needs no texts.
        self.store.put_texts(map, image, texts).await?;
        Ok(Outcome::Done)
    }

    /// Reads a picture. In the background, it is begun when no request waits.
    async fn read(
        &self,
        reader: &Arc<dyn Reader>,
        picture: &Digest,
        in_background: bool,
    ) -> Result<Result<Vec<TextLine>, NotRead>, StoreError> {
        let permit = match in_background {
            // Background work is never rejected.
            true => self.admission.acquire(AdmissionRequest::BACKGROUND).await.ok(),
            false => None,
        };
        let Some(bytes) = self.store.blob(picture).await? else {
            return Ok(Err(NotRead::Later("its bytes are missing from the store".into())));
        };
        let (reader, limits) = (Arc::clone(reader), self.limits);
        let read = move || {
            let picture = decode::decode(&bytes, limits, decode::Needed::All)
                .map_err(|error| NotRead::Never(error.to_string()))?;
            // Others may begin: what follows has a thread of its own.
            drop(permit);
            reader.read(&picture).map_err(|error| NotRead::Never(error.to_string()))
        };
        Ok(self.pool.run(read).await.unwrap_or_else(|error| Err(NotRead::Later(error.to_string()))))
    }

    /// How much of a map was read; `None` if nothing was and there is no reader.
    pub(crate) async fn state_of(
        &self,
        map: &Map,
        images: usize,
    ) -> Result<Option<MapTexts>, ServiceError> {
        let reader = self.reader.as_ref().map(|reader| reader.digest());
        let counts = self.counted(map, images, reader.as_ref()).await?;
        if reader.is_none() && counts == TextCounts::default() {
            return Ok(None);
        }
        let TextCounts { read, failed, lines } = counts;
        let waiting = reader.map(|_| images.saturating_sub(read + failed));
        Ok(Some(MapTexts { reader, read, failed, waiting, lines }))
    }

    /// Whether this reader has read text in a map.
    async fn has_texts(&self, map: &MapName, reader: &Arc<dyn Reader>) -> Result<bool, StoreError> {
        let Some(map) = self.store.map(map).await? else { return Ok(false) };
        let images = self.store.index_state(&map).await?.images;
        Ok(self.counted(&map, images, Some(&reader.digest())).await?.lines > 0)
    }

    async fn counted(
        &self,
        map: &Map,
        images: usize,
        reader: Option<&Digest>,
    ) -> Result<TextCounts, StoreError> {
        let known = self.counts.lock().get(&map.uid).copied();
        if let Some((at, counts)) = known
            && images > COUNTED_AT_ONCE
            && at.elapsed() < COUNTS_AGE
        {
            return Ok(counts);
        }
        let counts = self.store.text_counts(map, reader).await?;
        self.counts.lock().insert(map.uid, (Instant::now(), counts));
        Ok(counts)
    }
}

#[async_trait]
impl FrameReader for Reading {
    async fn read_frame(&self, map: &MapName, frame: &Digest) -> Option<Vec<TextLine>> {
        let reader = self.reader.as_ref()?;
        let read = async {
            match self.has_texts(map, reader).await? {
                true => self.read(reader, frame, false).await.map(Some),
                false => Ok(None),
            }
        };
        match read.await {
            Ok(Some(Ok(lines))) => Some(ImageTexts::read(reader.digest(), lines).lines),
            Ok(Some(Err(NotRead::Never(why) | NotRead::Later(why)))) => {
                tracing::warn!(why, "the text of a frame cannot be read");
                None
            }
            Ok(None) => None,
            Err(error) => {
                tracing::debug!(%error, "the text of a frame was not read");
                None
            }
        }
    }
}

/// Identifies the reading of an image, on every server of its store.
fn claim_of(map: &Map, image: &Image, reader: &Digest) -> Digest {
    let Image { id, digest, .. } = image;
    Digest::of(format!("text of {} {digest} {reader} {id}", map.uid).as_bytes())
}
