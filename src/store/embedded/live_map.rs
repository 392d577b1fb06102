//! A loaded map: which image is in which slot, and the index over them.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use super::super::changes::in_order;
use super::super::{HardNegatives, LocatedImage, StoreError};
use super::blobs::replace_durably;
use super::images::{Entry, StoredImage};
use super::segments::VectorFiles;
use super::trees::Trees;
use parking_lot::RwLock;
use rayon::prelude::*;
use whereabouts_core::{Calibration, CalibrationSettings, Candidate, Map, Pose};
use whereabouts_index::{IndexSettings, MapIndex, ScoredSlot, SealedGraph, SearchMode, Vectors};

/// Slots whose records one thread reads at a time when a map is opened.
const READ_TOGETHER: usize = 16_384;

pub(super) struct LiveMap {
    /// The map as stored; scene and description may change.
    map: RwLock<Map>,
    pub vectors: Arc<VectorFiles>,
    pub index: MapIndex,
    pub calibration: StoredCalibration,
    /// Where the sealed graph is stored, so that a restart need not rebuild it.
    graph_file: PathBuf,
    /// By slot, kept in memory so that a search reads no records.
    entries: RwLock<Vec<Option<Entry>>>,
    /// The slot of the next image. Only the writer thread changes it.
    next_slot: AtomicUsize,
    /// Number of additions, removals and changed poses since the map was loaded.
    changes: AtomicU64,
    /// The same of images with a pose.
    located: AtomicU64,
    /// How often poses were changed since the map was created.
    moved: AtomicU64,
}

impl LiveMap {
    /// Loads a map. An image with a damaged descriptor is logged and excluded from searches.
    pub fn load(
        map: Map,
        descriptors: &Path,
        index: IndexSettings,
        trees: &Trees,
    ) -> Result<Self, StoreError> {
        let uid = map.uid;
        let live = Self::open(map, descriptors, index)?;
        live.moved.store(trees.moved(uid)?, Ordering::Relaxed);
        // Each takes about a second for a million images.
        let (images, ()) = rayon::join(|| live.restore_images(trees), || live.restore_graph(index));
        images?;
        Ok(live)
    }

    /// Makes the stored images visible to searches.
    fn restore_images(&self, trees: &Trees) -> Result<(), StoreError> {
        let map = self.map();
        let end = trees.slot_end(map.uid)?;
        let starts = (0..end).into_par_iter().step_by(READ_TOGETHER);
        let intact =
            starts.map(|start| self.intact_images(trees, &map, start..start + READ_TOGETHER));
        let intact: Vec<Vec<(usize, Entry)>> = intact.collect::<Result<_, _>>()?;
        self.next_slot.fetch_max(end, Ordering::Relaxed);
        self.index.add_all(intact.iter().flatten().map(|(slot, _)| *slot));
        intact.iter().flatten().for_each(|(_, image)| self.count_change(image.pose.is_some()));
        let mut entries = self.entries.write();
        entries.resize_with(end, || None);
        for (slot, image) in intact.into_iter().flatten() {
            entries[slot] = Some(image);
        }
        Ok(())
    }

    /// Returns the images in a range of slots whose descriptors are intact.
    fn intact_images(
        &self,
        trees: &Trees,
        map: &Map,
        slots: Range<usize>,
    ) -> Result<Vec<(usize, Entry)>, StoreError> {
        let mut intact = Vec::new();
        for located in trees.entries_in(map.uid, slots) {
            let (slot, image) = located?;
            if self.vectors.is_intact(slot) {
                intact.push((slot, image));
            } else {
                tracing::error!(
                    map = %map.name, image = %image.id,
                    "its descriptor is damaged, so searches do not find it; delete the image and add it \
                     again"
                );
            }
        }
        Ok(intact)
    }

    /// Opens a map's descriptors, without any images yet.
    pub fn open(map: Map, descriptors: &Path, index: IndexSettings) -> Result<Self, StoreError> {
        let folder = folder_of(&map, descriptors);
        let vectors = VectorFiles::open(folder.clone(), map.dim)?;
        Ok(Self {
            map: RwLock::new(map),
            vectors: Arc::new(vectors),
            index: MapIndex::new(index),
            calibration: StoredCalibration::open(&folder),
            graph_file: folder.join("graph"),
            entries: RwLock::default(),
            next_slot: AtomicUsize::new(0),
            changes: AtomicU64::new(0),
            located: AtomicU64::new(0),
            moved: AtomicU64::new(0),
        })
    }

