//! One map in memory: which slot is which image, and its index.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use super::super::StoreError;
use super::blobs::replace_durably;
use super::segments::VectorFiles;
use super::trees::{StoredImage, Trees};
use crate::domain::{Candidate, ImageId, Map, Pose};
use crate::retrieve::index::{IndexSettings, MapIndex, SealedGraph, SearchMode, Vectors};

pub(super) struct LiveMap {
    /// The map as stored; scene and description may change.
    map: RwLock<Map>,
    pub vectors: Arc<VectorFiles>,
    pub index: MapIndex,
    /// The sealed graph, so that a start need not build it again.
    graph_file: PathBuf,
    entries: RwLock<Vec<Option<Entry>>>,
    /// The slot of the next image. Only the writer thread moves it.
    next_slot: AtomicUsize,
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
            graph_file: folder.join("graph"),
            entries: RwLock::default(),
            next_slot: AtomicUsize::new(0),
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
            Ok(sealed) if sealed.dim() == self.vectors.dim() && sealed.fits(&settings) => {
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
        self.map.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub fn set_map(&self, map: Map) {
        *self.map.write().unwrap_or_else(PoisonError::into_inner) = map;
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
        let mut entries = self.entries.write().unwrap_or_else(PoisonError::into_inner);
        if entries.len() <= stored.slot {
            entries.resize_with(stored.slot + 1, || None);
        }
        entries[stored.slot] = Some(Entry { id: stored.image.id.clone(), pose: stored.image.pose });
        drop(entries);
        self.index.add(stored.slot);
    }

    /// Keeps an image out of every later answer.
    pub fn withdraw(&self, slot: usize) {
        self.index.remove(slot);
        let mut entries = self.entries.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(entry) = entries.get_mut(slot) {
            *entry = None;
        }
    }

    pub fn search(&self, query: &[f32], k: usize, mode: SearchMode) -> Vec<Candidate> {
        let found = self.index.search(self.vectors.as_ref(), query, k, mode);
        let entries = self.entries.read().unwrap_or_else(PoisonError::into_inner);
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
}

/// Where the descriptors of a map are: each revision has a folder of its own.
pub(super) fn folder_of(map: &Map, descriptors: &Path) -> PathBuf {
    let uid = map.uid.simple();
    descriptors.join(match map.revision {
        0 => uid.to_string(),
        revision => format!("{uid}-{revision}"),
    })
}
