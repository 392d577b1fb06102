//! What calls in progress may cost, among all processes that share a store.

use std::sync::Arc;

use jiff::civil::Date;

use super::budget::Spent;
use super::patience::insist;
use crate::store::{Purse, SharedLimits, StoreError};

/// What is set aside for one call. Dropped unsettled, it goes back: the call was not answered.
pub(super) struct Aside {
    shared: Arc<dyn SharedLimits>,
    day: Date,
    unneeded: Purse,
}

impl Aside {
    /// Sets aside what a call may cost at the most; `None` if the limit of the day would be passed.
    pub async fn set(
        shared: Arc<dyn SharedLimits>,
        day: Date,
        most: Spent,
        limit: Spent,
    ) -> Result<Option<Self>, StoreError> {
        let unneeded = purse(most);
        // On a task of its own: a job that is cancelled now must not leave something set aside.
        let setting = tokio::spawn(async move {
            let set = shared.set_aside(day, unneeded, purse(limit)).await?;
            Ok(set.then_some(Self { shared, day, unneeded }))
        });
        setting.await.unwrap_or_else(|error| Err(StoreError::Failed(error.to_string())))
    }

    /// Keeps what the call cost: it is taken away when it is written down as spent.
    pub fn settle(mut self, cost: Spent) {
        self.unneeded.tokens = self.unneeded.tokens.saturating_sub(cost.tokens);
        self.unneeded.money = (self.unneeded.money - cost.money).max(0.0);
    }
}

impl Drop for Aside {
    fn drop(&mut self) {
        let (shared, day, unneeded) = (Arc::clone(&self.shared), self.day, self.unneeded);
        tokio::spawn(async move {
            insist("what a call did not need", || shared.give_back(day, unneeded)).await;
        });
    }
}

fn purse(spent: Spent) -> Purse {
    Purse { tokens: spent.tokens, money: spent.money }
}
