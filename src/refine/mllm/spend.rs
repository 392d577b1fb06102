//! Paid calls: reserved before they are made, settled by their bill, and recorded in the store.

use std::sync::Arc;

use jiff::Timestamp;
use whereabouts_core::{CachedDescription, DayUsage, Digest, Spent, Usage, utc_day};

use super::MllmRefiner;
use super::budget::Exceeded;
use super::client::{Answer, Call};
use super::describe::transient;
use super::reservation::SharedReservation;
use super::retry::CallError;
use super::run::RefineRun;
use crate::store_retry::retry_write;

/// Returns the cost of a call as jobs report it.
pub(super) fn cost_of(answer: &Answer) -> Usage {
    Usage {
        calls: 1,
        cached: 0,
        prompt_tokens: answer.prompt_tokens,
        completion_tokens: answer.completion_tokens,
        estimated: answer.estimated.into(),
    }
}

impl MllmRefiner {
    /// Makes a call if the budgets of the job and the day allow the longest answer it may get.
    pub(super) async fn paid_call(
        &self,
        run: &RefineRun<'_>,
        call: &Call<'_>,
    ) -> Result<Answer, CallError> {
        let reserved = run
            .budget
            .reserve(call.prompt_tokens, self.client.max_tokens(), Timestamp::now())
            .map_err(|exceeded| match exceeded {
                Exceeded::Job => CallError::JobSpent,
                Exceeded::Day => CallError::DaySpent,
            })?;
        let shared = self.reserve_shared(call.prompt_tokens).await?;
        let answer = self.client.call(call).await?;
        reserved.settle(answer.prompt_tokens, answer.completion_tokens);
        if let Some(shared) = shared {
            shared.settle(self.budget.cost(answer.prompt_tokens, answer.completion_tokens));
        }
        run.charge(cost_of(&answer));
        Ok(answer)
    }

    /// Reserves the cost of a call among all processes; `None` if there is one process or no daily limit.
    async fn reserve_shared(
        &self,
        prompt_tokens: u64,
    ) -> Result<Option<SharedReservation>, CallError> {
        let limit = self.daily_limit();
        let Some(shared) = self.shared.clone().filter(|_| limit != Spent::default()) else {
            return Ok(None);
        };
        let most = self.budget.cost(prompt_tokens, self.client.max_tokens());
        let today = utc_day(Timestamp::now());
        let reserved = SharedReservation::reserve(shared, today, most, limit).await;
        reserved.map_err(transient)?.map(Some).ok_or(CallError::DaySpent)
    }

    /// Returns the limits of a day; 0 stands for none.
    pub(super) fn daily_limit(&self) -> Spent {
        Spent { tokens: self.settings.tokens_per_day, money: self.settings.money_per_day }
    }

    /// Records what was spent, and the description that was bought for it. Runs as its own task, so that
    /// a job cancelled at this moment does not lose them.
    pub(super) async fn record_spend(
        &self,
        run: &RefineRun<'_>,
        usage: Usage,
        bought: Option<(Digest, CachedDescription)>,
    ) {
        let (cache, accounts) = (Arc::clone(&self.cache), Arc::clone(&self.usage));
        let money = self.budget.cost(usage.prompt_tokens, usage.completion_tokens).money;
        let date = utc_day(Timestamp::now());
        let spent = DayUsage { date, map: run.input.map.name.clone(), usage, money };
        let recording = tokio::spawn(async move {
            let description = async {
                if let Some((key, description)) = bought {
                    let keep = || cache.keep_description(key, description.clone());
                    retry_write("a description; it will be bought again", keep).await;
                }
            };
            let account = retry_write("what was spent", || accounts.add_usage(spent.clone()));
            tokio::join!(description, account)
        });
        if let Err(error) = recording.await {
            tracing::error!(%error, "what was bought could not be recorded");
        }
    }
}
