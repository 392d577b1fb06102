//! Descriptions are bought once: looked up in the cache, and bought by one caller if they are not there.
//!
//! Concurrent jobs of this process share the call ([`SingleFlight`]); of all processes that share a store,
//! one makes it ([`DescriptionLease`]). The synchronisation is theirs; there is none here.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use jiff::Timestamp;
use whereabouts_core::{CachedDescription, Digest, StandIn};
use whereabouts_store::{DescriptionCache, StoreError};

use super::lease::{Acquired, DescriptionLease};
use super::retry::CallError;
use super::single_flight::SingleFlight;
use crate::store_retry::retry_read;
use crate::{CacheLookup, RefineMetrics};

/// Finds descriptions in the cache or has them bought.
pub(super) struct BuyOnce {
    cache: Arc<dyn DescriptionCache>,
    metrics: Arc<RefineMetrics>,
    in_flight: SingleFlight<FoundDescription>,
}

/// A description that was found or bought.
#[derive(Debug, Clone)]
pub(super) struct FoundDescription {
    pub description: CachedDescription,
    /// The earlier frame that it describes, if it stands in.
    pub stands_in: Option<StandIn>,
    /// Duration of the call, if this caller bought it.
    pub took: Option<Duration>,
    /// Whether this caller did not pay for it: it was cached, or another job bought it.
    pub cached: bool,
}

impl FoundDescription {
    fn cached(description: CachedDescription, stands_in: Option<StandIn>) -> Self {
        Self { description, stands_in, took: None, cached: true }
    }
}

impl BuyOnce {
    pub fn new(cache: Arc<dyn DescriptionCache>, metrics: Arc<RefineMetrics>) -> Self {
        Self { cache, metrics, in_flight: SingleFlight::default() }
    }

    /// Returns the description with that key, one of the cached `stand_ins`, or else what `buy` returns.
    /// `buy` must have put its description into the cache when it returns. Cached descriptions from before
    /// `since` do not count.
    pub async fn find_or_buy<F>(
        &self,
        key: Digest,
        since: Option<Timestamp>,
        stand_ins: &[(Digest, StandIn)],
        buy: impl FnOnce() -> F,
    ) -> Result<FoundDescription, CallError>
    where
        F: Future<Output = Result<(CachedDescription, Duration), CallError>>,
    {
        let bought = AtomicBool::new(false);
        let find = || async {
            if let Some(found) = self.find(&key, since, stand_ins).await.map_err(unavailable)? {
                return Ok(found);
            }
            let acquired = DescriptionLease::acquire(&self.cache, &key, since).await;
            let _lease = match acquired.map_err(unavailable)? {
                Acquired::Lease(lease) => lease,
                Acquired::Description(description) => {
                    self.metrics.description_lookup(CacheLookup::Hit);
                    return Ok(FoundDescription::cached(description, None));
                }
            };
            self.metrics.description_lookup(CacheLookup::Miss);
            let (description, took) = buy().await?;
            bought.store(true, Ordering::Relaxed);
            let took = Some(took);
            Ok(FoundDescription { description, stands_in: None, took, cached: false })
        };
        let found: Result<_, CallError> = self.in_flight.join(key, find).await;
        let found = found?;
        // Jobs that joined the flight get the buyer's result, but did not pay for it.
        let cached = !bought.load(Ordering::Relaxed);
        Ok(FoundDescription { cached, took: found.took.filter(|_| !cached), ..found })
    }

    /// Looks into the cache. Runs inside the single flight, and so sees what a flight that has just ended
    /// put there.
    async fn find(
        &self,
        key: &Digest,
        since: Option<Timestamp>,
        stand_ins: &[(Digest, StandIn)],
    ) -> Result<Option<FoundDescription>, StoreError> {
        let known = retry_read(|| self.cache.description(key)).await?;
        if let Some(description) = known.filter(|known| counts(known, since)) {
            self.metrics.description_lookup(CacheLookup::Hit);
            return Ok(Some(FoundDescription::cached(description, None)));
        }
        for (key, stand_in) in stand_ins {
            let known = retry_read(|| self.cache.description(key)).await?;
            if let Some(description) = known.filter(|known| counts(known, since)) {
                self.metrics.description_lookup(CacheLookup::Similar);
                return Ok(Some(FoundDescription::cached(description, Some(*stand_in))));
            }
        }
        Ok(None)
    }
}

/// Whether a cached description is recent enough.
pub(super) fn counts(description: &CachedDescription, since: Option<Timestamp>) -> bool {
    since.is_none_or(|since| description.created_at >= since)
}

fn unavailable(error: StoreError) -> CallError {
    CallError::Transient(error.to_string())
}
