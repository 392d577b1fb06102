//! Accounting of calls to external models.

use async_trait::async_trait;
use jiff::civil::Date;

use super::StoreError;
use whereabouts_core::DayUsage;

/// Usage and cost of external models, by day and map.
#[async_trait]
pub trait UsageStore: Send + Sync {
    /// Adds usage to the total of its day and map.
    async fn add_usage(&self, spent: DayUsage) -> Result<(), StoreError>;
    /// Returns the totals from a day on, by day and map, oldest first.
    async fn usage(&self, from: Date) -> Result<Vec<DayUsage>, StoreError>;
}