    /// Restores the graph sealed by an earlier process. If it is damaged or missing, it is rebuilt in
    /// the background while the map is searched exactly.
    fn restore_graph(&self, settings: IndexSettings) {
        let bytes = match std::fs::read(&self.graph_file) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return,
            Err(error) => {
                tracing::warn!(file = %self.graph_file.display(), %error, "cannot read the graph");
                return;
            }
        };
        match SealedGraph::from_bytes(&bytes) {
            Ok(sealed) if sealed.dim() == self.vectors.dim() && sealed.is_built_with(&settings) => {
                // Its slots must not be reused for other images.
                self.next_slot.fetch_max(sealed.end(), Ordering::Relaxed);
                self.index.restore(sealed);
            }
            Ok(_) => tracing::info!(
                file = %self.graph_file.display(),
                "the graph was built with other settings; rebuilding it"
            ),
            Err(error) => {
                tracing::warn!(file = %self.graph_file.display(), %error, "rebuilding the graph");
            }
        }
    }

    /// Writes a sealed graph to disk for the next start.
    pub fn store_graph(&self, sealed: &SealedGraph) {
        let temporary = self.graph_file.with_extension("tmp");
        if let Err(error) = replace_durably(&self.graph_file, &temporary, &sealed.to_bytes()) {
            // The next start rebuilds it.
            tracing::warn!(file = %self.graph_file.display(), %error, "cannot write the graph");
        }
    }

    pub fn map(&self) -> Map {
        self.map.read().clone()
    }

    pub fn set_map(&self, map: Map) {
        *self.map.write() = map;
    }

    /// Allocates the slot of a new image. Call it on the writer thread.
    pub fn allocate_slot(&self) -> usize {
        self.next_slot.fetch_add(1, Ordering::Relaxed)
    }

    /// Returns the slot of the next image. Only on the writer thread does this mean that all images with
    /// lower slots are stored.
    pub fn next_slot(&self) -> usize {
        self.next_slot.load(Ordering::Relaxed)
    }

    /// Continues the slot numbers and the count of changed poses of `other`, which this map replaces.
    pub fn continue_from(&self, other: &Self) {
        self.next_slot.store(other.next_slot(), Ordering::Relaxed);
        self.moved.store(other.moved(), Ordering::Relaxed);
    }

    /// Makes a stored image visible to searches.
    pub fn publish(&self, stored: &StoredImage) {
        let (slot, entry) = (stored.slot, Entry::from(stored));
        let is_located = entry.pose.is_some();
        let mut entries = self.entries.write();
        if entries.len() <= slot {
            entries.resize_with(slot + 1, || None);
        }
        entries[slot] = Some(entry);
        drop(entries);
        self.count_change(is_located);
        self.index.add(slot);
    }

    /// Makes the changed pose of an image visible to searches.
    pub fn move_image(&self, stored: &StoredImage) {
        let mut entries = self.entries.write();
        // An image with a damaged descriptor has no entry, and one that the draft lacks will be published.
        if let Some(Some(entry)) = entries.get_mut(stored.slot) {
            entry.pose = stored.image.pose;
        }
        drop(entries);
        self.count_change(true);
        self.moved.fetch_add(1, Ordering::Relaxed);
    }

    /// Hides an image from searches.
    pub fn withdraw(&self, slot: usize) {
        self.index.remove(slot);
        let mut entries = self.entries.write();
        let gone = entries.get_mut(slot).and_then(Option::take);
        drop(entries);
        self.count_change(gone.is_some_and(|gone| gone.pose.is_some()));
    }

    fn count_change(&self, is_located: bool) {
        self.changes.fetch_add(1, Ordering::Relaxed);
        self.located.fetch_add(u64::from(is_located), Ordering::Relaxed);
    }

    /// Returns the size of the descriptors and the sealed graph, in bytes.
    pub fn index_bytes(&self) -> u64 {
        self.vectors.bytes_of(self.next_slot()) + self.index.sealed_bytes() as u64
    }

    /// Returns the number of additions, removals and changed poses since the map was loaded.
    pub fn changes(&self) -> u64 {
        self.changes.load(Ordering::Relaxed)
    }

    /// Returns the number of changes of images with a pose since the map was loaded.
    pub fn located(&self) -> u64 {
        self.located.load(Ordering::Relaxed)
    }

    /// Returns how often poses were changed since the map was created.
    pub fn moved(&self) -> u64 {
        self.moved.load(Ordering::Relaxed)
    }

    /// Returns the images that have a pose, in the order of recording.
    pub fn positions(&self) -> Vec<LocatedImage> {
        let entries = self.entries.read();
        let located = |(slot, entry): (usize, &Option<Entry>)| {
            let entry = entry.as_ref()?;
            let image = LocatedImage { slot, id: entry.id.clone(), pose: entry.pose? };
            Some((image, entry.recording))
        };
        let located = entries.iter().enumerate().filter_map(located).collect();
        drop(entries);
        in_order(located)
    }

    /// Calls `read` with the descriptor in each slot. Returns `None` for a slot without an image.
    pub fn read_slots<T>(&self, slots: &[usize], read: impl Fn(&[f32]) -> T) -> Vec<Option<T>> {
        let has_image: Vec<bool> = {
            let entries = self.entries.read();
            slots.iter().map(|slot| matches!(entries.get(*slot), Some(Some(_)))).collect()
        };
        let mut all = Vec::with_capacity(slots.len());
        for (slot, has_image) in slots.iter().zip(has_image) {
            let mut result = None;
            if has_image {
                self.vectors.scan(*slot..*slot + 1, &mut |_, numbers| result = Some(read(numbers)));
            }
            all.push(result);
        }
        all
    }

    pub fn search(&self, query: &[f32], k: usize, mode: SearchMode) -> Vec<Candidate> {
        self.candidates(&self.index.search(self.vectors.as_ref(), query, k, mode))
    }

    fn candidates(&self, found: &[ScoredSlot]) -> Vec<Candidate> {
        let entries = self.entries.read();
        found
            .iter()
            // Skip images that were removed since the search.
            .filter_map(|found| Some((found, entries.get(found.slot)?.as_ref()?)))
            .enumerate()
            .map(|(position, (found, entry))| Candidate {
                rank: position + 1,
                image_id: entry.id.clone(),
                // Rounding can push the cosine of identical pictures slightly above 1.
                similarity: found.similarity.clamp(-1.0, 1.0),
                pose: entry.pose,
                order: Some(found.slot),
            })
            .collect()
    }

    /// Samples images evenly across the map and returns the `k` hardest negatives of each.
    pub fn hard_negatives(&self, settings: CalibrationSettings, k: usize) -> Vec<HardNegatives> {
        let images: Vec<ImageLocation> = {
            let entries = self.entries.read();
            let present = entries.iter().enumerate();
            let present = present.filter_map(|(slot, entry)| Some((slot, entry.as_ref()?)));
            present.map(|(slot, entry)| ImageLocation { slot, pose: entry.pose }).collect()
        };
        let samples = (0..images.len()).step_by(settings.step(images.len()));
        samples.filter_map(|at| self.hard_negatives_of(&images, at, settings, k)).collect()
    }

    /// Returns the hard negatives of one image; `None` if the image was removed meanwhile.
    fn hard_negatives_of(
        &self,
        images: &[ImageLocation],
        at: usize,
        settings: CalibrationSettings,
        k: usize,
    ) -> Option<HardNegatives> {
        let query = &images[at];
        let of_another_place = |found: &ScoredSlot| {
            // Its position in insertion order.
            let position = images.partition_point(|image| image.slot < found.slot);
            let pose = images.get(position).and_then(|image| image.pose);
            settings.are_apart(images.len(), (at, query.pose), (position, pose))
        };
        let mut descriptor = Vec::new();
        self.vectors
            .scan(query.slot..query.slot + 1, &mut |_, numbers| descriptor = numbers.to_vec());
        // Double the limit until enough results are of other places.
        let mut limit = k + 2 * settings.place_radius(images.len()) + 1;
        let others: Vec<ScoredSlot> = loop {
            let found =
                self.index.search(self.vectors.as_ref(), &descriptor, limit, SearchMode::Fast);
            let exhausted = found.len() < limit;
            let others: Vec<ScoredSlot> =
                found.into_iter().filter(of_another_place).take(k).collect();
            if others.len() == k || exhausted {
                break others;
            }
            limit *= 2;
        };
        let image_id = self.entries.read();
        let image_id = image_id.get(query.slot)?.as_ref()?.id.clone();
        Some(HardNegatives { image_id, others: self.candidates(&others) })
    }
}

