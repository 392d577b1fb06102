//! An LRU cache of dense features, bounded in bytes.
//!
//! The features are derived data: after a miss they are extracted again from the picture.
//!
//! Not `quick_cache`: a frame's features are inserted once and read once, when its job runs, and the
//! eviction policy of that cache (S3-FIFO) drops just such entries first.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use whereabouts_core::{DenseFeatures, Digest};

/// The picture that the features are of, and the model that extracted them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DenseKey {
    /// The identity of the model.
    pub model: Digest,
    /// The digest of the picture.
    pub picture: Digest,
}

/// Caches dense features by model and picture; the least recently used are evicted first.
#[derive(Debug)]
pub struct DenseCache {
    max_bytes: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    entries: HashMap<DenseKey, Entry>,
    bytes: usize,
    /// Counts accesses, to order them.
    clock: u64,
}

#[derive(Debug)]
struct Entry {
    features: Arc<DenseFeatures>,
    last_used: u64,
}

impl DenseCache {
    /// Creates a cache that holds at most `max_bytes` of features.
    pub fn new(max_bytes: usize) -> Self {
        Self { max_bytes, state: Mutex::default() }
    }

    /// Returns the features of a picture, if they are cached.
    pub fn get(&self, key: &DenseKey) -> Option<Arc<DenseFeatures>> {
        let mut state = self.state.lock();
        state.clock += 1;
        let now = state.clock;
        let entry = state.entries.get_mut(key)?;
        entry.last_used = now;
        Some(Arc::clone(&entry.features))
    }

    /// Caches the features of a picture and evicts the least recently used ones if there is no room.
    /// Features larger than the whole cache are not cached.
    pub fn insert(&self, key: DenseKey, features: Arc<DenseFeatures>) {
        let bytes = features.bytes();
        if bytes > self.max_bytes {
            return;
        }
        let mut state = self.state.lock();
        state.clock += 1;
        let last_used = state.clock;
        if let Some(old) = state.entries.insert(key, Entry { features, last_used }) {
            state.bytes -= old.features.bytes();
        }
        state.bytes += bytes;
        while state.bytes > self.max_bytes {
            state.evict();
        }
    }

    /// Returns the size of all cached features in bytes.
    pub fn bytes(&self) -> usize {
        self.state.lock().bytes
    }
}

impl State {
    /// Evicts the least recently used entry. Scans all entries, of which there are hundreds, because each
    /// is a matrix of 100 kB or more.
    fn evict(&mut self) {
        let oldest =
            self.entries.iter().min_by_key(|(_, entry)| entry.last_used).map(|(key, _)| *key);
        if let Some(entry) = oldest.and_then(|key| self.entries.remove(&key)) {
            self.bytes -= entry.features.bytes();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn features(cells: usize) -> Arc<DenseFeatures> {
        Arc::new(DenseFeatures::new(1, cells, 1, vec![1.0; cells], None).unwrap())
    }

    fn key(picture: &[u8]) -> DenseKey {
        DenseKey { model: Digest::of(b"model"), picture: Digest::of(picture) }
    }

    #[test]
    fn the_least_recently_used_features_are_evicted_first() {
        let cache = DenseCache::new(3 * 40);
        let keys = [b"a", b"b", b"c", b"d"].map(|name| key(name));
        for key in &keys[..3] {
            cache.insert(*key, features(10));
        }
        assert!(cache.get(&keys[0]).is_some());
        cache.insert(keys[3], features(10));
        let cached: Vec<bool> = keys.iter().map(|key| cache.get(key).is_some()).collect();
        assert_eq!(cached, [true, false, true, true]);
        assert_eq!(cache.bytes(), 120);
        let other_model = DenseKey { model: Digest::of(b"another"), ..keys[0] };
        assert!(cache.get(&other_model).is_none());
    }

    #[test]
    fn the_bound_holds_for_any_sequence_of_sizes() {
        let cache = DenseCache::new(100);
        cache.insert(key(b"huge"), features(26));
        assert_eq!(cache.bytes(), 0);
        for size in [1, 25, 3, 20, 7, 7] {
            cache.insert(key(&[size as u8]), features(size));
            assert!(cache.bytes() <= 100);
        }
        cache.insert(key(&[7]), features(7));
        assert!(cache.bytes() <= 100);
    }
}
