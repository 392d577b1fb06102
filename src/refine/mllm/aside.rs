//! What calls in progress may cost, among all processes that share a store.

use std::sync::Arc;

use jiff::civil::Date;

use crate::patience::insist;
use whereabouts_core::Spent;
use whereabouts_store::{SharedLimits, StoreError};

/// What is set aside for one call. Dropped unsettled, it goes back: the call was not answered.
pub(super) struct SpendReservation {
    shared: Arc<dyn SharedLimits>,
    day: Date,
    unneeded: Spent,
}

impl SpendReservation {
    /// Sets aside what a call may cost at the most; `None` if the limit of the day would be passed.
    pub async fn set(
        shared: Arc<dyn SharedLimits>,
        day: Date,
        most: Spent,
        limit: Spent,
    ) -> Result<Option<Self>, StoreError> {
        // On a task of its own: a job that is cancelled now must not leave something set aside.
        let setting = tokio::spawn(async move {
            let set = shared.reserve(day, most, limit).await?;
            Ok(set.then_some(Self { shared, day, unneeded: most }))
        });
        setting.await.unwrap_or_else(|error| Err(StoreError::Failed(error.to_string())))
    }

    /// Keeps what the call cost: it is taken away when it is written down as spent.
    pub fn settle(mut self, cost: Spent) {
        self.unneeded = self.unneeded.minus(cost);
    }
}

impl Drop for SpendReservation {
    fn drop(&mut self) {
        let (shared, day, unneeded) = (Arc::clone(&self.shared), self.day, self.unneeded);
        tokio::spawn(async move {
            insist("what a call did not need", || shared.release(day, unneeded)).await;
        });
    }
}
