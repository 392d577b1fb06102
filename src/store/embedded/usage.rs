//! Usage of external models: one record for each day and map, kept for a configured number of days.

use std::sync::Arc;

use async_trait::async_trait;
use jiff::civil::Date;

use super::super::{StoreError, UsageStore};
use super::trees::{decode, failed, get, put};
use super::{EmbeddedStore, blocking};
use whereabouts_core::DayUsage;

/// The key sorts by day, because a date has a fixed number of digits.
fn key(of: &DayUsage) -> Vec<u8> {
    format!("{}/{}", of.date, of.map.as_str()).into_bytes()
}

#[async_trait]
impl UsageStore for EmbeddedStore {
    async fn add_usage(&self, spent: DayUsage) -> Result<(), StoreError> {
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    let key = key(&spent);
                    let sum = match get::<DayUsage>(&trees.usage, &key)? {
                        Some(total) => DayUsage {
                            usage: total.usage + spent.usage,
                            money: total.money + spent.money,
                            ..spent
                        },
                        None => spent,
                    };
                    put(&trees.usage, &key, &sum)
                },
                |()| {},
            )
            .await
    }

    async fn usage(&self, from: Date) -> Result<Vec<DayUsage>, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || {
            let values = inner.trees.usage.range(from.to_string().into_bytes()..).values();
            values.map(|value| decode(&value.map_err(failed)?)).collect()
        })
        .await
    }
}
