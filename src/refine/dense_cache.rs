//! Dense features of pictures that were looked at lately.
//!
//! They are derived: whoever misses one here extracts it again from the image's bytes.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use whereabouts_core::{DenseFeatures, Digest};

/// Whose features they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DenseKey {
    /// The identity of the model that made them.
    pub model: Digest,
    /// The digest of the picture.
    pub picture: Digest,
}

/// A cache by model and picture, bounded in bytes; the least recently used goes first.
#[derive(Debug)]
pub struct DenseCache {
    max_bytes: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    entries: HashMap<DenseKey, Entry>,
    bytes: usize,
    clock: u64,
}

#[derive(Debug)]
struct Entry {
    features: Arc<DenseFeatures>,
    used: u64,
}

impl DenseCache {
    /// A cache that holds at most `max_bytes` of features.
    pub fn new(max_bytes: usize) -> Self {
        Self { max_bytes, state: Mutex::default() }
    }

    /// The features of a picture, if they are still here.
    pub fn get(&self, key: &DenseKey) -> Option<Arc<DenseFeatures>> {
        let mut state = self.state.lock();
        state.clock += 1;
        let now = state.clock;
        let entry = state.entries.get_mut(key)?;
        entry.used = now;
        Some(Arc::clone(&entry.features))
    }

    /// Keeps the features of a picture, at the expense of those used longest ago.
    pub fn insert(&self, key: DenseKey, features: Arc<DenseFeatures>) {
        let bytes = features.bytes();
        if bytes > self.max_bytes {
            return;
        }
        let mut state = self.state.lock();
        state.clock += 1;
        let used = state.clock;
        if let Some(old) = state.entries.insert(key, Entry { features, used }) {
            state.bytes -= old.features.bytes();
        }
        state.bytes += bytes;
        while state.bytes > self.max_bytes {
            state.drop_oldest();
        }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.state.lock().bytes
    }
}

impl State {
    /// A walk over all entries: there are hundreds, each worth a matrix of 100 kB and more.
    fn drop_oldest(&mut self) {
        let oldest = self.entries.iter().min_by_key(|(_, entry)| entry.used).map(|(key, _)| *key);
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
    fn the_least_recently_used_goes_first() {
        let cache = DenseCache::new(3 * 40);
        let keys = [b"a", b"b", b"c", b"d"].map(|name| key(name));
        for key in &keys[..3] {
            cache.insert(*key, features(10));
        }
        assert!(cache.get(&keys[0]).is_some());
        cache.insert(keys[3], features(10));
        let kept: Vec<bool> = keys.iter().map(|key| cache.get(key).is_some()).collect();
        assert_eq!(kept, [true, false, true, true]);
        assert_eq!(cache.bytes(), 120);
        let of_another_model = DenseKey { model: Digest::of(b"another"), ..keys[0] };
        assert!(cache.get(&of_another_model).is_none());
    }

    #[test]
    fn the_bound_holds_whatever_comes() {
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
