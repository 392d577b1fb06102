//! What calls to models outside have cost.

use jiff::civil::Date;
use jiff::{SignedDuration, Timestamp};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Service, ServiceError};
use crate::domain::{DayUsage, MapName, Usage, utc_day};

/// What calls to models outside have cost.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct UsageReport {
    /// The budget of today; null if the refiner asks no model outside.
    #[schema(nullable)]
    pub today: Option<Today>,
    /// By day and map, the newest day first. A day on which nothing was asked has no entry.
    pub days: Vec<DayUsage>,
    /// All of `days` together.
    pub total: Total,
}

/// The budget of today.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct Today {
    /// Today, in UTC.
    pub date: Date,
    /// Tokens spent in all maps, calls in progress included with the most they may cost.
    pub tokens: u64,
    /// The most tokens; null for no limit.
    pub token_limit: Option<u64>,
    /// Money spent in all maps, in the currency of the configured prices.
    pub money: f64,
    /// The most money; null for no limit.
    pub money_limit: Option<f64>,
    /// Whether calls are suspended because the last ones failed.
    pub suspended: bool,
}

/// A sum over days and maps.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
pub struct Total {
    /// The calls and their tokens.
    pub usage: Usage,
    /// Money, in the currency of the configured prices.
    pub money: f64,
}

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
        let levels = self.refiner.as_ref()?.levels()?;
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
