//! What calls to paid models cost.

use jiff::civil::Date;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{DayUsage, Usage};

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
