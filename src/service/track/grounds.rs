//! What tracks know of each map, read again when the map has changed.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::Instant;
use uuid::Uuid;

use super::super::ServiceError;
use super::ground::{Ground, Known};
use super::{Tracks, on_blocking_thread};
use whereabouts_core::Map;
use whereabouts_store::StoreError;

/// Minimum age of what is known of a map before it is read again, for maps that grow.
const REFRESH: Duration = Duration::from_secs(2);

/// Maximum age of what is known of a map that has changed, though no image with a pose is known to have: a server of the
/// previous release does not count those.
const UNCOUNTED_REFRESH: Duration = Duration::from_secs(30);

/// The maps that tracks are in.
#[derive(Debug, Default)]
pub(super) struct Grounds {
    maps: Mutex<HashMap<Uuid, CachedGround>>,
    /// Locked while a map is read, so that concurrent frames read it once.
    loading: AsyncMutex<()>,
}

/// What tracks know of one map.
#[derive(Debug, Clone)]
struct CachedGround {
    version: Version,
    read_at: Instant,
    ground: Arc<Ground>,
}

/// The state of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Version {
    revision: u32,
    /// The number of changes of its images, and that of images with a pose.
    changes: u64,
    located: u64,
}

impl CachedGround {
    fn is_fresh(&self, now: Version) -> bool {
        let age = self.read_at.elapsed();
        self.version == now
            // Descriptors of another revision cannot be compared.
            || self.version.revision == now.revision
                && (self.version.located == now.located && age < UNCOUNTED_REFRESH
                    // A map that had no poses has some now.
                    || self.ground.len() > 0 && age < REFRESH)
    }
}

impl Tracks {
    /// What tracks know of a map.
    pub(super) async fn ground(&self, map: &Map) -> Result<Arc<Ground>, ServiceError> {
        let state = self.store.index_state(map).await?;
        let (changes, located) = (state.changes, state.located);
        let version = Version { revision: map.revision, changes, located };
        if let Some(ground) = self.cached(map, version) {
            return Ok(ground);
        }
        let _guard = self.grounds.loading.lock().await;
        if let Some(ground) = self.cached(map, version) {
            return Ok(ground);
        }
        let images = self.store.positions(map).await?;
        let mut ground = on_blocking_thread(move || Ground::new(images)).await?;
        let sample = ground.sample_with_neighbours();
        let known = self.descriptors(map, &ground, &sample).await?;
        ground.learn_common(&known);
        let ground = Arc::new(ground);
        self.cache(map, version, &ground);
        Ok(ground)
    }

    fn cached(&self, map: &Map, version: Version) -> Option<Arc<Ground>> {
        let maps = self.grounds.maps.lock();
        let known = maps.get(&map.uid)?;
        known.is_fresh(version).then(|| Arc::clone(&known.ground))
    }

    /// Caches what tracks know of a map, and drops those of maps without tracks.
    fn cache(&self, map: &Map, version: Version, ground: &Arc<Ground>) {
        let used = self.memory.maps();
        let mut maps = self.grounds.maps.lock();
        maps.retain(|uid, _| used.contains(uid));
        let known = CachedGround { version, read_at: Instant::now(), ground: Arc::clone(ground) };
        maps.insert(map.uid, known);
    }

    /// The descriptors of some images.
    pub(super) async fn descriptors(
        &self,
        map: &Map,
        ground: &Ground,
        images: &[u32],
    ) -> Result<Known, StoreError> {
        let descriptors = self.store.descriptors(map, ground.slots(images)).await?;
        let known = images.iter().copied().zip(descriptors);
        Ok(known.filter_map(|(image, descriptor)| Some((image, descriptor?))).collect())
    }
}
