//! Usage and cost of external models.

use jiff::civil::Date;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{DayUsage, Usage};

/// Usage and cost of calls to external models.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct UsageReport {
    /// Today's budget; null if the refiner does not call an external model.
    #[schema(nullable)]
    pub today: Option<Today>,
    /// Usage by day and map, newest day first. Days without calls have no entry.
    pub days: Vec<DayUsage>,
    /// Sum over `days`.
    pub total: Total,
}

/// Today's budget.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct Today {
    /// Today's date in UTC.
    pub date: Date,
    /// Tokens spent in all maps, including the reservations of calls in progress.
    pub tokens: u64,
    /// Daily token limit; null for unlimited.
    pub token_limit: Option<u64>,
    /// Money spent in all maps, in the currency of the configured prices.
    pub money: f64,
    /// Daily money limit; null for unlimited.
    pub money_limit: Option<f64>,
    /// Whether the circuit breaker has suspended calls because recent ones failed.
    pub suspended: bool,
}

/// A sum over days and maps.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
pub struct Total {
    /// The calls and their tokens.
    pub usage: Usage,
    /// Cost in the currency of the configured prices.
    pub money: f64,
}
