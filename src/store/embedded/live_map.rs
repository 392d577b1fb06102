//! One map in memory: which slot is which image, and its index.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use super::super::{HardNegatives, StoreError};
use super::blobs::replace_durably;
use super::segments::VectorFiles;
use super::trees::{StoredImage, Trees};
use parking_lot::RwLock;
use whereabouts_core::{Calibration, CalibrationSettings, Candidate, ImageId, Map, Pose};
use whereabouts_index::{IndexSettings, MapIndex, ScoredSlot, SealedGraph, SearchMode, Vectors};

pub(super) struct LiveMap {
    /// The map as stored; scene and description may change.
    map: RwLock<Map>,
    pub vectors: Arc<VectorFiles>,
    pub index: MapIndex,
    pub calibration: KeptCalibration,
    /// The sealed graph, so that a start need not build it again.
    graph_file: PathBuf,
    entries: RwLock<Vec<Option<Entry>>>,
    /// The slot of the next image. Only the writer thread moves it.
    next_slot: AtomicUsize,
    /// How often images were added and removed.
    changes: AtomicU64,
}

/// What an answer says about an image, kept in memory so that a search reads no record.
struct Entry {
    id: ImageId,
    pose: Option<Pose>,
}

impl LiveMap {
    /// Loads a map. An image whose descriptor is damaged is left out of answers, and said so.
    pub fn load(
        map: Map,
        descriptors: &Path,
        index: IndexSettings,
        trees: &Trees,
    ) -> Result<Self, StoreError> {
        let uid = map.uid;
        let live = Self::open(map, descriptors, index)?;
        live.restore_graph(index);
        for stored in trees.images_of(uid) {
            let stored = stored?;
            live.next_slot.fetch_max(stored.slot + 1, Ordering::Relaxed);
            if live.vectors.is_intact(stored.slot) {
                live.publish(&stored);
            } else {
                tracing::error!(
                    map = %live.map().name, image = %stored.image.id,
                    "its descriptor is damaged, so it is not found; delete the image and add it again"
                );
            }
        }
        Ok(live)
    }

    /// A map of which nothing is known yet but its descriptors.
    pub fn open(map: Map, descriptors: &Path, index: IndexSettings) -> Result<Self, StoreError> {
        let folder = folder_of(&map, descriptors);
        let vectors = VectorFiles::open(folder.clone(), map.dim)?;
        Ok(Self {
            map: RwLock::new(map),
            vectors: Arc::new(vectors),
            index: MapIndex::new(index),
            calibration: KeptCalibration::open(&folder),
            graph_file: folder.join("graph"),
            entries: RwLock::default(),
            next_slot: AtomicUsize::new(0),
            changes: AtomicU64::new(0),
        })
    }

