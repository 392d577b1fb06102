//! What calls to models outside have cost.

use jiff::{SignedDuration, Timestamp};

use super::{Service, ServiceError};
use whereabouts_api::{Today, Total, UsageReport};
use whereabouts_core::{MapName, utc_day};

impl Service {
    /// What the last `days` days have cost (today included), in one map or in all.
    pub async fn usage(
        &self,
        map: Option<MapName>,
        days: u32,
    ) -> Result<UsageReport, ServiceError> {
        if days == 0 || days > self.settings.usage_days {
            return Err(ServiceError::unprocessable(format!(
                "days is {days}; it must be 1 to {}, for as long as usage is kept (data.usage_days)",
                self.settings.usage_days
            )));
        }
        let date = utc_day(Timestamp::now());
        let from = date.saturating_sub(SignedDuration::from_hours(24 * i64::from(days - 1)));
        let mut spent = self.accounts.usage(from).await?;
        spent.retain(|spent| map.as_ref().is_none_or(|map| *map == spent.map));
        spent.reverse();
        let total = spent.iter().fold(Total::default(), |sum, spent| Total {
            usage: sum.usage + spent.usage,
            money: sum.money + spent.money,
        });
        Ok(UsageReport { today: self.today(), days: spent, total })
    }

    /// The budget of today, if the refiner asks models outside.
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