/// The slot of an image and the pose it was taken from.
struct ImageLocation {
    slot: usize,
    pose: Option<Pose>,
}

/// The latest calibration of a map, cached in memory and stored next to its descriptors.
pub(super) struct StoredCalibration {
    file: PathBuf,
    cached: RwLock<Option<Arc<Calibration>>>,
}

impl StoredCalibration {
    /// Reads the calibration of an earlier process. A file that cannot be read counts as missing.
    fn open(folder: &Path) -> Self {
        let file = folder.join("calibration.json");
        let stored = std::fs::read(&file).ok().and_then(|json| serde_json::from_slice(&json).ok());
        Self { file, cached: RwLock::new(stored) }
    }

    pub fn get(&self) -> Option<Arc<Calibration>> {
        self.cached.read().clone()
    }

    pub fn put(&self, measured: Calibration) {
        let temporary = self.file.with_extension("tmp");
        let written = serde_json::to_vec(&measured)
            .map_err(std::io::Error::from)
            .and_then(|json| replace_durably(&self.file, &temporary, &json));
        if let Err(error) = written {
            // The next start calibrates again.
            tracing::warn!(file = %self.file.display(), %error, "cannot write a calibration");
        }
        *self.cached.write() = Some(Arc::new(measured));
    }
}

/// Returns the folder of a map's descriptors; each revision has its own.
pub(super) fn folder_of(map: &Map, descriptors: &Path) -> PathBuf {
    let uid = map.uid.simple();
    descriptors.join(match map.revision {
        0 => uid.to_string(),
        revision => format!("{uid}-{revision}"),
    })
}