    /// Takes up the graph of an earlier process. One that is damaged or missing is built again in
    /// the background, while the map is searched exactly.
    fn restore_graph(&self, settings: IndexSettings) {
        let bytes = match std::fs::read(&self.graph_file) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return,
            Err(error) => {
                tracing::warn!(file = %self.graph_file.display(), %error, "the graph cannot be read");
                return;
            }
        };
        match SealedGraph::from_bytes(&bytes) {
            Ok(sealed) if sealed.dim() == self.vectors.dim() && sealed.is_built_with(&settings) => {
                // Its slots are never given to other images.
                self.next_slot.fetch_max(sealed.end(), Ordering::Relaxed);
                self.index.restore(sealed);
            }
            Ok(_) => tracing::info!(
                file = %self.graph_file.display(),
                "the graph was made with other settings; it is built again"
            ),
            Err(error) => {
                tracing::warn!(file = %self.graph_file.display(), %error, "the graph is built again");
            }
        }
    }

    /// Writes a sealed graph where the next start finds it.
    pub fn keep(&self, sealed: &SealedGraph) {
        let beside = self.graph_file.with_extension("tmp");
        if let Err(error) = replace_durably(&self.graph_file, &beside, &sealed.to_bytes()) {
            // The next start builds it again.
            tracing::warn!(file = %self.graph_file.display(), %error, "the graph cannot be kept");
        }
    }

    pub fn map(&self) -> Map {
        self.map.read().clone()
    }

    pub fn set_map(&self, map: Map) {
        *self.map.write() = map;
    }

    /// The slot for a new image. Call on the writer thread.
    pub fn take_slot(&self) -> usize {
        self.next_slot.fetch_add(1, Ordering::Relaxed)
    }

    /// The slot that the next image will have. Only on the writer thread does it mean that every
    /// image with a lower one is stored.
    pub fn next_slot(&self) -> usize {
        self.next_slot.load(Ordering::Relaxed)
    }

    /// Gives out slots where `other`, which this one replaces, leaves off.
    pub fn go_on_from(&self, other: &Self) {
        self.next_slot.store(other.next_slot(), Ordering::Relaxed);
    }

    /// Makes a stored image part of every later answer.
    pub fn publish(&self, stored: &StoredImage) {
        let mut entries = self.entries.write();
        if entries.len() <= stored.slot {
            entries.resize_with(stored.slot + 1, || None);
        }
        entries[stored.slot] = Some(Entry { id: stored.image.id.clone(), pose: stored.image.pose });
        drop(entries);
        self.changes.fetch_add(1, Ordering::Relaxed);
        self.index.add(stored.slot);
    }

    /// Keeps an image out of every later answer.
    pub fn withdraw(&self, slot: usize) {
        self.index.remove(slot);
        let mut entries = self.entries.write();
        if let Some(entry) = entries.get_mut(slot) {
            *entry = None;
        }
        self.changes.fetch_add(1, Ordering::Relaxed);
    }

    /// Bytes of the descriptors, and of the sealed graph.
    pub fn index_bytes(&self) -> u64 {
        self.vectors.bytes_of(self.next_slot()) + self.index.sealed_bytes() as u64
    }

    /// How often images were added and removed since the map was loaded.
    pub fn changes(&self) -> u64 {
        self.changes.load(Ordering::Relaxed)
    }

    /// The images that have a pose, in the order of their addition.
    pub fn positions(&self) -> Vec<(ImageId, Pose)> {
        let entries = self.entries.read();
        entries.iter().flatten().filter_map(|entry| Some((entry.id.clone(), entry.pose?))).collect()
    }

    pub fn search(&self, query: &[f32], k: usize, mode: SearchMode) -> Vec<Candidate> {
        self.candidates(&self.index.search(self.vectors.as_ref(), query, k, mode))
    }

    fn candidates(&self, found: &[ScoredSlot]) -> Vec<Candidate> {
        let entries = self.entries.read();
        found
            .iter()
            // An image that was removed since the search is left out.
            .filter_map(|found| Some((found, entries.get(found.slot)?.as_ref()?)))
            .enumerate()
            .map(|(position, (found, entry))| Candidate {
                rank: position + 1,
                image_id: entry.id.clone(),
                // Rounding can carry the cosine of equal pictures just past 1.
                similarity: found.similarity.clamp(-1.0, 1.0),
                pose: entry.pose,
            })
            .collect()
    }

    /// Images spread over the map, each with the `k` most similar ones of other places.
    pub fn look_alikes(&self, settings: CalibrationSettings, k: usize) -> Vec<HardNegatives> {
        let places: Vec<Place> = {
            let entries = self.entries.read();
            let known = entries.iter().enumerate();
            let known = known.filter_map(|(slot, entry)| Some((slot, entry.as_ref()?)));
            known.map(|(slot, entry)| Place { slot, pose: entry.pose }).collect()
        };
        let asked = (0..places.len()).step_by(settings.step(places.len()));
        asked.filter_map(|at| self.look_alikes_of(&places, at, settings, k)).collect()
    }

    /// `None` for an image that is no longer there.
    fn look_alikes_of(
        &self,
        places: &[Place],
        at: usize,
        settings: CalibrationSettings,
        k: usize,
    ) -> Option<HardNegatives> {
        let asked = &places[at];
        let of_another_place = |found: &ScoredSlot| {
            // Where it stands in the order of addition.
            let position = places.partition_point(|place| place.slot < found.slot);
            let pose = places.get(position).and_then(|place| place.pose);
            settings.are_apart(places.len(), (at, asked.pose), (position, pose))
        };
        let mut descriptor = Vec::new();
        self.vectors
            .scan(asked.slot..asked.slot + 1, &mut |_, numbers| descriptor = numbers.to_vec());
        // Twice as many, until enough of them are of other places.
        let mut wanted = k + 2 * settings.place_radius(places.len()) + 1;
        let others: Vec<ScoredSlot> = loop {
            let found =
                self.index.search(self.vectors.as_ref(), &descriptor, wanted, SearchMode::Fast);
            let all = found.len() < wanted;
            let others: Vec<ScoredSlot> =
                found.into_iter().filter(of_another_place).take(k).collect();
            if others.len() == k || all {
                break others;
            }
            wanted *= 2;
        };
        let image_id = self.entries.read();
        let image_id = image_id.get(asked.slot)?.as_ref()?.id.clone();
        Some(HardNegatives { image_id, others: self.candidates(&others) })
    }
}

/// Where an image is, and where it was taken from.
struct Place {
    slot: usize,
    pose: Option<Pose>,
}

/// What was last measured in the map, beside its descriptors.
pub(super) struct KeptCalibration {
    file: PathBuf,
    known: RwLock<Option<Arc<Calibration>>>,
}

impl KeptCalibration {
    /// What an earlier process measured; if it cannot be read it is measured again.
    fn open(folder: &Path) -> Self {
        let file = folder.join("calibration.json");
        let known = std::fs::read(&file).ok().and_then(|json| serde_json::from_slice(&json).ok());
        Self { file, known: RwLock::new(known) }
    }

    pub fn get(&self) -> Option<Arc<Calibration>> {
        self.known.read().clone()
    }

    pub fn put(&self, measured: Calibration) {
        let beside = self.file.with_extension("tmp");
        let kept = serde_json::to_vec(&measured)
            .map_err(std::io::Error::from)
            .and_then(|json| replace_durably(&self.file, &beside, &json));
        if let Err(error) = kept {
            // The next start measures again.
            tracing::warn!(file = %self.file.display(), %error, "a calibration cannot be kept");
        }
        *self.known.write() = Some(Arc::new(measured));
    }
}

/// Where the descriptors of a map are: each revision has a folder of its own.
pub(super) fn folder_of(map: &Map, descriptors: &Path) -> PathBuf {
    let uid = map.uid.simple();
    descriptors.join(match map.revision {
        0 => uid.to_string(),
        revision => format!("{uid}-{revision}"),
    })
}
