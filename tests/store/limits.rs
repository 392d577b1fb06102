//! Limits that all processes share.

use jiff::civil::date;
use whereabouts_core::{DayUsage, Spent, Usage};
use whereabouts_store::{SharedLimits, TokenRequest, UsageStore};

use crate::processes::{database, long_lived};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_rate_limit_is_shared_by_all_processes() {
    let database = database().await;
    let processes = [database.open(long_lived()).await, database.open(long_lived()).await];
    // Next to nothing is refilled while this runs.
    let draw = TokenRequest { per_minute: 0.01, required: 0.001, amount: 0.001 };
    let mut taken = 0;
    for number in 0..30 {
        let drawn = processes[number % 2]
            .take_tokens("key", [draw, TokenRequest::UNLIMITED])
            .await
            .unwrap();
        taken += usize::from(drawn.granted);
        assert!(drawn.granted || drawn.remaining[0] < 0.002);
    }
    assert!((9..=12).contains(&taken), "{taken}");
    // Tokens that are returned are available to others, up to those of a minute.
    let back = TokenRequest { required: f64::MIN, amount: -1.0, ..draw };
    processes[0].take_tokens("key", [back, TokenRequest::UNLIMITED]).await.unwrap();
    let drawn = processes[1].take_tokens("key", [draw, TokenRequest::UNLIMITED]).await.unwrap();
    assert!(drawn.granted && drawn.remaining[0] < 0.01, "{drawn:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_daily_budget_is_shared_by_all_processes() {
    let database = database().await;
    let processes = [database.open(long_lived()).await, database.open(long_lived()).await];
    let (day, limit) = (date(2026, 5, 1), Spent { tokens: 1000, money: 0.0 });
    let tokens = |tokens| Spent { tokens, money: 0.0 };
    assert!(processes[0].reserve(day, tokens(600), limit).await.unwrap());
    assert!(!processes[1].reserve(day, tokens(600), limit).await.unwrap());
    // The call used 100 tokens: 500 are released, and 100 are recorded as usage.
    processes[0].release(day, tokens(500)).await.unwrap();
    let usage = Usage { calls: 1, prompt_tokens: 80, completion_tokens: 20, ..Usage::default() };
    let spent = DayUsage { date: day, map: "m".parse().unwrap(), usage, money: 0.0 };
    processes[0].add_usage(spent).await.unwrap();
    assert!(!processes[1].reserve(day, tokens(901), limit).await.unwrap());
    assert!(processes[1].reserve(day, tokens(900), limit).await.unwrap());
    assert!(!processes[0].reserve(day, tokens(1), limit).await.unwrap());
    // Another day, and no limit at all.
    assert!(processes[0].reserve(date(2026, 5, 2), tokens(1000), limit).await.unwrap());
    assert!(processes[0].reserve(day, tokens(5000), tokens(0)).await.unwrap());
}
