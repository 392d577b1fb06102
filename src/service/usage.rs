//! Reports of what calls to paid models cost. Spending and its budget are for the refiner.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use super::ServiceError;
use whereabouts_api::{Today, Total, UsageReport};
use whereabouts_core::{MapName, ModelServer, utc_day};
use whereabouts_refine::{PaidCalls, Refiner};
use whereabouts_store::UsageStore;

/// Reports what calls to paid models cost.
pub struct UsageReports {
    /// Usage by day and map.
    pub store: Arc<dyn UsageStore>,
    /// The refiner, which knows today's budget.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// Retention of usage, in days.
    pub keep_days: u32,
}

impl UsageReports {
    /// Reports the cost of the last `days` days, today included, of one map or of all.
    pub async fn report(
        &self,
        map: Option<MapName>,
        days: u32,
    ) -> Result<UsageReport, ServiceError> {
        if days == 0 || days > self.keep_days {
            return Err(ServiceError::unprocessable(format!(
                "days is {days}; it must be 1 to {}, the days for which usage is kept (data.usage_days)",
                self.keep_days
            )));
        }
        let date = utc_day(Timestamp::now());
        let from = date.saturating_sub(SignedDuration::from_hours(24 * i64::from(days - 1)));
        let mut spent = self.store.usage(from).await?;
        spent.retain(|spent| map.as_ref().is_none_or(|map| *map == spent.map));
        spent.reverse();
        let total = spent.iter().fold(Total::default(), |sum, spent| Total {
            usage: sum.usage + spent.usage,
            money: sum.money + spent.money,
        });
        Ok(UsageReport { today: self.today(), days: spent, total })
    }

    /// Returns what is known about the servers of the refiner's models, if it calls any.
    pub fn model_servers(&self) -> Vec<ModelServer> {
        let calls = self.refiner.as_ref().and_then(|refiner| refiner.paid_calls());
        calls.map(PaidCalls::servers).unwrap_or_default()
    }

    /// Returns today's spend and budget, if the refiner calls a paid model.
    pub fn today(&self) -> Option<Today> {
        let levels = self.refiner.as_ref()?.paid_calls()?.levels();
        Some(Today {
            date: utc_day(Timestamp::now()),
            tokens: levels.spent_today.tokens,
            token_limit: Some(levels.limit.tokens).filter(|limit| *limit > 0),
            money: levels.spent_today.money,
            money_limit: Some(levels.limit.money).filter(|limit| *limit > 0.0),
            suspended: levels.suspended,
        })
    }
}
