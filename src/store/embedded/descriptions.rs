//! The description cache, with records in sled and the order of use in memory, and the frames whose
//! pairs were described.
//!
//! The cache is bounded in bytes and in age. The least recently used description is evicted first;
//! after a restart, which forgets uses, the oldest.

use std::collections::{BTreeMap, HashMap};
use std::ops::Bound;
use std::sync::Arc;

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use parking_lot::{Mutex, MutexGuard};
use uuid::Uuid;

use super::super::{DescriptionBounds, StoreError};
use super::trees::{Trees, decode, encode, failed, put};
use super::{EmbeddedStore, blocking};
use crate::{DescriptionCache, DescriptionFilter};
use whereabouts_core::{CacheLevels, CachedDescription, DescribedFrame, SimilarFrame};
use whereabouts_core::{Descriptor, Digest, StandIn};

/// Maximum number of similar frames returned. A pair that none of them has is bought.
const MAX_SIMILAR_FRAMES: usize = 4;

/// The keys of the cached descriptions, in order of use.
pub(super) struct DescriptionLru {
    bounds: DescriptionBounds,
    order: Mutex<UseOrder>,
}

#[derive(Default)]
struct UseOrder {
    /// Key → when it was last used (by `clock`), and the size of its record.
    entries: HashMap<Digest, (u64, u64)>,
    /// When it was last used → key.
    by_use: BTreeMap<u64, Digest>,
    bytes: u64,
    clock: u64,
}

impl UseOrder {
    fn touch(&mut self, key: Digest, bytes: u64) {
        self.forget(&key);
        self.clock += 1;
        self.entries.insert(key, (self.clock, bytes));
        self.by_use.insert(self.clock, key);
        self.bytes += bytes;
    }

    fn forget(&mut self, key: &Digest) {
        if let Some((used, bytes)) = self.entries.remove(key) {
            self.by_use.remove(&used);
            self.bytes -= bytes;
        }
    }

    /// Records a use of a description, unless it was evicted meanwhile.
    fn used(&mut self, key: Digest) {
        if let Some(&(_, bytes)) = self.entries.get(&key) {
            self.touch(key, bytes);
        }
    }

    /// Evicts the least recently used entries until the rest fits, and returns them.
    fn evict(&mut self, max_bytes: u64) -> Vec<Digest> {
        let mut evicted = Vec::new();
        while self.bytes > max_bytes
            && let Some((_, &oldest)) = self.by_use.iter().next()
        {
            self.forget(&oldest);
            evicted.push(oldest);
        }
        evicted
    }
}

impl DescriptionLru {
    /// Reads the cached descriptions and orders them by age.
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
        let mut order = UseOrder::default();
        found.into_iter().for_each(|(_, key, bytes)| order.touch(key, bytes));
        Ok(Self { bounds, order: Mutex::new(order) })
    }

    fn order(&self) -> MutexGuard<'_, UseOrder> {
        self.order.lock()
    }

    /// Adds a new description; returns the descriptions evicted to make room.
    fn add(&self, key: Digest, bytes: u64) -> Vec<Digest> {
        let mut order = self.order();
        order.touch(key, bytes);
        order.evict(self.bounds.max_bytes)
    }

    fn is_fresh(&self, record: &CachedDescription) -> bool {
        let age = SignedDuration::try_from(self.bounds.max_age).unwrap_or(SignedDuration::MAX);
        Timestamp::now().duration_since(record.created_at) <= age
    }
}

