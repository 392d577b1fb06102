//! What calls to a paid model cost.

use crate::DayUsage;

/// An amount spent on model calls.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Spent {
    /// Prompt and completion tokens.
    pub tokens: u64,
    /// Money, in the currency of the prices.
    pub money: f64,
}

impl From<&DayUsage> for Spent {
    fn from(day: &DayUsage) -> Self {
        let tokens = day.usage.prompt_tokens.saturating_add(day.usage.completion_tokens);
        Self { tokens, money: day.money }
    }
}

impl Spent {
    /// The sum of the two amounts.
    pub fn plus(self, other: Self) -> Self {
        Self { tokens: self.tokens.saturating_add(other.tokens), money: self.money + other.money }
    }

    /// The difference of the two amounts, saturating at zero.
    pub fn minus(self, other: Self) -> Self {
        Self {
            tokens: self.tokens.saturating_sub(other.tokens),
            money: (self.money - other.money).max(0.0),
        }
    }

    /// Whether the amount exceeds either limit. A limit of 0 means unlimited.
    pub fn exceeds(self, tokens: u64, money: f64) -> bool {
        (tokens > 0 && self.tokens > tokens) || (money > 0.0 && self.money > money)
    }
}
