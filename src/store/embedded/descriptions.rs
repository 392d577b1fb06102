//! The cache of descriptions that were paid for: records in sled, their order of use in memory.
//!
//! Bounded in bytes and in age. The least recently used goes first; after a restart, when uses are
//! forgotten, the oldest.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};

use super::super::StoreError;
use super::trees::{Trees, decode, encode, failed};
use super::{EmbeddedStore, blocking};
use crate::domain::Digest;
use crate::refine::mllm::{CachedDescription, DescriptionCache};

/// Bounds of the cache.
#[derive(Debug, Clone, Copy)]
pub struct DescriptionBounds {
    /// The most bytes of records.
    pub max_bytes: u64,
    /// Older descriptions are not used any more.
    pub max_age: Duration,
}

/// Which descriptions there are, and in which order they were used.
pub(super) struct DescriptionUse {
    bounds: DescriptionBounds,
    order: Mutex<Order>,
}

#[derive(Default)]
struct Order {
    /// Key → when it was used last, and its bytes.
    known: HashMap<Digest, (u64, u64)>,
    /// When it was used last → key.
    by_use: BTreeMap<u64, Digest>,
    bytes: u64,
    clock: u64,
}

impl Order {
    fn touch(&mut self, key: Digest, bytes: u64) {
        self.forget(&key);
        self.clock += 1;
        self.known.insert(key, (self.clock, bytes));
        self.by_use.insert(self.clock, key);
        self.bytes += bytes;
    }

    fn forget(&mut self, key: &Digest) {
        if let Some((used, bytes)) = self.known.remove(key) {
            self.by_use.remove(&used);
            self.bytes -= bytes;
        }
    }

    /// Those that must go for the rest to fit.
    fn over(&mut self, max_bytes: u64) -> Vec<Digest> {
        let mut gone = Vec::new();
        while self.bytes > max_bytes
            && let Some((_, &oldest)) = self.by_use.iter().next()
        {
            self.forget(&oldest);
            gone.push(oldest);
        }
        gone
    }
}

impl DescriptionUse {
    /// Reads which descriptions there are, oldest first.
    pub fn load(trees: &Trees, bounds: DescriptionBounds) -> Result<Self, StoreError> {
        let mut found = Vec::new();
        for entry in trees.descriptions.iter() {
            let (key, value) = entry.map_err(failed)?;
            let record: CachedDescription = decode(&value)?;
            if let Some(key) = std::str::from_utf8(&key).ok().and_then(|hex| hex.parse().ok()) {
                found.push((record.created_at, key, size(&value)));
            }
        }
        found.sort_by_key(|(created, ..)| *created);
        let mut order = Order::default();
        found.into_iter().for_each(|(_, key, bytes)| order.touch(key, bytes));
        Ok(Self { bounds, order: Mutex::new(order) })
    }

    fn used(&self, key: Digest, bytes: u64) -> Vec<Digest> {
        let mut order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        order.touch(key, bytes);
        order.over(self.bounds.max_bytes)
    }

    fn is_fresh(&self, record: &CachedDescription) -> bool {
        let age = SignedDuration::try_from(self.bounds.max_age).unwrap_or(SignedDuration::MAX);
        Timestamp::now().duration_since(record.created_at) <= age
    }
}

/// What a record takes on disk, key included.
fn size(value: &[u8]) -> u64 {
    (value.len() + 64) as u64
}

#[async_trait]
impl DescriptionCache for EmbeddedStore {
    async fn description(&self, key: &Digest) -> Result<Option<CachedDescription>, StoreError> {
        let (inner, key) = (Arc::clone(&self.inner), *key);
        blocking(move || {
            let Some(value) = inner.trees.descriptions.get(key.hex()).map_err(failed)? else {
                return Ok(None);
            };
            let record: CachedDescription = decode(&value)?;
            if !inner.descriptions.is_fresh(&record) {
                return Ok(None);
            }
            inner.descriptions.used(key, size(&value));
            Ok(Some(record))
        })
        .await
    }

    async fn keep_description(
        &self,
        key: Digest,
        value: CachedDescription,
    ) -> Result<(), StoreError> {
        let inner = Arc::clone(&self.inner);
        let value = encode(&value)?;
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    for gone in inner.descriptions.used(key, size(&value)) {
                        trees.descriptions.remove(gone.hex()).map_err(failed)?;
                    }
                    trees.descriptions.insert(key.hex(), value).map(drop).map_err(failed)
                },
                |()| {},
            )
            .await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(number: u8) -> Digest {
        Digest::of(&[number])
    }

    #[test]
    fn the_least_recently_used_make_room() {
        let mut order = Order::default();
        (0..4).for_each(|number| order.touch(key(number), 10));
        order.touch(key(0), 10);
        assert_eq!(order.over(25), [key(1), key(2)]);
        assert_eq!((order.bytes, order.known.len(), order.by_use.len()), (20, 2, 2));
    }

    #[test]
    fn a_description_that_grew_is_counted_once() {
        let mut order = Order::default();
        order.touch(key(0), 10);
        order.touch(key(0), 30);
        assert_eq!((order.bytes, order.by_use.len()), (30, 1));
        assert_eq!(order.over(29), [key(0)]);
        assert_eq!(order.over(0), []);
    }
}
