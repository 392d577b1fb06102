//! Reservations of spend among all processes that share a store.

use std::sync::Arc;

use jiff::civil::Date;
use whereabouts_core::Spent;
use whereabouts_store::{SharedLimits, StoreError};

use crate::store_retry::retry_write;

/// The reserved cost of one call. Released if it is dropped unsettled, because the call was not answered.
pub(super) struct SharedReservation {
    shared: Arc<dyn SharedLimits>,
    day: Date,
    /// The part that is released when this is dropped.
    unused: Spent,
}

impl SharedReservation {
    /// Reserves the most that a call may cost; `None` if that would exceed the limit of the day.
    pub async fn reserve(
        shared: Arc<dyn SharedLimits>,
        day: Date,
        most: Spent,
        limit: Spent,
    ) -> Result<Option<Self>, StoreError> {
        // Runs as its own task, so that a job cancelled at this moment does not leak the reservation.
        let reserving = tokio::spawn(async move {
            let reserved = shared.reserve(day, most, limit).await?;
            Ok(reserved.then_some(Self { shared, day, unused: most }))
        });
        reserving.await.unwrap_or_else(|error| Err(StoreError::Failed(error.to_string())))
    }

    /// Keeps the actual cost reserved until it is recorded as spent, and releases the rest.
    pub fn settle(mut self, cost: Spent) {
        self.unused = self.unused.minus(cost);
    }
}

impl Drop for SharedReservation {
    fn drop(&mut self) {
        let (shared, day, unused) = (Arc::clone(&self.shared), self.day, self.unused);
        tokio::spawn(async move {
            let release = || shared.release(day, unused);
            retry_write("the release of a spend reservation", release).await;
        });
    }
}
