//! Leases on descriptions: of all processes that share a store, one buys a description and the others wait.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use whereabouts_core::{CachedDescription, Digest};
use whereabouts_store::{DescriptionCache, StoreError};

use super::buy_once::counts;
use crate::store_retry::{retry_read, retry_write};

/// The pause between two looks for a description that another process is buying.
const POLL: Duration = Duration::from_millis(250);

/// The length of a lease. After it, another process may buy the description.
const LENGTH: SignedDuration = SignedDuration::from_mins(10);

/// The right of this process to buy a description. Released when it is dropped.
pub(super) struct DescriptionLease {
    cache: Arc<dyn DescriptionCache>,
    /// `None` if the lease was not granted, and so need not be released.
    key: Option<Digest>,
}

/// The outcome of [`DescriptionLease::acquire`].
pub(super) enum Acquired {
    /// This process is to buy the description.
    Lease(DescriptionLease),
    /// Another process has bought it in the meantime.
    Description(CachedDescription),
}

impl DescriptionLease {
    /// Waits until this process may buy the description of that key or another process has bought it. One from
    /// before `since` does not count.
    pub async fn acquire(
        cache: &Arc<dyn DescriptionCache>,
        key: &Digest,
        since: Option<Timestamp>,
    ) -> Result<Acquired, StoreError> {
        loop {
            let until = Timestamp::now().saturating_add(LENGTH).unwrap_or(Timestamp::MAX);
            // Made before the grant is known, because the store's answer may get lost on its way.
            let mut lease = Self { cache: Arc::clone(cache), key: Some(*key) };
            let granted = retry_read(|| cache.acquire_lease(key, until)).await?;
            if !granted {
                lease.key = None;
            }
            // The process that held the lease may have finished since the cache was last read.
            let known = retry_read(|| cache.description(key)).await?;
            if let Some(known) = known.filter(|known| counts(known, since)) {
                return Ok(Acquired::Description(known));
            }
            if granted {
                return Ok(Acquired::Lease(lease));
            }
            tokio::time::sleep(POLL).await;
        }
    }
}

impl Drop for DescriptionLease {
    fn drop(&mut self) {
        let Some(key) = self.key else { return };
        let cache = Arc::clone(&self.cache);
        tokio::spawn(async move {
            // Other processes wait for the lease as long as this process is alive.
            let release = || cache.release_lease(&key);
            retry_write("the release of a description lease", release).await;
        });
    }
}