/// Estimates the size of a record on disk, key included.
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
            inner.descriptions.order().used(key);
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
                    for evicted in inner.descriptions.add(key, size(&value)) {
                        trees.descriptions.remove(evicted.hex()).map_err(failed)?;
                    }
                    trees.descriptions.insert(key.hex(), value).map(drop).map_err(failed)
                },
                |()| {},
            )
            .await
    }

    async fn descriptions(
        &self,
        filter: &DescriptionFilter,
        after: Option<&Digest>,
        limit: usize,
    ) -> Result<Vec<(Digest, CachedDescription)>, StoreError> {
        let (inner, filter) = (Arc::clone(&self.inner), filter.clone());
        let from = match after {
            Some(after) => Bound::Excluded(after.hex().into_bytes()),
            None => Bound::Unbounded,
        };
        blocking(move || {
            let mut found = Vec::new();
            for entry in inner.trees.descriptions.range((from, Bound::Unbounded)) {
                let (key, value) = entry.map_err(failed)?;
                let record: CachedDescription = decode(&value)?;
                let key = std::str::from_utf8(&key).ok().and_then(|hex| hex.parse().ok());
                if let Some(key) = key.filter(|_| filter.matches(&record)) {
                    found.push((key, record));
                }
                if found.len() >= limit {
                    break;
                }
            }
            Ok(found)
        })
        .await
    }

    async fn remove_descriptions(&self, keys: &[Digest]) -> Result<usize, StoreError> {
        let (inner, keys) = (Arc::clone(&self.inner), keys.to_vec());
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    let mut removed = 0;
                    for key in &keys {
                        let there = trees.descriptions.remove(key.hex()).map_err(failed)?;
                        inner.descriptions.order().forget(key);
                        removed += usize::from(there.is_some());
                    }
                    Ok(removed)
                },
                |_| {},
            )
            .await
    }

    async fn similar_frames(
        &self,
        map: Uuid,
        to: &Descriptor,
        at_least: f32,
    ) -> Result<Vec<SimilarFrame>, StoreError> {
        let (inner, to) = (Arc::clone(&self.inner), to.clone());
        blocking(move || {
            let mut similar = Vec::new();
            for value in inner.trees.frames.scan_prefix(map.as_bytes()).values() {
                let frame: DescribedFrame = decode(&value.map_err(failed)?)?;
                let similarity = frame.descriptor.similarity(&to);
                // A map whose model changed while it was empty still has frames of the old model.
                if frame.descriptor.dim() == to.dim() && similarity >= at_least {
                    let stand_in = StandIn { query_id: frame.query_id, similarity };
                    similar.push(SimilarFrame { digest: frame.digest, stand_in });
                }
            }
            similar.sort_by(|a, b| b.stand_in.similarity.total_cmp(&a.stand_in.similarity));
            similar.truncate(MAX_SIMILAR_FRAMES);
            Ok(similar)
        })
        .await
    }

    async fn keep_frame(
        &self,
        map: Uuid,
        frame: DescribedFrame,
        max_frames: usize,
    ) -> Result<(), StoreError> {
        let key = [map.as_bytes().as_slice(), frame.query_id.as_bytes()].concat();
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    put(&trees.frames, &key, &frame)?;
                    let of_map = || trees.frames.scan_prefix(map.as_bytes()).keys();
                    for oldest in of_map().take(of_map().count().saturating_sub(max_frames)) {
                        trees.frames.remove(oldest.map_err(failed)?).map_err(failed)?;
                    }
                    Ok(())
                },
                |()| {},
            )
            .await
    }

    fn levels(&self) -> CacheLevels {
        let order = self.inner.descriptions.order();
        CacheLevels { entries: order.entries.len(), bytes: order.bytes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(number: u8) -> Digest {
        Digest::of(&[number])
    }

    #[test]
    fn the_least_recently_used_descriptions_are_evicted() {
        let mut order = UseOrder::default();
        (0..4).for_each(|number| order.touch(key(number), 10));
        order.touch(key(0), 10);
        assert_eq!(order.evict(25), [key(1), key(2)]);
        assert_eq!((order.bytes, order.entries.len(), order.by_use.len()), (20, 2, 2));
    }

    #[test]
    fn a_use_of_an_evicted_description_is_ignored() {
        let mut order = UseOrder::default();
        order.touch(key(0), 10);
        order.used(key(1));
        assert_eq!((order.bytes, order.entries.len()), (10, 1));
    }

    #[test]
    fn a_description_that_is_replaced_is_counted_once() {
        let mut order = UseOrder::default();
        order.touch(key(0), 10);
        order.touch(key(0), 30);
        assert_eq!((order.bytes, order.by_use.len()), (30, 1));
        assert_eq!(order.evict(29), [key(0)]);
        assert_eq!(order.evict(0), []);
    }
}
