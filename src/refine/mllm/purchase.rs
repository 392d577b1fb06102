//! Of all processes one buys a description, and the others wait for it.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use crate::patience::{insist, patiently};
use whereabouts_core::CachedDescription;
use whereabouts_core::Digest;
use whereabouts_store::DescriptionCache;
use whereabouts_store::StoreError;

/// The pause between two looks for a description that another process is buying.
const PURCHASE_LOOK: Duration = Duration::from_millis(250);

/// After so long another process may buy what this one has not bought.
const LONGEST_PURCHASE: SignedDuration = SignedDuration::from_mins(10);

/// The right of this process to buy a description. It ends when this is dropped.
pub(super) struct DescriptionLease {
    cache: Arc<dyn DescriptionCache>,
    key: Option<Digest>,
}

impl DescriptionLease {
    /// The right to buy the description of that key; or the description, if another process was buying it.
    pub async fn begin(
        cache: &Arc<dyn DescriptionCache>,
        key: &Digest,
    ) -> Result<Result<Self, CachedDescription>, StoreError> {
        loop {
            let until = Timestamp::now().saturating_add(LONGEST_PURCHASE).unwrap_or(Timestamp::MAX);
            // Made before it is known to be granted: the answer may be lost on its way.
            let purchase = Self { cache: Arc::clone(cache), key: Some(*key) };
            let begun = patiently(|| cache.acquire_lease(key, until)).await?;
            let purchase = if begun { Some(purchase) } else { purchase.not_granted() };
            // Whoever was at it a moment ago may have ended just now.
            if let Some(known) = patiently(|| cache.description(key)).await? {
                return Ok(Err(known));
            }
            if let Some(purchase) = purchase {
                return Ok(Ok(purchase));
            }
            tokio::time::sleep(PURCHASE_LOOK).await;
        }
    }

    fn not_granted(mut self) -> Option<Self> {
        self.key = None;
        None
    }
}

impl Drop for DescriptionLease {
    fn drop(&mut self) {
        let Some(key) = self.key else { return };
        let cache = Arc::clone(&self.cache);
        tokio::spawn(async move {
            // Other processes wait for it, as long as this one is alive.
            let ended = || cache.release_lease(&key);
            insist("that a description is not being bought any more", ended).await;
        });
    }
}
